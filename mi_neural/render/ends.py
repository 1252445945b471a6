"""Where paths end, and which shadow rays are traced: by what is expected of them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..estimators import roulette
from . import path as paths
from . import vertex


class Ends:
    """Where paths end: with which probability they go on, and a shadow ray is traced.

    By the throughput from the camera, as in ``path``; where `strength` is positive by the radiance that an `outlook`
    expects, relative to that of the first vertex, where `first` stands. `share`: of directions, from its guide.
    """

    def __init__(self, outlook, strength, share, first, rr_depth: int):
        self.share = share
        self.outlook, self.strength, self.rr_depth, self.β_first = outlook, strength, rr_depth, first.β
        if outlook is None:
            self.direct = None
            return
        self.foresees = strength > 0
        self.level = outlook.level_at(first.si, first.active & self.foresees)

    def survival(self, path):
        """Probability that a path goes on from where it has arrived."""
        plain = paths.survival(path, self.rr_depth, self.β_first)
        if self.outlook is None:
            return plain
        smooth = vertex.is_smooth(path.si, path.active) & self.foresees
        expected = mi.luminance(path.β) * self.outlook.ahead_at(path.si, smooth)
        least = roulette.least_of(dr.max(path.β))
        return dr.select(smooth, roulette.survival(expected, self.level, self.strength, least), plain)

    def bsdf(self, path):
        """The BSDF where a path stands, with directions from the guide."""
        bsdf = path.si.bsdf(path.ray)
        guide = None if self.outlook is None else self.outlook.guide
        return bsdf if guide is None else guide.guided(bsdf, path.si, self.share, path.active)

    def direct(self, scene, lights, path, bsdf, found, numbers, sampler, alone=None):
        """Direct light, shadow rays being left out by chance where little light is expected to arrive."""
        here = Shaded(path, bsdf, found, self)
        return paths.direct_light(scene, lights, path, bsdf, found, numbers, sampler, alone, here)


class Shaded(paths.Surface):
    """A surface whose shadow rays are traced with a probability: E[light arriving] is kept."""

    untested = True

    def __init__(self, path, bsdf, found, ends: Ends):
        super().__init__(path, bsdf, found)
        self.β, self.ends = path.β, ends

    def light_arriving(self, scene, tested, ds, light, f, sampled, sampler):
        ends = self.ends
        sampled &= dr.max(f * light) > 0
        visible = ends.outlook.visible_at(self.it, sampled & ends.foresees)
        expected = mi.luminance(self.β * f * light) * dr.sqrt(visible)
        least = roulette.least_of(dr.max(self.β), roulette.LEAST_SHADOW)
        q = roulette.survival(expected, ends.level, ends.strength, least)
        sampled &= sampler.next_1d() < q
        sampled &= ~scene.ray_test(self.it.spawn_ray_to(ds.p), sampled)
        return light / q, sampled, sampler
