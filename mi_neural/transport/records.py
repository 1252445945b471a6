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
    normal     unit shading normals, on the side that the path came from
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


def leave_out_nonfinite(records: TrainingRecords) -> mi.UInt32:
    """Make records invalid, and harmless, of which anything is not finite; returns how many.

    Positions, directions and normals are so where those of a mesh are.
    """
    finite = mi.Bool(True)
    for v in (records.position, records.direction, records.normal, records.target):
        finite &= dr.all(dr.isfinite(v))
    n_bad = dr.count(records.valid & ~finite)
    records.valid &= finite
    up = mi.Vector3f(0, 0, 1)
    records.position = dr.select(finite, records.position, 0)
    records.direction, records.normal = (dr.select(finite, v, up) for v in (records.direction, records.normal))
    records.target = dr.select(records.valid, records.target, 0)
    return n_bad


def trace_training_paths(
    scene, sensor, sampler, n_paths: int, n_vertices: int, tail: Callable, lights=None
) -> tuple[TrainingRecords, mi.UInt32]:
    """Paths from random points of the film; each non-delta vertex but the last gives one record.

    The target at vertex k and its sampled direction is the radiance reflected there by vertex k+1,

        R_{k+1} = N_{k+1} + f_{k+1} (E_{k+1} + R_{k+2}),

    N being next-event estimation at vertex k+1, E the emission met by its BSDF ray (the two share the direct light by
    MIS) and f the BSDF sample's weight. `lights` chooses lights; None: the scene itself. Emission met directly by the
    record's own direction is not part of it: it belongs to direct light at the record. At the last vertex ``tail(si,
    bsdf, active, sampler)`` stands for R without N: an estimate from the cache (self-training), or 0.

    Returns ``n_paths * (n_vertices - 1)`` records, and how many were left out because not all of them was finite.
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

    def bounce(k, ray, si, active, sampler):
        bsdf = si.bsdf(ray)
        smooth = active & vertex.has_smooth(bsdf)
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        wo = si.to_world(bs.wo)
        alive = active & (dr.max(weight) > 0)
        ray = si.spawn_ray(wo)
        si_next = scene.ray_intersect(ray, alive)
        L_nee, Le = vertex.emitted(
            scene, lights, si, bsdf, sampler.next_1d(), sampler.next_2d(), sampler, active, si_next, bs.pdf, delta,
            alive,
        )  # fmt: skip

        i = k * n_paths + lane
        dr.scatter(E, Le, i)
        dr.scatter(N, L_nee, i)
        dr.scatter(f, dr.select(alive, weight, 0), i)
        dr.scatter(records.position, si.p, i)
        dr.scatter(records.direction, wo, i)
        dr.scatter(records.normal, vertex.facing(si), i)
        dr.scatter(records.valid, alive & smooth & ~delta, i)
        return k + 1, ray, si_next, alive & si_next.is_valid(), sampler

    si = scene.ray_intersect(ray)
    _, ray, si, active, sampler = dr.while_loop(
        (mi.UInt32(0), mi.Ray3f(ray), si, si.is_valid(), sampler),
        lambda k, ray, si, active, sampler: active & (k < n_kept),
        bounce,
        label="training paths",
    )

    # The last vertex; if it is a mirror or glass, the one that is seen through it
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
    # Direct light with a BSDF ray to share the work: next-event estimation alone varies without bound beside an emitter
    bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), smooth)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    followed = smooth & (dr.max(weight) > 0)
    si_next = scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)), followed)
    L_nee, Le = vertex.emitted(
        scene, lights, si, bsdf, sampler.next_1d(), sampler.next_2d(), sampler, smooth, si_next, bs.pdf, delta, followed
    )
    L_nee += vertex.finite(weight * Le, followed)
    R += dr.select(smooth, β * (L_nee + tail(si, bsdf, smooth, sampler)), 0)

    # Back to front. E and N of a vertex belong to it: what its own ray met, and its next-event estimation. A path that
    # ended early carries zeros from there on.
    dr.eval(E, N, f, R, records)
    for k in reversed(range(n_kept)):
        i = k * n_paths + lane
        dr.scatter(records.target, R, i)
        R = dr.gather(mi.Color3f, N, i) + dr.gather(mi.Color3f, f, i) * (dr.gather(mi.Color3f, E, i) + R)

    return records, leave_out_nonfinite(records)
