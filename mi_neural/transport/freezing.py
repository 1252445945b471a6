"""What must be known before a function is frozen (``dr.freeze``)."""

from __future__ import annotations

import gc
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi


def can_freeze(sensor) -> bool:
    """Whether Dr.Jit can freeze a function of this sensor.

    Mitsuba 3.9.1 does not show Dr.Jit all that `thinlens` and `orthographic` sensors hold; a function of theirs must be
    traced anew at each call.
    """

    @dr.freeze
    def probe(sensor, sample):
        ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, sample, sample)
        return ray.o, ray.d

    try:
        with dr.suspend_grad(), undisturbed():
            probe(sensor, mi.Point2f(dr.opaque(mi.Float, 0.5, 2), dr.opaque(mi.Float, 0.25, 2)))
    except RuntimeError:
        return False
    return True


@contextmanager
def undisturbed():
    """No garbage collection inside: memory of an old scene, freed while a function is recorded, ends the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
