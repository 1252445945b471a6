"""A gallery out of what `mi-neural compare` and `sequence` wrote: ``python -m mi_neural.bench.gallery DIR``.

Every folder in DIR that holds a `results.json` becomes a section of `DIR/index.html`: pictures, error maps, what each
cost, and the command that makes it; the frames of a sequence become an animation. ``--compact FILE.webp`` also writes
the pictures as one sheet, ``--animation FILE.webp`` the animation of the first sequence.
"""

from __future__ import annotations

import html
import json
import shlex
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from mi_neural.image import exr, metrics

from .load import InputError, one_line
from .montage import montage
from .page import flip_colours
from .reference import load_reference
from .report import number
from .sequence import frame_path

#: Frames a second of animations; quality of WebP for them and for sheets (100: best).
RATE, MOVING_QUALITY, SHEET_QUALITY = 12, 60, 85
#: Pictures side by side on a sheet.
PER_ROW = 4

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1250px; padding: 0 1rem; color: #222 }
h1 { font-size: 1.6rem } h2 { font-size: 1.2rem; margin: 2.5rem 0 .3rem }
.row { display: flex; flex-wrap: wrap; gap: 1rem } figure { margin: 0; width: 290px }
img { width: 100%; display: block; image-rendering: pixelated } figure img + img { margin-top: 2px }
figcaption { font-size: 13px; line-height: 1.4 } figcaption b { font-size: 14px; overflow-wrap: anywhere }
code { font: 11.5px/1.35 ui-monospace, monospace; color: #555; overflow-wrap: anywhere; user-select: all }
.wide { width: 620px } a { color: #0b5cad }
"""


def write(folder: Path, compact: Path | None = None, animation: Path | None = None) -> None:
    """Write `index.html` and its pictures. Raises :class:`InputError` where there is nothing to show."""
    sections, sheet, moving = [], [], []
    for results in sorted(folder.glob("*/results.json")):
        found = json.loads(results.read_text(encoding="utf-8"))
        if "cases" in found:  # of a sequence
            section, frames = _sequence(results.parent, found, folder)
            moving.append(frames)
        else:
            shown = [_comparison(results.parent, found, k, folder) for k in range(len(found["scenes"]))]
            sheet += [pictures for _, pictures in shown]
            section = "\n".join(text for text, _ in shown)
        sections.append(section)
    if not sections:
        raise InputError(f"{folder} holds no results of compare or sequence: run them with -o {folder}/NAME")
    page = PAGE.format(style=STYLE, sections="\n".join(sections))
    exr.write_text(folder / "index.html", page)
    if compact is not None:
        _write_sheet(sheet, compact)
    if animation is not None:
        if not moving:
            raise InputError(f"{folder} holds no sequence: run mi-neural sequence with -o {folder}/NAME")
        write_animation(moving[0], animation)


# ------------------------------------------------------------------------------------------------------------------
# Comparisons


def _comparison(folder: Path, found: dict, k: int, root: Path) -> tuple[str, list[np.ndarray]]:
    """The section of scene number `k` of a comparison, and its pictures in uint8."""
    scene, several = found["scenes"][k], len(found["scenes"]) > 1
    report = folder.relative_to(root) / "report.html"
    folder = folder / scene["scene"] if several else folder
    reference = load_reference(_reference_path(folder, scene), tuple(scene["size"]), scaled=True).rgb
    exposure = exr.automatic_exposure(reference)
    exr.write_png(folder / "reference.png", reference, exposure)
    name = folder.relative_to(root)
    figures = [_figure([name / "reference.png"], "<b>reference</b>", "")]
    pictures = [exr.to_srgb8(reference, exposure)]
    seen = set()
    for row in found["rows"]:
        shows = row["scene"] == scene["scene"] and row["image"] and not row["denoised"] and row["mode"] != "sample"
        if not shows or row["label"] in seen:
            continue
        seen.add(row["label"])
        rgb = exr.read(folder / row["image"]).rgb
        stem = Path(row["image"]).stem
        exr.write_png(folder / f"{stem}.png", rgb, exposure)
        error = metrics.flip(metrics.block_means(rgb, reference.shape), reference)
        exr.write_bytes(folder / f"{stem}_flip.png", exr.png_bytes(flip_colours(error.map)))
        pictures.append(exr.to_srgb8(rgb, exposure))
        shown = [name / f"{stem}.png", name / f"{stem}_flip.png"]
        figures.append(_figure(shown, _caption(row), command_of(row, found["command"])))
    width, height = scene["size"]
    title = f"{scene['scene']}, {width}x{height}"
    more = f'<p><a href="{report.as_posix()}">report</a> <code>{html.escape(found["command"])}</code></p>'
    return f'<h2>{html.escape(title)}</h2>\n{more}\n<div class="row">{"".join(figures)}</div>', pictures


def _reference_path(folder: Path, scene: dict) -> Path:
    path = Path(scene["reference"]["path"])
    if not path.is_file():
        raise InputError(f"the reference of {folder}, {path}, is gone: run its mi-neural compare again")
    return path


def _caption(row: dict) -> str:
    cost = [f"{number(row['seconds_train'] + row['seconds_render'])} s", f"{number(row['spp'])} samples a pixel"]
    if row["seconds_train"]:
        cost.insert(1, f"{number(row['seconds_train'])} of it training")
    if row["seconds_pretrain"]:
        cost.append(f"{number(row['seconds_pretrain'])} s of training before")
    errors = [f"{title} {number(row[key])}" for key, title in (("relmse_trimmed", "trimmed relMSE"), ("flip", "FLIP"))
              if row[key] is not None]  # fmt: skip
    return f"<b>{html.escape(row['label'])}</b><br>{', '.join(cost)}<br>{', '.join(errors)}"


def command_of(row: dict, command: str) -> str:
    """The command that renders such a picture as that of a row which `command` made."""
    named = [word for word in shlex.split(command)[2:] if Path(word).stem == row["scene"]]
    words = ["mi-neural", "render", *(named[:1] or [row["scene"]]), "-i", row["label"]]
    width, height = row["size"]
    keys = [text for text in _given(command, "--set") if text.partition("=")[0] in row.get("parameters", {})]
    words += [word for text in keys for word in ("--set", text)]
    words += [word for text in _given(command, "--define", "-D") for word in ("-D", text)]
    words += ["--size", f"{width}x{height}"]
    words += ["--pretrain", str(row["pretrain_frames"])] if row["pretrain_frames"] else []
    words += ["--seconds", f"{row['budget_seconds']:g}"] if row["budget_seconds"] else ["--spp", f"{row['spp']:g}"]
    return shlex.join([*words, "-o", "picture.png"])


def _given(command: str, *names: str) -> list[str]:
    """What was typed for an option of these names, as `--name text`, `--name=text`, `-n text` or `-ntext`."""
    found, words = [], iter(shlex.split(command))
    for word in words:
        if word in names:
            found.append(next(words))
        elif name := next((n for n in names if word.startswith(n + "=" if n.startswith("--") else n)), None):
            found.append(word[len(name) :].removeprefix("="))
    return found


def _figure(pictures: list[Path], caption: str, command: str, wide: bool = False) -> str:
    images = "".join(f'<img src="{p.as_posix()}" alt="">' for p in pictures)
    shown = f"<br><code>{html.escape(command)}</code>" if command else ""
    return f'<figure{" class=wide" if wide else ""}>{images}<figcaption>{caption}{shown}</figcaption></figure>'


# ------------------------------------------------------------------------------------------------------------------
# Sequences


def _sequence(folder: Path, found: dict, root: Path) -> tuple[str, list[np.ndarray]]:
    """The section of a sequence, and its frames, all integrators side by side, in uint8."""
    cases = found["cases"]
    n_frames = min(len(case["rows"]) for case in cases)
    images = [[exr.read(frame_path(folder / case["folder"], k)).rgb for case in cases] for k in range(n_frames)]
    exposure = exr.automatic_exposure(np.concatenate(images[0]))
    frames = [montage([exr.to_srgb8(image, exposure) for image in strip], len(cases)) for strip in images]
    write_animation(frames, folder / "frames.webp")
    name = folder.relative_to(root)
    caption = "from the left: " + ", ".join(html.escape(case["label"]) for case in cases)
    figure = _figure([name / "frames.webp"], caption, found["command"], wide=True)
    more = f'<p><a href="{name}/report.html">report</a></p>'
    return f'<h2>{html.escape(found["scene"])}, {len(frames)} frames</h2>\n{more}\n{figure}', frames


def write_animation(frames: list[np.ndarray], path: Path) -> None:
    """Frames of equal shape (height, width, 3), uint8, as an endless animated WebP, whole or not at all."""
    from PIL import Image  # comes with matplotlib

    first, *others = (Image.fromarray(frame) for frame in frames)
    with exr.replacing(path) as temporary:
        first.save(temporary, save_all=True, append_images=others, duration=1000 // RATE, loop=0,
                   quality=MOVING_QUALITY)  # fmt: skip


def _write_sheet(rows: list[list[np.ndarray]], path: Path) -> None:
    """A sheet of all comparisons, PER_ROW pictures to a row and as high as the lowest, as WebP, whole or not at all."""
    from PIL import Image

    height = min(picture.shape[0] for row in rows for picture in row)
    strips = []
    for row in rows:
        images = [Image.fromarray(p).resize((round(p.shape[1] * height / p.shape[0]), height), Image.Resampling.BOX)
                  for p in row]  # fmt: skip
        strips.append(montage([np.asarray(image) for image in images], min(PER_ROW, len(images))))
    width = max(strip.shape[1] for strip in strips)
    padded = [np.pad(s, ((0, 4), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    with exr.replacing(path) as temporary:
        Image.fromarray(np.concatenate(padded)[:-4]).save(temporary, quality=SHEET_QUALITY)


PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>mi_neural: gallery</title><style>{style}</style></head><body>
<h1>mi_neural: gallery</h1>
<p>Wall time with kernels compiled. Below each picture its HDR-FLIP map against the reference: black is no visible
error. The commands make the pictures.</p>
{sections}
</body></html>
"""


def main(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="folder of folders of results")],
    compact: Annotated[Path | None, typer.Option(metavar="FILE.webp", help="all pictures as one sheet")] = None,
    animation: Annotated[Path | None, typer.Option(metavar="FILE.webp", help="the animation alone")] = None,
) -> None:
    """Write DIR/index.html."""
    try:
        write(folder, compact, animation)
    except (InputError, OSError) as error:
        print(one_line(error), file=sys.stderr)
        raise typer.Exit(2) from None
    print(f"wrote {folder / 'index.html'}")


if __name__ == "__main__":
    typer.run(main)
