"""Errors of images against a reference, and the flicker between frames, as a row of the benchmark has them."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from mi_neural.image import metrics

from .reference import Reference

if TYPE_CHECKING:
    from .benchmark import Row


def judge(
    row: Row, images: list[np.ndarray], reference: Reference | None, exposures: metrics.FlipExposures | None = None
) -> np.ndarray | None:
    """Fill in the row's errors and flicker; returns the FLIP map of the first image, None without a reference.

    Images that are larger than the reference are averaged to its size for the errors.
    """
    if len(images) > 1:
        row.flicker = float(np.mean([metrics.smape(b, a) for a, b in pairwise(images)]))
    if reference is None:
        return None
    images = averaged(images, reference)
    row.relmse, row.relmse_trimmed = mean_relmse(images, reference)
    found = [metrics.flip(image, reference.rgb, exposures) for image in images]
    row.flip = float(np.mean([f.mean for f in found]))
    if reference.clean is not None:
        row.flip_clean = float(np.mean([metrics.flip(image, reference.clean, exposures).mean for image in images]))
    return found[0].map


def flip_map(
    image: np.ndarray, reference: Reference | None, exposures: metrics.FlipExposures | None = None
) -> np.ndarray | None:
    """The map that :func:`judge` returns for this image, alone."""
    if reference is None:
        return None
    (image,) = averaged([image], reference)
    return metrics.flip(image, reference.rgb, exposures).map


def averaged(images: list[np.ndarray], reference: Reference) -> list[np.ndarray]:
    """The images at the reference's size, see :func:`.reference.load_reference`."""
    return [metrics.block_means(image, reference.rgb.shape) for image in images]


def mean_relmse(images: list[np.ndarray], reference: Reference) -> tuple[float, float]:
    """relMSE and trimmed relMSE, means over the images, which have the reference's size."""
    known = reference.rgb, reference.variance
    return (
        float(np.mean([metrics.relmse(image, *known) for image in images])),
        float(np.mean([metrics.relmse_trimmed(image, *known) for image in images])),
    )
