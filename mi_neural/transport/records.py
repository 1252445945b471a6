"""Training records, and the paths that make them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import vertex

#: Delta surfaces that the end of a training path is followed through.
MAX_CHAIN = 16


@dataclass
class TrainingRecords:
    """A fixed number of records; where `valid` is false, a record holds nothing.

    position   points on surfaces, world space
    direction  unit vectors, away from the surface
    normal     unit shading normals, on the side of `direction`
    target     estimates of the radiance that arrives at `position` from `direction` after at least one reflection
    valid      mask
    """

    position: mi.Point3f
    direction: mi.Vector3f
    normal: mi.Vector3f
    target: mi.Color3f
    valid: mi.Bool


def empty_records(n: int) -> TrainingRecords:
    """`n` records that hold nothing."""
    return TrainingRecords(
        dr.zeros(mi.Point3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Color3f, n),
        dr.zeros(mi.Bool, n),
    )  # fmt: skip


def trace_training_paths(
    scene, sensor, sampler, n_paths: int, n_vertices: int, tail: Callable
) -> tuple[TrainingRecords, mi.UInt32]:
    """Paths from random points of the film; each non-delta vertex but the last gives one record.

    The target at vertex k and its sampled direction is the radiance reflected there by vertex k+1,

        R_{k+1} = N_{k+1} + f_{k+1} (E_{k+2} + R_{k+2}),

    N being next-event estimation, E the emission met by the BSDF ray (the two share the direct light by MIS) and f the
    BSDF sample's weight. Emission met directly by the record's own direction is not part of it: it belongs to direct
    light at the record. At the last vertex ``tail(si, bsdf, active, sampler)`` stands for R without N: an estimate from
    the cache (self-training), or 0.

    Returns ``n_paths * (n_vertices - 1)`` records, and how many targets were not finite and were left out.
    """
    n_kept = n_vertices - 1
    size = n_paths * n_kept
    lane = dr.arange(mi.UInt32, n_paths)
    ctx = mi.BSDFContext()

    records = empty_records(size)
    E, N, f = (dr.zeros(mi.Color3f, size) for _ in range(3))

    # Stratified over the film: paths are the samples of one pixel, the film
    ray, _ = sensor.sample_ray(
        sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time(),
        sampler.next_1d(), sampler.stratified_2d(0), sampler.next_2d(),
    )  # fmt: skip

    def arrive(ray, p_prev, n_prev, pdf, delta, active):
        si = scene.ray_intersect(ray, active)
        return si, vertex.emission_mis(scene, si, p_prev, n_prev, pdf, delta, active)

    def bounce(k, ray, p_prev, n_prev, pdf, delta, active, sampler):
        si, Le = arrive(ray, p_prev, n_prev, pdf, delta, active)
        active &= si.is_valid()
        bsdf = si.bsdf(ray)
        smooth = active & vertex.has_smooth(bsdf)
        L_nee = vertex.direct_light(scene, si, bsdf, sampler.next_2d(), smooth)

        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        wo = si.to_world(bs.wo)
        alive = active & (dr.max(weight) > 0)

        i = k * n_paths + lane
        dr.scatter(E, Le, i)
        dr.scatter(N, L_nee, i)
        dr.scatter(f, dr.select(alive, weight, 0), i)
        dr.scatter(records.position, si.p, i)
        dr.scatter(records.direction, wo, i)
        n = mi.Vector3f(si.sh_frame.n)
        dr.scatter(records.normal, dr.mulsign(n, dr.dot(n, wo)), i)
        dr.scatter(records.valid, alive & smooth & ~delta, i)
        return k + 1, si.spawn_ray(wo), mi.Point3f(si.p), mi.Normal3f(si.n), mi.Float(bs.pdf), delta, alive, sampler

    state = dr.while_loop(
        (mi.UInt32(0), mi.Ray3f(ray), mi.Point3f(ray.o), mi.Normal3f(0, 0, 1), mi.Float(1), mi.Bool(True),
         mi.Bool(True), sampler),
        lambda k, ray, p, n, pdf, delta, active, sampler: active & (k < n_kept),
        bounce,
        label="training paths",
    )  # fmt: skip
    _, ray, p_prev, n_prev, pdf, delta, active, sampler = state

    # The last vertex; if it is a mirror or glass, the one that is seen through it
    si, E_next = arrive(ray, p_prev, n_prev, pdf, delta, active)

    def is_delta(si, active):
        return active & si.is_valid() & ~vertex.has_smooth(si.bsdf())

    def look_through(k, ray, β, R, chain, sampler):
        si = scene.ray_intersect(ray, chain)
        bs, weight = si.bsdf().sample(ctx, si, sampler.next_1d(), sampler.next_2d(), chain)
        β = dr.select(chain, vertex.finite(β * weight, chain), β)
        ray = dr.select(chain, si.spawn_ray(si.to_world(bs.wo)), ray)
        si = scene.ray_intersect(ray, chain)
        R += dr.select(chain, β * vertex.emission(scene, si, chain), 0)
        return k + 1, ray, β, R, is_delta(si, chain) & (dr.max(β) > 0), sampler

    chain = is_delta(si, active)
    _, ray, β, R, _, sampler = dr.while_loop(
        (mi.UInt32(0), mi.Ray3f(ray), mi.Color3f(1), mi.Color3f(0), mi.Bool(chain), sampler),
        lambda k, ray, β, R, chain, sampler: chain & (k < MAX_CHAIN), look_through, label="delta chain",
    )  # fmt: skip
    si = dr.select(chain, scene.ray_intersect(ray, chain), si)
    active &= si.is_valid()
    bsdf = si.bsdf(ray)
    smooth = active & vertex.has_smooth(bsdf)
    L_nee = vertex.direct_light(scene, si, bsdf, sampler.next_2d(), smooth, alone=True)
    R += dr.select(smooth, β * (L_nee + tail(si, bsdf, smooth, sampler)), 0)

    # Back to front. A path that ended early carries zeros from there on; its last vertex' emission is in E.
    dr.eval(E, N, f, E_next, R, records)
    for k in reversed(range(n_kept)):
        i = k * n_paths + lane
        dr.scatter(records.target, R, i)
        R = dr.gather(mi.Color3f, N, i) + dr.gather(mi.Color3f, f, i) * (E_next + R)
        E_next = dr.gather(mi.Color3f, E, i)

    finite = dr.all(dr.isfinite(records.target))
    n_bad = dr.count(records.valid & ~finite)
    records.valid &= finite
    records.target = dr.select(records.valid, records.target, 0)
    return records, n_bad
