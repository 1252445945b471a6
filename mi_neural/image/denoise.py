"""Open Image Denoise with albedo and normals as guides: what a user would do without a cache."""

from __future__ import annotations

import numpy as np


def denoiser():
    """The module `mitsuba_oidn`. Raises ``ImportError`` with what to type where it is not installed."""
    try:
        import mitsuba_oidn
    except ImportError:
        raise ImportError("denoising needs Open Image Denoise; type: pip install 'mi_neural[denoise]'") from None
    return mitsuba_oidn


def denoise(rgb: np.ndarray, albedo: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Denoised linear RGB, float32 of shape (height, width, 3), as all three arguments have it.

    `albedo` is in [0, 1], `normal` in [-1, 1] (world space). Non-finite pixels of `rgb` go in as black. Raises
    ``ImportError`` where the denoiser is not installed, ``ValueError`` for unequal shapes.
    """
    oidn = denoiser()
    if not rgb.shape == albedo.shape == normal.shape:
        raise ValueError(f"image, albedo and normals have the shapes {rgb.shape}, {albedo.shape} and {normal.shape}: "
                         "they must be equal")  # fmt: skip
    noisy = np.ascontiguousarray(np.nan_to_num(rgb, nan=0.0, posinf=0.0, neginf=0.0), np.float32)
    return np.array(oidn.denoise(noisy, albedo=albedo, normal=normal, hdr=True), np.float32)
