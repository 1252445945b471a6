"""The traced part of a path that ends in a cache; where it ends, the caller says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_neural.transport import vertex
from mi_neural.transport.suffixes import Surface, scene_is_glossy, surface_of
from mi_neural.transport.termination import PathSpread

#: Dimensions of the stratified numbers of the first vertex
AA, NEE, BSDF, LOBE, LIGHT = range(5)


@dataclass
class Prefix:
    """A traced path, and where it stands at its end.

    L          light traced, emission that the camera sees included
    visible    whether the camera sees anything
    depth      segments up to its end
    ray, si    the last ray and what it met
    β          throughput up to there
    ends       whether a cache is to be asked there for all that `si` reflects
    ends_lit   whether for indirect light alone: direct light there is in `L`
    first      the first surface with a smooth lobe; None unless it was asked for
    β_first    throughput up to there, 0 without one
    share      weight of what a cache is to say of `first`; `β` and `L` hold the rest
    glossy     see :func:`~mi_neural.transport.suffixes.scene_is_glossy`
    """

    L: mi.Color3f
    visible: mi.Bool
    depth: mi.UInt32
    ray: mi.Ray3f
    si: mi.SurfaceInteraction3f
    β: mi.Color3f
    ends: mi.Bool
    ends_lit: mi.Bool
    first: Surface | None
    β_first: mi.Color3f
    share: mi.Float
    glossy: bool


def trace(integrator, scene, lights, sampler, ray, active, stop: Callable | None, look: bool = False) -> Prefix:
    """Trace paths as ``path`` does, up to where ``stop(si, spread, smooth, first, sampler)`` ends them.

    It is asked at each vertex and returns (share, ends, ends lit), see :class:`Prefix`; a share counts at the `first`
    `smooth` vertex, and 1 ends the path. None: paths run on. `look`: keep the first surface.
    """
    ctx = mi.BSDFContext()
    glossy = scene_is_glossy(scene)
    max_depth = mi.UInt32(integrator.max_depth if integrator.max_depth >= 0 else 0xFFFFFFFF)
    active = mi.Bool(active) & (max_depth > 0)

    # --------------------- What the camera sees --------------------
    if integrator.hide:
        pi = integrator.skip_area_emitters(scene, mi.Ray3f(ray), True, active)
        si = pi.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, active)
    else:
        si = scene.ray_intersect(ray, active)
    shown = active & (si.is_valid() | (not integrator.hide))
    L = vertex.emission(scene, si, shown)
    visible = active & si.is_valid() | shown & (dr.max(L) > 0)
    active &= si.is_valid() & (max_depth > 1)

    def is_smooth(si, active):
        return active & si.is_valid() & vertex.has_smooth(si.bsdf())

    def arrive(si, ray, spread, started, smooth, β, view, sampler):
        """Decide at a vertex: (ends, ends lit, throughput of what is traced on, share and view)."""
        first = smooth & ~started
        share, ends, ends_lit = stop(si, spread, smooth, first, sampler)
        share = dr.select(first, share, 0)
        whole = share >= 1
        if view:
            surface, β_first, kept = view
            view = (
                dr.select(first, surface_of(si, si.bsdf(ray), first, glossy), surface), dr.select(first, β, β_first),
                dr.select(first, share, kept),
            )  # fmt: skip
        return smooth & ends & ~whole, smooth & ends_lit & ~whole, β * (1 - share), view, whole

    smooth = is_smooth(si, active)
    spread = PathSpread.start(dr.width(si.t)).arrive(si, ray, mi.Float(1), mi.Bool(True), smooth)
    ends, ends_lit, whole, β, view = mi.Bool(False), mi.Bool(False), mi.Bool(False), mi.Color3f(1), ()
    if stop is not None:
        if look:
            n = dr.width(si.t)
            view = (dr.zeros(Surface, n), dr.zeros(mi.Color3f, n), dr.zeros(mi.Float, n))
        ends, ends_lit, β, view, whole = arrive(si, ray, spread, mi.Bool(False), smooth, β, view, sampler)
    # Numbers of the first vertex, which spread evenly over the samples of a pixel
    first = [sampler.stratified_1d(LOBE), sampler.stratified_2d(BSDF), sampler.stratified_1d(LIGHT),
             sampler.stratified_2d(NEE)]  # fmt: skip

    def bounce(depth, ray, si, β, η, L, spread, ends, ends_lit, active, sampler, *view):
        # ------------------- One BSDF sample ----------------------
        bsdf = si.bsdf(ray)
        independent = [sampler.next_1d(), sampler.next_2d(), sampler.next_1d(), sampler.next_2d()]
        u_lobe, u_bsdf, u_light, u_nee = (dr.select(depth == 1, a, b) for a, b in zip(first, independent, strict=True))
        bs, weight = bsdf.sample(ctx, si, u_lobe, u_bsdf, active)
        weight = vertex.finite(weight, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        next_ray = si.spawn_ray(si.to_world(bs.wo))
        followed = active & (dr.max(weight) > 0)
        si_next = scene.ray_intersect(next_ray, followed)

        # ---------------------- Direct light ----------------------
        L_nee, Le = vertex.emitted(
            scene, lights, si, bsdf, u_light, u_nee, sampler, active, si_next, bs.pdf, delta, followed
        )
        L += β * (L_nee + weight * Le)

        # --------- Roulette (must cancel out η² to obtain unitless throughput)
        β_next, η_next = β * weight, η * bs.eta
        alive = followed & ~ends_lit & si_next.is_valid() & (depth + 1 < max_depth) & (dr.max(β_next) > 0)
        roulette = depth >= integrator.rr_depth
        q = dr.minimum(dr.max(β_next) * η_next**2, 0.95)
        alive &= ~roulette | (sampler.next_1d() < q)
        β_next = dr.select(roulette, β_next * dr.rcp(dr.maximum(q, 1e-6)), β_next)

        # ------------------- Stop at the next vertex? -------------
        goes_on = mi.Bool(alive)
        if stop is not None:
            smooth = is_smooth(si_next, alive)
            started = spread.started
            spread = spread.arrive(si_next, next_ray, bs.pdf, delta, smooth)
            now, now_lit, β_next, view, whole = arrive(
                si_next, next_ray, spread, started, smooth, β_next, view, sampler
            )
            # One that ends lit is here once more, for direct light, and stays
            β_next, si_next = dr.select(ends_lit, β, β_next), dr.select(ends_lit, si, si_next)
            ends |= now
            ends_lit |= now_lit
            goes_on &= ~(now | whole)
        return depth + dr.select(alive, 1, 0), next_ray, si_next, β_next, η_next, L, spread, ends, ends_lit, goes_on, \
            sampler, *view  # fmt: skip

    state = (mi.UInt32(1), mi.Ray3f(ray), si, β, mi.Float(1), L, spread, ends, ends_lit, active & ~(ends | whole),
             sampler, *view)  # fmt: skip
    depth, ray, si, β, _, L, _, ends, ends_lit, _, sampler, *view = dr.while_loop(
        state, lambda *state: state[9], bounce, label="path prefix"
    )
    surface, β_first, share = view or (None, mi.Color3f(0), mi.Float(0))
    return Prefix(L, visible, depth, ray, si, β, ends, ends_lit, surface, β_first, share, glossy)
