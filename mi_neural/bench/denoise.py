"""The denoiser in a comparison: its guides, and the time that it takes (:mod:`mi_neural.image.denoise` denoises).

The guides come from Mitsuba's `aov` integrator and are the same for all integrators of a comparison, so that none has a
better denoiser than another. Their time is reported apart and belongs to no integrator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_neural.image import denoise as oidn

from .budget import STREAM_GUIDES, clock, pass_seed, render_pass
from .load import InputError

#: Samples a pixel of the guides.
GUIDE_SPP = 16


@dataclass(frozen=True)
class Guides:
    """Albedo in [0, 1] and shading normals in [-1, 1] (world space), float32 of shape (height, width, 3).

    `seconds` is the wall time of rendering them, kernels compiled.
    """

    albedo: np.ndarray
    normal: np.ndarray
    seconds: float


def require() -> None:
    """Raise :class:`InputError` where the denoiser is not installed."""
    try:
        oidn.denoiser()
    except ImportError:
        raise InputError("--denoise needs Open Image Denoise; type: pip install 'mi_neural[denoise]'") from None


def render_guides(scene, seed: int = 0, sensor: int = 0) -> Guides:
    """Albedo and shading normals of the first hit, through the scene's own film and reconstruction filter."""
    import mitsuba as mi

    integrator = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    render_pass(scene, integrator, 1, pass_seed(seed, STREAM_GUIDES, 1), sensor)  # compiles
    start = clock()
    image = render_pass(scene, integrator, GUIDE_SPP, pass_seed(seed, STREAM_GUIDES, 0), sensor)
    image = np.nan_to_num(image[..., -6:].astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
    return Guides(
        albedo=np.ascontiguousarray(image[..., :3].clip(0.0, 1.0)),
        normal=np.ascontiguousarray(image[..., 3:].clip(-1.0, 1.0)),
        seconds=clock() - start,
    )


def denoise(rgb: np.ndarray, guides: Guides) -> tuple[np.ndarray, float]:
    """Denoised linear RGB, float32 of shape (height, width, 3), and the seconds it took.

    Raises :class:`InputError` without the package, ``ValueError`` for unequal shapes.
    """
    require()
    start = clock()
    clean = oidn.denoise(rgb, guides.albedo, guides.normal)
    return clean, clock() - start


def warm_up(guides: Guides) -> float:
    """Start the denoiser's device and return the seconds that one image of this size takes from now on."""
    denoise(guides.albedo, guides)
    return denoise(guides.albedo, guides)[1]
