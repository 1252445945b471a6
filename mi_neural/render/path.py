"""A path and one bounce of it: the light transport loop of all integrators and of all training paths.

A path is a :class:`PathState`. :func:`camera_vertex` begins one, :func:`bounce` samples the BSDF where it stands,
traces that ray and finds direct light, :func:`advance` moves it to what the ray met, :func:`roulette` may end it:

    path = camera_vertex(integrator, scene, ray, active)
    while path.active:
        found, sampler = bounce(scene, lights, path, sampler)
        path = advance(path, found, max_depth)
        path, sampler = roulette(path, sampler, rr_depth)

is a path tracer; E[path.L] is the radiance along the camera ray. The behaviour of Mitsuba's ``path`` is the reference
for `valid` (alpha), null surfaces, ``hide_emitters``, ``rr_depth`` and ``max_depth``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..estimators.mis import mis_weight
from . import vertex

#: `max_depth` of a path without a limit.
NO_LIMIT = 0x7FFFFFFF
#: Dimensions of the stratified numbers of a camera sample, see :func:`stratified`; 0 is the place on the film, those
#: from `FREE` on are the integrator's.
POINT, DIRECTION, LOBE, LIGHT, FREE = range(1, 6)


@dataclass
class PathState:
    """A path at one of its vertices. A PyTree: it may be a loop variable.

    L        radiance found so far, at the start of the path
    β        throughput from the start to here
    η        relative index of refraction along the path
    depth    segments traced, the one that led here included
    length   of them together
    ray, si  that segment, and what it met
    valid    whether the pixel is covered: what Mitsuba's film takes as alpha
    active   whether the path goes on: there is a surface, and another segment is allowed
    """

    L: mi.Spectrum
    β: mi.Spectrum
    η: mi.Float
    depth: mi.UInt32
    length: mi.Float
    ray: mi.Ray3f
    si: mi.SurfaceInteraction3f
    valid: mi.Bool
    active: mi.Bool


@dataclass
class Numbers:
    """Uniform random numbers of one bounce: the BSDF's lobe and direction, the light, and the point on it."""

    lobe: mi.Float
    direction: mi.Point2f
    light: mi.Float
    point: mi.Point2f


@dataclass
class Bounce:
    """One BSDF sample, what its ray met, and direct light where it started.

    bs        BSDF sample
    weight    ``f cos / p``
    delta     whether a mirror lobe was sampled
    ray, si   the ray and what it met
    followed  whether it was traced
    L_nee     next-event estimation at the vertex
    Le        emission that the ray met; both carry their MIS weights
    """

    bs: mi.BSDFSample3f
    weight: mi.Spectrum
    delta: mi.Bool
    ray: mi.Ray3f
    si: mi.SurfaceInteraction3f
    followed: mi.Bool
    L_nee: mi.Spectrum
    Le: mi.Spectrum

    @property
    def direct(self):
        """Direct light at the vertex: E[direct] = ∫ f Le cos dω."""
        return self.L_nee + self.weight * self.Le

    @property
    def traced(self):
        """Whether the ray was traced."""
        return self.followed

    @property
    def turn(self):
        """`weight` without what media on the way do to the light."""
        return self.weight

    @property
    def pdf(self):
        """Density of the ray's direction (solid angle)."""
        return self.bs.pdf


@dataclass
class Turn:
    """A direction in which a path may go on.

    sampled  what was sampled, for a bounce in this direction
    weight   ``f cos / p``, in a medium that of the phase function
    delta    whether a mirror lobe was sampled
    pdf      density of the direction (solid angle)
    d        the direction, world space
    """

    sampled: tuple
    weight: mi.Spectrum
    delta: mi.Bool
    pdf: mi.Float
    d: mi.Vector3f


def depth_limit(max_depth: int) -> int:
    """Mitsuba's ``max_depth``, -1 being no limit, as a number to compare depths with."""
    return min(max_depth, NO_LIMIT) if max_depth >= 0 else NO_LIMIT


