"""Training paths, which give records to caches of incident and of outgoing radiance (Müller et al. 2021, section 3.4).

The radiance that a ray brings to one vertex is what the next vertex sends out, so one path has records for both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi

from ..render import path as paths
from ..render import vertex
from ..render.film import film_rays
from ..render.kernels import end_kernel
from ..render.sampling import PathSampler
from ..render.surface import Roughened, surface_of
from ..render.walk import SURFACES, SurfaceWalk, Unlimited, fork
from .records import OutgoingRecords, TrainingRecords, empty_surfaces, leave_out_nonfinite

#: Contents of a cache of outgoing radiance: all light that a surface reflects, or that without direct light.
CONTENTS = ("reflected", "indirect")
#: Mirrors that the end of a training path is followed through.
MAX_CHAIN = 16
#: Training paths end nowhere by their depth.
UNLIMITED = Unlimited()
#: Bounces before roulette may end a path without an end.
RR_DEPTH = 5


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
    content         see `CONTENTS`; what the cache holds that is queried at the ends
    twins           whether the paths 2k and 2k + 1 start with the same ray
    surfaces        whether records of outgoing radiance are wanted
    densities       whether the densities of BSDF rays are
    arriving        whether incident records are wanted, in scenes with participating media
    """

    n_paths: int
    n_vertices: int
    suffix: str = "full"
    threshold: float = 0.01
    n_unbounded: int = 0
    world_share: float = 0.0
    roughening: float = 0.0
    content: str = "indirect"
    twins: bool = False
    surfaces: bool = True
    densities: bool = False
    arriving: bool = False


@dataclass
class PathRecords:
    """What training paths give, vertex by vertex: ``n_paths * (n_vertices - 1)`` entries.

    outgoing   records of what the vertex sends out; only their positions and normals if no surfaces were asked for
    incident   records of the radiance that the BSDF ray brought back, emission excluded; valid for rays of smooth lobes
    direct     direct light that the vertex reflects towards its viewer, traced
    weight     ``f cos/p`` of the BSDF ray that left it; in media, where incident records were not asked for, times what
               the medium on the way left of the light
    stops      whether the vertex that the ray met is where a pixel's path would end in the cache
    pdf        density p of that BSDF ray (solid angle); of no meaning where densities were not asked for
    n_bad      how many outgoing and incident records were left out because their targets were not finite
    """

    outgoing: OutgoingRecords
    incident: TrainingRecords
    direct: mi.Color3f
    weight: mi.Color3f
    stops: mi.Bool
    pdf: mi.Float
    n_bad: tuple


def first_rays(sensor, sampler, n_paths: int, world_share: float, places: tuple | None):
    """Rays from random points of the film; so many others to random `places` instead: positions and directions to
    their viewers (world space; not finite where unknown), and how far before them to start."""
    # Stratified over the film: paths are the samples of one pixel, the film
    ray = film_rays(sensor, sampler.stratified_2d(0), sampler)
    return ray if places is None or world_share <= 0 else _world_rays(ray, sampler, n_paths, world_share, places)[0]


def _world_rays(ray, sampler, n_paths: int, world_share: float, places: tuple) -> tuple:
    """(rays, of which a share leads to random places instead of where it did, which ones do, numbers of the places)."""
    # Every so many-th lane, evenly: multiples of the golden ratio
    lane = dr.arange(mi.UInt32, n_paths)
    world = mi.Float((lane * mi.UInt32(0x9E3779B9)) >> 8) * 2**-24 < world_share
    position, view, distance = places[:3]
    n_places = dr.width(position)
    i = dr.minimum(mi.UInt32(sampler.next_1d() * n_places), n_places - 1)
    p, w = dr.gather(mi.Point3f, position, i), dr.gather(mi.Vector3f, view, i)
    world &= dr.all(dr.isfinite(p))
    ray.o, ray.d = dr.select(world, p + distance * w, ray.o), dr.select(world, -w, ray.d)
    return ray, world, i


def _twin_numbers(sampler, plan: Suffixes) -> tuple:
    """(how many rays twins start with, random numbers of these)."""
    n_rays = (plan.n_paths + 1) // 2
    lane, seed = dr.arange(mi.UInt32, n_rays), dr.gather(mi.UInt32, sampler.scramble, 0)
    return n_rays, PathSampler.make(lane, seed + 0x85EBCA6B, index=lane, scramble=seed)


