"""Tables, curves, and one self-contained HTML page out of benchmark rows.

The page holds everything: pictures as base64 PNG, curves as inline SVG, style and script inline. It loads nothing.
"""

from __future__ import annotations

import base64
import html
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import exr
from .benchmark import Picture, Row, plain
from .reference import Reference

#: Headings and cells of every table, in order.
COLUMNS = (
    ("integrator", lambda r: r.label + (" + denoiser" if r.denoised else "")),
    ("mode", lambda r: r.mode),
    ("budget s", lambda r: number(r.budget_seconds)),
    ("spp", lambda r: number(r.spp)),
    ("train s", lambda r: number(r.seconds_train)),
    ("render s", lambda r: number(r.seconds_render)),
    ("denoise s", lambda r: number(r.seconds_denoise) if r.denoised else ""),
    ("ns/sample", lambda r: number(r.ns_per_sample)),
    ("relMSE trimmed", lambda r: number(r.relmse_trimmed)),
    ("relMSE", lambda r: number(r.relmse)),
    ("FLIP", lambda r: number(r.flip)),
    ("flicker", lambda r: number(r.flicker)),
)

MODE_TEXT = {
    "one-shot": "One image from nothing: wall time from compiled kernels, training included",
    "sample": "One-sample frames of a running sequence, trained before",
    "steady": "Frames of a running sequence at equal time, trained before; the denoiser's time is part of the frame",
    "spp": "A fixed number of samples",
}


@dataclass
class Report:
    """What a comparison found. `notes` are lines a reader must know, `command` is what was typed."""

    scene: str
    size: tuple[int, int]
    command: str
    environment: dict[str, object]
    rows: list[Row]
    pictures: list[Picture]
    reference: Reference | None
    notes: list[str]


def table(rows: Iterable[Row]) -> list[list[str]]:
    """Cells as text, the headings first; columns that are empty in every row are left out."""
    cells = [[name for name, _ in COLUMNS], *([cell(r) for _, cell in COLUMNS] for r in rows)]
    kept = [k for k in range(len(COLUMNS)) if any(line[k] for line in cells[1:])]
    return [[line[k] for k in kept] for line in cells]


def markdown(cells: list[list[str]]) -> str:
    """A table, its headings first, in Markdown."""
    head, *body = cells
    lines = [head, ["---"] + ["---:"] * (len(head) - 1), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines) + "\n"


def results(report: Report) -> dict[str, object]:
    """What `results.json` holds."""
    reference = report.reference
    return plain(
        {
            "scene": report.scene,
            "size": report.size,
            "command": report.command,
            "environment": report.environment,
            "reference": reference
            and {
                "path": str(reference.path),
                "noise_relmse": reference.noise_floor(),
                "variance_subtracted": reference.variance is not None,
                **reference.metadata,
            },
            "notes": report.notes,
            "rows": [row.to_json() for row in report.rows],
        }
    )


def write(report: Report, folder: Path) -> None:
    """Write `report.html`, `table.md` and `results.json`, each whole or not at all."""
    exr.write_text(folder / "results.json", json.dumps(results(report), indent=1) + "\n")
    exr.write_text(folder / "table.md", markdown(table(report.rows)))
    exr.write_text(folder / "report.html", page(report))


# ------------------------------------------------------------------------------------------------------------------
# Curves


def curves(rows: list[Row], modes: tuple[str, ...]) -> str | None:
    """Errors over time, log-log, as inline SVG: a line per integrator, dashed where denoised. None: nothing to draw."""
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    lines: dict[tuple[str, bool], list[Row]] = {}
    for row in rows:
        if row.mode in modes and row.relmse_trimmed is not None:
            lines.setdefault((row.label, row.denoised), []).append(row)
    if not lines:
        return None

    quantities = [("relmse_trimmed", "trimmed relMSE"), ("flip", "HDR-FLIP")]
    if any(row.flicker is not None for line in lines.values() for row in line):
        quantities.append(("flicker", "flicker (SMAPE between frames)"))
    labels = list(dict.fromkeys(label for label, _ in lines))

    figure = Figure(figsize=(4.6 * len(quantities), 3.6), layout="constrained")
    for k, (name, title) in enumerate(quantities):
        axes = figure.add_subplot(1, len(quantities), k + 1)
        for (label, denoised), line in lines.items():
            points = sorted((r.seconds_total, getattr(r, name)) for r in line if getattr(r, name))
            if points:
                axes.plot(
                    *zip(*points, strict=True),
                    color=f"C{labels.index(label) % 10}",
                    linestyle="--" if denoised else "-",
                    marker="o",
                    markersize=4,
                    label=label + (" + denoiser" if denoised else ""),
                )
        axes.set(xscale="log", yscale="log", title=title, xlabel="seconds")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(True, which="both", alpha=0.25)
    axes.legend(fontsize=8)

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        FigureCanvasSVG(figure).print_svg(buffer)
    return buffer.getvalue()[buffer.getvalue().index("<svg") :]


