"""Open Image Denoise with albedo and normals as guides. Pure NumPy: nothing here knows a renderer."""

from __future__ import annotations

import threading
from functools import cache

import numpy as np

# Filters belong to one device, which must not be used from two threads at once
_lock = threading.Lock()


def denoiser():
    """The module `mitsuba_oidn`. Raises ``ImportError`` with what to type where it is not installed."""
    try:
        import mitsuba_oidn
    except ImportError:
        raise ImportError("denoising needs Open Image Denoise; type: pip install 'mi_neural[denoise]'") from None
    return mitsuba_oidn


def denoise(rgb: np.ndarray, albedo: np.ndarray, normal: np.ndarray, clean: bool = False) -> np.ndarray:
    """Denoised linear RGB, float32 of shape (height, width, 3), as all three arguments have it.

    `albedo` is in [0, 1], `normal` in [-1, 1] (world space); `clean` says that they hold no noise (:func:`prefilter`).
    Non-finite pixels of `rgb` go in as black. Raises ``ImportError`` where the denoiser is not installed,
    ``ValueError`` for unequal shapes.
    """
    oidn = denoiser()
    if not rgb.shape == albedo.shape == normal.shape:
        raise ValueError(f"image, albedo and normals have the shapes {rgb.shape}, {albedo.shape} and {normal.shape}: "
                         "they must be equal")  # fmt: skip
    noisy = np.ascontiguousarray(np.nan_to_num(rgb, nan=0.0, posinf=0.0, neginf=0.0), np.float32)
    return np.array(oidn.denoise(noisy, albedo=albedo, normal=normal, hdr=True, clean_aux=clean), np.float32)


def prefilter(albedo: np.ndarray, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both guides with their noise removed (of defocus, motion, rough glass), each by a filter of its own, as the
    denoiser's manual recommends. Shapes and ranges as for :func:`denoise`."""
    with _lock:
        return _filtered("albedo", albedo).clip(0.0, 1.0), _filtered("normal", normal).clip(-1.0, 1.0)


@cache
def _device():
    oidn = denoiser()
    return oidn.Device(oidn.DeviceType.Default)  # the fastest there is


def _filtered(name: str, image: np.ndarray) -> np.ndarray:
    """`mitsuba_oidn.denoise` needs a colour image, so that a guide alone goes through the filter that it wraps."""
    oidn = denoiser()
    image = np.ascontiguousarray(image, np.float32)
    shape = {"width": image.shape[1], "height": image.shape[0], "format": oidn.Format.Float3}
    device = _device()
    source, target = device.new_buffer(image.nbytes), device.new_buffer(image.nbytes)
    source.write(image)
    guide = device.new_filter("RT")
    guide.set_image(name, source, **shape)
    guide.set_image("output", target, **shape)
    guide.execute()
    clean = np.empty_like(image)
    target.read(clean)
    return clean
