"""Pictures of a sequence: crops of a few frames with error maps, maps of which predictor answers, an animated preview.

Crops show two regions, the one that the change alters most and the one that it alters least (as Figures 1, 4 and 5 of
the paper on reliability-weighted averaging do).
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field

import numpy as np

from mi_neural.image import exr, metrics

from .load import LoadedScene
from .page import flip_colours
from .sequence import Result, Run

#: Frames after a change that count as the first response.
FIRST = 10
#: Statistics whose names contain one of these are drawn over the frames; channels, shown as maps from red to green.
RELIABILITY = ("reliab", "sigma", "prefer", "blend")
#: Colours of crops, as in the paper: blue where the change is strong, orange where it is weak, then others.
CROP_COLOURS = ("#2f6fdb", "#e8820c", "#2a9d57", "#b03a8c", "#7a5c3e")
#: Of the preview: frames a second, most frames, width in pixels to which small pictures are enlarged, largest width of
#: all side by side.
PREVIEW_FPS, PREVIEW_FRAMES, PREVIEW_WIDTH, PREVIEW_STRIP = 12, 120, 256, 1280

Crop = tuple[int, int, int, int]


@dataclass
class Found:
    """What :func:`.plots.write` needs: the run with its results, crops (x, y, width, height), lines for the reader."""

    loaded: LoadedScene
    run: Run
    command: str
    crops: list[Crop] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def change(self) -> int | None:
        return self.run.sequence.change

    @property
    def results(self) -> list[Result]:
        return [r for r in self.run.results if r.rows]


# ------------------------------------------------------------------------------------------------------------------
# Crops


def choose_crops(before: np.ndarray, after: np.ndarray) -> list[Crop]:
    """Two regions (x, y, width, height) of a quarter of the width and height: where two images, in shape (height,
    width, 3), differ most, and where they differ least among those that are not dark."""
    h, w = before.shape[:2]
    ch, cw = (min(n, max(8, n // 4)) for n in (h, w))
    a, b = (np.maximum(np.nan_to_num(metrics.luminance(i)), 0.0) for i in (before, after))
    level = 0.5 * (a + b)
    difference = np.abs(a - b) / (level + 0.05 * level.mean() + 1e-12)
    means = [_window_means(image, ch, cw) for image in (difference, level)]
    y, x = np.unravel_index(means[0].argmax(), means[0].shape)
    strong = (int(x), int(y), cw, ch)
    lit = means[1] >= 0.5 * np.median(means[1])
    apart_y = np.abs(np.arange(means[0].shape[0]) - y)[:, None] >= ch
    apart_x = np.abs(np.arange(means[0].shape[1]) - x)[None] >= cw
    allowed = lit & (apart_x | apart_y)
    y, x = np.unravel_index(np.where(allowed, means[0], np.inf).argmin(), means[0].shape)
    return [strong, (int(x), int(y), cw, ch)] if allowed.any() else [strong]


def _window_means(image: np.ndarray, height: int, width: int) -> np.ndarray:
    sums = np.pad(image.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    total = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    return total / (height * width)


def shown_frames(frames: int, change: int | None) -> list[int]:
    """The frames of a montage: before the change, at it, 2 and 10 after, and the last; evenly spread without one."""
    if change is None:
        chosen = np.linspace(0, frames - 1, min(frames, 5)).round()
    else:
        chosen = [change - 1, change, change + 2, change + FIRST, frames - 1]
    return sorted({int(k) for k in chosen if 0 <= k < frames})


def pictures_of(found: Found, frame: int) -> np.ndarray:
    """The picture that others are compared with at a frame: the reference, or without one the first case's frame."""
    if found.run.references is not None:
        return found.run.references.of(frame).rgb
    return found.results[0].image(frame).rgb


