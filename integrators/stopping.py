"""Paths that stop in a cache of incident radiance, without a ray in the direction that is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_neural.caches.blend import sigma_channels
from mi_neural.caches.material import material_at, needs_material
from mi_neural.estimators import spread
from mi_neural.estimators.spread import SHARP_PDF, PathSpread
from mi_neural.render import path as paths
from mi_neural.render.kernels import end_kernel


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


class ByChance:
    """A path stops at each vertex with the probability t = Nc p_f / (Nc p_f + p_g), p_g being the density of its BSDF
    sample: the balanced heuristic (Dereviannykh et al. 2025)."""

    def __init__(self, n_cache: int):
        self.n_cache = max(n_cache, 1)

    def keep(self, pdf, wide):
        """Probability with which a ray of density `pdf` is followed."""
        return spread.follow_probability(self.n_cache, pdf)

    def wide(self, walk, path, spread):
        """What else that depends on."""
        return mi.Bool(False)


class WhereWide:
    """A path stops at the first vertex where its spread a exceeds c a_0 (Müller et al. 2021, sec. 3.4); sharp lobes are
    followed."""

    def __init__(self, threshold):
        self.threshold = threshold

    def keep(self, pdf, wide):
        return dr.select(wide & (pdf <= SHARP_PDF), 0, mi.Float(1))

    def wide(self, walk, path, spread):
        return walk.terminal(path, path.active) & spread.exceeds(self.threshold)


class Thinned:
    """A place whose BSDF rays are followed with the probability ``keep(pdf)``: their density is so much less.

    In all else what it is made of: a :class:`.path.Surface`, or a :class:`.media.Place`."""

    def __init__(self, place, keep):
        self.place, self.keep = place, keep

    def __getattr__(self, name):
        return getattr(self.place, name)

    def pdf(self):
        pdf = self.place.pdf()
        return pdf * self.keep(pdf)

    def eval_pdf(self, d, active):
        f, pdf = self.place.eval_pdf(d, active)
        return f, pdf * self.keep(pdf)


def estimate(integrator, scene, lights, field, path, sampler, rule):
    """A path that stops as the `rule` says, by what an integrator's `estimate` returns; `path` is at its first vertex.

    Mirror lobes are always followed. Where the path stops no ray is traced, and the cache answers for the direction of
    the BSDF sample. Direct light is estimated at each vertex. Its BSDF rays have the density p_g keep(p_g). Where media
    lie behind surfaces that let a part of the light pass, what shines through these competes with light samples at
    later vertices, too: all rays are traced then.
    """
    first, walk = paths.stratified(sampler), integrator.walk
    traces_all = walk.may_stay

    def step(path, end, spread, direct_first, is_first, sampler):
        numbers, sampler = paths.draw_numbers(sampler)
        numbers = dr.select(is_first, first, numbers)
        wide = rule.wide(walk, path, spread)

        def keep(pdf):
            return rule.keep(pdf, wide)

        def direct(scene, lights, path, bsdf, found, numbers, sampler, alone=None, here=None):
            here = Thinned(here or paths.Surface(path, bsdf, found), keep)
            L_nee, Le, sampler = paths.direct_light(scene, lights, path, bsdf, found, numbers, sampler, alone, here)
            share = dr.select(found.followed & ~found.delta, keep(found.pdf), 1)  # not 0: the ray was followed
            return L_nee, Le / share, sampler

        bsdf = path.si.bsdf(path.ray)
        turn = walk.sample(path, bsdf, numbers.lobe, numbers.direction)
        stops = path.active & ~turn.delta & (dr.max(turn.weight) > 0) & (sampler.next_1d() >= keep(turn.pdf))
        thinned = {} if traces_all else {"follow": lambda bs, delta: ~stops, "direct": direct}
        found, sampler = walk.bounce(integrator, scene, lights, path, sampler, numbers, bsdf, turn, **thinned)
        material = material_at(field, walk, path, bsdf, stops)
        here = End(*walk.place(path), found.ray.d, path.β * turn.weight, stops, material)
        end = dr.select(stops, here, end)
        direct_first = dr.select(is_first, path.β * found.direct, direct_first)
        before, path = path, walk.advance(integrator, path, found)
        if traces_all:
            path.active &= ~stops
        path, sampler = paths.roulette(path, sampler, integrator.rr_depth + walk.later)
        smooth = walk.terminal(path, path.active)
        spread = walk.spread(spread, before, found, path, smooth)
        return path, end, spread, direct_first, mi.Bool(False), sampler

    n = dr.width(path.si.t)
    a_0 = walk.camera_spread(path)
    grown = PathSpread(dr.zeros(mi.Float, n), a_0, mi.Float(path.length), mi.Bool(path.active))
    material = {"material": (mi.Color3f(0), mi.Float(0))} if needs_material(field) else {}
    zeros = (dr.zeros(kind, n) for kind in (mi.Point3f, mi.Vector3f, mi.Vector3f, mi.Color3f, mi.Bool))
    seen, none = path.L, End(*zeros, material)
    path, end, _, direct_first, _, sampler = dr.while_loop(
        (path, none, grown, mi.Color3f(0), mi.Bool(True), sampler), lambda path, *_: path.active, step,
        label="paths that stop",
    )  # fmt: skip
    end_kernel(path.L, path.valid, path.depth, end, direct_first, seen)
    features = field.encode(end.position, end.normal, **end.material)
    cache = dr.select(end.queried, end.β * field.query(features, end.direction), 0)
    channels = {"direct": direct_first, "cache": cache, "residual": path.L - seen - direct_first}
    channels |= {"depth": path.depth - dr.select(end.queried, 1.0, 0.0)}  # no ray where it stopped
    channels |= {k: dr.select(end.queried, v, 0) for k, v in sigma_channels(field, end.position, end.normal).items()}
    return path.L + cache, dr.select(path.valid, mi.Float(1), 0), channels
