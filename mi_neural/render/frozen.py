"""What must be known before a function is frozen (``dr.freeze``)."""

from __future__ import annotations

import functools
import gc
import signal
import threading
from collections.abc import Callable
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

#: Held while an integrator of this package renders or trains: what one thread records, another must not disturb.
LOCK = threading.RLock()

#: Shapes that can be part of a recorded function.
RECORDABLE = {"Mesh", "OBJMesh", "PLYMesh", "SerializedMesh", "BlenderMesh", "Cube", "Rectangle", "Sphere", "Disk",
              "Cylinder", "Instance", "ShapeGroup"}  # fmt: skip
#: Numbers of sensors that are gone, in a row, after which Dr.Jit's list of sensors is taken to end. It gives them to
#: new sensors, the lowest first.
UNUSED_NUMBERS = 64
#: Whether sensors can be recorded, by their kind.
_freezes: dict[tuple, bool] = {}


def locked(method):
    """A method that renders or trains: it waits for those of other threads, and they for it."""

    @functools.wraps(method)
    def waits(*args, **keys):
        with LOCK:
            return method(*args, **keys)

    return waits


def can_freeze(sensor) -> bool:
    """Whether Dr.Jit can freeze a function of this sensor; tried once for each kind of sensor.

    Mitsuba 3.9.1 does not show Dr.Jit all that `thinlens` and `orthographic` sensors hold, and `irradiancemeter` has no
    ``sample_ray``; rays of theirs are made outside of recorded functions. So are those of `batch`, which keeps which of
    its sensors were last asked: to free that in a recording ends the process.
    """
    if is_special(sensor) or special_films() or sensor.class_name() == "BatchSensor":
        return False
    key = mi.variant(), sensor.class_name()
    if key not in _freezes:
        _freezes[key] = _records(_ray_of, sensor)
    return _freezes[key]


def is_special(sensor) -> bool:
    """Whether the film of a sensor makes its own channels of a sample, as `specfilm` does.

    In Mitsuba 3.9.1 a function that is frozen while there is such a film fails, and what the film holds is lost."""
    return isinstance(sensor, mi.Sensor) and mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special)


def special_films() -> bool:
    """Whether any sensor of the process has such a film, in whatever scene: Dr.Jit shows a recording all sensors."""
    if not mi.is_spectral:  # they work in spectral variants alone
        return False
    index, missing = 1, 0
    while missing < UNUSED_NUMBERS:
        try:
            if is_special(dr.reinterpret_array(mi.SensorPtr, mi.UInt32(index))[0]):
                return True
            missing = 0
        except RuntimeError:  # no sensor has this number
            missing += 1
        index += 1
    return False


def _ray_of(sensor, sample):
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, sample, sample)
    other, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, sample, sample)  # some sensors have none
    return ray.o, ray.d, other.o, other.d


def can_freeze_scene(scene) -> bool:
    """Whether Dr.Jit can freeze a function of this scene (not with an ``ellipsoidsmesh`` in Mitsuba 3.9.1).

    Tried where there are shapes that are not known to be fine.
    """
    if special_films():
        return False
    return {s.class_name() for s in scene.shapes()} <= RECORDABLE or _records(_hit_in, scene)


def _hit_in(scene, sample):
    ray = mi.Ray3f(mi.Point3f(sample.x, sample.y, 0), mi.Vector3f(0, 0, 1))
    si = scene.ray_intersect(ray)
    bs, weight = si.bsdf().sample(mi.BSDFContext(), si, sample.x, sample)
    return si.t, bs.pdf, weight, si.emitter(scene).eval(si)


def can_freeze_lights(scene) -> bool:
    """Whether Dr.Jit can freeze a function that samples the lights of this scene as Mitsuba does (3.9.1: not where an
    area light shows a picture). Tried where there are such lights.
    """
    varies = int(mi.EmitterFlags.Surface) | int(mi.EmitterFlags.SpatiallyVarying)
    return all(int(e.flags()) & varies != varies for e in scene.emitters()) or _records(_lit_in, scene)


def _lit_in(scene, sample):
    it = dr.zeros(mi.Interaction3f, 2)
    ds, weight = scene.sample_emitter_direction(it, sample, True)
    return ds.pdf, ds.p, weight


def _records(function, thing) -> bool:
    if special_films():
        return False
    try:
        with dr.suspend_grad(), undisturbed():
            dr.freeze(function)(thing, mi.Point2f(dr.opaque(mi.Float, 0.5, 2), dr.opaque(mi.Float, 0.25, 2)))
    except RuntimeError:
        return False
    return True


def disturbed(error: RuntimeError) -> bool:
    """Whether a recording failed because another thread made or freed something of Mitsuba's meanwhile: then the
    function can be called as it is."""
    return "record" in str(error) and not is_recording()


def call(recorded: dict, key, plain: Callable, *args):
    """Call ``recorded[key]``, the frozen form of `plain`; `plain` where there is none or it cannot be recorded now."""
    with undisturbed():
        if key not in recorded or special_films():
            return plain(*args)
        try:
            return recorded[key](*args)
        except RuntimeError as e:
            if not disturbed(e):
                raise
            mi.Log(mi.LogLevel.Debug, f"mi_neural: {key} could not be recorded: {e}")
            del recorded[key]
            return plain(*args)


def is_recording() -> bool:
    """Whether a function of the user's is being frozen, whose part this call is."""
    return dr.flag(dr.JitFlag.FreezingScope)


@contextmanager
def undisturbed():
    """No garbage collection inside: memory of an old scene, freed while a function is recorded, ends the process.

    And no Ctrl-C: a function that is left while it is recorded leaves its arguments, a cache's weights among them,
    unusable. What is sent inside (SIGINT, or a SIGTERM that the program answers) takes effect at the end.
    """
    collects = gc.isenabled()
    gc.disable()
    with _deferred(signal.SIGTERM, signal.SIGINT):
        try:
            yield
        finally:
            if collects:
                gc.enable()


@contextmanager
def _deferred(*numbers):
    """Signals that Python handles are handled after the block; only the main thread has any to handle."""
    handlers, sent = {}, []
    if threading.current_thread() is threading.main_thread():
        handlers = {n: h for n in numbers if callable(h := signal.getsignal(n))}
    try:
        for number in handlers:
            signal.signal(number, lambda number, _: sent.append(number))
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if sent:
        handlers[sent[0]](sent[0], None)
