"""What integrators refuse before any work."""

from __future__ import annotations

import inspect
import os

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural import parameters
from mi_neural.render.media import has_instances, media_of

#: Most entries of an array: Dr.Jit counts them in 32 bits.
MOST_ENTRIES = 2**32 - 1
#: Numbers of a pixel while an image is made: colour, alpha, weight, and copies of them.
FILM_VALUES = 16


#: What renders participating media.
WITH_MEDIA = (
    'media are not modelled by it; use <integrator type="plain_path"/>, "neural_path", "nrc" or "nirc", with a light '
    'sampler or without, or "volpath"'
)


def check_scene(scene, plugin: str, media: bool = False) -> None:
    """Refuse, before any work, a scene that cannot be rendered; the message says what to do. `media`: whether the
    plugin renders participating media."""
    if not scene.emitters():
        raise ValueError(f"{plugin}: the scene has no emitter, the image would be black; add a light")
    if not media:
        _refuse_media(scene, plugin)
    for emitter in scene.emitters():
        _check_emitter(emitter, plugin)


def _refuse_media(scene, plugin: str) -> None:
    for sensor in scene.sensors():
        refuse_medium_of(sensor, plugin)
    for shape in scene.shapes():
        if shape.is_medium_transition():
            raise ValueError(f"{plugin}: shape '{shape.id()}' borders a participating medium, and {WITH_MEDIA}")
    if has_instances(scene) and media_of(scene):
        raise ValueError(f"{plugin}: an instance borders a participating medium, and {WITH_MEDIA}")


def refuse_medium_of(sensor, plugin: str) -> None:
    """Refuse a sensor that is inside a participating medium."""
    if hasattr(sensor, "get_medium") and sensor.get_medium() is not None:
        raise ValueError(f"{plugin}: the camera is inside a participating medium, and {WITH_MEDIA}")


def check_phase_functions(scene, sensor, plugin: str) -> None:
    """Refuse media whose phase functions cannot be rendered here."""
    for medium in media_of(scene, [sensor]):
        if int(medium.phase_function().flags()) & int(mi.PhaseFunctionFlags.Microflake):
            raise ValueError(
                f"{plugin}: the medium '{medium.id()}' has a phase function of microflakes (sggx), which is not "
                'modelled; use <integrator type="volpath"/>'
            )


def check_lights_in_media(lights, plugin: str) -> None:
    """Refuse an object that chooses lights for surfaces alone (see :mod:`mi_neural.lights.sampling`)."""
    for name in ("choose", "pmf"):
        arguments = inspect.signature(getattr(lights, name)).parameters.values()
        if not any(a.name == "around" or a.kind == a.VAR_KEYWORD for a in arguments):
            raise ValueError(
                f"{plugin}: the light sampler's {type(lights).__name__}.{name} has no argument 'around', which names "
                "the points in a participating medium; add around=None to it (mi-neural doc extend)"
            )


def check_gradients_in_media(scene, plugin: str) -> None:
    """Refuse gradients in a scene with participating media, if derivatives with respect to it are wanted."""
    if wants_gradients(scene):
        raise no_gradients_in_media(plugin)


def wants_gradients(scene) -> bool:
    """Whether derivatives with respect to a parameter of `scene` are wanted."""
    params = mi.traverse(scene)
    return any(dr.grad_enabled(value) for value in (parameters.read(params, key) for key in params.keys()))


def no_gradients_in_media(plugin: str) -> RuntimeError:
    """The error where gradients are wanted in a scene with participating media."""
    return RuntimeError(
        f"{plugin}: there are no gradients in scenes with participating media; use Mitsuba's own, "
        "mi.render(scene, params, integrator=mi.load_dict({'type': 'prbvolpath'}))"
    )


def _check_emitter(emitter, plugin: str) -> None:
    """Refuse a light that is not finite: no choice of lights has a probability then, and every pixel is lost. And one
    that Mitsuba 3.9.1 cannot evaluate inside of recorded loops (`path` fails, too); to try it may end the process."""
    if emitter.class_name() == "TimedSunskyEmitter":
        raise ValueError(
            f"{plugin}: emitter '{emitter.id()}' is a timed_sunsky, which Mitsuba 3.9.1 cannot evaluate in symbolic "
            'loops, also those of path; use <emitter type="sunsky"/> at one time (keys year, month, day, hour, ...)'
        )
    shape = emitter.get_shape()
    parts = [(f"emitter '{emitter.id()}'", mi.traverse(emitter), "")]
    if shape is not None and shape.is_mesh():
        parts.append((f"the mesh '{shape.id()}', which shines,", mi.traverse(shape), "vertex_positions"))
    for name, params, only in parts:
        for key in params.keys():
            if only and key != only:
                continue
            value = params[key]
            if dr.is_array_v(value) and dr.is_float_v(value) and not np.isfinite(np.array(value)).all():
                raise ValueError(
                    f"{plugin}: {name} has values that are not finite in '{key}'; "
                    f"mend them, for example mi.traverse(scene) ... ['{key}'] = 0"
                )


def check_spp(spp, plugin: str) -> None:
    """Refuse samples a pixel that are no whole number from 0 on."""
    if not hasattr(spp, "__index__") or spp < 0:
        raise ValueError(f"{plugin}: spp is {spp!r}; give a whole number, 0 for the sampler's own count")


def check_film(sensor, plugin: str, bytes_per_pixel: int = 4 * FILM_VALUES) -> None:
    """Refuse, before memory is asked for, a film that does not fit Dr.Jit's arrays or the memory that is free.

    `bytes_per_pixel`: what is held at once of each pixel at one sample a pixel.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    advice = "render it in crop windows (crop_offset_x, crop_width, ... of the film), or make it smaller"
    if width * height * FILM_VALUES > MOST_ENTRIES:
        raise ValueError(f"{plugin}: a film of {width}x{height} exceeds the 2^32 entries of an array; {advice}")
    needed, free = width * height * bytes_per_pixel, _free_memory()
    if free is not None and needed > free:
        raise ValueError(
            f"{plugin}: a film of {width}x{height} takes about {needed / 2**30:.1f} GiB at one sample a pixel, "
            f"{free / 2**30:.1f} GiB are free; {advice}"
        )


def _free_memory() -> int | None:
    """Bytes of main memory that are free; None where that is unknown, or where rendering is done elsewhere."""
    if dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
        return None
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            found = dict(line.split(":", 1) for line in file)
        return int(found["MemAvailable"].split()[0]) * 1024
    except (OSError, KeyError, ValueError):
        pass
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None