def flip_colours(flip_map: np.ndarray) -> np.ndarray:
    """A FLIP map in [0, 1] in the magma colours its authors use, uint8 of shape (height, width, 3)."""
    from matplotlib import colormaps

    return colormaps["magma"](np.clip(flip_map, 0.0, 1.0), bytes=True)[..., :3].copy()


# ------------------------------------------------------------------------------------------------------------------
# The page


def page(report: Report) -> str:
    """The report as one HTML document."""
    pictures = _pictures(report)
    sections = []
    for modes in (("one-shot",), ("sample", "steady"), ("spp",)):
        rows = [r for r in report.rows if r.mode in modes]
        if not rows:
            continue
        for mode in modes:
            if of_mode := [r for r in rows if r.mode == mode]:
                sections.append(f"<h2>{html.escape(MODE_TEXT[mode])}</h2>\n{html_table(table(of_mode))}")
        if svg := curves(report.rows, modes):
            sections.append(f'<div class="curves">{svg}</div>')
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in report.notes)
    environment = "\n".join(f"{k:16} {v}" for k, v in report.environment.items())
    return PAGE.format(
        style=STYLE,
        title=html.escape(f"{report.scene} {report.size[0]}x{report.size[1]}"),
        sections="\n".join(sections),
        viewer=VIEWER if pictures else "",
        notes=f"<ul>{notes}</ul>" if notes else "",
        command=html.escape(report.command),
        environment=html.escape(environment),
        pictures=json.dumps(pictures).replace("</", "<\\/"),
    )


def _pictures(report: Report) -> list[dict[str, object]]:
    """What the viewer shows: name, caption, picture, FLIP map. All at the exposure of the first."""
    exposure = None
    if report.reference is not None:
        exposure = exr.automatic_exposure(report.reference.rgb)
    elif report.pictures:
        exposure = exr.automatic_exposure(report.pictures[0].rgb)

    entries = []
    if report.reference is not None:
        spp = report.reference.metadata.get("spp")
        entries.append(
            {
                "name": "reference",
                "caption": f"{spp} samples a pixel" if spp else "",
                "image": _data_url(exr.to_srgb8(report.reference.rgb, exposure)),
                "flip": None,
            }
        )
    for picture in report.pictures:
        row = picture.row
        budget = f" {row.budget_seconds:g} s" if row.budget_seconds else ""
        errors = [
            f"{title} {number(value)}"
            for title, value in (("trimmed relMSE", row.relmse_trimmed), ("FLIP", row.flip), ("flicker", row.flicker))
            if value is not None
        ]
        entries.append(
            {
                "name": f"{row.label}{' + denoiser' if row.denoised else ''}, {row.mode}{budget}",
                "caption": ", ".join([f"{number(row.spp)} spp", *errors]),
                "image": _data_url(exr.to_srgb8(picture.rgb, exposure)),
                "flip": None if picture.flip_map is None else _data_url(flip_colours(picture.flip_map)),
            }
        )
    return entries


def _data_url(rgb8: np.ndarray) -> str:
    return "data:image/png;base64," + base64.b64encode(exr.png_bytes(rgb8)).decode()


def html_table(cells: list[list[str]]) -> str:
    """A table, its headings first, in HTML."""
    head, *body = cells

    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(c)}</{tag}>" for c in cells) + "</tr>"

    return "<table>" + line(head, "th") + "".join(line(cells, "td") for cells in body) + "</table>"


