"""Figures for notebooks and reports: pictures side by side, maps, curves.

Each function gives a :class:`Drawing`: a notebook shows it, ``save`` writes it, ``figure`` is the matplotlib figure to
go on with. Nothing global is touched, neither matplotlib's backend nor its styles. Pictures of many colours are
embedded as JPEG and the rest as PNG, so that a notebook stays small.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import NullFormatter

from mi_neural.image import exr

#: Inches of a figure across, and pixels an inch.
WIDTH, DPI = 9.0, 100
#: Inches from edge to edge of neighbouring pictures, of a title line, and the outermost margin.
GAP, LINE, MARGIN = 0.08, 0.19, 0.04


class Drawing:
    """A figure that a notebook shows by itself. `kind`: ``png`` or ``jpeg``."""

    def __init__(self, figure: Figure, kind: str = "png"):
        self.figure, self.kind = figure, kind

    @property
    def axes(self) -> list[Axes]:
        """The axes, to draw on."""
        return self.figure.axes

    def data(self, kind: str | None = None) -> bytes:
        """The figure as a PNG or JPEG file."""
        buffer, kind = io.BytesIO(), kind or self.kind
        options = {"pil_kwargs": {"quality": 85}} if kind in ("jpeg", "jpg") else {}
        FigureCanvasAgg(self.figure)
        self.figure.savefig(buffer, format=kind, dpi=DPI, **options)
        return buffer.getvalue()

    def save(self, path) -> None:
        """Write the figure whole or not at all; the name's suffix says in which format."""
        exr.write_bytes(path, self.data(Path(path).suffix.lstrip(".").lower() or self.kind))

    def _repr_mimebundle_(self, include=None, exclude=None):
        return {f"image/{self.kind}": self.data()}


# ------------------------------------------------------------------------------------------------------------------


def pictures(
    images: Mapping[str, np.ndarray], *, notes: Mapping[str, str] | None = None, exposure: float | None = None,
    columns: int | None = None, marks: Sequence[tuple[float, float]] = (), disk: bool = False, width: float = WIDTH,
) -> Drawing:  # fmt: skip
    """Renderings side by side, all at one exposure.

    images    title -> linear RGB, shape (height, width, 3)
    notes     title -> a second line
    exposure  in stops; default: the mean of the last picture at middle grey
    columns   pictures in a row; default: all of up to four
    marks     points (x, y) in pixels, marked by numbers in each picture
    disk      cut out the disk in each: directions above a point (:class:`~mi_neural.explore.views.Hemisphere`)

    Raises ``ValueError`` without an image, or for one that is not of such a shape.
    """
    arrays = {title: _rgb(image, title) for title, image in images.items()}
    if not arrays:
        raise ValueError("there is no picture to show")
    if exposure is None:
        exposure = exr.automatic_exposure(list(arrays.values())[-1])
    figure, places = _grid(arrays, notes or {}, columns, width)
    for axes, image in zip(places, arrays.values(), strict=True):
        drawn = axes.imshow(exr.to_srgb8(image, exposure), interpolation="nearest" if image.shape[1] < 160 else None)
        if disk:
            drawn.set_clip_path(Circle((0.5, 0.5), 0.49, transform=axes.transAxes))
            axes.patch.set_visible(False)
        for k, (x, y) in enumerate(marks):
            axes.plot(x, y, "o", markersize=11, markerfacecolor="white", markeredgecolor="black", alpha=0.85)
            axes.annotate(str(k + 1), (x, y), ha="center", va="center_baseline", fontsize=8)
    return Drawing(figure, "jpeg")