def start(ray, si, active, max_depth: int = NO_LIMIT) -> PathState:
    """A path that begins with `ray`, which met `si`, and has found nothing yet."""
    active = mi.Bool(active) & si.is_valid()
    valid = active & ~vertex.has_null(si.bsdf())
    return PathState(
        mi.Spectrum(0), mi.Spectrum(1), mi.Float(1), mi.UInt32(1), dr.select(active, si.t, 0), mi.Ray3f(ray), si, valid,
        active & (max_depth > 1),
    )  # fmt: skip


def camera_vertex(integrator, scene, ray, active) -> PathState:
    """A path at what a camera ray meets, with the emission that the camera sees there.

    `integrator` gives ``max_depth`` and ``hide_emitters`` (its attribute `hide`).
    """
    limit = depth_limit(integrator.max_depth)
    active = mi.Bool(active) & (limit > 0)
    if integrator.hide:
        pi = integrator.skip_area_emitters(scene, mi.Ray3f(ray), True, active)
        si = pi.compute_surface_interaction(mi.Ray3f(ray), mi.RayFlags.All, active)
    else:
        si = scene.ray_intersect(ray, active)
    path = start(ray, si, active, limit)
    if integrator.hide:
        path.L = path.L + vertex.emission(scene, si, active & si.is_valid())
    else:
        path.L = path.L + vertex.emission(scene, si, active)
        path.valid = path.valid | (active & (scene.environment() is not None))
    return path


def draw_numbers(sampler) -> tuple:
    """(independent numbers of one bounce, sampler)."""
    lobe, direction, light, point = sampler.next_1d(), sampler.next_2d(), sampler.next_1d(), sampler.next_2d()
    return Numbers(lobe, mi.Point2f(direction), light, mi.Point2f(point)), sampler


def stratified(sampler, n=1, i=0) -> Numbers:
    """Numbers of bounce `i` of `n` that spread evenly over the samples of a pixel."""
    return Numbers(
        sampler.stratified_1d(LOBE, n, i), sampler.stratified_2d(DIRECTION, n, i), sampler.stratified_1d(LIGHT, n, i),
        sampler.stratified_2d(POINT, n, i),
    )  # fmt: skip


def sample_bsdf(si, bsdf, lobe, direction, active) -> tuple:
    """A direction by a BSDF, from uniform numbers: (BSDF sample, ``f cos / p``, whether a mirror lobe was sampled)."""
    bs, weight = bsdf.sample(mi.BSDFContext(), si, lobe, direction, active)
    return bs, vertex.finite(weight, active), mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)


def bounce(
    scene, lights, path: PathState, sampler, numbers: Numbers | None = None, *, bsdf=None, sampled: tuple | None = None,
    follow: Callable | None = None, alone: Callable | None = None, direct: Callable | None = None, black: bool = False,
):  # fmt: skip
    """Sample the BSDF where `path` stands, trace that ray, and find direct light. Returns (:class:`Bounce`, sampler).

    lights   what chooses the light of next-event estimation (see ``mi_neural.lights.sampling``); None: the scene does
    numbers  stratified ones in place of the sampler's own
    bsdf     in place of the surface's
    sampled  what :func:`sample_bsdf` gave before, in place of a new sample
    follow   ``follow(bs, delta)`` says which rays are traced at all
    alone    ``alone(pdf)`` says at which densities of the BSDF no ray will be traced, so that next-event estimation
             counts in full
    direct   in place of :func:`direct_light`, with the same arguments
    black    whether rays are traced from BSDFs whose value is 0, too: it may have a derivative
    """
    si, active = path.si, path.active
    if numbers is None:
        numbers, sampler = draw_numbers(sampler)
    bsdf = si.bsdf(path.ray) if bsdf is None else bsdf
    bs, weight, delta = sampled or sample_bsdf(si, bsdf, numbers.lobe, numbers.direction, active)
    followed = active & ((bs.pdf > 0) if black else (dr.max(weight) > 0))
    if follow is not None:
        followed &= follow(bs, delta)
    ray = si.spawn_ray(si.to_world(bs.wo))
    si_next = scene.ray_intersect(ray, followed)
    found = Bounce(bs, weight, delta, ray, si_next, followed, mi.Spectrum(0), mi.Spectrum(0))
    found.L_nee, found.Le, sampler = (direct or direct_light)(
        scene, lights, path, bsdf, found, numbers, sampler, alone
    )  # fmt: skip
    return found, sampler


