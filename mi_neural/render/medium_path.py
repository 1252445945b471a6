"""State of a path through participating media: where it stands, where it last turned, what a ray meets."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import path as paths
from .tracking import medium_interaction


@dataclass
class Scattering:
    """Where a path last changed its direction, which light samples compete with what it meets from there.

    p, n       the point, and its geometric normal; 0 in a medium
    receiver, transmits, around   how light is received there, see :func:`.vertex.receiver`
    pdf        density of the direction in which it went on
    in_full    whether emission that it meets counts in full: no light sample finds it
    """

    p: mi.Point3f
    n: mi.Normal3f
    receiver: mi.Vector3f
    transmits: mi.Bool
    around: mi.Bool
    pdf: mi.Float
    in_full: mi.Bool

    @classmethod
    def at_camera(cls, ray) -> Scattering:
        no = mi.Bool(False)
        return cls(mi.Point3f(ray.o), mi.Normal3f(0), mi.Vector3f(0), no, no, mi.Float(0), mi.Bool(True))


@dataclass
class MediumPath(paths.PathState):
    """A path at a surface or at a point where a medium scatters; see :class:`.path.PathState`.

    p          the point, where it is `scattered`
    scattered  whether the path stands in a medium; `ray` led there, `si` is meaningless then
    medium     the medium that it came through
    channel    colour by which distances are sampled along the whole path
    shares     probability of each colour to be `channel`, given the path
    last       where it last changed its direction; None where nothing lets a part of the light pass
    """

    p: mi.Point3f
    scattered: mi.Bool
    medium: mi.MediumPtr
    channel: mi.UInt32
    shares: mi.Spectrum
    last: Scattering | None


@dataclass
class Flight:
    """What a ray meets on its way through media.

    going      whether it is still under way
    ray, si    its last part, and the surface at its end
    p          where a medium scatters, if it does
    scattered  whether it does
    medium     the medium of the last part
    weight     transmittance over the density of what happened, with the albedo where it is `scattered`
    shares     see :class:`MediumPath`
    """

    going: mi.Bool
    ray: mi.Ray3f
    si: mi.SurfaceInteraction3f
    p: mi.Point3f
    scattered: mi.Bool
    medium: mi.MediumPtr
    weight: mi.Spectrum
    shares: mi.Spectrum


@dataclass
class MediumBounce(paths.Bounce):
    """See :class:`.path.Bounce`; `weight` contains that of the flight, and what it met shines where it is `followed`.

    end      where the ray ended
    null     whether the surface was passed as if it were not there
    goes_on  whether the ray was followed
    last     where the path last changed its direction
    turned   `weight` without that of the flight
    """

    end: Flight
    null: mi.Bool
    goes_on: mi.Bool
    last: Scattering
    turned: mi.Spectrum

    @property
    def traced(self):
        return self.goes_on

    @property
    def turn(self):
        return self.turned

    @property
    def pdf(self):
        return self.last.pdf


def scattering_point(path: MediumPath):
    """Where a path is scattered by a medium."""
    return medium_interaction(path.p, path.ray, path.medium)


def phase_function(path: MediumPath, in_medium):
    """The phase function where a path is scattered."""
    return dr.select(in_medium, path.medium.phase_function(), dr.zeros(mi.PhaseFunctionPtr))


def interaction(path: MediumPath):
    """Where a path stands, as emitters are seen from there."""
    it = dr.zeros(mi.Interaction3f)
    it.p, it.n = dr.select(path.scattered, path.p, path.si.p), dr.select(path.scattered, 0, path.si.n)
    it.time, it.wavelengths = path.ray.time, path.ray.wavelengths
    return it


def beyond(path: MediumPath, d):
    """The medium in direction `d` of where a path stands."""
    crosses = path.active & ~path.scattered & path.si.is_medium_transition()
    return dr.select(crosses, path.si.target_medium(d), path.medium)