def maps(
    values: Mapping[str, np.ndarray], *, notes: Mapping[str, str] | None = None, low: float | None = None,
    high: float | None = None, colours: str = "magma", label: str = "", columns: int | None = None,
    width: float = WIDTH,
) -> Drawing:  # fmt: skip
    """Maps of one number a pixel side by side, with one scale of colours for all.

    values     title -> numbers, shape (height, width). NaN is left white
    low, high  ends of the scale; default: 0 and the 99th percentile of all values
    colours    a colour map of matplotlib; ``RdBu_r`` with `low` = -`high` for differences
    label      what the numbers are

    Raises ``ValueError`` without a map, or for one that is not of such a shape.
    """
    arrays = {title: np.asarray(v, np.float64) for title, v in values.items()}
    for title, v in arrays.items():
        if v.ndim != 2 or v.size == 0:
            raise ValueError(f"the map '{title}' has shape {v.shape}, expected (height, width)")
    if not arrays:
        raise ValueError("there is no map to show")
    finite = np.concatenate([v[np.isfinite(v)] for v in arrays.values()])
    low = 0.0 if low is None else low
    if high is None:
        high = float(np.quantile(finite, 0.99)) if finite.size else 1.0
    bar = 0.75
    figure, places = _grid(arrays, notes or {}, columns, width, right=bar)
    for axes, v in zip(places, arrays.values(), strict=True):
        drawn = axes.imshow(v, vmin=low, vmax=max(high, low + 1e-30), cmap=colours, interpolation="nearest")
    total = figure.get_size_inches()
    box = places[0].get_position()
    scale = figure.add_axes(((width - bar + 0.08) / total[0], box.y0, 0.12 / total[0], box.height))
    figure.colorbar(drawn, cax=scale).set_label(label, fontsize=8)
    scale.tick_params(labelsize=7)
    return Drawing(figure, "png" if sum(v.size for v in arrays.values()) < 30_000 else "jpeg")


def curves(
    lines: Mapping[str, tuple], *, x: str = "", y: str = "", title: str = "", log: str = "", marks: str = "",
    vertical: Mapping[str, float] | None = None, horizontal: Mapping[str, float] | None = None,
    width: float = 0.6 * WIDTH, height: float = 3.2,
) -> Drawing:  # fmt: skip
    """Curves over one pair of axes.

    lines                 label -> (values along x, values along y), or with standard errors (x, y, error)
    x, y, title           what stands at the axes
    log                   the logarithmic axes: ``x``, ``y`` or ``xy``
    marks                 a marker of matplotlib at each value, ``o`` for few values
    vertical, horizontal  label -> place of a thin line across
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    for label, (xs, ys, *errors) in lines.items():
        (line,) = axes.plot(xs, ys, label=label, marker=marks or None, markersize=4, linewidth=1.4)
        if errors:
            ys, error = np.asarray(ys), np.asarray(errors[0])
            axes.fill_between(xs, ys - error, ys + error, color=line.get_color(), alpha=0.2, linewidth=0)
    for places, draw in ((vertical, axes.axvline), (horizontal, axes.axhline)):
        for label, place in (places or {}).items():
            draw(place, color="0.35", linewidth=0.9, linestyle="--", label=label)
    axes.set(xlabel=x, ylabel=y, title=title)
    if "x" in log:
        axes.set_xscale("log")
        axes.xaxis.set_minor_formatter(NullFormatter())
    if "y" in log:
        axes.set_yscale("log")
    axes.grid(True, which="major", alpha=0.3)
    if len(lines) > 1 or vertical or horizontal:
        axes.legend(fontsize=8, frameon=False)
    return Drawing(figure)


# ------------------------------------------------------------------------------------------------------------------


def _rgb(image, title: str) -> np.ndarray:
    image = np.asarray(image, np.float64)
    if image.ndim != 3 or image.shape[2] < 3 or image.size == 0:
        raise ValueError(f"the picture '{title}' has shape {image.shape}, expected (height, width, 3)")
    return image[..., :3]


def _grid(arrays: Mapping[str, np.ndarray], notes: Mapping[str, str], columns: int | None, width: float,
          right: float = 0.0):  # fmt: skip
    """A figure `width` inches across with a place for each picture under its title; `right`: room left free there."""
    columns = columns or min(len(arrays), 4)
    rows = -(-len(arrays) // columns)
    side = (width - right - 2 * MARGIN - GAP * (columns - 1)) / columns
    aspect = max(v.shape[0] / v.shape[1] for v in arrays.values())
    lines = max(title.count("\n") + 1 + (1 + notes[title].count("\n") if title in notes else 0) for title in arrays)
    head = lines * LINE + 0.08
    total = rows * (head + side * aspect) + 2 * MARGIN
    figure = Figure(figsize=(width, total))
    places = []
    for k, title in enumerate(arrays):
        column, row = k % columns, k // columns
        left, bottom = MARGIN + column * (side + GAP), total - MARGIN - (row + 1) * (head + side * aspect)
        axes = figure.add_axes((left / width, bottom / total, side / width, side * aspect / total))
        axes.set(xticks=[], yticks=[])
        for spine in axes.spines.values():
            spine.set_visible(False)
        axes.set_title("\n".join([title, *([notes[title]] if title in notes else [])]), fontsize=9, pad=3, loc="left")
        places.append(axes)
    return figure, places