class Surface:
    """Where :func:`direct_light` is found: a surface, in a scene without media (see :mod:`.media` for the other).

    it       what light samples are seen from
    origin   where the last scattering was, from which light samples compete with what the path met
    in_full  whether emission that the path met counts in full, as no light sample finds it
    around   whether it receives light from all directions alike; None: nowhere
    untested whether shadow rays are left to `light_arriving`, the scene's own light samples included
    attached whether derivatives are wanted
    """

    around, untested = None, False

    def __init__(self, path: PathState, bsdf, found: Bounce, attached: bool = False):
        self.attached = attached
        self.it = self.origin = path.si
        self.bsdf, self.found = bsdf, found
        self.in_full = found.delta

    def is_smooth(self):
        """Whether light samples can contribute."""
        return vertex.has_smooth(self.bsdf)

    def seen_from(self):
        return vertex.reference_point(self.it.p, self.it.n)

    @cached_property
    def received(self):
        """How light is received here, see :func:`.vertex.receiver`."""
        return vertex.receiver(self.it, self.bsdf)

    def pmf_hit(self, lights, choice, hit, active):
        """Probability that `lights`, which made this choice, choose the light `hit`, which the path met."""
        return choice.of_hit(lights, self.it, *self.received, hit, active)

    def pdf(self):
        """Density of the direction in which the path went on."""
        return self.found.bs.pdf

    def eval_pdf(self, d, active):
        """Share of light from `d` that goes on along the path, and the density with which `d` is sampled."""
        return self.bsdf.eval_pdf(mi.BSDFContext(), self.it, self.it.to_local(d), active)

    def light_arriving(self, scene, tested: bool, ds, light, f, sampled, sampler):
        """(`light` as it comes through the scene, where it is `sampled` and not shadowed, sampler). `tested`: whether a
        shadow ray has been traced."""
        if not tested:
            if not self.attached:  # what is 0 may have a derivative
                sampled &= dr.max(f * light) > 0
            sampled &= ~scene.ray_test(self.it.spawn_ray_to(ds.p), sampled)
        return light, sampled, sampler


def direct_light(
    scene, lights, path: PathState, bsdf, found: Bounce, numbers: Numbers, sampler, alone=None, here=None,
    attached: bool = False,
):  # fmt: skip
    """Both halves of direct light at a vertex: (next-event estimation, emission that the BSDF ray met, sampler).

    They are weighted against each other, so that ``E[first + f/p second] = ∫ f Le cos dω``. `here`: what stands there,
    in place of a :class:`Surface`. `attached`: both have derivatives with respect to BSDFs and emitters, inside of
    ``dr.suspend_grad()`` too, where directions and weights have none; `here` must be a surface. The choice of a light
    has none ever.
    """
    here = here or Surface(path, bsdf, found, attached)
    hit = _light_hit(scene, lights, here, found)
    L_nee, choice, sampler = _light_sample(
        scene, lights, here, path.active, hit, numbers.light, numbers.point, sampler, 1, alone, attached
    )  # fmt: skip
    weighed = hit.emits & ~here.in_full
    with dr.suspend_grad(when=attached):
        pmf_hit = None if lights is None else here.pmf_hit(lights, choice, hit.index, weighed)
    return L_nee, _light_met(scene, lights, here, found, hit, pmf_hit, 1, attached), sampler


