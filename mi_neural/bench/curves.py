"""Curves of a comparison: errors over time, and over samples, log-log, as SVG."""

from __future__ import annotations

import io
from collections.abc import Iterable

import numpy as np

from .benchmark import Row

QUANTITIES = (("relmse_trimmed", "trimmed relMSE"), ("flip", "HDR-FLIP"), ("flicker", "flicker (SMAPE between frames)"))
AXES = {"seconds_total": "seconds", "spp": "samples a pixel"}


def line(rows: Iterable[Row], over: str, name: str) -> list[tuple[float, float, float, float]]:
    """Points (x, y, least y, largest y) of rows that differ by budget, samples and repeat: means over the repeats at
    each budget, of a curve at each number of samples. Rows that lack either value are left out."""
    places: dict[float, list[Row]] = {}
    for row in rows:
        if getattr(row, name) and getattr(row, over) is not None:
            place = row.spp if row.mode == "curve" else row.budget_seconds or 0.0
            places.setdefault(place, []).append(row)
    points = []
    for at in places.values():
        ys = [getattr(row, name) for row in at]
        points.append((float(np.mean([getattr(row, over) for row in at])), float(np.mean(ys)), min(ys), max(ys)))
    return sorted(points)


def overview(rows: list[Row]) -> str | None:
    """Trimmed relMSE over seconds as inline SVG, one line an integrator: finished images of one shot, dots with a
    denoiser dashed, and behind them the longest image while it was rendered; or frames, where there is no one shot.

    None: nothing to draw.
    """
    import matplotlib
    from matplotlib.figure import Figure

    rows = [row for row in rows if row.relmse_trimmed]
    shots = [row for row in rows if row.mode == "one-shot"]
    shown = shots or [row for row in rows if row.mode in ("sample", "steady")]
    if not shown:
        return None
    labels = list(dict.fromkeys(row.label for row in shown))
    figure = Figure(figsize=(7.5, 3.8), layout="constrained")
    axes = figure.add_subplot()
    for label, denoised in dict.fromkeys((row.label, row.denoised) for row in shown):
        colour = f"C{labels.index(label) % 10}"
        x, y, _, _ = zip(*line([r for r in shown if (r.label, r.denoised) == (label, denoised)], "seconds_total",
                               "relmse_trimmed"), strict=True)  # fmt: skip
        axes.plot(x, y, color=colour, linestyle="--" if denoised else "-", marker="o", markersize=4,
                  label=label + (" + denoiser" if denoised else ""))  # fmt: skip
        unfinished = [r for r in rows if r.mode == "curve" and r.label == label and r.denoised == denoised]
        if shots and unfinished:
            x, y, _, _ = zip(*line(unfinished, "seconds_total", "relmse_trimmed"), strict=True)
            axes.plot(x, y, color=colour, linewidth=0.8, alpha=0.6)
    axes.set(xscale="log", yscale="log", xlabel="seconds, training included" if shots else "seconds of a frame",
             ylabel="trimmed relMSE")  # fmt: skip
    _seconds(axes)
    axes.legend(fontsize=8)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        return _text(figure)


def _seconds(axes) -> None:
    """Plain numbers along a logarithmic axis of x, and a grid."""
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(ScalarFormatter())
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(True, which="both", alpha=0.25)


def _text(figure) -> str:
    """A figure as an SVG element."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer)
    return buffer.getvalue()[buffer.getvalue().index("<svg") :]


def svg(rows: list[Row], modes: tuple[str, ...]) -> str | None:
    """Rows of some modes as inline SVG: a line per integrator, dashed where denoised, the range of its repeats shaded.

    Above over time, below over samples. None: nothing to draw.
    """
    import matplotlib
    from matplotlib.figure import Figure

    kinds: dict[tuple[str, bool], list[Row]] = {}
    for row in rows:
        if row.mode in modes and row.relmse_trimmed is not None:
            kinds.setdefault((row.label, row.denoised), []).append(row)
    if not kinds:
        return None
    quantities = [(n, t) for n, t in QUANTITIES if any(getattr(r, n) for of_kind in kinds.values() for r in of_kind)]
    labels = list(dict.fromkeys(label for label, _ in kinds))

    figure = Figure(figsize=(4.6 * len(quantities), 6.6), layout="constrained")
    for k, (over, unit) in enumerate(AXES.items()):
        for column, (name, title) in enumerate(quantities):
            axes = figure.add_subplot(len(AXES), len(quantities), k * len(quantities) + column + 1)
            for (label, denoised), of_kind in kinds.items():
                points = line(of_kind, over, name)
                if not points:
                    continue
                x, y, low, high = zip(*points, strict=True)
                colour = f"C{labels.index(label) % 10}"
                axes.plot(x, y, color=colour, linestyle="--" if denoised else "-", marker="o", markersize=3.5,
                          label=label + (" + denoiser" if denoised else ""))  # fmt: skip
                if low != high:
                    axes.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
            axes.set(xscale="log", yscale="log", title=title, xlabel=unit)
            _seconds(axes)
    axes.legend(fontsize=8)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        return _text(figure)
