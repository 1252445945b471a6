"""Reuse of light samples in ``restir_di``: over frames, and over pixels."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural.estimators import reservoir
from mi_neural.estimators.reservoir import Reservoir
from mi_neural.integrators import restir_samples as samples
from mi_neural.integrators.restir_past import alike


def frames(integrator, scene, power, past_power, si, kept, past, before, found, sampler) -> Reservoir:
    """Combine with what the pixel `before` kept in the last frame."""
    old = reservoir.clamp_history(past.kept.at(before, found), integrator.history)
    target = samples.target(integrator, scene, power, si, old.index, old.uv, found & (old.W > 0))
    us = [sampler.next_1d(), sampler.next_1d()]
    if not integrator.unbiased:
        return reservoir.combine([kept, old], [kept.target, target], us)
    si_old = dr.gather(mi.SurfaceInteraction3f, past.surface, before, found)
    swapped = samples.target(integrator, scene, past_power, si_old, kept.index, kept.uv, found & (kept.W > 0))
    shares = [reservoir.balance(kept.M, kept.target, old.M, swapped),
              reservoir.balance(old.M, old.target, kept.M, target)]  # fmt: skip
    return reservoir.combine([kept, old], [kept.target, target], us, shares)


def pixels(integrator, scene, power, si, kept, usable, pixel, width, height, sampler) -> Reservoir:
    """Combine with what pixels nearby kept, by defensive pairwise weights (biased: by 1/M)."""
    n = integrator.spatial_samples
    radius = integrator.spatial_radius if integrator.spatial_radius > 0 else min(max(height / 24, 4.0), 32.0)

    def neighbour(i, total, own_share, sampler):
        offset = mi.warp.square_to_uniform_disk(sampler.next_2d()) * radius
        x = mi.Int32(pixel % width) + mi.Int32(dr.round(offset.x))
        y = mi.Int32(pixel // width) + mi.Int32(dr.round(offset.y))
        near = usable & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        lane = mi.UInt32(dr.select(near, x + y * width, 0))
        near &= (lane != pixel) & dr.gather(mi.Bool, usable, lane, near)
        si_near = dr.gather(mi.SurfaceInteraction3f, si, lane, near)
        near &= alike(integrator, si, si.t, si_near, si_near.t)
        other = kept.at(lane, near)

        target = samples.target(integrator, scene, power, si, other.index, other.uv, near & (other.W > 0))
        share = other.M
        if integrator.unbiased:
            swapped = samples.target(integrator, scene, power, si_near, kept.index, kept.uv, near & (kept.W > 0))
            share, _ = reservoir.pairwise(other.M, other.target, kept.M, target, n)
            own_share += reservoir.pairwise(other.M, swapped, kept.M, kept.target, n)[1]
        total = reservoir.merge(total, other, target, share, sampler.next_1d())
        return i + 1, total, own_share, sampler

    _, total, own_share, sampler = dr.while_loop(
        (mi.UInt32(0), Reservoir.empty(dr.width(pixel)), mi.Float(kept.M), sampler),
        lambda i, *_: usable & (i < n), neighbour, label="neighbours",
    )  # fmt: skip
    return reservoir.finish(reservoir.merge(total, kept, kept.target, own_share, sampler.next_1d()))
