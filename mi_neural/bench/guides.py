"""Guides of the denoiser: what each pixel shows, without its light.

The guides are albedo and shading normal of the first surface with a smooth lobe. Mirrors, glass and null surfaces are
followed up to there, so that a reflection is as sharp as what it shows, and the albedo is that of all lobes together
(:func:`~mi_neural.render.surface.surface_of`), so that metal is not black. Their noise is filtered before they are
used.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.image import denoise as oidn
from mi_neural.render.film import sensor_of

#: Samples a pixel of the guides. With the noise filtered, 64 are 0 to 3 % better in trimmed relMSE (studies/guides.py).
GUIDE_SPP = 16


@dataclass(frozen=True)
class Guides:
    """Albedo in [0, 1] and shading normals in [-1, 1] (world space), float32 of shape (height, width, 3), noise removed
    where the denoiser is installed (`clean`)."""

    albedo: np.ndarray
    normal: np.ndarray
    clean: bool

    def denoise(self, image) -> mi.TensorXf:
        """The image without its noise; see :func:`denoise`."""
        pixels = np.array(image, np.float32)
        if pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
            raise ValueError(f"the image has shape {pixels.shape}; denoising takes (height, width, 3), or 4 with "
                             "alpha: pass image[..., :3] of one with further channels")  # fmt: skip
        if pixels.shape[:2] != self.albedo.shape[:2]:
            (h, w), (height, width) = pixels.shape[:2], self.albedo.shape[:2]
            raise ValueError(f"the image has {w}x{h} pixels, the film of the sensor {width}x{height}")
        pixels[..., :3] = oidn.denoise(np.ascontiguousarray(pixels[..., :3]), self.albedo, self.normal, self.clean)
        return mi.TensorXf(pixels)


def denoise(image, scene, sensor: int | mi.Sensor = 0, seed: int = 0) -> mi.TensorXf:
    """Remove the noise of an image of `scene` by Open Image Denoise.

    Albedo and normals are rendered for it (16 samples a pixel, through mirrors and glass). For several images of one
    view render them once: ``guides = mi_neural.guides(scene)``, then ``guides.denoise(image)``.

    image     linear RGB or RGBA, shape (height, width, 3 or 4): what ``mi.render`` returns, an array or a ``Bitmap``;
              alpha stays as it is
    sensor    the sensor that it was rendered by, or its number in the scene
    seed      of the guides

    Returns a tensor of the image's shape. Raises ``ImportError`` where the package `mitsuba-oidn` is not installed
    (``pip install 'mi_neural[denoise]'``), ``ValueError`` for another shape or size.
    """
    oidn.denoiser()
    return guides(scene, sensor, seed).denoise(image)


def guides(scene, sensor: int | mi.Sensor = 0, seed: int = 0) -> Guides:
    """The denoiser's guides of a view of `scene`, through the film and reconstruction filter of the sensor."""
    camera = sensor_of(scene, sensor, "guides")
    n_samples = camera.sampler().sample_count()  # restored below; Mitsuba would keep ours for later renderings
    with dr.suspend_grad():
        image = _integrator().render(scene, camera, seed=seed, spp=GUIDE_SPP, develop=True, evaluate=False)
        values = np.nan_to_num(np.array(image)[..., -6:].astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
        camera.sampler().set_sample_count(n_samples)
        camera.sampler().seed(0, 1)  # or the sampler's state keeps the loop alive
    albedo = np.ascontiguousarray(values[..., :3].clip(0.0, 1.0))
    normal = np.ascontiguousarray(values[..., 3:].clip(-1.0, 1.0))
    try:
        return Guides(*oidn.prefilter(albedo, normal), clean=True)
    except ImportError:
        return Guides(albedo, normal, clean=False)


def _integrator():
    """What renders the guides; Mitsuba's own in variants that paths of this package do not run in."""
    if mi.is_rgb and not mi.is_polarized and mi.variant().startswith(("llvm", "cuda")):
        from mi_neural.integrators.guides import GuideIntegrator  # of the variant that is set now

        return GuideIntegrator(mi.Properties())
    return mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
