"""Images that other renderers made, as rows of a comparison: the user gives their time, and their error is measured as
that of every other row."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_neural.image import exr, metrics

from .benchmark import Picture, Row
from .budget import Rendered
from .judging import judge
from .load import InputError, LoadedScene, user_path
from .reference import Reference, scale_between

FORM = "--image takes NAME=FILE.exr,seconds=T and, where wanted, spp=N, denoised=true, scene=NAME"


@dataclass(frozen=True)
class Image:
    """An image file and what the user says of it.

    label     its name in tables
    path      an EXR file, linear RGB of the film's size, or a whole number of times as large
    seconds   what it took
    spp       samples a pixel; None: not known
    denoised  a denoiser was used
    scene     the scene that it shows; None: the only one of the comparison
    """

    label: str
    path: Path
    seconds: float
    spp: float | None = None
    denoised: bool = False
    scene: str | None = None


def parse(text: str) -> Image:
    """An image as it is typed; raises :class:`InputError`."""
    first, *rest = text.split(",")
    label, equals, path = first.partition("=")
    given = dict(part.split("=", 1) if "=" in part else (part, "") for part in rest)
    unknown = given.keys() - {"seconds", "spp", "denoised", "scene"}
    if not (label and equals and path) or unknown or "seconds" not in given:
        raise InputError(f"{FORM}; got {text!r}")
    if given.get("denoised", "false") not in ("true", "false"):
        raise InputError(f"--image: denoised is true or false, got {given['denoised']!r}")
    if not user_path(path).is_file():
        raise InputError(f"--image: no such image: {path}")
    return Image(
        label, user_path(path), _positive(given["seconds"], "seconds", text),
        _positive(given["spp"], "spp", text) if "spp" in given else None,
        given.get("denoised") == "true", given.get("scene"),
    )  # fmt: skip


def of_scene(images: list[Image], name: str) -> list[Image]:
    """The images that show this scene."""
    return [image for image in images if image.scene in (None, name)]


def require_scenes(images: list[Image], names: list[str]) -> None:
    """Raise :class:`InputError` where an image shows none of the scenes, or does not say which of several."""
    there = ", ".join(names)
    for image in images:
        if image.scene is None and len(names) > 1:
            raise InputError(f"--image {image.label}: there are several scenes; add scene=NAME, one of {there}")
        if image.scene is not None and image.scene not in names:
            raise InputError(f"--image {image.label}: no scene {image.scene!r} here; there is {there}")


def check(images: list[Image], size: tuple[int, int]) -> None:
    """Raise :class:`InputError` for images that cannot be averaged to a film's size: before a reference is rendered,
    which takes long."""
    for image in images:
        _read(image, size)


def pictures(
    images: list[Image], loaded: LoadedScene, reference: Reference, environment: dict[str, object]
) -> list[Picture]:
    """A one-shot picture for each image; images of one name, time and denoising are its repeats."""
    exposures, seen, made = metrics.flip_exposures(reference.rgb), {}, []
    for image in images:
        key = image.label, image.seconds, image.denoised
        seen[key] = repeat = seen.get(key, -1) + 1
        rgb = _read(image, loaded.size)
        row = _row(image, rgb, loaded, repeat, environment)
        flip_map = judge(row, [rgb], reference, exposures)
        rendered = Rendered(rgb, {}, image.spp or 0, 0.0, image.seconds, row.nonfinite)
        made.append(Picture(row, rendered, rgb, flip_map))
    return made


def _read(image: Image, size: tuple[int, int]) -> np.ndarray:
    """The image's pixels, averaged to the film's size."""
    try:
        found = exr.read(image.path)
    except (ValueError, OSError) as error:
        raise InputError(f"--image {image.label}: {error}") from None
    if found.size[0] < size[0] or scale_between(size, found.size) is None:
        (w, h), (iw, ih) = size, found.size
        raise InputError(f"--image {image.label}: {image.path} is {iw}x{ih}, the film {w}x{h}: add --size {iw}x{ih}")
    return metrics.block_means(found.rgb, (size[1], size[0], 3)).astype(np.float32)


def _row(image: Image, rgb: np.ndarray, loaded: LoadedScene, repeat: int, environment: dict[str, object]) -> Row:
    finite = np.isfinite(rgb).all(axis=-1)
    n_samples = (image.spp or 0) * rgb.shape[0] * rgb.shape[1]
    return Row(
        scene=loaded.name, integrator=image.label, label=image.label, parameters={"file": str(image.path)},
        size=list(loaded.size), seed=repeat, mode="one-shot", frames=1, denoised=image.denoised, spp=image.spp,
        seconds_compile=0.0, seconds_train=0.0, seconds_render=image.seconds, seconds_denoise=0.0,
        seconds_total=image.seconds, ns_per_sample=1e9 * image.seconds / n_samples if n_samples else None,
        ns_per_query=None, records=None, queries=None,
        mean=float(rgb[finite].mean(dtype=np.float64)) if finite.any() else 0.0, nonfinite=int((~finite).sum()),
        budget_seconds=image.seconds, repeat=repeat, statistics={"made_elsewhere": str(image.path)},
        environment=environment,
    )  # fmt: skip


def _positive(text: str, name: str, typed: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise InputError(f"--image: {name} must be a number greater than 0; got {typed!r}")
    return value
