"""Small pictures of what caches say: maps in colours, disks side by side, curves, as arrays or PNG."""

from __future__ import annotations

import io

import numpy as np

from mi_neural.image import exr

#: Of a curve; of more, some are left out.
MOST_POINTS = 1000


def colours(values: np.ndarray, name: str = "viridis") -> np.ndarray:
    """Values in [0, 1] in a colour map of matplotlib, uint8 of shape (height, width, 3)."""
    from matplotlib import colormaps

    return colormaps[name](np.clip(values, 0.0, 1.0), bytes=True)[..., :3].copy()


def side_by_side(images: list[np.ndarray], exposure: float, zoom: int = 3) -> bytes:
    """Linear RGB images beside each other as a PNG, each pixel `zoom` wide, on white where they are 0 around a disk."""
    shown = []
    for image in images:
        rgb8 = exr.to_srgb8(image, exposure)
        y, x = np.mgrid[: rgb8.shape[0], : rgb8.shape[1]] * 2 + 1
        outside = (x - rgb8.shape[1]) ** 2 + (y - rgb8.shape[0]) ** 2 >= rgb8.shape[0] ** 2
        rgb8[outside] = 255
        shown += [rgb8, np.full((rgb8.shape[0], 2, 3), 255, np.uint8)]
    return exr.png_bytes(np.repeat(np.repeat(np.hstack(shown[:-1]), zoom, axis=0), zoom, axis=1))


def curve_png(curve: list[tuple[float, str, float]]) -> bytes:
    """Error over time where there is one, else the loss, as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    names = [name for _, name, _ in curve]
    name = "trimmed relMSE" if "trimmed relMSE" in names else "loss"
    points = [(t, v) for t, kind, v in curve if kind == name and v > 0]
    points = points[:: 1 + len(points) // MOST_POINTS]
    figure = Figure(figsize=(4.0, 2.2), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    if points:
        axes.plot(*zip(*points, strict=True), linewidth=1)
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set(xlabel="seconds of rendering", ylabel=name)
    axes.grid(True, which="both", alpha=0.25)
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()
