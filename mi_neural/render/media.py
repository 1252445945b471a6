"""Paths through participating media: fog, smoke, and what lies inside of glass.

A scene without media is rendered by :mod:`.path` alone. In others a path has two kinds of vertices, surfaces and points
where a medium scatters, and :class:`Media` has the steps of :mod:`.path`:

    path, sampler = media.camera_vertex(integrator, scene, ray, medium, sampler, active)
    while path.active:
        found, sampler = media.bounce(integrator, scene, lights, path, sampler)
        path = media.advance(integrator, path, found)
        path, sampler = paths.roulette(path, sampler, rr_depth + 1)

The distance to the next scattering is sampled by delta tracking. Transmittance along shadow rays is exact in
homogeneous media, and estimated by ratio tracking in others (Novák et al. 2014). Boundaries that do not refract
(``null``) are passed on the way; they are no vertices. The behaviour of Mitsuba's ``volpath`` is the reference for
`valid` (alpha), ``hide_emitters``, ``rr_depth`` and ``max_depth``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from .. import parameters
from . import path as paths
from . import vertex
from .medium_path import (
    Flight,
    MediumBounce,
    MediumPath,
    Scattering,
    beyond,
    interaction,
    phase_function,
    scattering_point,
)
from .tracking import colour, event, exists, flown, is_boundary, medium_interaction

#: Dimension of the stratified number by which the distance along a camera ray is sampled.
DISTANCE = 2**16


class Place:
    """In the place of :class:`.path.Surface`: a surface in a scene with media, or a point in a medium."""

    untested = False

    def __init__(self, media: Media, path: MediumPath, it, bsdf, phase, receiver: tuple, last: Scattering):
        self.media, self.path, self.it, self.bsdf, self.phase, self.last = media, path, it, bsdf, phase, last
        self.received, self.around, self.in_full = receiver, path.scattered, last.in_full
        self.origin = vertex.reference_point(last.p, last.n)

    def is_smooth(self):
        return self.path.scattered | vertex.has_smooth(self.bsdf)

    def seen_from(self):
        return self.origin

    def pmf_hit(self, lights, choice, hit, active):
        if not self.media.partial:
            return choice.of_hit(lights, self.it, *self.received, hit, active, around=self.around)
        last = self.last
        return lights.pmf(self.origin, last.receiver, last.transmits, hit, active, around=last.around)

    def pdf(self):
        return self.last.pdf

    def eval_pdf(self, d, active):
        path = self.path
        at_surface, in_medium = active & ~path.scattered, active & path.scattered
        f, pdf = self.bsdf.eval_pdf(mi.BSDFContext(), path.si, path.si.to_local(d), at_surface)
        f_medium, pdf_medium = self.phase.eval_pdf(mi.PhaseFunctionContext(None), scattering_point(path), d, in_medium)
        return dr.select(in_medium, f_medium, f), dr.select(in_medium, pdf_medium, pdf)

    def light_arriving(self, scene, tested: bool, ds, light, f, sampled, sampler):
        sampled &= dr.max(f * light) > 0
        share, sampler = self.media.transmittance(
            scene, self.it, ds.p, beyond(self.path, ds.d), self.path.channel, sampler, sampled
        )
        return light * share, sampled, sampler


class Media:
    """How paths go through the media of a scene. Its attributes are facts of the scene, which are compiled.

    media           the media, by their address
    ids             their identity in pointers
    heterogeneous   whether the density of a medium varies
    boundaries      whether there are surfaces that let all light pass
    partial         whether there are surfaces that let a part of the light pass, or shine and let it pass
    """

    def __init__(self, media: dict, heterogeneous: bool, boundaries: bool, partial: bool):
        self.media = media
        self.ids = [int(dr.reinterpret_array(mi.UInt32, mi.MediumPtr(m))[0]) for m in media.values()]
        self.heterogeneous, self.boundaries, self.partial = heterogeneous, boundaries, partial
        pairs = [(params, key) for params in map(parameters.traverse, media.values()) for key in params.keys()]
        self.edits = parameters.Edits([(params, key) for params, key in pairs if _is_hidden(params, key)])
        self.edits.changed()

    @classmethod
    def of(cls, scene, sensors=()) -> Media | None:
        """The media of a scene and of these sensors; None where there are none."""
        media = media_of(scene, sensors)
        if not media:
            return None
        unknown, found = has_instances(scene), [(_lobes(s), s.is_emitter()) for s in scene.shapes()]
        null = int(mi.BSDFFlags.Null)
        boundaries = unknown or any(lobes == null and not shines for lobes, shines in found)
        partial = unknown or any(lobes & null and (lobes != null or shines) for lobes, shines in found)
        return cls({m.ptr: m for m in media}, not all(m.is_homogeneous() for m in media), boundaries, partial)

    def edited(self) -> bool:
        """Whether a parameter has changed, since the call before, that recorded functions take for a constant."""
        return self.edits.changed()

    def number(self, medium):
        """Number of a medium, 1, 2, ...; 0: none. It is the same as long as the scene has these media."""
        identity, number = dr.reinterpret_array(mi.UInt32, medium), mi.UInt32(0)
        for k, known in enumerate(self.ids):
            number = dr.select(identity == known, k + 1, number)
        return number

    def numbered(self, number):
        """The medium of a number."""
        identity = mi.UInt32(0)
        for k, known in enumerate(self.ids):
            identity = dr.select(number == k + 1, known, identity)
        return dr.reinterpret_array(mi.MediumPtr, identity)

    # -------------------------------------------------------------------------------------------------------------
    # The steps of a path

    def camera_vertex(self, integrator, scene, ray, medium, sampler, active) -> tuple:
        """(a path at what a camera ray meets, with the emission that the camera sees there; sampler).

        `medium`: that of the camera; None: none. `integrator`: see :func:`.path.camera_vertex`.
        """
        limit = paths.depth_limit(integrator.max_depth)
        active, ray = mi.Bool(active) & (limit > 0), mi.Ray3f(ray)
        medium = dr.zeros(mi.MediumPtr) if medium is None else mi.MediumPtr(medium)
        n = dr.size_v(mi.Spectrum)
        channel = dr.minimum(mi.UInt32(sampler.next_1d() * n), n - 1) if mi.is_rgb else mi.UInt32(0)
        hidden = active if integrator.hide else None
        end, sampler = self.fly(
            integrator, scene, ray, medium, channel, mi.Spectrum(1 / n), sampler, active, hidden,
            None if self.heterogeneous else sampler.stratified_1d(DISTANCE),
        )  # fmt: skip
        L, valid = mi.Spectrum(0), mi.Bool(False)
        if not integrator.hide:
            L = end.weight * vertex.emission(scene, end.si, active & ~end.scattered)
            valid = active & (scene.environment() is not None)
        path = MediumPath(
            L, end.weight, mi.Float(1), mi.UInt32(1), mi.Float(0), end.ray, end.si, valid, active, end.p, end.scattered,
            end.medium, channel, end.shares, Scattering.at_camera(ray) if self.partial else None,
        )  # fmt: skip
        return self._arrive(path, limit), sampler

    def sample(self, path: MediumPath, lobe, direction) -> paths.Turn:
        """A direction by BSDF or phase function where `path` stands, from uniform numbers."""
        si, in_medium = path.si, path.active & path.scattered
        at_surface = path.active & ~path.scattered
        bs, weight, delta = paths.sample_bsdf(si, si.bsdf(path.ray), lobe, direction, at_surface)
        wo, weight_medium, pdf_medium = phase_function(path, in_medium).sample(
            mi.PhaseFunctionContext(None), scattering_point(path), lobe, direction, in_medium
        )
        weight = dr.select(in_medium, vertex.finite(weight_medium, pdf_medium > 0), weight)
        pdf, d = dr.select(in_medium, pdf_medium, bs.pdf), dr.select(in_medium, wo, si.to_world(bs.wo))
        return paths.Turn((bs,), weight, delta & ~in_medium, pdf, d)

    def bounce(
        self, integrator, scene, lights, path: MediumPath, sampler, numbers=None, *, turn: paths.Turn | None = None,
        follow: Callable | None = None, alone: Callable | None = None, direct: Callable | None = None,
    ):  # fmt: skip
        """Sample a direction where `path` stands, by BSDF or phase function, follow it to the next vertex, and find
        direct light. Returns (:class:`MediumBounce`, sampler). `numbers`: in place of the sampler's own; `turn`: what
        :meth:`sample` gave before, in place of a new sample; else see :func:`.path.bounce`, where `follow` gets `turn`
        in place of a BSDF sample, and `direct` gets a :class:`Place` as its last argument."""
        if numbers is None:
            numbers, sampler = paths.draw_numbers(sampler)
        si, active, in_medium = path.si, path.active, path.active & path.scattered
        at_surface, bsdf, phase = active & ~path.scattered, si.bsdf(path.ray), phase_function(path, in_medium)
        turn = self.sample(path, numbers.lobe, numbers.direction) if turn is None else turn
        (bs,), weight, delta, d = turn.sampled, turn.weight, turn.delta, turn.d

        it, receiver = interaction(path), vertex.receiver(si, bsdf)
        here = last = Scattering(it.p, it.n, *receiver, in_medium, turn.pdf, delta)
        null, deeper, hidden = mi.Bool(False), active, None
        followed = active & (dr.max(weight) > 0)
        if follow is not None:
            followed &= follow(turn, delta)
        if self.partial:
            null = at_surface & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            last = dr.select(null, path.last, here)
            deeper = active & (path.depth < paths.depth_limit(integrator.max_depth))
            followed &= null | deeper
            hidden = null & (path.depth == 1) if integrator.hide else None
        end, sampler = self.fly(
            integrator, scene, it.spawn_ray(d), beyond(path, d), path.channel, path.shares, sampler, followed, hidden
        )
        emits = followed & ~end.scattered
        found = MediumBounce(
            bs, weight * end.weight, delta, end.ray, end.si, emits if hidden is None else emits & ~hidden,
            mi.Spectrum(0), mi.Spectrum(0), end, null, followed, last, weight,
        )  # fmt: skip
        place = Place(self, path, it, bsdf, phase, receiver, last)
        found.L_nee, found.Le, sampler = (direct or paths.direct_light)(
            scene, lights, replace(path, active=deeper), bsdf, found, numbers, sampler, alone, place
        )
        return found, sampler

    def advance(self, integrator, path: MediumPath, found: MediumBounce) -> MediumPath:
        """The path at the next vertex, direct light taken up."""
        end = found.end
        path = MediumPath(
            path.L + path.β * found.direct, path.β * found.weight,
            path.η * dr.select(path.scattered, 1, found.bs.eta), path.depth + dr.select(found.null, mi.UInt32(0), 1),
            path.length, end.ray, end.si, path.valid | (path.active & ~found.null), mi.Bool(found.goes_on), end.p,
            end.scattered, end.medium, path.channel, end.shares, found.last if self.partial else None,
        )  # fmt: skip
        return self._arrive(path, paths.depth_limit(integrator.max_depth))

    def _arrive(self, path: MediumPath, limit: int) -> MediumPath:
        """The path at the end of a flight, which may be its last vertex."""
        path.active &= path.scattered | path.si.is_valid()
        on_surface = path.active & ~path.scattered
        lets_pass = on_surface & vertex.has_null(path.si.bsdf())
        path.valid |= on_surface & ~lets_pass
        deeper = path.depth < limit
        path.active &= deeper | lets_pass if self.partial else deeper
        return path

    # -------------------------------------------------------------------------------------------------------------
    # Rays through media

    def fly(self, integrator, scene, ray, medium, channel, shares, sampler, active, hidden, u=None) -> tuple:
        """Follow a ray to where the medium scatters or a surface does not let all light pass: (:class:`Flight`,
        sampler). Of rays that `hidden` names emitters are skipped, as long as they are in no medium; None: of none.

        E[weight] over all that may happen is the transmittance, times the scattering coefficient where it scatters.
        `u`: the number by which the first distance is sampled, in media that are homogeneous; None: one of the sampler.
        """

        def step(f, sampler, u=None):
            inside = f.going & exists(f.medium)
            if self.heterogeneous:
                si = self._meet(integrator, scene, f.ray, f.going, hidden, inside)
                f, sampler = self._track(f, si.t, channel, sampler, inside)
            else:
                u = sampler.next_1d() if u is None else u
                mei = f.medium.sample_interaction(f.ray, u, channel, inside)
                near = mi.Ray3f(f.ray)
                near.maxt = dr.select(inside & mei.is_valid(), mei.t, near.maxt)
                si = self._meet(integrator, scene, near, f.going, hidden, inside)
                f.scattered, _, weight, f.shares = event(mei, si.t, mi.Float(0), channel, f.shares, inside)
                f.weight, f.p = f.weight * weight, mei.p
            f.si, f.going = si, f.going & ~f.scattered & si.is_valid() & self._is_boundary(si)
            if self.boundaries:
                f.weight *= dr.select(f.going, si.bsdf().eval_null_transmission(si, f.going), 1)
                f.ray = dr.select(f.going, si.spawn_ray(f.ray.d), f.ray)
                crosses = f.going & si.is_medium_transition()
                f.medium = dr.select(crosses, si.target_medium(f.ray.d), f.medium)
            return f, sampler

        f = Flight(mi.Bool(active), mi.Ray3f(ray), dr.zeros(mi.SurfaceInteraction3f), mi.Point3f(0), mi.Bool(False),
                   mi.MediumPtr(medium), mi.Spectrum(1), mi.Spectrum(shares))  # fmt: skip
        if not self.boundaries:
            return step(f, sampler, u)
        if u is None:
            return dr.while_loop((f, sampler), lambda f, sampler: f.going, step, label="flight")

        def first(f, sampler, u):
            f, sampler = step(f, sampler, u)
            return f, sampler, sampler.next_1d()

        return dr.while_loop((f, sampler, u), lambda f, sampler, u: f.going, first, label="camera flight")[:2]

    def _meet(self, integrator, scene, ray, active, hidden, inside):
        """The surface that a ray meets, behind emitters where these are `hidden`."""
        if hidden is None:
            return scene.ray_intersect(ray, active)
        hidden = active & hidden & ~inside
        si = scene.ray_intersect(ray, active & ~hidden)
        pi = integrator.skip_area_emitters(scene, ray, True, hidden)
        return dr.select(hidden, pi.compute_surface_interaction(ray, mi.RayFlags.All, hidden), si)

    def _is_boundary(self, si):
        """Whether a surface lets all light pass."""
        if not self.boundaries:
            return mi.Bool(False)
        passes = is_boundary(si.bsdf())
        return passes & ~exists(si.shape.emitter()) if self.partial else passes

    def _track(self, f: Flight, distance, channel, sampler, inside) -> tuple:
        """Delta tracking up to a surface at that `distance`: (:class:`Flight`, sampler)."""

        def step(tracking, ray, left, p, scattered, weight, shares, sampler):
            mei = f.medium.sample_interaction(ray, sampler.next_1d(), channel, tracking)
            real, null, factor, shares = event(mei, left, sampler.next_1d(), channel, shares, tracking)
            weight *= factor
            ray.o = dr.select(null, mei.p, ray.o)
            left -= dr.select(null, mei.t, 0)
            return (null & (dr.max(weight) > 0), ray, left, dr.select(real, mei.p, p), scattered | real, weight, shares,
                    sampler)  # fmt: skip

        state = (inside, mi.Ray3f(f.ray), distance, mi.Point3f(f.p), mi.Bool(False), f.weight, f.shares, sampler)
        _, _, _, f.p, f.scattered, f.weight, f.shares, sampler = dr.while_loop(
            state, lambda tracking, *_: tracking, step, label="delta tracking"
        )
        return f, sampler

    def transmittance(self, scene, it, target, medium, channel, sampler, active) -> tuple:
        """(estimate of the share of light that comes from the point `target` to `it` through media and what lets it
        pass, sampler). `medium`: where the ray begins. E[share] is the transmittance."""

        def step(active, ray, medium, share, sampler):
            if self.boundaries and not self.partial:
                # What is met is looked at in full where it lets light pass
                pi = scene.ray_intersect_preliminary(ray, active=active)
                meets, length = active & pi.is_valid(), dr.minimum(pi.t, ray.maxt)
                passes = meets & is_boundary(pi.shape.bsdf())
                si = pi.compute_surface_interaction(ray, mi.RayFlags.All, passes)
                share *= dr.select(meets, dr.select(passes, si.bsdf().eval_null_transmission(si, passes), 0), 1)
            elif self.partial:
                si = scene.ray_intersect(ray, active)
                meets, length = active & si.is_valid(), dr.minimum(si.t, ray.maxt)
                share *= dr.select(meets, si.bsdf().eval_null_transmission(si, meets), 1)
            else:
                meets, length = mi.Bool(False), ray.maxt
                share *= dr.select(scene.ray_test(ray, active), mi.Float(0), 1)
            active = active & (dr.max(share) > 0)
            share, sampler = self._attenuate(ray, length, medium, share, channel, sampler, active & exists(medium))
            if self.boundaries or self.partial:
                active &= meets & (dr.max(share) > 0)
                ray = si.spawn_ray(ray.d)
                ray.maxt = dr.dot(target - ray.o, ray.d) * (1 - mi.math.ShadowEpsilon)
                active &= ray.maxt > 0
                crosses = active & si.is_medium_transition()
                medium = dr.select(crosses, si.target_medium(ray.d), medium)
            return active, ray, medium, share, sampler

        state = (mi.Bool(active), it.spawn_ray_to(target), mi.MediumPtr(medium), mi.Spectrum(1), sampler)
        if self.boundaries or self.partial:
            state = dr.while_loop(state, lambda active, *_: active, step, label="transmittance")
        else:
            state = step(*state)
        return state[3:]

    def _attenuate(self, ray, length, medium, share, channel, sampler, inside) -> tuple:
        """(`share` times the transmittance of one medium over a `length`, sampler): exact, or by ratio tracking."""
        exact = inside & medium.is_homogeneous() if self.heterogeneous else inside
        σ_t = medium.get_majorant(medium_interaction(ray.o, ray, medium), exact)
        share = share * dr.select(exact, dr.exp(-σ_t * length), 1)
        if not self.heterogeneous:
            return share, sampler

        def step(tracking, ray, left, share, sampler):
            mei = medium.sample_interaction(ray, sampler.next_1d(), channel, tracking)
            collides = tracking & mei.is_valid() & (mei.t < left)
            majorant, m = mei.combined_extinction, colour(mei.combined_extinction, channel)
            share = share * dr.select(tracking, dr.exp(-flown(mei, left) * (majorant - m)), 1)
            share *= dr.select(collides, mei.sigma_n * dr.rcp(m), 1)
            ray.o = dr.select(collides, mei.p, ray.o)
            left -= dr.select(collides, mei.t, 0)
            return collides & (dr.max(share) > 0), ray, left, share, sampler

        state = (inside & ~exact, mi.Ray3f(ray), mi.Float(length), share, sampler)
        return dr.while_loop(state, lambda tracking, *_: tracking, step, label="ratio tracking")[3:]


def media_of(scene, sensors=()) -> list:
    """All media of a scene's shapes, and those that its sensors and `sensors` are in."""
    found = {}
    media = [s.get_medium() for s in (*scene.sensors(), *sensors) if hasattr(s, "get_medium")]
    for shape in scene.shapes():
        media += [shape.interior_medium(), shape.exterior_medium()]
    if has_instances(scene):  # what they consist of is not among the scene's shapes
        media += [node for node in mi.traverse(scene).hierarchy if isinstance(node, mi.Medium)]
    for medium in media:
        if medium is not None:
            found[medium.ptr] = medium
    return list(found.values())


def _is_hidden(params, key: str) -> bool:
    """Whether Dr.Jit does not see a parameter of a medium in Mitsuba 3.9.1: plain numbers, and phase functions."""
    return "phase_function" in key or not dr.is_jit_v(parameters.read(params, key))


def has_instances(scene) -> bool:
    return any(s.class_name() == "Instance" for s in scene.shapes())


def _lobes(shape) -> int:
    """Flags of the lobes of a shape's BSDF."""
    return int(shape.bsdf().flags()) & int(mi.BSDFFlags.All) if shape.bsdf() is not None else 0
