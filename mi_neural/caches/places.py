"""Where records have lain: training comes back to what has left the view."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

#: Places that are remembered, and steps after which all earlier ones weigh as much as the next 1000.
N_PLACES, PLACES_HORIZON = 4096, 1000


class Places:
    """Where records lay, and from where they were seen: an even sample of all steps so far, so that training can come
    back to what has left the view. A PyTree.

    position   world space; not finite: unknown
    view       towards the viewer
    age        steps so far, 1-wide
    """

    DRJIT_STRUCT = {"position": object, "view": object, "age": object}  # noqa: RUF012

    def __init__(self, n: int):
        self.position = dr.full(mi.Point3f, math.nan, n)
        self.view = dr.zeros(mi.Vector3f, n)
        self.age = mi.Float(0)

    def remember(self, position, view, valid, sampler) -> None:
        """Put random records of this step into so many random places as make all steps equally likely (reservoir
        sampling); after a horizon, recent ones more so."""
        self.age = self.age + 1
        n = dr.width(valid)
        i = dr.minimum(mi.UInt32(sampler.next_1d() * n), n - 1)
        new = dr.gather(mi.Bool, valid, i)
        new &= (sampler.next_1d() * dr.minimum(self.age, PLACES_HORIZON) < 1) | ~dr.isfinite(self.position.x)
        self.position = dr.select(new, dr.gather(mi.Point3f, position, i, new), self.position)
        self.view = dr.select(new, dr.gather(mi.Vector3f, view, i, new), self.view)
        dr.eval(self.position, self.view, self.age)
