"""Derivatives of images with respect to their scene: along adjoint paths that read incident radiance from a cache or
trace it, or by Mitsuba's ``prb``.

The derivative of the rendering equation has two terms (Vicini, Speierer and Jakob 2021, "Path Replay Backpropagation",
eq. 5, after Nimier-David et al. 2020, "Radiative Backpropagation", eq. 4):

    dL_o = dL_e + ∫ df L_i cos dω + ∫ f dL_i cos dω.

The last one is the derivative at the next vertex of a path, times the throughput. The first ones need the radiance L_i
at each vertex but not its derivative. Path replay traces it (``traced``): all that lies further along the path, found
by a first pass with the same random numbers. E[derivative] is right for all but shapes and sensors.

With a cache (``cache``) its emission is traced, and the rest is what the cache predicts, so that one pass suffices and
the derivative at a vertex does not have the noise of the vertices behind it. E[derivative] is right if the cache is.
"""

from __future__ import annotations

import weakref
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi

from mi_neural import parameters
from mi_neural.caches.material import material_of
from mi_neural.estimators.spread import SHARP_PDF
from mi_neural.integrators.base import as_seed
from mi_neural.integrators.checks import no_gradients_in_media
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.film import PACKET, PASS_SAMPLES, Area, Samples, camera_rays
from mi_neural.render.frozen import LOCK, can_freeze, can_freeze_lights, disturbed, is_recording, undisturbed
from mi_neural.render.media import media_of
from mi_neural.render.surface import scene_is_glossy, surface_of

#: Values of the key ``gradient``.
GRADIENTS = ("cache", "traced", "prb")
#: Of the random numbers of adjoint paths, which are not those of the image.
SALT = 0x3C6EF372
#: Dimensions of the numbers that decide together where paths end, from here on one for each depth
TOGETHER = 16


def moved(scene, params, lamps: bool = False) -> list[str]:
    """Names of the shapes' and sensors' parameters that derivatives are wanted of: positions, normals, transforms.

    `lamps`: those of shapes that shine alone."""
    if not isinstance(params, mi.SceneParameters):
        params = mi.traverse(scene)
    names = []
    for key, (_, _, owner, *_) in params.properties.items():
        asked = isinstance(owner, mi.Shape) and owner.is_emitter() if lamps else isinstance(owner, mi.Shape | mi.Sensor)
        value = parameters.read(params, key) if asked else None
        if value is not None and dr.grad_enabled(value) and not _is_attribute(key):
            names.append(key)
    return names


def _is_attribute(key: str) -> bool:
    """Whether a mesh's parameter is an attribute that textures show."""
    name = key.rpartition(".")[2]
    fixed = ("vertex_positions", "vertex_normals", "vertex_texcoords")
    return name.startswith(("vertex_", "face_")) and name not in fixed


def prb_of(integrator):
    """Mitsuba's ``prb`` with the limits of `integrator`."""
    return mi.load_dict({
        "type": "prb", "max_depth": integrator.max_depth, "rr_depth": integrator.rr_depth,
        "hide_emitters": integrator.hide,
    })  # fmt: skip


# -----------------------------------------------------------------------------------------------------------------
# Methods of the integrators


def render_forward(integrator, scene, params, sensor=0, seed=0, spp=0):
    """The image's derivative along the gradients that `params` have, by the method of the key ``gradient``."""
    sensor = integrator._checked(scene, sensor, spp)
    with LOCK, dr.suspend_grad():
        method = _method(integrator, scene, params, sensor)
        if method != "prb":
            spp = spp or sensor.sampler().sample_count()
            return forward(integrator, scene, sensor, as_seed(seed), spp, method == "cache")
        image = prb_of(integrator).render_forward(scene, params, sensor, seed, spp)
        missing = dr.zeros(mi.TensorXf, (*image.shape[:2], len(integrator.aov_names())))
        return dr.concat([image, missing], axis=2) if integrator.channels else image


