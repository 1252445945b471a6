"""What renders the denoiser's guides; :mod:`mi_neural.bench.guides` has what users call."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural.render import path as paths
from mi_neural.render.surface import surface_of

#: Mirrors that are followed.
MAX_MIRRORS = 8


class GuideIntegrator(mi.SamplingIntegrator):
    """Albedo and normal as six channels beside a black image."""

    def __init__(self, props):
        super().__init__(props)
        self.max_depth, self.hide = -1, False

    def sample(self, scene, sampler, ray, medium=None, active=True):
        path = paths.camera_vertex(self, scene, ray, active)
        path, sampler = paths.follow_mirrors(scene, path, sampler, MAX_MIRRORS + 1, MAX_MIRRORS + 1)
        surface = surface_of(path.si, path.si.bsdf(path.ray), path.active, glossy=False)
        albedo = dr.select(path.active, path.β * surface.albedo, 0)
        normal = dr.select(path.active, surface.normal, 0)
        return mi.Color3f(0), path.valid, [*albedo, *normal]

    def aov_names(self):
        return [*(f"albedo.{c}" for c in "RGB"), *(f"normal.{c}" for c in "XYZ")]