def several_lights(
    n_lights: int, scene, lights, path: PathState, bsdf, found: Bounce, numbers: Numbers, sampler, alone=None,
):  # fmt: skip
    """As :func:`direct_light` at a surface without media, by the mean of `n_lights` light samples against one BSDF ray.

    What the choice of a light needs to know of the surface, a query of a network included, is found once. The light
    samples have stratified numbers in place of `numbers`.
    """
    here = Surface(path, bsdf, found)
    hit = _light_hit(scene, lights, here, found)
    if hasattr(lights, "remembering"):
        lights = lights.remembering(here.it, *here.received, several=True)
    active = path.active & here.is_smooth()

    def one(i, total, sampler):
        u, point = sampler.stratified_1d(LIGHT, n_lights, i), sampler.stratified_2d(POINT, n_lights, i)
        L, _, sampler = _light_sample(scene, lights, here, active, hit, u, point, sampler, n_lights, alone)
        return i + 1, total + L, sampler

    _, L_nee, sampler = dr.while_loop(
        (mi.UInt32(0), mi.Spectrum(0), sampler), lambda i, *_: active & (i < n_lights), one, label="light samples"
    )
    weighed = hit.emits & ~here.in_full
    pmf_hit = None if lights is None else lights.pmf(here.it, *here.received, hit.index, weighed)
    return L_nee / n_lights, _light_met(scene, lights, here, found, hit, pmf_hit, n_lights), sampler


@dataclass
class _Hit:
    """What the BSDF ray of a vertex met: the light's `index`, whether it `emits`, the direction `ds`."""

    index: mi.UInt32 | None
    emits: mi.Bool
    ds: mi.DirectionSample3f


def _light_hit(scene, lights, here, found: Bounce) -> _Hit:
    ds = mi.DirectionSample3f(scene, found.si, here.seen_from())
    if lights is None:
        return _Hit(None, found.followed, ds)
    return _Hit(*lights.table.index_of(scene, found.si, found.followed), ds)


def _light_sample(scene, lights, here, active, hit: _Hit, u, point, sampler, n_lights, alone=None, attached=False):
    """One of `n_lights` light samples: (what it gives, how its light was chosen, sampler)."""
    smooth, choice = active & here.is_smooth(), None
    if lights is None:
        tests = here.around is None and not here.untested
        ds, light = scene.sample_emitter_direction(here.it, point, tests, smooth)
        pdf_light, sampled = ds.pdf, smooth & (ds.pdf > 0)
    else:
        n, transmits = here.received
        in_media = {} if here.around is None else {"around": here.around}
        with dr.suspend_grad(when=attached):
            choice = lights.choose(here.it, n, transmits, u, sampler, hit.index, active, **in_media)
        sampler = choice.advanced(sampler)
        with dr.resume_grad(when=attached):
            ds, light, pdf = lights.table.sample(
                scene, here.it, choice.index, point, smooth & (choice.weight > 0), attached
            )  # fmt: skip
            light *= choice.weight
        pdf_light, sampled = choice.pmf * pdf, smooth & (pdf > 0)

    with dr.resume_grad(when=attached):
        f, pdf_bsdf = here.eval_pdf(ds.d, sampled)
        if attached and lights is None:
            emitted = scene.eval_emitter_direction(here.it, ds, sampled)
            light = dr.replace_grad(light, emitted * dr.select(sampled, dr.rcp(ds.pdf), 0))
    pdf_bsdf = dr.detach(pdf_bsdf)
    light, sampled, sampler = here.light_arriving(scene, lights is None, ds, light, f, sampled, sampler)
    in_full = mi.Bool(ds.delta)
    if alone is not None:
        in_full |= alone(pdf_bsdf)
    w_light = dr.select(in_full, 1, mis_weight(n_lights * pdf_light, pdf_bsdf))
    with dr.resume_grad(when=attached):
        return vertex.finite(f * light * w_light, sampled), choice, sampler