def crops_montage(found: Found) -> bytes:
    """Crops of a few frames as PNG: the reference, and each case with maps of FLIP (magma, 0 to 1) and of SMAPE to the
    frame before (viridis, 0 to 1), which name their means over the crop. A block of columns for each crop."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    done = min(len(r.rows) for r in found.results)
    change = found.change if found.change is not None and found.change < done else None
    frames = shown_frames(done, change)
    rows, shown, means = _montage_rows(found, frames)

    # ---- Lengths in inches
    cell, gap, top, left = 1.15, 0.05, 0.28, 4.1
    block = cell * len(frames) + 0.2
    height = max(c[3] / c[2] for c in found.crops) * cell
    side = left - 1.0
    aspect = found.loaded.size[1] / found.loaded.size[0]
    width = left + block * len(found.crops)
    total = max(top + (height + gap) * len(rows), 2 * (side * aspect + top + 0.1)) + 0.05
    figure = Figure(figsize=(width, total), dpi=110)

    def axes(x: float, y: float, w: float, h: float):
        """A place measured from the upper left corner."""
        made = figure.add_axes((x / width, 1.0 - (y + h) / total, w / width, h / total))
        made.set(xticks=[], yticks=[])
        for spine in made.spines.values():
            spine.set_visible(False)
        return made

    # ---- Left: the whole picture before and after, with the crops' places
    exposure = _exposure(found)
    kind = "reference" if found.run.references is not None else found.results[0].label
    for n, frame in enumerate(dict.fromkeys((max((change or 1) - 1, 0), done - 1))):
        overview = axes(0.1, top + n * (side * aspect + top + 0.1), side, side * aspect)
        overview.imshow(exr.to_srgb8(pictures_of(found, frame), exposure), interpolation="nearest")
        overview.set_title(f"{kind}, frame {frame}", fontsize=8, pad=2)
        for k, (x, y, w, h) in enumerate(found.crops):
            overview.add_patch(Rectangle((x - 0.5, y - 0.5), w, h, fill=False, edgecolor=_colour(k), linewidth=2))

    # ---- Right: a block for each crop
    box = {"facecolor": "black", "alpha": 0.6, "edgecolor": "none", "pad": 1}
    for k, (cx, cy, w, h) in enumerate(found.crops):
        part = (slice(cy, cy + h), slice(cx, cx + w))
        for r, label in enumerate(rows):
            for f, frame in enumerate(frames):
                x, y = left + k * block + f * cell, top + r * (height + gap)
                place = axes(x, y, cell - gap, h / w * cell)
                if (r, frame) in shown:
                    place.imshow(shown[r, frame][part], interpolation="nearest", aspect="auto")
                if (r, frame) in means:
                    text = f"{means[r, frame][part].mean():.3f}"
                    place.text(0.03, 0.06, text, transform=place.transAxes, fontsize=7, color="white", bbox=box)
                if r == 0:
                    place.set_title(f"frame {frame}", fontsize=8, pad=2, color=_colour(k))
                if k == f == 0:
                    folded = label.replace(":", ":\n").replace(",", ",\n")
                    place.set_ylabel(folded, fontsize=7, rotation=0, ha="right", va="center")
    return png(figure)


def _montage_rows(found: Found, frames: list[int]):
    """Labels of the rows; their pictures, uint8, by (row, frame); and the maps whose means are named."""
    references, exposure = found.run.references, _exposure(found)
    rows: list[tuple[str, int | None]] = [("reference", None)] if references else []
    for number, result in enumerate(found.results):
        rows += [(result.label, number)] + ([("FLIP", number)] if references else []) + [("SMAPE", number)]
    shown: dict[tuple[int, int], np.ndarray] = {}
    means: dict[tuple[int, int], np.ndarray] = {}
    for frame in frames:
        for r, (label, number) in enumerate(rows):
            image = references.of(frame).rgb if number is None else found.results[number].image(frame).rgb
            if label == "FLIP":
                means[r, frame] = metrics.flip(image, references.of(frame).rgb, references.exposures).map
                shown[r, frame] = flip_colours(means[r, frame])
            elif label == "SMAPE":
                if frame:
                    means[r, frame] = metrics.smape_map(image, found.results[number].image(frame - 1).rgb)
                    shown[r, frame] = _colours(means[r, frame])
            else:
                shown[r, frame] = exr.to_srgb8(image, exposure)
    return [label for label, _ in rows], shown, means


def _colour(k: int) -> str:
    return CROP_COLOURS[k % len(CROP_COLOURS)]


def _colours(values: np.ndarray) -> np.ndarray:
    from matplotlib import colormaps

    return colormaps["viridis"](np.clip(values, 0.0, 1.0), bytes=True)[..., :3]


def preference_map(found: Found) -> bytes | None:
    """Maps of a blend weight before and after the change, red 0 to green 1, where frames hold such a channel; PNG."""
    from matplotlib.figure import Figure

    maps = []
    for result in found.results:
        names = [n for n in result.image(0).channels if any(w in n.lower() for w in RELIABILITY)]
        for name in names:
            for frame in shown_frames(len(result.rows), found.change):
                maps.append((f"{result.label}: {name}\nframe {frame}", result.image(frame).channels[name]))
    if not maps:
        return None
    columns = min(5, len(maps))
    lines = -(-len(maps) // columns)
    height, width = maps[0][1].shape
    figure = Figure(figsize=(2.6 * columns, (2.6 * height / width + 0.45) * lines), layout="constrained", dpi=110)
    for k, (title, values) in enumerate(maps):
        axes = figure.add_subplot(lines, columns, k + 1)
        axes.imshow(values, vmin=0.0, vmax=1.0, cmap="RdYlGn", interpolation="nearest")
        axes.set_title(title, fontsize=8)
        axes.set(xticks=[], yticks=[])
    return png(figure)


def preview(found: Found) -> bytes:
    """The frames as an animated GIF: the reference, then the cases, side by side, each with its name.

    Of long sequences every second, third, ... frame; wide pictures are made smaller.
    """
    from PIL import Image, ImageDraw  # comes with matplotlib

    exposure = _exposure(found)
    labels = (["reference"] if found.run.references is not None else []) + [r.label for r in found.results]
    factor = max(1, PREVIEW_WIDTH // found.loaded.size[0])
    factor = min(factor, PREVIEW_STRIP / (found.loaded.size[0] * len(labels)))
    width, height = (max(1, int(n * factor)) for n in found.loaded.size)
    filter_ = Image.Resampling.NEAREST if factor >= 1 else Image.Resampling.BOX
    n_frames = max(len(r.rows) for r in found.results)
    strips = []
    for frame in range(0, n_frames, -(-n_frames // PREVIEW_FRAMES)):
        images = [pictures_of(found, frame)] if found.run.references is not None else []
        images += [r.image(frame).rgb if frame < len(r.rows) else None for r in found.results]
        strip = Image.new("RGB", (len(images) * (width + 2) - 2, height + 14), "white")
        draw = ImageDraw.Draw(strip)
        for k, (image, label) in enumerate(zip(images, labels, strict=True)):
            x = k * (width + 2)
            if image is not None:
                shown = Image.fromarray(exr.to_srgb8(image, exposure)).resize((width, height), filter_)
                strip.paste(shown, (x, 14))
            text = f"{label}  {frame}" if k == 0 else label
            draw.text((x + 2, 1), text[: width // 6], fill="black")
        strips.append(strip.quantize(256, dither=Image.Dither.NONE))
    buffer = io.BytesIO()
    strips[0].save(buffer, "GIF", save_all=True, append_images=strips[1:], duration=1000 // PREVIEW_FPS, loop=0)
    return buffer.getvalue()


def _exposure(found: Found) -> float:
    """One exposure for all pictures: that of the brighter of the first and the last frame's."""
    last = max(len(r.rows) for r in found.results) - 1
    pictures = [pictures_of(found, frame) for frame in (0, min(last, len(found.results[0].rows) - 1))]
    return exr.automatic_exposure(max(pictures, key=lambda p: np.nan_to_num(p).mean()))


def png(figure) -> bytes:
    """A figure as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()
