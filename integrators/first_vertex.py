"""What ``nirc_two_level`` samples at the first surface that is not a mirror."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from mi_neural.caches.material import material_of
from mi_neural.estimators import two_level
from mi_neural.estimators.spread import SHARP_PDF
from mi_neural.render import path as paths
from mi_neural.render import vertex

#: Share of the scene's mean radiance that RIS grants every direction, so that light unknown to the cache is found.
DEFENSIVE = 0.25
#: Dimensions of the stratified numbers of cache samples, and of the number that decides which are traced
EXTRA, EXTRA_LOBE, KEPT = range(paths.FREE, paths.FREE + 3)
#: Dimensions of the numbers that decide together, from here on one for each depth of each traced path
TOGETHER = 16


@dataclass
class Sums:
    """Sums over the traced samples of a first vertex: direct light, the cache's predictions, the residuals of indirect
    light, and pixels covered."""

    direct: mi.Color3f
    cache: mi.Color3f
    residual: mi.Color3f
    covered: mi.Float


class FirstVertex:
    """What is sampled at the first surface that is not a mirror.

    path      the path that stands there
    α         coefficient of the control variate
    queried   where the cache is queried; `helps` says whether its terms do anything
    """

    def __init__(self, integrator, field, path, alpha, helps, n_cache, ends):
        self.integrator, self.field, self.path = integrator, field, path
        self.bsdf = ends.bsdf(path)
        self.here = replace(path, L=mi.Color3f(0), β=mi.Color3f(1), η=mi.Float(1))
        self.α, self.features, self.queried = mi.Float(0), None, mi.Bool(False)
        if integrator.choice.may_ask and field is not None:
            queried = vertex.is_smooth(path.si, path.active) & helps
            self.α = integrator.coefficient(field, path.si, alpha, queried)
            self.queried = queried & ((self.α > 0) | (mi.Bool(integrator.ris) & (n_cache > 1)))
            more = material_of(field, path.si, path.si.bsdf(path.ray), self.queried)
            self.features = field.encode(path.si.p, vertex.facing(path.si), self.queried, **more)

    def candidate(self, lobe, direction) -> tuple:
        """(BSDF sample, its weight, whether it is of a mirror, the cache's prediction times the weight)."""
        si = self.path.si
        bs, weight, delta = paths.sample_bsdf(si, self.bsdf, lobe, direction, self.path.active)
        cached = mi.Color3f(0)
        if self.features is not None:
            queries = self.queried & ~delta & (bs.pdf <= SHARP_PDF)
            cached = dr.select(queries, weight * self.field.query(self.features, si.to_world(bs.wo), queries), 0)
        return bs, weight, delta, vertex.finite(cached, self.path.active)

    def traced_sample(self, scene, lights, i, n, probability, sums: Sums, sampler, beyond, ends, kept=None) -> tuple:
        """`sums` after one more direction: direct light, and indirect light traced with `probability`."""
        it, numbers = self.integrator, paths.stratified(sampler, n, i)
        bs, weight, delta, cached = self.candidate(numbers.lobe, numbers.direction) if kept is None else kept
        found, sampler = paths.bounce(
            scene, lights, self.here, sampler, numbers, bsdf=self.bsdf, sampled=(bs, weight, delta), direct=ends.direct
        )
        q = dr.select(delta | (bs.pdf > SHARP_PDF), 1, probability)
        keep = self.path.active & (sampler.together_1d(KEPT) < q)
        after = replace(paths.advance(self.here, found, it.depth_limit), L=mi.Color3f(0))
        after.active &= keep
        dimension = mi.UInt32(i) * 64 + TOGETHER
        if ends.outlook is not None:
            goes_on = dr.select(ends.foresees, ends.survival(after), 1)
            after, sampler = paths.roulette(after, sampler, it.rr_depth, u=sampler.together_1d(dimension), q=goes_on)
        after, sampler = beyond(after, sampler, dimension)
        return Sums(
            sums.direct + found.direct, sums.cache + cached,
            sums.residual + two_level.residual(after.L, cached, self.α, q, keep),
            sums.covered + dr.select(after.valid, 1, 0),
        ), sampler  # fmt: skip

    def cache_samples_only(self, n, sampler):
        """Sum of the cache's predictions in `n` directions that are not traced."""

        def sample(i, cache):
            numbers = sampler.stratified_1d(EXTRA_LOBE, n, i), sampler.stratified_2d(EXTRA, n, i)
            return i + 1, cache + self.candidate(*numbers)[3]

        return dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0)), lambda i, _: self.queried & (i < n), sample, label="cache samples"
        )[1]

    def resampled(self, n, sampler) -> tuple:
        """One of `n` directions, kept in proportion to what the cache predicts from there: (sum of its predictions,
        :meth:`candidate` with the RIS weight in it, sampler)."""
        defensive = DEFENSIVE * (self.field.scale if self.field is not None else mi.Float(1))

        def consider(i, cache, t_sum, t_kept, kept, sampler):
            new = self.candidate(sampler.stratified_1d(EXTRA_LOBE, n, i), sampler.stratified_2d(EXTRA, n, i))
            t = two_level.resampling_target(new[3], new[1], defensive)
            t_sum += t
            take = sampler.next_1d() * t_sum < t
            kept = tuple(dr.select(take, a, b) for a, b in zip(new, kept, strict=True))
            return i + 1, cache + new[3], t_sum, dr.select(take, t, t_kept), kept, sampler

        none = dr.zeros(mi.BSDFSample3f), mi.Color3f(0), mi.Bool(False), mi.Color3f(0)
        state = mi.UInt32(0), mi.Color3f(0), mi.Float(0), mi.Float(0), none, sampler
        _, cache, t_sum, t, (bs, weight, delta, cached), sampler = dr.while_loop(
            state, lambda i, *_: self.path.active & (i < n), consider, label="candidates"
        )
        w = two_level.resampling_weight(t_sum, mi.Float(n), t)
        return cache, (bs, w * weight, delta, w * cached), sampler
