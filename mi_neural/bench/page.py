"""One self-contained HTML page of a comparison. Each scene begins with pictures side by side, which are zoomed
together, and one plot of the error over time. Tables and more curves follow.

The page holds everything: pictures as data URLs, curves as inline SVG, style and script inline. It loads nothing.
"""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path

import numpy as np

from mi_neural.image import exr

from . import curves
from .benchmark import Picture
from .reference import Reference
from .report import (
    Report,
    SceneResult,
    best,
    best_of_summary,
    errors_of,
    html_table,
    name_of,
    number,
    split_table,
    summary,
    table,
)

#: What the modes of rows mean, in the order in which a page shows them.
MODE_TEXT = {
    "one-shot": "One image, from an empty cache: wall time after kernels are compiled, training included",
    "sample": "Frames of one sample in a running sequence, with a cache that was trained before",
    "steady": "Frames of equal time, denoising included, in a running sequence, with a cache that was trained before",
}
#: Modes whose errors are drawn together, by the name of the drawing.
CURVES = {"one-shot": ("one-shot",), "unfinished": ("curve",), "steady": ("sample", "steady")}
CURVE_TEXT = {
    "one-shot": "Error of finished images over their budget",
    "unfinished": "Error of the longest image while it was rendered, after 1, 2, 4, ... samples",
    "steady": "Error of frames over their time",
}
#: Bytes of a page that the pictures of a scene may take, so that a page of three scenes stays below 8 MB: a third of
#: that, without 0.4 MB of curves and tables. The files beside the page hold the pictures exactly.
SCENE_BYTES = 8e6 / 3 - 0.4e6
#: Qualities of WebP that are tried for a picture; where none is small enough, the picture is halved.
QUALITIES = (90, 75, 60, 40)
#: Below so many pixels along its shorter side no picture is halved.
SMALLEST = 64


def style() -> str:
    """The page's style sheet."""
    return Path(__file__).with_name("page.css").read_text(encoding="utf-8")


def curves_of(scene: SceneResult) -> dict[str, str]:
    """Drawings of a scene as SVG, by their name; those with nothing to draw are left out."""
    drawn = {kind: curves.svg(scene.rows, modes) for kind, modes in CURVES.items()}
    return {kind: svg for kind, svg in drawn.items() if svg}


def drawings(report: Report) -> dict[tuple[str, str], str]:
    """Drawings of all scenes, by the names of scene and drawing."""
    return {(scene.name, kind): svg for scene in report.scenes for kind, svg in curves_of(scene).items()}


# ------------------------------------------------------------------------------------------------------------------
# Pictures


def picture_bytes(n_kinds: int) -> int:
    """Bytes that an image may take where a scene has so many pictures, each with its FLIP map, and a reference."""
    return int(0.75 * SCENE_BYTES / (1 + 2 * n_kinds))  # a data URL has four letters for three bytes


def entry(picture: Picture, exposure: float, most: int | None = None) -> dict[str, object]:
    """What the viewer shows of a picture: name, caption, by what it can be chosen, image and FLIP map.

    most   bytes of an image, see :func:`data_url`
    """
    row = picture.row
    kind = row.mode + (f" {row.budget_seconds:g} s" if row.budget_seconds else "")
    errors = [
        f"{title} {number(value)}"
        for title, value in (("trimmed relMSE", row.relmse_trimmed), ("FLIP", row.flip), ("flicker", row.flicker))
        if value is not None
    ]
    return {
        "name": f"{name_of(row)}, {kind}",
        "caption": ", ".join([*([f"{number(row.spp)} spp"] if row.spp else []), *errors]),
        "integrator": row.label,
        "kind": kind,
        "denoiser": "denoised" if row.denoised else "raw",
        "image": data_url(exr.to_srgb8(picture.rgb, exposure), most),
        "error": None if picture.flip_map is None else data_url(flip_colours(picture.flip_map), most),
    }


def reference_entry(reference: Reference, exposure: float, most: int | None = None) -> dict[str, object]:
    """The reference as the viewer's first picture."""
    spp, error = reference.metadata.get("spp"), reference.standard_error()
    caption = [f"{spp} spp"] if spp else []
    caption += [f"standard error of a pixel {100 * error:.2g} %"] if error is not None else []
    image = data_url(exr.to_srgb8(reference.rgb, exposure), most)
    return {"name": "reference", "caption": ", ".join(caption), "image": image, "error": None}


def flip_colours(flip_map: np.ndarray) -> np.ndarray:
    """A FLIP map in [0, 1] in the magma colours its authors use, uint8 of shape (height, width, 3)."""
    from matplotlib import colormaps

    return colormaps["magma"](np.clip(flip_map, 0.0, 1.0), bytes=True)[..., :3].copy()


def data_url(rgb8: np.ndarray, most: int | None = None) -> str:
    """Pixels as a data URL: PNG, or with `most` WebP of at most so many bytes, exact where that is small enough."""
    if most is None:
        return "data:image/png;base64," + base64.b64encode(exr.png_bytes(rgb8)).decode()
    return "data:image/webp;base64," + base64.b64encode(_webp(rgb8, most)).decode()


