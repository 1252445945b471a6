"""Training paths of an outgoing radiance cache, with a record at every vertex that has a smooth lobe (Müller et al.
2021, section 3.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass

import drjit as dr
import mitsuba as mi

from . import vertex
from .records import MAX_CHAIN, TrainingRecords, empty_records, leave_out_nonfinite
from .samples import PathSampler
from .termination import PathSpread

#: Contents of a cache: all light that a surface reflects, or that without direct light.
CONTENTS = ("reflected", "indirect")
#: Fixed BSDF samples that albedo and roughness are read from.
N_LOBES = 2
#: Vertices after which a path without an end is given up; roulette ends nearly all before.
MAX_VERTICES = 256


@dataclass
class Surface:
    """A surface as an outgoing cache sees it; the arguments of ``OutgoingField.query``, in that order.

    position   world space
    normal     unit shading normal, on the side of `view`
    view       unit, away from the surface
    albedo     diffuse and specular reflectance together, see :func:`surface_of`
    roughness  1: as rough as Lambert's, 0: a mirror
    """

    position: mi.Point3f
    normal: mi.Vector3f
    view: mi.Vector3f
    albedo: mi.Color3f
    roughness: mi.Float

    def inputs(self) -> tuple:
        return self.position, self.normal, self.view, self.albedo, self.roughness


def scene_is_glossy(scene) -> bool:
    """Whether any surface has a lobe whose width the cache must know of; without one, roughness is 0 everywhere."""
    lobes = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.GlossyTransmission
    return any(s.bsdf() is not None and bool(int(s.bsdf().flags()) & int(lobes)) for s in scene.shapes())


def surface_of(si, bsdf, active, glossy: bool = True) -> Surface:
    """The surface at `si`, seen from where its ray came.

    Mitsuba says neither reflectance (of conductors and glossy lobes) nor roughness of a BSDF. Both are read off a few
    BSDF samples with fixed numbers, the peaks of its lobes: the mean weight ``f cos/p`` is the reflectance (exactly
    for Lambert's), and from a density p follows the roughness ``1/sqrt(π p)``. What matters is that training and query
    get the same answer at the same point: no noise. Without a `glossy` surface in the scene the roughness is 0.
    """
    albedo, roughness, total = mi.Color3f(0), mi.Float(0), mi.Float(1e-6)
    for i in range(N_LOBES):
        bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float((i + 0.5) / N_LOBES), mi.Point2f(0.5, 0.5), active)
        weight = dr.clip(vertex.finite(weight, active), 0, 4)
        albedo += weight * (1 / N_LOBES)
        if glossy:
            share = dr.max(weight)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            width = dr.minimum(dr.rsqrt(dr.pi * dr.maximum(bs.pdf, 1e-6)), 1)
            roughness += dr.select(delta, 0, share * width)
            total += share
    return Surface(
        mi.Point3f(si.p), vertex.facing(si), si.to_world(si.wi), dr.minimum(albedo, 1),
        roughness / total if glossy else mi.Float(0),
    )  # fmt: skip


class Roughened:
    """A BSDF, and where `lambert` is true a Lambertian of the same albedo in its place."""

    def __init__(self, bsdf, lambert, albedo):
        self.bsdf, self.lambert, self.albedo = bsdf, lambert, albedo

    def flags(self):
        return self.bsdf.flags()

    def sample(self, ctx, si, sample1, sample2, active=True):
        bs, weight = self.bsdf.sample(ctx, si, sample1, sample2, active & ~self.lambert)
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        bs.wo = dr.select(self.lambert, dr.mulsign(wo, si.wi.z), bs.wo)
        bs.pdf, bs.eta = dr.select(self.lambert, pdf, bs.pdf), dr.select(self.lambert, 1, bs.eta)
        diffuse = mi.UInt32(int(mi.BSDFFlags.DiffuseReflection))
        bs.sampled_type = dr.select(self.lambert, diffuse, bs.sampled_type)
        return bs, dr.select(self.lambert, self.albedo, weight)

    def eval_pdf(self, ctx, si, wo, active=True):
        f, pdf = self.bsdf.eval_pdf(ctx, si, wo, active & ~self.lambert)
        cosine = dr.select(wo.z * si.wi.z > 0, dr.abs(wo.z) * dr.inv_pi, 0)
        return dr.select(self.lambert, self.albedo * cosine, f), dr.select(self.lambert, cosine, pdf)


@dataclass
class OutgoingRecords:
    """A fixed number of records; where `valid` is false, a record holds nothing.

    target   estimates of the radiance that leaves `surface` towards its `view`, what the cache holds of it
    """

    surface: Surface
    target: mi.Color3f
    valid: mi.Bool


def _empty(n: int) -> OutgoingRecords:
    vectors = (dr.zeros(mi.Point3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Color3f, n))
    return OutgoingRecords(Surface(*vectors, dr.zeros(mi.Float, n)), dr.zeros(mi.Color3f, n), dr.zeros(mi.Bool, n))


@dataclass
class Bounces:
    """What happened at the vertices of training paths, vertex by vertex; beside their `OutgoingRecords`.

    direct     direct light that the vertex reflects towards its viewer, traced
    weight     ``f cos/p`` of the BSDF ray that left it
    incident   records of the radiance that this ray brought back, emission excluded; valid for rays of smooth lobes
    stops      whether the vertex that the ray met is where a pixel's path would end in the cache
    """

    direct: mi.Color3f
    weight: mi.Color3f
    incident: TrainingRecords
    stops: mi.Bool


@dataclass(frozen=True)
class Suffixes:
    """How training paths run.

    n_paths         paths
    n_vertices      longest path whose vertices give records, but the last
    suffix          where a path ends in the cache: ``spread``, at the second vertex where it has become wide
                    (termination; the first one ends the path of a pixel), or ``full``, at vertex `n_vertices`
    threshold       constant c of the spread test
    n_unbounded     paths that do not end in the cache, but run on until roulette or nothingness ends them
    world_share     share of the paths that start where earlier records lay, in place of the camera
    roughening      at each further bounce this share of a surface's BSDF becomes Lambertian
    content         see `CONTENTS`
    twins           whether the paths 2k and 2k + 1 start with the same ray
    """

    n_paths: int
    n_vertices: int
    suffix: str
    threshold: float
    n_unbounded: int
    world_share: float
    roughening: float
    content: str
    twins: bool = False


def first_rays(sensor, sampler, n_paths: int, world_share: float, places: tuple | None):
    """Rays from random points of the film; so many others to random `places` instead: positions and directions to
    their viewers (world space; not finite where unknown), and how far before them to start."""
    # Stratified over the film: paths are the samples of one pixel, the film
    ray, _ = sensor.sample_ray(
        sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time(),
        sampler.next_1d(), sampler.stratified_2d(0), sampler.next_2d(),
    )  # fmt: skip
    ray = mi.Ray3f(ray)
    if places is None or world_share <= 0:
        return ray
    # Every so many-th lane, evenly: multiples of the golden ratio
    lane = dr.arange(mi.UInt32, n_paths)
    world = mi.Float((lane * mi.UInt32(0x9E3779B9)) >> 8) * 2**-24 < world_share
    position, view, distance = places
    n_places = dr.width(position)
    i = dr.minimum(mi.UInt32(sampler.next_1d() * n_places), n_places - 1)
    p, w = dr.gather(mi.Point3f, position, i), dr.gather(mi.Vector3f, view, i)
    world &= dr.all(dr.isfinite(p))
    ray.o, ray.d = dr.select(world, p + distance * w, ray.o), dr.select(world, -w, ray.d)
    return ray


def trace_suffixes(
    scene, sensor, sampler, plan: Suffixes, query: Callable | None, lights=None, places: tuple | None = None,
    glossy: bool = True, first: Callable | None = None,
) -> tuple[OutgoingRecords, mi.UInt32, Bounces, mi.Color3f]:  # fmt: skip
    """Training paths; each vertex with a smooth lobe, but the last, gives one record.

    The radiance reflected at vertex k is

        S_k = N_k + f_k (E_k + S_{k+1}),

    N being next-event estimation, E the emission met by the BSDF ray (the two share the direct light by MIS) and f the
    BSDF sample's weight. It is the target for the content ``reflected``; for ``indirect`` that is ``f_k S_{k+1}``. At
    the end of a path ``query(surface)`` stands for what the cache holds of S (self-training; None: nothing). Paths
    that left the scene, or that run on without an end, are not self-trained.

    Returns ``n_paths * (n_vertices - 1)`` records, how many targets were not finite and were left out, the bounces that
    gave them (of equal number), and what ``first(si, bsdf, active, sampler)`` says of the first vertex of each path
    (None: black).
    """
    n_paths, n_kept = plan.n_paths, plan.n_vertices - 1
    size = n_paths * n_kept
    lane = dr.arange(mi.UInt32, n_paths)
    unbounded = lane < plan.n_unbounded
    ctx = mi.BSDFContext()

    records = _empty(size)
    E, N, f = (dr.zeros(mi.Color3f, size) for _ in range(3))
    direction, rough, stops = dr.zeros(mi.Vector3f, size), dr.zeros(mi.Bool, size), dr.zeros(mi.Bool, size)

    def step(ray, si, n_rough, active, sampler, albedo=None):
        """One bounce: (next ray, what it met, BSDF weight, N, E, its density, delta, alive)."""
        bsdf = si.bsdf(ray)
        if plan.roughening > 0:
            albedo = surface_of(si, bsdf, active, False).albedo if albedo is None else albedo
            share = 1 - dr.power(mi.Float(1 - plan.roughening), n_rough)
            opaque = vertex.has_smooth(bsdf) & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
            bsdf = Roughened(bsdf, active & opaque & (sampler.next_1d() < share), albedo)
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        weight = vertex.finite(weight, active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        alive = active & (dr.max(weight) > 0)
        ray = si.spawn_ray(si.to_world(bs.wo))
        si_next = scene.ray_intersect(ray, alive)
        L_nee, Le = vertex.emitted(
            scene, lights, si, bsdf, sampler.next_1d(), sampler.next_2d(), sampler, active, si_next, bs.pdf, delta,
            alive,
        )  # fmt: skip
        return ray, si_next, weight, L_nee, vertex.finite(Le, alive), bs.pdf, delta, alive

    def is_smooth(si, active):
        return active & si.is_valid() & vertex.has_smooth(si.bsdf())

    # ------------------------- Vertices with records --------------------------
    def bounce(k, ray, si, spread, ends, n_rough, open_, active, sampler):
        bsdf = si.bsdf(ray)
        smooth = active & vertex.has_smooth(bsdf)
        surface = surface_of(si, bsdf, active, glossy)
        ray, si_next, weight, L_nee, Le, pdf, delta, alive = step(ray, si, n_rough, active, sampler, surface.albedo)
        i = k * n_paths + lane
        dr.scatter(E, Le, i)
        dr.scatter(N, L_nee, i)
        dr.scatter(f, weight, i)
        for to, value in zip(records.surface.inputs(), surface.inputs(), strict=True):
            dr.scatter(to, value, i)
        dr.scatter(records.valid, smooth, i)
        dr.scatter(direction, ray.d, i)
        dr.scatter(rough, smooth & alive & ~delta, i)

        open_ = alive & si_next.is_valid()
        goes_on = mi.Bool(open_)
        smooth_next = is_smooth(si_next, open_)
        spread = spread.arrive(si_next, ray, pdf, delta, smooth_next)
        wide = smooth_next & spread.exceeds(plan.threshold)
        dr.scatter(stops, wide, i)
        if plan.suffix == "spread":
            goes_on &= ~(wide & (ends > 0)) | unbounded
            ends += dr.select(wide, 1, 0)
            spread = spread.restarted(wide)
        return k + 1, ray, si_next, spread, ends, n_rough + dr.select(delta, 0, 1), open_, goes_on, sampler

    if plan.twins:
        n_rays = (n_paths + 1) // 2
        ray_lane, seed = dr.arange(mi.UInt32, n_rays), dr.gather(mi.UInt32, sampler.scramble, 0)
        numbers = PathSampler.make(ray_lane, seed + 0x85EBCA6B, index=ray_lane, scramble=seed)
        ray = dr.gather(mi.Ray3f, first_rays(sensor, numbers, n_rays, plan.world_share, places), lane // 2)
    else:
        ray = first_rays(sensor, sampler, n_paths, plan.world_share, places)
    si = scene.ray_intersect(ray)
    active = si.is_valid()
    said = mi.Color3f(0) if first is None else first(si, si.bsdf(ray), is_smooth(si, active), sampler)
    spread = PathSpread.start(n_paths).arrive(si, ray, mi.Float(1), mi.Bool(True), is_smooth(si, active))
    state = (mi.UInt32(0), ray, si, spread, mi.UInt32(0), mi.Float(0), mi.Bool(active), mi.Bool(active), sampler)
    k_end, ray, si, _, _, n_rough, open_, _, sampler = dr.while_loop(
        state, lambda k, ray, si, spread, ends, n_rough, open_, active, sampler: active & (k < n_kept), bounce,
        label="training suffixes",
    )  # fmt: skip

    # ------------- Their ends: seen through mirrors and glass, or run on ----------
    def run_on(k, ray, si, β, S, n_rough, asks, active, sampler):
        ray, si, weight, L_nee, Le, _, delta, alive = step(ray, si, n_rough, active, sampler)
        S += dr.select(active, β * (L_nee + weight * Le), 0)
        β = dr.select(active, β * weight, β)
        alive &= si.is_valid() & (dr.max(β) > 0)
        smooth = is_smooth(si, alive)
        asks |= smooth & ~unbounded
        roulette = unbounded & (k >= 4)
        q = dr.minimum(dr.max(β), 0.95)
        alive &= unbounded & (~roulette | (sampler.next_1d() < q)) | (~unbounded & ~smooth & (k < MAX_CHAIN))
        β = dr.select(roulette & active, β * dr.rcp(dr.maximum(q, 1e-6)), β)
        return k + 1, ray, si, β, S, n_rough + dr.select(delta, 0, 1), asks, alive & (k < MAX_VERTICES), sampler

    smooth = is_smooth(si, open_)
    state = (mi.UInt32(0), ray, si, mi.Color3f(1), mi.Color3f(0), n_rough, smooth & ~unbounded,
             open_ & (unbounded | ~smooth), sampler)  # fmt: skip
    _, ray, si, β, S, n_rough, asks, _, sampler = dr.while_loop(
        state, lambda k, ray, si, β, S, n_rough, asks, active, sampler: active, run_on, label="ends of paths"
    )
    if plan.content == "indirect":  # direct light at the end: it is in S, but not in the cache
        _, _, weight, L_nee, Le, _, _, _ = step(ray, si, n_rough, asks, sampler)
        S += dr.select(asks, β * (L_nee + weight * Le), 0)
    if query is not None:
        S += dr.select(asks, β * query(surface_of(si, si.bsdf(ray), asks, glossy)), 0)
    end = S

    # ------------------------------ Back to front -----------------------------
    dr.eval(E, N, f, end, k_end, records, direction, rough, stops, said)
    arrived = dr.zeros(mi.Color3f, size)
    S = mi.Color3f(0)
    for k in reversed(range(n_kept)):
        i = k * n_paths + lane
        S = dr.select(k_end == k + 1, end, S)
        dr.scatter(arrived, S, i)
        weight = dr.gather(mi.Color3f, f, i)
        direct = dr.gather(mi.Color3f, N, i) + weight * dr.gather(mi.Color3f, E, i)
        reflected = weight * S
        S = direct + reflected
        dr.scatter(records.target, reflected if plan.content == "indirect" else S, i)

    finite = dr.all(dr.isfinite(records.target))
    n_bad = dr.count(records.valid & ~finite)
    records.valid &= finite
    records.target = dr.select(records.valid, records.target, 0)
    incident = TrainingRecords(records.surface.position, direction, records.surface.normal, arrived, rough)
    leave_out_nonfinite(incident)
    return records, n_bad, Bounces(N + f * E, f, incident, stops), said


def packed(records, n: int):
    """The valid records in `n` places, in their order; what does not fit is left out, the rest holds nothing."""
    slot = dr.prefix_sum(dr.select(records.valid, mi.UInt32(1), mi.UInt32(0)))
    fits = records.valid & (slot < n)
    out = _empty(n) if isinstance(records, OutgoingRecords) else empty_records(n)

    def put(to, value):
        if is_dataclass(to):
            for field in fields(to):
                put(getattr(to, field.name), getattr(value, field.name))
        else:
            dr.scatter(to, value, slot, fits)

    put(out, records)
    return out