def number(value: float | int | None) -> str:
    """Three significant digits, no exponent where it can be helped, empty for None."""
    if value is None:
        return ""
    if value == 0 or isinstance(value, int) or float(value).is_integer():
        return str(int(value))
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1200px; padding: 0 1rem; color: #222 }
h1 { font-size: 1.6rem } h2 { font-size: 1.15rem; margin-top: 2rem }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 14px }
th, td { padding: .25rem .7rem; text-align: right; border-bottom: 1px solid #ddd }
th:first-child, td:first-child { text-align: left } tr:hover td { background: #f4f6ff }
.curves svg { max-width: 100%; height: auto }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 13px }
.controls label { margin-right: 1rem }
#stage { position: relative; display: inline-block; cursor: ew-resize; margin-top: .6rem }
#stage { max-width: 100%; overflow: auto }
#stage img { display: block; image-rendering: pixelated; user-select: none; touch-action: none }
#imgL { position: absolute; inset: 0 }
#bar { position: absolute; top: 0; width: 1px; background: #fff; box-shadow: 0 0 3px #000; pointer-events: none }
#gallery { display: flex; flex-wrap: wrap; gap: 1rem }
#gallery figure { margin: 0; width: 270px; cursor: pointer } #gallery img { width: 100%; display: block }
#gallery figcaption { font-size: 12.5px; line-height: 1.35 }
"""

VIEWER = """<h2>Pictures</h2>
<p>Drag across the picture to compare. Keys 1 to 9 choose the right-hand picture; F switches to FLIP error maps.</p>
<div class="controls">
<label>left <select id="left"></select></label> <label>right <select id="right"></select></label>
<label><input type="checkbox" id="flip"> FLIP error maps</label>
<label>size <input type="range" id="zoom" min="1" max="4" step="0.5" value="1"></label>
</div>
<div id="stage"><img id="imgR" alt="right picture"><img id="imgL" alt="left picture"><div id="bar"></div></div>
<p id="captions"></p>
<div id="gallery"></div>
"""

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}: speed against error</title>
<style>{style}</style></head><body>
<h1>{title}</h1>
{notes}
{sections}
{viewer}
<h2>How this was made</h2>
<pre>{command}</pre>
<pre>{environment}</pre>
<script>
const pictures = {pictures};
const $ = id => document.getElementById(id);
if (pictures.length) {{
  let cut = 0.5;
  for (const id of ["left", "right"])
    pictures.forEach((p, k) => $(id).add(new Option(p.name, k)));
  $("left").value = 0;
  $("right").value = Math.min(1, pictures.length - 1);
  const source = p => $("flip").checked && p.flip ? p.flip : p.image;
  function show() {{
    const l = pictures[$("left").value], r = pictures[$("right").value];
    $("imgL").src = source(l);
    $("imgR").src = source(r);
    $("captions").textContent = "left: " + l.name + " (" + l.caption + "); right: " + r.name + " (" + r.caption + ")";
  }}
  function wipe() {{
    const w = $("imgR").clientWidth;
    $("imgL").style.clipPath = "inset(0 " + (1 - cut) * 100 + "% 0 0)";
    $("bar").style.left = cut * w + "px";
    $("bar").style.height = $("imgR").clientHeight + "px";
  }}
  function zoom() {{
    for (const id of ["imgL", "imgR"]) $(id).style.width = $("imgR").naturalWidth * $("zoom").value + "px";
    wipe();
  }}
  $("stage").addEventListener("pointermove", e => {{
    const box = $("imgR").getBoundingClientRect();
    cut = Math.min(1, Math.max(0, (e.clientX - box.left) / box.width));
    wipe();
  }});
  for (const id of ["left", "right", "flip"]) $(id).addEventListener("input", show);
  $("zoom").addEventListener("input", zoom);
  $("imgR").addEventListener("load", zoom);
  document.addEventListener("keydown", e => {{
    if (e.target.tagName === "SELECT") return;
    const k = Number(e.key) - 1;
    if (k >= 0 && k < pictures.length) $("right").value = k;
    else if (e.key === "f") $("flip").checked = !$("flip").checked;
    else return;
    show();
  }});
  pictures.forEach((p, k) => {{
    const figure = document.createElement("figure");
    for (const url of [p.image, p.flip]) if (url) {{
      const image = new Image();
      image.src = url;
      image.alt = p.name;
      figure.append(image);
    }}
    const caption = document.createElement("figcaption");
    caption.textContent = p.name + ": " + p.caption;
    figure.append(caption);
    figure.addEventListener("click", () => {{ $("right").value = k; show(); $("stage").scrollIntoView(); }});
    $("gallery").append(figure);
  }});
  show();
}}
</script>
</body></html>
"""
