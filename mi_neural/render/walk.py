"""How paths that may end in a cache go from vertex to vertex: by surfaces alone, or through participating media, too.

:class:`SurfaceWalk` has the steps of :mod:`.path`, :class:`MediaWalk` those of :mod:`.media`. There a vertex may also
be a point at which a medium scatters. A path may end at such a point. What a cache holds of it is the radiance that is
scattered towards the path: ``∫ p L dω``, p being the phase function. The medium's albedo is in the throughput that led
there. So the reflectance that is factored out of the cache is 1 there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass, replace

import drjit as dr
import mitsuba as mi

from ..estimators.spread import PathSpread, camera_spread, segment_spread
from . import path as paths
from . import vertex
from .media import Media
from .medium_path import Scattering
from .surface import Surface, surface_of


class SurfaceWalk:
    """Steps of paths in a scene without media. `integrator` names what :func:`.path.camera_vertex` reads of one."""

    #: Added to ``rr_depth``.
    later = 0
    #: Whether vertices may lie in media. Surfaces are not made rougher then.
    in_media = False
    #: Whether a path may pass surfaces and have the same depth as before: then a number for each depth is not enough.
    may_stay = False
    #: Probability at most with which a training path survives roulette; vertices after which one that has no end in the
    #: cache is given up, and whether it then ends there.
    most_survival, most_vertices, gives_up = 0.95, 256, True

    def camera_vertex(self, integrator, scene, ray, sampler, active) -> tuple:
        """(a path at what a camera ray meets, sampler)."""
        return paths.camera_vertex(integrator, scene, ray, active), sampler

    def first_vertex(self, integrator, scene, ray, sampler, active) -> tuple:
        """(a path at the first vertex behind mirrors and glass, with the emission that is seen on the way, sampler).
        Its `length` is the distance along them."""
        path = paths.camera_vertex(integrator, scene, ray, active)
        limit = paths.depth_limit(integrator.max_depth)
        return paths.follow_mirrors(scene, path, sampler, limit, integrator.rr_depth)

    def sample(self, path, bsdf, lobe, direction) -> paths.Turn:
        """A direction where a path stands at a surface of that `bsdf`, from uniform numbers."""
        bs, weight, delta = paths.sample_bsdf(path.si, bsdf, lobe, direction, path.active)
        return paths.Turn((bs, weight, delta), weight, delta, bs.pdf, path.si.to_world(bs.wo))

    def bounce(
        self, integrator, scene, lights, path, sampler, numbers=None, bsdf=None, turn: paths.Turn | None = None, **how
    ) -> tuple:
        """(what a bounce found, sampler). `turn`: what :meth:`sample` gave before; `how`: see :func:`.path.bounce`."""
        sampled = None if turn is None else turn.sampled
        return paths.bounce(scene, lights, path, sampler, numbers, bsdf=bsdf, sampled=sampled, **how)

    def advance(self, integrator, path, found):
        """The path at the next vertex."""
        return paths.advance(path, found, paths.depth_limit(integrator.max_depth))

    def camera_spread(self, path):
        """Footprint a_0 of a pixel where the path stands, that came from :meth:`first_vertex`."""
        return camera_spread(dr.square(path.length), dr.dot(path.si.n, path.ray.d))

    def segment_spread(self, path, found):
        """What the ray of a bounce adds to the square root of the spread of `path`, from which it starts."""
        cos_theta = dr.dot(found.si.n, found.ray.d)
        return dr.select(found.delta, 0, segment_spread(found.si.t**2, found.pdf, cos_theta))

    def terminal(self, path, active):
        """Whether a path may end in a cache where it stands."""
        return vertex.is_terminal(path.si, active)

    def receives(self, path, active, terminal):
        """Whether a cache of incident light learns what arrives where a path stands, which is `terminal` or not."""
        return terminal

    def place(self, path) -> tuple:
        """Where a path stands: (position, normal on the side that it came from)."""
        return path.si.p, vertex.facing(path.si)

    def inside(self, path):
        """What a path is in where it stands: None where there are no media, else a number that :meth:`start_in` takes.
        """
        return

    def surface(self, path, active, glossy: bool) -> Surface:
        """Where a path stands, as a cache of outgoing radiance sees it."""
        return surface_of(path.si, path.si.bsdf(path.ray), active, glossy)

    def start(self, ray, path, smooth) -> PathSpread:
        """The spread of a path at what its camera `ray` met, which is `smooth` (:meth:`terminal`) or not."""
        spread = PathSpread.start(dr.width(path.si.t))
        return spread.arrive(path.si, path.ray, mi.Float(1), mi.Bool(True), smooth)

    def spread(self, spread: PathSpread, before, found, path, smooth) -> PathSpread:
        """The spread of a path that came from `before` to `path` by the bounce `found`."""
        return spread.arrive(path.si, path.ray, found.bs.pdf, found.delta, smooth)


class MediaWalk(SurfaceWalk):
    """Steps of paths through `media`; `camera` is the medium that the camera is in (None: none). `windows`: whether
    paths may end at rough glass around a medium.

    Roulette begins one bounce later than on surfaces, as in ``volpath``. Training paths survive it with their
    throughput as probability: at most 0.95 would make the light of long paths in a medium of high albedo rare and huge,
    and Adam, whose steps are bounded, learns less than the mean of such targets. Rough glass with wax inside: -3 %.
    """

    later = 1
    in_media = True
    most_survival, most_vertices, gives_up = 1.0, 128, False

    def __init__(self, media: Media, camera: mi.Medium | None = None, windows: bool = False):
        self.media, self.camera, self.may_stay, self.windows = media, camera, media.partial, windows

    def camera_vertex(self, integrator, scene, ray, sampler, active):
        return self.media.camera_vertex(integrator, scene, ray, self.camera, sampler, active)

    def first_vertex(self, integrator, scene, ray, sampler, active):
        path, sampler = self.camera_vertex(integrator, scene, ray, sampler, active)
        path.length = dr.select(path.active, dr.norm(self.place(path)[0] - ray.o), 0)

        def is_mirror(path):
            return ~path.scattered & vertex.is_mirror(path.si, path.active)

        def step(path, mirror, sampler):
            before = self.place(path)[0]
            found, sampler = self.bounce(integrator, scene, None, path, sampler, direct=paths.emission_alone)
            path = self.advance(integrator, path, found)
            path.length += dr.select(path.active, dr.norm(self.place(path)[0] - before), 0)
            path, sampler = paths.roulette(path, sampler, integrator.rr_depth + self.later)
            return path, is_mirror(path), sampler

        path, _, sampler = dr.while_loop(
            (path, is_mirror(path), sampler), lambda path, mirror, sampler: mirror, step, label="mirrors"
        )
        return path, sampler

    def sample(self, path, bsdf, lobe, direction):
        return self.media.sample(path, lobe, direction)

    def bounce(self, integrator, scene, lights, path, sampler, numbers=None, bsdf=None, turn=None, **how):
        return self.media.bounce(integrator, scene, lights, path, sampler, numbers, turn=turn, **how)

    def advance(self, integrator, path, found):
        return self.media.advance(integrator, path, found)

    def camera_spread(self, path):
        cosine = dr.select(path.scattered, 1, dr.dot(path.si.n, path.ray.d))
        return camera_spread(dr.square(path.length), cosine)

    def segment_spread(self, path, found):
        end = found.end
        arrives, p = end.scattered | end.si.is_valid(), dr.select(end.scattered, end.p, end.si.p)
        cosine = dr.select(end.scattered, 1, dr.dot(end.si.n, end.ray.d))
        grown = segment_spread(dr.squared_norm(p - self.place(path)[0]), found.pdf, cosine)
        return dr.select(found.delta, 0, dr.select(arrives, grown, math.inf))

    def terminal(self, path, active):
        """No rough glass around a medium, but for caches of incident light (`windows`): from inside its radiance has
        the sharp lobes of what is outside."""
        smooth = vertex.is_terminal(path.si, active)
        if not self.windows:
            smooth &= ~(path.si.is_medium_transition() & vertex.transmits(path.si.bsdf()))
        return active & (path.scattered | smooth)

    def receives(self, path, active, terminal):
        """Also at surfaces that let a part of the light pass: what arrives there is learned as elsewhere. Without that
        the image of a half open shell full of fog is 3 % too bright where the cache answers at its first vertex."""
        return active & (path.scattered | vertex.is_smooth(path.si, active)) if self.windows else terminal

    def place(self, path):
        normal = dr.select(path.scattered, path.ray.d, vertex.facing(path.si))
        return dr.select(path.scattered, path.p, path.si.p), normal

    def inside(self, path):
        """1 in no medium, then two numbers for each medium: on a surface, and at a point in it; 0 is for unknown."""
        return 1 + 2 * self.media.number(path.medium) + dr.select(path.scattered, mi.UInt32(1), 0)

    def start_in(self, scene, path, ray, inside, sampler, starts) -> tuple:
        """(`path`, but one that stands at what `ray` met once before where it `starts`, sampler).

        `inside`: of the place that was met, by :meth:`inside`. A surface lies on the ray, and is looked for anew. In a
        medium the path starts at the end of the ray, ``ray.maxt``.
        """
        number = dr.select(starts, inside - 1, 0)
        scattered, medium = starts & (number % 2 == 1), self.media.numbered(number // 2)
        clear = mi.Ray3f(ray)
        clear.maxt = dr.largest(mi.Float)
        si = scene.ray_intersect(clear, starts & ~scattered)
        n = dr.size_v(mi.Spectrum)
        channel = dr.minimum(mi.UInt32(sampler.next_1d() * n), n - 1) if mi.is_rgb else mi.UInt32(0)
        new = {
            "L": mi.Spectrum(0), "β": mi.Spectrum(1), "η": mi.Float(1), "depth": mi.UInt32(1), "length": mi.Float(0),
            "ray": clear, "si": si, "valid": scattered | si.is_valid(), "active": scattered | si.is_valid(),
            "p": ray(ray.maxt), "scattered": scattered, "medium": medium, "channel": channel,
            "shares": mi.Spectrum(1 / n), "last": Scattering.at_camera(clear),
        }  # fmt: skip
        return _where(starts, new, path), sampler

    def surface(self, path, active, glossy):
        """A point in a medium has the normal ``-view``, which no surface that is seen has, and reflectance 1."""
        surface = surface_of(path.si, path.si.bsdf(path.ray), active & ~path.scattered, glossy)
        position, normal = self.place(path)
        rough = dr.select(path.scattered, 1, surface.roughness) if glossy else surface.roughness
        return Surface(
            position, dr.select(path.scattered, normal, surface.normal),
            dr.select(path.scattered, -path.ray.d, surface.view), dr.select(path.scattered, 1, surface.albedo), rough,
        )  # fmt: skip

    def start(self, ray, path, smooth):
        spread = PathSpread.start(dr.width(path.si.t))
        return self._reach(spread, ray.o, path, mi.Float(1), mi.Bool(True), smooth)

    def spread(self, spread, before, found, path, smooth):
        return self._reach(spread, self.place(before)[0], path, found.last.pdf, found.delta, smooth)

    def _reach(self, spread: PathSpread, origin, path, pdf, delta, smooth):
        cosine = dr.select(path.scattered, 1, dr.dot(path.si.n, path.ray.d))
        distance, arrives = dr.norm(self.place(path)[0] - origin), path.scattered | path.si.is_valid()
        return spread.reach(distance, cosine, pdf, delta, arrives, smooth)


def _where(mask, new: dict, path):
    """`path` with the fields of `new` where the mask says so."""
    changed = {}
    for name, value in new.items():
        old = getattr(path, name)
        if is_dataclass(old):
            value = _where(mask, {f.name: getattr(value, f.name) for f in fields(old)}, old)
        changed[name] = None if old is None else value if is_dataclass(old) else dr.select(mask, value, old)
    return replace(path, **changed)


def in_medium(inside):
    """Whether what :meth:`MediaWalk.inside` says is a point in a medium."""
    return (inside > 0) & (inside % 2 == 0)


#: For scenes without media.
SURFACES = SurfaceWalk()


@dataclass(frozen=True)
class Unlimited:
    """In the place of an integrator, for paths that end nowhere by themselves."""

    max_depth: int = -1
    hide: bool = False


def fork(path, n: int):
    """`n` paths (or rays), of which 2k and 2k + 1 are as number k of `path`."""
    half = dr.arange(mi.UInt32, n) // 2
    if not is_dataclass(path):
        return dr.gather(type(path), path, half)
    values = ((f.name, getattr(path, f.name)) for f in fields(path))
    return replace(path, **{name: dr.gather(type(v), v, half) for name, v in values if v is not None})
