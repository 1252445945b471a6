"""The way of a camera ray to the first surface where a cache can be asked."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural.transport import vertex


def first_vertex(integrator, scene, sampler, ray, active):
    """Follow the camera ray through delta surfaces to the first one with a smooth lobe.

    Returns (emission on the way, throughput, last ray, its intersection, segments traced, visible, active,
    sampler).
    """
    ctx = mi.BSDFContext()
    ray = mi.RayDifferential3f(ray)
    active = mi.Bool(active)
    max_depth = integrator.max_depth if integrator.max_depth >= 0 else 0x7FFFFFFF
    active &= max_depth > 0

    if integrator.hide:
        pi = integrator.skip_area_emitters(scene, mi.Ray3f(ray), True, active)
        si = pi.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, active)
    else:
        si = scene.ray_intersect(ray, active)
    visible = active & si.is_valid()
    shown = active & (si.is_valid() | (not integrator.hide))
    L = vertex.emission(scene, si, shown)
    visible |= shown & (dr.max(L) > 0)
    β = dr.select(active & si.is_valid(), mi.Color3f(1), 0)

    def is_delta(si, active):
        return active & si.is_valid() & ~vertex.has_smooth(si.bsdf())

    # Only a delta surface needs the loop: the others are done
    chain = is_delta(si, active)

    def bounce(depth, ray, β, L, chain, sampler):
        si = scene.ray_intersect(ray, chain)
        seen = chain & (depth > 0)
        L += dr.select(seen, β * vertex.emission(scene, si, seen), 0)
        goes_on = is_delta(si, chain)
        bs, weight = si.bsdf().sample(ctx, si, sampler.next_1d(), sampler.next_2d(), goes_on)
        β = dr.select(goes_on, β * weight, dr.select(chain & ~si.is_valid(), 0, β))
        roulette = goes_on & (depth >= max(integrator.rr_depth, 8))
        q = dr.minimum(dr.max(β), 0.95)
        goes_on &= (dr.max(β) > 0) & (depth + 1 < max_depth) & (~roulette | (sampler.next_1d() < q))
        β = dr.select(roulette, β * dr.rcp(dr.maximum(q, 1e-6)), β)
        β = dr.select(is_delta(si, chain) & ~goes_on, 0, β)
        ray = dr.select(goes_on, si.spawn_ray(si.to_world(bs.wo)), ray)
        return depth + dr.select(goes_on, 1, 0), ray, β, L, goes_on, sampler

    depth, ray, β, L, _, sampler = dr.while_loop(
        (mi.UInt32(0), mi.Ray3f(ray), β, L, mi.Bool(chain), sampler),
        lambda depth, ray, β, L, chain, sampler: chain, bounce, label="delta chain",
    )  # fmt: skip
    si_chain = scene.ray_intersect(ray, chain & (dr.max(β) > 0))
    si = dr.select(chain, si_chain, si)
    active = (dr.max(β) > 0) & si.is_valid() & (depth + 1 < max_depth)
    return L, β, ray, si, depth + 1, visible, active, sampler
