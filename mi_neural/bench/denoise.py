"""The denoiser in a comparison: its guides, and the time that it takes.

The guides (:mod:`mi_neural.bench.guides`) are the same for all integrators of a comparison, so that none has a better
denoiser than another. Their time is reported separately and counts for no integrator.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_neural.image import denoise as oidn

from .budget import STREAM_GUIDES, clock, pass_seed
from .guides import Guides, guides
from .load import InputError
from .reference import Reference


def require() -> None:
    """Raise :class:`InputError` where the denoiser is not installed."""
    try:
        oidn.denoiser()
    except ImportError:
        raise InputError("--denoise needs Open Image Denoise; type: pip install 'mi_neural[denoise]'") from None


def render_guides(scene, seed: int = 0, sensor: int = 0) -> tuple[Guides, float]:
    """The guides of a view, and the wall time of making them, kernels compiled."""
    guides(scene, sensor, pass_seed(seed, STREAM_GUIDES, 1))  # compiles
    start = clock()
    found = guides(scene, sensor, pass_seed(seed, STREAM_GUIDES, 0))
    return found, clock() - start


def denoise(rgb: np.ndarray, guides: Guides) -> tuple[np.ndarray, float]:
    """Denoised linear RGB, float32 of shape (height, width, 3), and the seconds it took.

    Raises :class:`InputError` without the package, ``ValueError`` for unequal shapes.
    """
    require()
    start = clock()
    clean = oidn.denoise(rgb, guides.albedo, guides.normal, guides.clean)
    return clean, clock() - start


def cleaned(reference: Reference, guides: Guides) -> Reference:
    """The reference together with its denoised image (`clean`). One of another size than the film stays as it is: the
    guides do not fit it."""
    if reference.rgb.shape != guides.albedo.shape:
        return reference
    return replace(reference, clean=denoise(reference.rgb, guides)[0])


def warm_up(guides: Guides) -> float:
    """Start the denoiser's device and return the seconds that one image of this size takes from now on."""
    denoise(guides.albedo, guides)
    return denoise(guides.albedo, guides)[1]