def render_backward(integrator, scene, params, grad_in, sensor=0, seed=0, spp=0):
    """Carry `grad_in`, derivatives with respect to the image, to the parameters, by the method of ``gradient``."""
    sensor = integrator._checked(scene, sensor, spp)
    with LOCK, dr.suspend_grad():
        method = _method(integrator, scene, params, sensor)
        if method != "prb":
            spp = spp or sensor.sampler().sample_count()
            backward(integrator, scene, grad_in, sensor, as_seed(seed), spp, method == "cache")
            return
        if integrator.channels:
            grad_in = grad_in[:, :, : grad_in.shape[2] - len(integrator.aov_names())]
        prb_of(integrator).render_backward(scene, params, grad_in, sensor, seed, spp)


def name_black_lamps(integrator) -> None:
    """Say once which lamps have no gradient, as the light sampler that is bound never chooses them."""
    lights = integrator.bound_lights
    if lights is not None and (dark := lights.table.n_dark()):
        integrator.film_state.say_once(
            f"{integrator.plugin}: {dark} lamps without extent are black and get no gradient, as "
            f"{integrator.light_sampler.plugin} never chooses them; begin with a small positive value"
        )


def _method(integrator, scene, params, sensor) -> str:
    """Which of `GRADIENTS` computes the derivatives. What is left out, or why it is not that of the key, is said once.
    """
    plugin, state, say_once = integrator.plugin, integrator.state, integrator.film_state.say_once
    if media_of(scene, [sensor]):
        raise no_gradients_in_media(plugin)
    if integrator.channels:
        say_once(f"{plugin}: the channels {', '.join(integrator.channels)} have no gradient")
    method = integrator.gradient
    if method != "prb":
        with dr.resume_grad():
            moving = moved(scene, params)
        if moving:
            why = "the cache has none" if method == "cache" else "traced paths have none"
            say_once(
                f"{plugin}: gradients come from prb, because {why} of shapes and sensors: "
                f"{', '.join(moving[:4])}{', ...' if len(moving) > 4 else ''}"
            )
            method = "prb"
        elif not state.bound.knows(scene) or (integrator.needs_cache and integrator.cache.field is None):
            integrator.bind(scene, sensor, train=method == "cache")
        elif integrator.light_sampler is not None:
            state.lights = integrator.light_sampler.lights(scene, sensor, train=False)  # they may have changed
    if method == "cache" and not integrator.needs_cache:
        method = "prb"
    if method != "prb":
        name_black_lamps(integrator)
    elif integrator.nested_sampler is not None or state.lights is not None:
        name = getattr(integrator.light_sampler, "plugin", "a light sampler")
        say_once(
            f"{plugin}: gradients by prb choose lights as Mitsuba does, without {name}; where that is wrong (mi-neural "
            "doc limits) they are wrong, too"
        )
    return method


# -----------------------------------------------------------------------------------------------------------------
# From an image to its camera samples and back


def backward(integrator, scene, grad_in, sensor, seed, spp: int, by_cache: bool) -> None:
    """Add `grad_in` times the image's derivatives to the gradients of the scene's parameters.

    `grad_in`: a tensor of the image's shape. `seed`: a ``mi.UInt32``. `spp`: samples a pixel. `by_cache`: whether the
    light at each vertex is the cache's, and is not traced.
    """
    area = Area.of(sensor)
    # What the scene computes from its parameters (an environment map) is left for the end: its derivatives would go on
    # to them once, and those of later parts of a path or of later passes would be lost
    with dr.isolate_grad():
        if area.box:  # the samples of a pixel count alike: one number of a pixel, however many samples it has
            pixel = dr.arange(mi.UInt32, area.n_pixels)
            δL = _of_samples(integrator, sensor, grad_in / spp, _middle(area, pixel), mi.Bool(True))
        for first, n in _passes(area, spp):
            samples, n_lanes = _samples(area, seed, first, n, spp)
            if not area.box:
                δL = _of_samples(integrator, sensor, grad_in * (n / spp), *_places(area, samples, n_lanes))
            _trace_pass(integrator, dr.ADMode.Backward, scene, sensor, area, samples, n_lanes, δL, by_cache)
            dr.eval()