def _twin_rays(sensor, sampler, plan: Suffixes, places):
    """As :func:`first_rays`; two paths start with each ray, so that two independent estimates of the same radiance
    exist."""
    n_rays, numbers = _twin_numbers(sampler, plan)
    rays = first_rays(sensor, numbers, n_rays, plan.world_share, places)
    return dr.gather(mi.Ray3f, rays, dr.arange(mi.UInt32, plan.n_paths) // 2)


def _first_vertices(scene, sensor, sampler, plan: Suffixes, places, walk: SurfaceWalk) -> tuple:
    """(rays, paths at what they meet, sampler)."""
    if not walk.in_media:
        if plan.twins:
            ray = _twin_rays(sensor, sampler, plan, places)
        else:
            ray = first_rays(sensor, sampler, plan.n_paths, plan.world_share, places)
        return ray, paths.start(ray, scene.ray_intersect(ray), mi.Bool(True)), sampler
    # Where a ray ends in a medium is random: twins share the point, too
    if not plan.twins:
        return _first_in_media(scene, sensor, sampler, plan.n_paths, plan.world_share, places, walk)
    n_rays, numbers = _twin_numbers(sampler, plan)
    ray, path, _ = _first_in_media(scene, sensor, numbers, n_rays, plan.world_share, places, walk)
    dr.eval(ray, path)  # together: to gather from each of its parts would follow the rays once for each
    return fork(ray, plan.n_paths), fork(path, plan.n_paths), sampler


def _first_in_media(scene, sensor, sampler, n_paths: int, world_share: float, places, walk) -> tuple:
    """As :func:`_first_vertices`, in participating media. Paths start at places of which is known what they are in."""
    ray = first_rays(sensor, sampler, n_paths, 0, None)
    if places is None or world_share <= 0:
        return ray, *walk.camera_vertex(UNLIMITED, scene, ray, sampler, mi.Bool(True))
    moved, world, i = _world_rays(mi.Ray3f(ray), sampler, n_paths, world_share, places)
    inside = dr.gather(mi.UInt32, places[3], i, world)
    world &= inside > 0
    path, sampler = walk.camera_vertex(UNLIMITED, scene, ray, sampler, ~world)
    ray = dr.select(world, moved, ray)
    ray.maxt = dr.select(world, places[2], ray.maxt)
    return ray, *walk.start_in(scene, path, ray, inside, sampler, world)


@dataclass
class Vertices:
    """What paths found at their vertices: that of vertex k of path i is entry ``k * n_paths + i``.

    records    outgoing records, their targets still missing
    emitted    emission met by the BSDF ray that left the vertex, weighed by MIS; Le
    estimated  next-event estimation at the vertex, weighed by MIS; L_nee
    weight     ``f cos/p`` of that BSDF ray, whose direction and lobe follow: whether the lobe is smooth
    arriving   what media on its way left of the light, in one sample; None: it is in `weight`
    stops      see :class:`PathRecords`
    pdf        density of that BSDF ray, if asked for
    """

    records: OutgoingRecords
    emitted: mi.Color3f
    estimated: mi.Color3f
    weight: mi.Color3f
    direction: mi.Vector3f
    smooth: mi.Bool
    stops: mi.Bool
    pdf: mi.Float
    arriving: mi.Color3f | None = None

    @classmethod
    def empty(cls, size: int, densities: bool = False, in_media: bool = False, arriving: bool = False) -> Vertices:
        colours = (dr.zeros(mi.Color3f, size) for _ in range(3))
        direction, smooth, stops = dr.zeros(mi.Vector3f, size), dr.zeros(mi.Bool, size), dr.zeros(mi.Bool, size)
        pdf = dr.zeros(mi.Float, size if densities else 1)
        flights = dr.zeros(mi.Color3f, size) if arriving else None
        return cls(empty_surfaces(size, in_media), *colours, direction, smooth, stops, pdf, flights)

    def keep(self, i, place: Callable, found: paths.Bounce, terminal, receives, surface, inside=None) -> None:
        """Write entries `i`; `surface` is None where only positions and normals of surfaces are wanted, which `place()`
        gives, `inside` where there are no media."""
        dr.scatter(self.emitted, found.Le, i)
        dr.scatter(self.estimated, found.L_nee, i)
        if self.arriving is None:
            dr.scatter(self.weight, found.weight, i)
        else:
            dr.scatter(self.weight, found.turn, i)
            dr.scatter(self.arriving, found.end.weight, i)
        if surface is not None:
            for to, value in zip(self.records.surface.inputs(), surface.inputs(), strict=True):
                dr.scatter(to, value, i)
        else:
            position, normal = place()
            dr.scatter(self.records.surface.position, position, i)
            dr.scatter(self.records.surface.normal, normal, i)
        if inside is not None:
            dr.scatter(self.records.inside, inside, i)
        dr.scatter(self.records.valid, terminal, i)
        dr.scatter(self.direction, found.ray.d, i)
        dr.scatter(self.smooth, receives & found.traced & ~found.delta, i)


@dataclass
class _Tracer:
    """What tracing a training path needs: its bounces are those of a pixel's path, but for `plan.roughening`."""

    scene: mi.Scene
    lights: object
    plan: Suffixes
    glossy: bool
    walk_on: SurfaceWalk

    def surface(self, path, active):
        return self.walk_on.surface(path, active, self.glossy)

    def bounce(self, path, n_rough, sampler, albedo=None):
        """One bounce, the surface roughened as the path has bounced `n_rough` times before: (Bounce, sampler)."""
        bsdf = path.si.bsdf(path.ray)
        if self.plan.roughening > 0 and not self.walk_on.in_media:
            albedo = surface_of(path.si, bsdf, path.active, False).albedo if albedo is None else albedo
            share = 1 - dr.power(mi.Float(1 - self.plan.roughening), n_rough)
            opaque = vertex.has_smooth(bsdf) & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
            bsdf = Roughened(bsdf, path.active & opaque & (sampler.next_1d() < share), albedo)
        return self.walk_on.bounce(UNLIMITED, self.scene, self.lights, path, sampler, bsdf=bsdf)

    def walk(self, path, spread, sampler) -> tuple:
        """The vertices with records: (Vertices, how many of each path, path, n_rough, whether it goes on, sampler)."""
        plan, n_kept = self.plan, self.plan.n_vertices - 1
        lane = dr.arange(mi.UInt32, plan.n_paths)
        unbounded = lane < plan.n_unbounded
        in_media = self.walk_on.in_media
        vertices = Vertices.empty(plan.n_paths * n_kept, plan.densities, in_media, in_media and plan.arriving)

        def step(k, path, spread, ends, n_rough, open_, sampler):
            i = k * plan.n_paths + lane
            terminal = self.walk_on.terminal(path, path.active)
            surface = self.surface(path, path.active) if plan.surfaces else None
            found, sampler = self.bounce(path, n_rough, sampler, surface.albedo if plan.surfaces else None)
            here, receives = partial(self.walk_on.place, path), self.walk_on.receives(path, path.active, terminal)
            vertices.keep(i, here, found, terminal, receives, surface, self.walk_on.inside(path))
            if plan.densities:
                dr.scatter(vertices.pdf, found.pdf, i)
            before, path = path, self.walk_on.advance(UNLIMITED, path, found)
            open_ = mi.Bool(path.active)
            if plan.surfaces:
                terminal = self.walk_on.terminal(path, open_)
                spread = self.walk_on.spread(spread, before, found, path, terminal)
                wide = terminal & spread.exceeds(plan.threshold)
                dr.scatter(vertices.stops, wide, i)
                if plan.suffix == "spread":
                    path.active &= ~(wide & (ends > 0)) | unbounded
                    ends += dr.select(wide, 1, 0)
                    spread = spread.restarted(wide)
            return k + 1, path, spread, ends, n_rough + dr.select(found.delta, 0, 1), open_, sampler

        state = (mi.UInt32(0), path, spread, mi.UInt32(0), mi.Float(0), mi.Bool(path.active), sampler)
        n_vertices, path, _, _, n_rough, open_, sampler = dr.while_loop(
            state, lambda k, path, spread, ends, n_rough, open_, sampler: path.active & (k < n_kept), step,
            label="training paths",
        )  # fmt: skip
        return vertices, n_vertices, path, n_rough, open_, sampler

    def ends(self, path, n_rough, open_, query: Callable | None, sampler) -> mi.Color3f:
        """What arrives from beyond the last vertex of each path: the cache, seen through mirrors and glass, or what
        paths without an end found until roulette ended them."""
        plan, walk = self.plan, self.walk_on
        unbounded = dr.arange(mi.UInt32, plan.n_paths) < plan.n_unbounded

        def run_on(k, path, n_rough, queries, sampler):
            found, sampler = self.bounce(path, n_rough, sampler)
            path = walk.advance(UNLIMITED, path, found)
            path, sampler = paths.roulette(path, sampler, RR_DEPTH, most=walk.most_survival)
            terminal = walk.terminal(path, path.active)
            queries |= terminal & ~unbounded
            if not walk.gives_up:
                queries |= terminal & unbounded & (k >= walk.most_vertices)
            path.active &= (unbounded & (k < walk.most_vertices)) | (~unbounded & ~terminal & (k < MAX_CHAIN))
            return k + 1, path, n_rough + dr.select(found.delta, 0, 1), queries, sampler

        terminal = walk.terminal(path, open_)
        path = replace(path, L=mi.Color3f(0), β=mi.Color3f(1), η=mi.Float(1), depth=mi.UInt32(1),
                       active=open_ & (unbounded | ~terminal))  # fmt: skip
        _, path, n_rough, queries, sampler = dr.while_loop(
            (mi.UInt32(0), path, n_rough, terminal & ~unbounded, sampler),
            lambda k, path, n_rough, queries, sampler: path.active, run_on, label="ends of training paths",
        )  # fmt: skip
        end, path = path.L, replace(path, active=queries)
        if plan.content == "indirect":  # direct light at the end: it is in S, but not in the cache
            found, sampler = self.bounce(path, n_rough, sampler)
            end += dr.select(queries, path.β * found.direct, 0)
        if query is not None:
            end_kernel(end, path, queries, sampler)
            value, sampler = query(path, queries, sampler)
            end += dr.select(queries, path.β * value, 0)
        return end


def _back_to_front(plan: Suffixes, vertices: Vertices, n_vertices, end) -> mi.Color3f:
    """Fill in the targets of outgoing records, and return those of incident ones: S_{k+1} for each vertex k."""
    lane = dr.arange(mi.UInt32, plan.n_paths)
    arrived, S = dr.zeros(mi.Color3f, dr.width(vertices.stops)), mi.Color3f(0)
    for k in reversed(range(plan.n_vertices - 1)):
        i = k * plan.n_paths + lane
        S = dr.select(n_vertices == k + 1, end, S)
        weight = dr.gather(mi.Color3f, vertices.weight, i)
        if vertices.arriving is None:
            dr.scatter(arrived, S, i)
            reflected = weight * S
        else:
            left = dr.gather(mi.Color3f, vertices.arriving, i)
            weight *= left
            dr.scatter(arrived, left * S, i)
            reflected = weight * S
        direct = dr.gather(mi.Color3f, vertices.estimated, i) + weight * dr.gather(mi.Color3f, vertices.emitted, i)
        S = direct + reflected
        if plan.surfaces:
            dr.scatter(vertices.records.target, reflected if plan.content == "indirect" else S, i)
    return arrived


def trace_training_paths(
    scene, sensor, sampler, plan: Suffixes, query: Callable | None, lights=None, places: tuple | None = None,
    glossy: bool = True, walk: SurfaceWalk = SURFACES,
) -> PathRecords:  # fmt: skip
    """Training paths; each terminal vertex (see ``vertex.is_terminal``), but the last, gives one record.

    The radiance reflected at vertex k is

        S_k = N_k + f_k (E_k + S_{k+1}),

    N being next-event estimation, E the emission met by the BSDF ray (the two share the direct light by MIS) and f the
    BSDF sample's weight. It is the target of outgoing records for the content ``reflected``; for ``indirect`` that is
    ``f_k S_{k+1}``. The target of an incident record at vertex k is S_{k+1}, in participating media times what the
    medium on the way left of it. At the end of a path ``query(path,
    active, sampler)``, which returns (value, sampler), stands for what the cache holds of S (self-training; None:
    nothing). Paths that left the scene, or that run on without an end, are not self-trained. `walk`: how paths go from
    vertex to vertex.
    """
    ray, path, sampler = _first_vertices(scene, sensor, sampler, plan, places, walk)
    spread = walk.start(ray, path, walk.terminal(path, path.active))

    tracer = _Tracer(scene, lights, plan, glossy, walk)
    vertices, n_vertices, path, n_rough, open_, sampler = tracer.walk(path, spread, sampler)
    end_kernel(vertices, n_vertices, path, n_rough, open_, sampler)
    end = tracer.ends(path, n_rough, open_, query, sampler)
    dr.eval(vertices, end, n_vertices)
    arrived = _back_to_front(plan, vertices, n_vertices, end)

    records = vertices.records
    finite = dr.all(dr.isfinite(records.target))
    n_bad = dr.count(records.valid & ~finite)
    records.valid &= finite
    records.target = dr.select(records.valid, records.target, 0)
    surface = records.surface
    incident = TrainingRecords(
        surface.position, vertices.direction, surface.normal, arrived, vertices.smooth, inside=records.inside
    )
    n_bad = n_bad, leave_out_nonfinite(incident)
    emitted = vertices.emitted if vertices.arriving is None else vertices.arriving * vertices.emitted
    direct = vertices.estimated + vertices.weight * emitted
    return PathRecords(records, incident, direct, vertices.weight, vertices.stops, vertices.pdf, n_bad)
