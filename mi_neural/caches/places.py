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
    inside     in scenes with participating media, what they are in: see
               :meth:`~mi_neural.render.walk.SurfaceWalk.inside`; 0: not known. It holds for the media that a scene has
               now, and is in no file
    age        steps so far, 1-wide
    """

    DRJIT_STRUCT = {"position": object, "view": object, "inside": object, "age": object}  # noqa: RUF012

    def __init__(self, n: int):
        self.position = dr.full(mi.Point3f, math.nan, n)
        self.view = dr.zeros(mi.Vector3f, n)
        self.forget_media()
        self.age = mi.Float(0)

    def forget_media(self) -> None:
        """Forget what places are in: in a scene with media no path starts there any more."""
        self.inside = dr.opaque(mi.UInt32, 0, dr.width(self.view))

    def remember(self, position, view, valid, sampler, inside=None) -> None:
        """Put random records of this step into so many random places as make all steps equally likely (reservoir
        sampling); after a horizon, recent ones more so. `inside`: of the records, in scenes with media."""
        self.age = self.age + 1
        n = dr.width(valid)
        i = dr.minimum(mi.UInt32(sampler.next_1d() * n), n - 1)
        new = dr.gather(mi.Bool, valid, i)
        unknown = ~dr.isfinite(self.position.x)
        if inside is not None:
            unknown |= self.inside == 0
        new &= (sampler.next_1d() * dr.minimum(self.age, PLACES_HORIZON) < 1) | unknown
        self.position = dr.select(new, dr.gather(mi.Point3f, position, i, new), self.position)
        self.view = dr.select(new, dr.gather(mi.Vector3f, view, i, new), self.view)
        if inside is not None:
            self.inside = dr.select(new, dr.gather(mi.UInt32, inside, i, new), self.inside)
        dr.eval(self.position, self.view, self.inside, self.age)