def _webp(rgb8: np.ndarray, most: int) -> bytes:
    from PIL import Image  # comes with matplotlib

    image = Image.fromarray(rgb8)

    def encoded(**options) -> bytes:
        buffer = io.BytesIO()
        image.save(buffer, "WEBP", method=2, **options)
        return buffer.getvalue()

    if rgb8.nbytes < 8 * most and len(exact := encoded(lossless=True, quality=20)) <= most:
        return exact
    while True:
        for quality in QUALITIES:
            if len(found := encoded(quality=quality)) <= most:
                return found
        if min(image.size) < 2 * SMALLEST:
            return found
        image = image.reduce(2)


# ------------------------------------------------------------------------------------------------------------------
# The page


def page(report: Report, drawn: dict[tuple[str, str], str]) -> str:
    """The report as one HTML document; `drawn` holds the curves by scene and kind."""
    several = len(report.scenes) > 1
    title = "Speed against error" if several else f"{report.scenes[0].name}: speed against error"
    contents = [(f"scene-{k}", scene.name) for k, scene in enumerate(report.scenes)]
    contents += [("summary", "All scenes")] if several else []
    sections = []
    for k, scene in enumerate(report.scenes):
        sections.append(_scene(scene, k, {kind: svg for (name, kind), svg in drawn.items() if name == scene.name}))
    sections += [_summary(report)] if several else []
    environment = "\n".join(f"{k:16} {v}" for k, v in report.environment.items())
    pictures = json.dumps([{"size": s.size, "pictures": s.entries} for s in report.scenes]).replace("</", "<\\/")
    links = "".join(f'<a href="#{at}">{html.escape(text)}</a>' for at, text in [*contents, ("made", "How it was made")])
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width">',
            f"<title>{html.escape(title)}</title>\n<style>\n{style()}</style></head><body>",
            f"<h1>{html.escape(title)}</h1>",
            _notes(report.notes),
            f"<nav>{links}</nav>",
            *sections,
            '<section id="made"><h2>How it was made</h2>',
            f"<pre>{html.escape(report.command)}</pre>\n<pre>{html.escape(environment)}</pre></section>",
            f'<script type="application/json" id="pictures">{pictures}</script>',
            f"<script>\n{Path(__file__).with_name('page.js').read_text(encoding='utf-8')}</script>\n</body></html>\n",
        ]
    )


def _notes(notes: list[str]) -> str:
    return f'<ul class="notes">{"".join(f"<li>{html.escape(n)}</li>" for n in notes)}</ul>' if notes else ""


def _wide(cells: list[list[str]], marked: set[tuple[int, int]] = frozenset()) -> str:
    return f'<div class="wide">{html_table(cells, marked)}</div>'


def _summary(report: Report) -> str:
    parts = [
        '<section id="summary"><h2>All scenes</h2>',
        f"<p>Errors: {errors_of(report)}. The factor is the trimmed relMSE of the first integrator, denoised or not as "
        "in this line, over that of this line (geometric mean over the scenes). The least error of a column is "
        'marked.</p><div class="tables">',
    ]
    for title, cells in summary(report):
        parts.append(f"<div><h3>{html.escape(title)}</h3>{_wide(cells, best_of_summary(cells))}</div>")
    return "\n".join(parts) + "</div></section>"


def _scene(scene: SceneResult, k: int, drawn: dict[str, str]) -> str:
    parts = [f'<section id="scene-{k}"><h2>{html.escape(scene.name)}, {scene.size[0]}x{scene.size[1]}</h2>']
    if scene.entries:
        parts.append(
            f'<div class="viewer" id="viewer-{k}"></div><p class="about">Click a picture first. Then the wheel or a '
            "double-click zooms, and dragging moves; all pictures follow.</p>"
        )
    if overview := curves.overview(scene.rows):
        parts.append(f'<h3>Error over time</h3><div class="curves overview">{overview}</div>')
    parts.append(_notes(scene.notes))
    for mode, text in MODE_TEXT.items():
        if of_mode := [g for g in scene.groups if g.first.mode == mode]:
            parts.append(f"<h3>{html.escape(text)}</h3>{_wide(table(of_mode), best(of_mode))}")
    if frames := split_table(scene.groups):
        parts.append(
            "<h3>Parts of the time of a one-sample frame, in ms</h3>" + _wide(frames) + '<p class="about">'
            "Dr.Jit times the kernels. One fused kernel holds queries and tracing, so the time of queries is their "
            "number times what one costs in a kernel of its own. Python: wall time in which no kernel runs.</p>"
        )
    for kind, svg in drawn.items():
        parts.append(f'<h3>{html.escape(CURVE_TEXT[kind])}</h3><div class="curves">{svg}</div>')
    return "\n".join(part for part in parts if part) + "</section>"
