"""The traced part of a path that ends in a cache; where it ends, the caller decides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..estimators.spread import PathSpread
from . import path as paths
from .path import PathState
from .surface import Surface
from .walk import SURFACES, SurfaceWalk


@dataclass
class Prefix:
    """A traced path, and where it stands. A PyTree: it is the state of the loop.

    path      the path; ``path.L`` is the light traced, emission that the camera sees included
    spread    how wide it has become
    ends      whether a cache is queried at its end for all that is reflected there
    ends_lit  whether it is queried for indirect light alone: direct light there is in ``path.L``
    first     the first surface with a smooth lobe; None unless it was asked for
    β_first   throughput up to there, 0 without one
    share     weight of the cache at `first`; ``path.β`` and ``path.L`` hold the rest
    """

    path: PathState
    spread: PathSpread
    ends: mi.Bool
    ends_lit: mi.Bool
    first: Surface | None = None
    β_first: mi.Color3f | None = None
    share: mi.Float | None = None

    @property
    def queried(self):
        """Whether a cache is queried at the end of the path."""
        return self.ends | self.ends_lit


def trace(
    integrator, scene, lights, sampler, ray, active, stop: Callable | None, glossy: bool, look: bool = False,
    walk: SurfaceWalk = SURFACES,
):  # fmt: skip
    """Trace paths as ``path`` does, up to where `stop` ends them. Returns (:class:`Prefix`, sampler).

    ``stop(path, spread, smooth, first, sampler)`` is called at each vertex and returns (share, ends, ends lit,
    sampler), see :class:`Prefix`; a share counts at the `first` `smooth` vertex, and 1 ends the path. None: paths run
    on. `glossy`: see :func:`~mi_neural.render.surface.surface_of`. `look`: keep the first surface. `walk`: how paths go
    on from vertex to vertex.
    """
    path, sampler = walk.camera_vertex(integrator, scene, ray, sampler, active)
    never = mi.Bool(False)
    state = Prefix(path, PathSpread.start(dr.width(path.si.t)), never, never)
    if look:
        n = dr.width(path.si.t)
        state = replace(state, first=dr.zeros(Surface, n), β_first=dr.zeros(mi.Color3f, n), share=dr.zeros(mi.Float, n))
    if stop is not None:
        smooth = walk.terminal(path, path.active)
        state, sampler = _arrive(state, walk.start(ray, path, smooth), smooth, stop, sampler, glossy, walk)
    numbers_first = paths.stratified(sampler)

    def step(state, sampler):
        here = state.path
        numbers, sampler = paths.draw_numbers(sampler)
        if not walk.may_stay:
            numbers = dr.select(here.depth == 1, numbers_first, numbers)
        found, sampler = walk.bounce(integrator, scene, lights, here, sampler, numbers)
        path = walk.advance(integrator, here, found)
        path.active &= ~state.ends_lit
        path, sampler = paths.roulette(path, sampler, integrator.rr_depth + walk.later)
        if stop is None:
            return replace(state, path=path), sampler
        smooth = walk.terminal(path, path.active)
        spread = walk.spread(state.spread, here, found, path, smooth)
        after, sampler = _arrive(replace(state, path=path), spread, smooth, stop, sampler, glossy, walk)
        # Paths that stop with direct light still pending made this iteration for it, and stay where they were
        stays = replace(here, L=path.L, valid=path.valid, active=mi.Bool(False))
        after.path = dr.select(state.ends_lit, stays, after.path)
        return after, sampler

    return dr.while_loop(
        (state, sampler), lambda state, sampler: state.path.active, step, label="path prefix"
    )


def _arrive(state: Prefix, spread: PathSpread, smooth, stop: Callable, sampler, glossy: bool, walk) -> tuple:
    """Decide whether the path ends where it now stands, as wide as `spread` says, at a `smooth` vertex or not."""
    path = state.path
    first = smooth & ~state.spread.started
    share, ends, ends_lit, sampler = stop(path, spread, smooth, first, sampler)
    share = dr.select(first, share, 0)
    whole = share >= 1
    ends, ends_lit = smooth & ends & ~whole, smooth & ends_lit & ~whole
    after = Prefix(
        replace(path, β=path.β * (1 - share), active=path.active & ~(ends | whole)), spread, state.ends | ends,
        state.ends_lit | ends_lit, state.first, state.β_first, state.share,
    )  # fmt: skip
    if state.first is not None:
        surface = walk.surface(path, first, glossy)
        after.first = dr.select(first, surface, state.first)
        after.β_first = dr.select(first, path.β, state.β_first)
        after.share = dr.select(first, share, state.share)
    return after, sampler
