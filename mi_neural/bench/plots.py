"""Results of a sequence: its table, curves of FLIP, frame-to-frame SMAPE and mean reliability over the frames, and
one self-contained page of these and of the pictures of :mod:`.sequence_pictures`.
"""

from __future__ import annotations

import base64
import html
import json
from pathlib import Path

import numpy as np

from mi_neural.image import exr

from . import report
from .benchmark import plain
from .page import style as page_style
from .sequence import Result
from .sequence_pictures import (
    FIRST,
    RELIABILITY,
    Found,
    choose_crops,
    crops_montage,
    pictures_of,
    png,
    preference_map,
    preview,
)

#: Frames after a change from which errors should be stable again.
LATE = 25


# ------------------------------------------------------------------------------------------------------------------
# Figures of one case


def summary(rows: list[dict[str, object]], change: int | None) -> dict[str, float | int | None]:
    """Means over the frames before and after the change; None where there are no such frames.

    flip_area is the sum of FLIP over the frames from the change on. SMAPE means leave out the frame of the change.
    """

    def mean(name: str, first: int = 0, last: float = np.inf) -> float | None:
        values = [r[name] for r in rows if first <= r["frame"] <= last and r.get(name) is not None]
        return float(np.mean(values)) if values else None

    c = change if change is not None else 0
    flips = [r["flip"] for r in rows if r["frame"] >= c and r["flip"] is not None]
    changed = change is not None
    return {
        "frames": len(rows),
        "flip_mean": mean("flip"),
        "flip_before": mean("flip", 0, c - 1) if changed else None,
        "flip_first": mean("flip", c, c + FIRST) if changed else None,
        "flip_late": mean("flip", c + LATE) if changed else None,
        "flip_area": float(np.sum(flips)) if flips else None,
        "smape_mean": None if changed else mean("smape"),
        "smape_before": mean("smape", 1, c - 1) if changed else None,
        "smape_first": mean("smape", c + 1, c + FIRST) if changed else None,
        "smape_late": mean("smape", c + LATE) if changed else None,
        "relmse_trimmed": mean("relmse_trimmed"),
        "seconds": float(np.median([r["seconds"] for r in rows])) if rows else None,
    }


def table(found: Found) -> list[list[str]]:
    """Cells as text, headings first; columns that are empty in every row are left out."""
    sums = [summary(r.rows, found.change) for r in found.results]
    head = [
        ("FLIP", "flip_mean"), ("FLIP before", "flip_before"), (f"FLIP +0..+{FIRST}", "flip_first"),
        (f"FLIP from +{LATE}", "flip_late"), ("FLIP area", "flip_area"), ("SMAPE", "smape_mean"),
        ("SMAPE before", "smape_before"), (f"SMAPE +1..+{FIRST}", "smape_first"),
        (f"SMAPE from +{LATE}", "smape_late"), ("relMSE trimmed", "relmse_trimmed"), ("frame s", "seconds"),
    ]  # fmt: skip
    kept = [(title, name) for title, name in head if any(s[name] is not None for s in sums)]
    cells = [["integrator", "frames", *(title for title, _ in kept), "ratio"]]
    for result, s in zip(found.results, sums, strict=True):
        ratio = s["seconds"] / sums[0]["seconds"] if sums[0]["seconds"] else None
        figures = [report.number(s[name]) for _, name in kept]
        cells.append([result.label, str(s["frames"]), *figures, report.number(ratio)])
    return cells


def results(found: Found) -> dict[str, object]:
    """What `results.json` holds."""
    run, sequence = found.run, found.run.sequence
    exposures = run.references and run.references.exposures
    return plain(
        {
            "scene": found.loaded.name,
            "size": found.loaded.size,
            "command": found.command,
            "environment": run.environment,
            "frames": sequence.frames,
            "change": found.change,
            "changed_keys": [p.key for p in sequence.parameters],
            "states": sequence.states,
            "spp": run.plan.spp,
            "pretrain": run.plan.pretrain,
            "seed": run.plan.seed,
            "denoised": run.plan.denoise,
            "references": run.references
            and {"spp": run.references.spp, "states": len(run.references.first), "folder": "references"},
            "flip_exposures": exposures and {"start": exposures.start, "stop": exposures.stop, "num": exposures.num},
            "crops": found.crops,
            "notes": found.notes,
            "cases": [
                {
                    "label": r.label,
                    "folder": r.folder.name,
                    **r.facts,
                    "summary": summary(r.rows, found.change),
                    "rows": r.rows,
                }
                for r in found.results
            ],
        }
    )


# ------------------------------------------------------------------------------------------------------------------
# Curves