def _light_met(scene, lights, here, found: Bounce, hit: _Hit, pmf_hit, n_lights, attached=False):
    """The emission that the BSDF ray met, weighted against `n_lights` light samples; `pmf_hit`: of :class:`_Hit`."""
    weighed = hit.emits & ~here.in_full
    if lights is None:
        pdf_hit = scene.pdf_emitter_direction(here.seen_from(), hit.ds, weighed)
    else:
        pdf_hit = pmf_hit * lights.table.pdf(scene, here.origin, hit.index, found.si, hit.ds, weighed)
    w_bsdf = dr.select(here.in_full, 1, mis_weight(here.pdf(), n_lights * pdf_hit))
    # What an emitter says that is not finite is seen and counted by the film, and by the training records
    with dr.resume_grad(when=attached):
        return dr.select(hit.emits, found.si.emitter(scene, hit.emits).eval(found.si, hit.emits) * w_bsdf, 0)


def emission_alone(scene, lights, path, bsdf, found: Bounce, numbers, sampler, alone=None, here=None):
    """As :func:`direct_light` for mirrors, which no light sample can reach: the emission that the ray met."""
    return mi.Spectrum(0), vertex.emission(scene, found.si, found.followed), sampler


def advance(path: PathState, found: Bounce, max_depth: int = NO_LIMIT) -> PathState:
    """The path at what its BSDF ray met, direct light taken up."""
    depth = path.depth + 1
    valid = path.valid | (path.active & ~mi.has_flag(found.bs.sampled_type, mi.BSDFFlags.Null))
    return PathState(
        path.L + path.β * found.direct, path.β * found.weight, path.η * found.bs.eta, depth,
        path.length + dr.select(found.followed & found.si.is_valid(), found.si.t, 0), found.ray, found.si, valid,
        found.followed & found.si.is_valid() & (depth < max_depth),
    )  # fmt: skip


def survival(path: PathState, rr_depth: int, share=1, most=0.95):
    """Probability that a path survives Russian roulette, 1 up to `rr_depth` bounces.

    It is the throughput times `share`, at most `most`, without the factor that refraction gives radiance (η²)."""
    q = dr.minimum(dr.max(path.β * share) * dr.square(path.η), most)
    return dr.select(path.depth > rr_depth, q, 1)


def roulette(path: PathState, sampler, rr_depth: int, share=1, u=None, most=0.95, q=None) -> tuple:
    """(the path, which may have ended, throughput divided by the probability that it has not; sampler).

    E[β] is kept, and so is that of its derivative: q is detached, as the decision is. `u`: a number in place of the
    sampler's, which decides for several paths together. `share`, `most`: of :func:`survival`; `q`: in place of it.
    """
    q = dr.detach(survival(path, rr_depth, share, most) if q is None else q)
    u = sampler.next_1d() if u is None else u
    alive = path.active & (u < q) & (dr.max(path.β) > 0)
    return replace(path, β=path.β * dr.rcp(dr.maximum(q, 1e-6)), active=alive), sampler


def scene_has_mirrors(scene) -> bool:
    """Whether some surface has no smooth lobe, as far as can be seen from here."""
    bsdfs = [s.bsdf() for s in scene.shapes()]
    hidden = any(s.class_name() == "Instance" for s in scene.shapes())
    return hidden or any(b is None or not mi.has_flag(b.flags(), mi.BSDFFlags.Smooth) for b in bsdfs)


def follow_mirrors(scene, path: PathState, sampler, max_depth: int, rr_depth: int) -> tuple:
    """Go on through mirrors, glass and null surfaces to the first surface with a smooth lobe: (path, sampler).

    The emission that is seen on the way is in ``path.L``. ``path.active`` is false where there is no such surface.
    Where the scene has no mirrors nothing is compiled.
    """
    if not scene_has_mirrors(scene):
        return path, sampler

    def step(path, mirror, sampler):
        found, sampler = bounce(scene, None, path, sampler, direct=emission_alone)
        path = advance(path, found, max_depth)
        path, sampler = roulette(path, sampler, rr_depth)
        return path, vertex.is_mirror(path.si, path.active), sampler

    mirror = vertex.is_mirror(path.si, path.active)
    path, _, sampler = dr.while_loop(
        (path, mirror, sampler), lambda path, mirror, sampler: mirror, step, label="mirrors"
    )
    return path, sampler
