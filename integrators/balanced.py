"""Paths that stop in a cache of incident radiance by chance: the balanced heuristic (Dereviannykh et al. 2025)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_neural.caches.blend import sigma_channels
from mi_neural.caches.material import material_of, needs_material
from mi_neural.estimators import spread
from mi_neural.render import path as paths
from mi_neural.render import vertex


@dataclass
class End:
    """Where a path has stopped: at `position`, where the cache is queried for the light from `direction` (both in world
    space), times the throughput `β`. `material`: what else the cache needs of the surface, by name. A PyTree."""

    position: mi.Point3f
    normal: mi.Vector3f
    direction: mi.Vector3f
    β: mi.Color3f
    queried: mi.Bool
    material: dict


class Thinned(paths.Surface):
    """A surface whose BSDF rays are followed with the probability ``keep(pdf)``: their density is so much less."""

    def __init__(self, path, bsdf, found, keep):
        super().__init__(path, bsdf, found)
        self.keep = keep

    def pdf(self):
        pdf = super().pdf()
        return pdf * self.keep(pdf)

    def eval_pdf(self, d, active):
        f, pdf = super().eval_pdf(d, active)
        return f, pdf * self.keep(pdf)


def estimate(integrator, scene, lights, field, path, sampler):
    """A path that stops at each vertex with a probability t of its own, by what an integrator's `estimate` returns.

    t = Nc p_f / (Nc p_f + p_g) for the sampled BSDF direction, p_g its density; 0 for mirror lobes. Where the path
    stops no ray is traced, and the cache answers for that direction. Direct light is estimated at each vertex, its
    BSDF rays having the density p_g (1 - t).
    """
    n_cache = max(integrator.cache_samples, 1)
    first = paths.stratified(sampler)

    def keep(pdf):
        return spread.follow_probability(n_cache, pdf)

    def direct(scene, lights, path, bsdf, found, numbers, sampler, alone=None):
        here = Thinned(path, bsdf, found, keep)
        L_nee, Le, sampler = paths.direct_light(scene, lights, path, bsdf, found, numbers, sampler, alone, here)
        share = dr.select(found.followed & ~found.delta, keep(found.bs.pdf), 1)  # not 0: the ray was followed
        return L_nee, Le / share, sampler

    def step(path, end, direct_first, is_first, sampler):
        numbers, sampler = paths.draw_numbers(sampler)
        numbers = dr.select(is_first, first, numbers)
        bsdf = path.si.bsdf(path.ray)
        sampled = paths.sample_bsdf(path.si, bsdf, numbers.lobe, numbers.direction, path.active)
        bs, weight, delta = sampled
        stops = path.active & ~delta & (dr.max(weight) > 0) & (sampler.next_1d() >= keep(bs.pdf))
        found, sampler = paths.bounce(
            scene, lights, path, sampler, numbers, bsdf=bsdf, sampled=sampled,
            follow=lambda bs, delta: ~stops, direct=direct,
        )  # fmt: skip
        material = material_of(field, path.si, bsdf, stops)
        here = End(path.si.p, vertex.facing(path.si), found.ray.d, path.β * weight, stops, material)
        end = dr.select(stops, here, end)
        direct_first = dr.select(is_first, path.β * found.direct, direct_first)
        path, sampler = paths.roulette(paths.advance(path, found, integrator.depth_limit), sampler, integrator.rr_depth)
        return path, end, direct_first, mi.Bool(False), sampler

    seen, n = path.L, dr.width(path.si.t)
    material = {"material": (mi.Color3f(0), mi.Float(0))} if needs_material(field) else {}
    zeros = (dr.zeros(kind, n) for kind in (mi.Point3f, mi.Vector3f, mi.Vector3f, mi.Color3f, mi.Bool))
    none = End(*zeros, material)
    path, end, direct_first, _, sampler = dr.while_loop(
        (path, none, mi.Color3f(0), mi.Bool(True), sampler), lambda path, *_: path.active, step,
        label="balanced termination",
    )  # fmt: skip
    features = field.encode(end.position, end.normal, **end.material)
    cache = dr.select(end.queried, end.β * field.query(features, end.direction), 0)
    channels = {"direct": direct_first, "cache": cache, "residual": path.L - seen - direct_first}
    channels |= {"depth": path.depth - dr.select(end.queried, 1.0, 0.0)}  # no ray where it stopped
    channels |= {k: dr.select(end.queried, v, 0) for k, v in sigma_channels(field, end.position, end.normal).items()}
    return path.L + cache, dr.select(path.valid, mi.Float(1), 0), channels