def _of_samples(integrator, sensor, grad_in, place, active):
    """Derivatives with respect to camera samples at `place` of a film that has these alone."""
    with dr.resume_grad():
        δL = dr.zeros(mi.Spectrum, dr.width(place))
        dr.enable_grad(δL)
        image = _image(integrator, sensor, [(place, δL, active)])
        dr.set_grad(image, grad_in)
        dr.enqueue(dr.ADMode.Backward, image)
        dr.traverse(dr.ADMode.Backward)
        δL = dr.grad(δL)
    dr.eval(δL)
    return δL


def forward(integrator, scene, sensor, seed, spp: int, by_cache: bool):
    """The image's derivative along the gradients that the scene's parameters have; a tensor of the image's shape."""
    area, parts = Area.of(sensor), []
    for first, n in _passes(area, spp):
        samples, n_lanes = _samples(area, seed, first, n, spp)
        place, active = _places(area, samples, n_lanes)
        δL = _trace_pass(integrator, dr.ADMode.Forward, scene, sensor, area, samples, n_lanes, None, by_cache)
        dr.eval(place, δL, active)
        parts.append((place, δL, active))
    return _image(integrator, sensor, parts)


def _passes(area: Area, spp: int):
    """(first sample, number of samples a pixel) of passes that fit memory."""
    most = max(1, PASS_SAMPLES // area.n_pixels)
    return [(first, min(most, spp - first)) for first in range(0, spp, most)]


def _samples(area: Area, seed, first: int, n: int, spp: int) -> tuple:
    """(:class:`Samples` of a pass of an image of `spp` samples a pixel, its number of lanes)."""
    numbers = (dr.opaque(mi.UInt32, v) for v in (first, n, 0, area.height, spp))
    return Samples(seed, seed, *numbers), -(-area.n_pixels // PACKET) * PACKET * n


def _places(area: Area, samples: Samples, n_lanes: int) -> tuple:
    """Where the camera samples of a pass lie on the film, with a box filter in the middle of their pixels, and which
    of them exist."""
    pixel, sample, active = samples.lanes(area, n_lanes)
    if area.box:
        return _middle(area, pixel), active
    place = area.corner(pixel) + samples.sampler(pixel, sample, SALT).stratified_2d(0)
    return place + _offset(area), active & area.reaches(place)


def _middle(area: Area, pixel):
    """Middle of a pixel, on the film."""
    return area.corner(pixel) + mi.Point2f(0.5) + _offset(area)


def _offset(area: Area):
    return mi.Point2f(*(float(v) for v in area.offset))


def _image(integrator, sensor, parts: list):
    """What the film makes of camera samples (place, radiance, active); its other channels are 0."""
    film, others = sensor.film(), integrator.aov_names()
    film.prepare(others)
    block = film.create_block()
    block.set_coalesce(False)
    for place, L, active in parts:
        alpha = [mi.Float(0)] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []
        block.put(place, [L.x, L.y, L.z, *alpha, mi.Float(1), *(mi.Float(0) for _ in others)], active)
    film.put_block(block)
    return film.develop()


def _trace_pass(integrator, mode, scene, sensor, area: Area, samples: Samples, n_lanes: int, δL, by_cache: bool):
    """Adjoint paths of one pass, by a recorded function where that is possible; their derivatives in forward mode."""
    held = weakref.ref(integrator)  # or a recording would keep the integrator alive

    def trace_pass(scene, sensor, lights, field, samples, δL):
        pixel, sample, active = samples.lanes(area, n_lanes)
        ray, weight, _, sampler = camera_rays(sensor, area, pixel, samples.sampler(pixel, sample, SALT))
        if δL is None:
            δL = mi.Spectrum(0)
        elif area.box:
            δL = dr.gather(mi.Spectrum, δL, pixel, active)
        δL = dr.zeros(mi.Spectrum, n_lanes) + δL * weight
        samples.scale_differentials(ray)
        δL = adjoint(held(), mode, scene, lights, field, sampler, ray, δL, active)
        return δL * weight if mode == dr.ADMode.Forward else None

    field = integrator.bound_field if by_cache else None
    arguments = scene, sensor, integrator.bound_lights, field, samples, δL
    state = integrator.film_state
    records = mode == dr.ADMode.Backward and integrator.records and not is_recording()
    lit = integrator.bound_lights is not None or can_freeze_lights(scene)
    if not (records and lit and state.scene_records(scene) and can_freeze(sensor)):
        return trace_pass(*arguments)
    limits = integrator.max_depth, integrator.rr_depth, integrator.hide
    key = ("adjoint", by_cache, area, n_lanes, sensor.class_name(), *limits)
    recorded = state.passes.recorded.setdefault(key, dr.freeze(trace_pass))
    try:
        with undisturbed():
            return recorded(*arguments)
    except RuntimeError as e:
        if not disturbed(e):
            raise
        # Not as :func:`.frozen.call`, without a recording: this one fails at its end, when its gradients have been
        # added, and they would be added twice (measured: in 5 of 25 calls beside a thread that loads scenes)
        del state.passes.recorded[key]
        raise RuntimeError(
            f"{integrator.plugin}: another thread made or freed something of Mitsuba's while gradients were recorded; "
            "set them to zero and compute them again"
        ) from e


# -----------------------------------------------------------------------------------------------------------------
# Along a path


def adjoint(integrator, mode, scene, lights, field, sampler, ray, δL, active):
    """Carry derivatives along camera paths: in backward mode `δL`, that of the radiance of each path, to the scene's
    parameters; in forward mode theirs to the radiance, which is returned.

    At a vertex of throughput β, the BSDF sampled with density p, NEE being next-event estimation,

        dL += β d[NEE + f/p (w L_e + L_i)],

    with L_i from ``integrator.incident_radiance``; where `field` is None it is traced, f being what the rest of the
    path has found times df / f (path replay). L_i, β, p, directions and MIS weights w are detached. `lights` chooses
    the lights of NEE (None: the scene does). Rays are traced from black surfaces, too.
    """
    with dr.resume_grad():
        path = paths.camera_vertex(integrator, scene, mi.Ray3f(dr.detach(ray)), active)
        δL = _carry(mode, path.L, δL, keep=True)
    path.L = dr.zeros(mi.Spectrum, dr.width(ray))
    numbers_first = paths.stratified(sampler)

    def bounce(path, sampler, direct=None):
        numbers, sampler = paths.draw_numbers(sampler)
        numbers = dr.select(path.depth == 1, numbers_first, numbers)
        return paths.bounce(scene, lights, path, sampler, numbers, direct=direct, black=True)

    def trace(path, sampler):
        found, sampler = bounce(path, sampler)
        after = paths.advance(path, found, integrator.depth_limit)
        return paths.roulette(after, sampler, integrator.rr_depth)

    if field is None:  # all that the path will find; the replay below takes it away again, vertex by vertex
        path.L = dr.while_loop(
            dr.copy((path, sampler)), lambda path, sampler: path.active, trace, label="path to be replayed"
        )[0].L

    def step(path, δL, sampler):
        si, bsdf = path.si, path.si.bsdf(path.ray)
        found, sampler = bounce(path, sampler, partial(paths.direct_light, attached=True))
        L_nee, Le = found.L_nee, found.Le
        if field is None:
            found.L_nee, found.Le = -dr.detach(L_nee), -dr.detach(Le)
        else:
            found.L_nee, found.Le = mi.Spectrum(0), mi.Spectrum(0)
        after = paths.advance(path, found, integrator.depth_limit)

        Li = mi.Spectrum(0)
        if field is not None:
            Li, sampler = integrator.incident_radiance(scene, lights, field, path, found, after, sampler)
        per_pdf = dr.select(found.followed & (found.bs.pdf > 0), dr.rcp(found.bs.pdf), 0)
        with dr.resume_grad():
            f = bsdf.eval(mi.BSDFContext(), si, found.bs.wo, found.followed)
            weight = dr.replace_grad(found.weight, f * per_pdf)
            Lo = path.β * (L_nee + weight * (Le + Li))
            if field is None:
                Lo += after.L * dr.select(dr.detach(f) > 0, f * dr.rcp(dr.detach(f)), 0)
            δL = _carry(mode, dr.select(path.active, Lo, 0), δL)
        # Lanes of a packet end together, so that their queries do. Traced light has more noise if they do (measured)
        u = None if field is None else sampler.together_1d(after.depth + TOGETHER)
        after, sampler = paths.roulette(after, sampler, integrator.rr_depth, u=u)
        return after, δL, sampler

    return dr.while_loop(
        (path, δL, sampler), lambda path, δL, sampler: path.active, step, label=f"adjoint path ({mode.name})"
    )[1]


def _carry(mode, L, δL, keep: bool = False):
    """Carry derivatives between radiance `L` and the parameters that it depends on: `δL`, in forward mode with those
    of `L` added. `keep`: leave those of the parameters as they are, for another call; inside of loops they stay anyway.
    """
    if not dr.grad_enabled(L):
        return δL
    if mode == dr.ADMode.Forward:
        return δL + dr.forward_to(L, flags=dr.ADFlag.ClearInterior if keep else dr.ADFlag.Default)
    dr.backward_from(δL * L)
    return δL


def by_incident_cache(integrator, scene, lights, field, path, found, after, sampler):
    """Radiance, emission apart, that the ray of a bounce brings to `path`, from a cache of incident radiance:
    (Li, sampler).

    Where the ray follows a lobe that is sharper than the cache, direct light is traced at what it met, and so on until
    a lobe is not. Nothing is read for mirrors, whose BSDFs have no derivative under detached sampling.
    """
    smooth = after.active & ~found.delta
    near = smooth & (found.bs.pdf <= SHARP_PDF)

    def query(path, found, active):
        more = material_of(field, path.si, path.si.bsdf(path.ray), active)
        return field.query(field.encode(path.si.p, vertex.facing(path.si), **more), found.ray.d)

    Li = query(path, found, near)
    Li = dr.select(near, Li, 0)
    if not scene_is_glossy(scene):
        return Li, sampler

    def step(path, sampler):
        found, sampler = paths.bounce(scene, lights, path, sampler)
        after = paths.advance(path, found, integrator.depth_limit)
        ends = vertex.is_terminal(path.si, path.active) & ~found.delta & (found.bs.pdf <= SHARP_PDF)
        beyond = query(path, found, ends)
        after.L += dr.select(ends & after.active, path.β * found.weight * beyond, 0)
        after.active &= ~ends
        return paths.roulette(after, sampler, integrator.rr_depth)

    path = replace(after, L=mi.Spectrum(0), β=mi.Spectrum(1), η=mi.Float(1), active=smooth & ~near)
    path, sampler = dr.while_loop((path, sampler), lambda path, sampler: path.active, step, label="sharp lobes")
    return Li + path.L, sampler


def by_outgoing_cache(integrator, scene, lights, field, content: str, after, sampler):
    """The same from a cache of outgoing radiance, which is read where the ray arrived, at `after`.

    Mirrors, glass and masks are traced on to the first surface that the cache knows; so is direct light there if the
    `content` of the cache is ``indirect``.
    """
    path = replace(after, L=mi.Spectrum(0), β=mi.Spectrum(1), η=mi.Float(1))

    def step(path, sampler):
        found, sampler = paths.bounce(scene, lights, path, sampler)
        path = paths.advance(path, found, integrator.depth_limit)
        return paths.roulette(path, sampler, integrator.rr_depth)

    def passes_on(path, sampler):
        return path.active & ~vertex.is_terminal(path.si, path.active)

    if paths.scene_has_mirrors(scene) or _scene_has_masks(scene):
        path, sampler = dr.while_loop((path, sampler), passes_on, step, label="mirrors and masks")
    if content == "indirect":
        found, sampler = paths.bounce(scene, lights, path, sampler)
        path.L += dr.select(path.active, path.β * found.direct, 0)
    bsdf = path.si.bsdf(path.ray)
    surface = surface_of(path.si, bsdf, path.active, scene_is_glossy(scene))
    return path.L + dr.select(path.active, path.β * field.query(*surface.inputs()), 0), sampler


def _scene_has_masks(scene) -> bool:
    bsdfs = [s.bsdf() for s in scene.shapes()]
    return any(b is not None and bool(int(b.flags()) & int(mi.BSDFFlags.Null)) for b in bsdfs)