def curves(found: Found) -> dict[str, bytes]:
    """PNG by name: `flip`, `smape`, and `reliability` where the integrators report one."""
    pictures = {}
    for name, title in (("flip", "HDR-FLIP to the reference"), ("smape", "SMAPE to the frame before")):
        lines = [(r.label, _series(r, name), {}) for r in found.results]
        if name == "smape" and found.results:
            longest = max(found.results, key=lambda r: len(r.rows))
            lines.append(("reference", _series(longest, "smape_reference"), {"color": "0.6", "linestyle": ":"}))
        if drawn := _draw(lines, title, found.change):
            pictures[name] = drawn
    lines = []
    for k, result in enumerate(found.results):
        styles = iter(("-", "--", ":", "-."))
        for name in sorted({n for r in result.rows for n in r["statistics"] if any(w in n for w in RELIABILITY)}):
            series = [(r["frame"], r["statistics"].get(name)) for r in result.rows]
            lines.append((f"{result.label}: {name}", series, {"color": f"C{k % 10}", "linestyle": next(styles, "-")}))
    if drawn := _draw(lines, "reliability", found.change):
        pictures["reliability"] = drawn
    return pictures


def _series(result: Result, name: str) -> list[tuple[int, float | None]]:
    return [(r["frame"], r.get(name)) for r in result.rows]


def _draw(lines, title: str, change: int | None) -> bytes | None:
    """Lines (label, [(frame, value)], style) over the frame; None where no line has two points."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6.4, 3.6), layout="constrained", dpi=120)
    axes = figure.add_subplot()
    for label, series, style in lines:
        points = [(frame, value) for frame, value in series if value is not None]
        if len(points) >= 2 and any(value for _, value in points):
            axes.plot(*zip(*points, strict=True), label=label, **{"linewidth": 1.4, **style})
    if not axes.lines:
        return None
    if change is not None:
        axes.axvline(change, color="0.3", linewidth=0.8, linestyle="--")
        axes.annotate("change", (change, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -10),
                      textcoords="offset points", fontsize=8, color="0.3")  # fmt: skip
    axes.set(title=title, xlabel="frame")
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(True, alpha=0.25)
    axes.legend(fontsize=8)
    return png(figure)


# ------------------------------------------------------------------------------------------------------------------
# All of it


def write(found: Found, folder: Path) -> None:
    """Write `results.json`, `table.md`, `report.html`, `preview.gif` and the plots as PNG, each whole or not at all.

    Crops are chosen here where `found` has none. Nothing is written where no frame is done.
    """
    if not found.results:
        return
    if not found.crops:
        last = min(len(r.rows) for r in found.results) - 1
        before = max((found.change or 1) - 1, 0)
        found.crops = choose_crops(pictures_of(found, min(before, last)), pictures_of(found, last))
    pictures = curves(found)
    for name, made in (("crops", crops_montage(found)), ("preference", preference_map(found))):
        if made:
            pictures[name] = made
    for name, data in pictures.items():
        exr.write_bytes(folder / f"{name}.png", data)
    animated = preview(found)
    exr.write_bytes(folder / "preview.gif", animated)
    exr.write_text(folder / "results.json", json.dumps(results(found), indent=1) + "\n")
    exr.write_text(folder / "table.md", report.markdown(table(found)))
    exr.write_text(folder / "report.html", page(found, pictures, animated))


def page(found: Found, pictures: dict[str, bytes], animated: bytes) -> str:
    """The report as one HTML document that loads nothing."""

    def image(data: bytes, kind: str, text: str) -> str:
        return f'<p><img alt="{text}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}"></p>'

    titles = {"flip": "Error over time", "smape": "Flicker over time", "reliability": "Reliability over time",
              "crops": "Crops", "preference": "Blend weight"}  # fmt: skip
    parts = [
        f"<h1>{html.escape(found.loaded.name)}, {found.run.sequence.frames} frames</h1>",
        "<ul>" + "".join(f"<li>{html.escape(note)}</li>" for note in found.notes) + "</ul>" if found.notes else "",
        report.html_table(table(found)),
        "<h2>Preview</h2>" + image(animated, "gif", "all frames"),
        *(f"<h2>{titles[name]}</h2>" + image(data, "png", titles[name]) for name, data in pictures.items()),
        "<h2>How this was made</h2>",
        f"<pre>{html.escape(found.command)}</pre>",
        f"<pre>{html.escape(chr(10).join(f'{k:16} {v}' for k, v in found.run.environment.items()))}</pre>",
    ]
    head = '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
    style = page_style() + "img { max-width: 100% } img[src^='data:image/gif'] { image-rendering: pixelated }\n"
    title = html.escape(f"{found.loaded.name}: sequence")
    body = "\n".join(part for part in parts if part)
    return f"{head}\n<title>{title}</title>\n<style>{style}</style></head><body>\n{body}\n</body></html>\n"
