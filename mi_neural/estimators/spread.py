"""Where a path may stop and ask a cache.

Spread: Müller et al. 2021 (NRC), section 3.4, after Bekaert et al. 2003. Balanced heuristic: Dereviannykh et al. 2025.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

#: A lobe that sends a sample with a density above this (per steradian; a Lambertian one has at most 1/π) is followed:
#: the directional detail of a cache of incident radiance does not suffice for it.
SHARP_PDF = 3.0
#: Samples a pixel at which :func:`grown` begins to grow from 1.
GROWS_FROM = 256


def camera_spread(distance_squared, cos_theta):
    """Footprint ``a_0 = |x_0-x_1|² / (4π |cos θ_1|)`` of a pixel's ray at the first vertex, in squared scene units."""
    return distance_squared / (4 * dr.pi * dr.maximum(dr.abs(cos_theta), 1e-4))


def segment_spread(distance_squared, pdf, cos_theta):
    """What one more segment adds to the square root of a path's spread: ``sqrt(|x_{i-1}-x_i|² / (p |cos θ_i|))``.

    `pdf` is the density of the segment's direction over solid angle. In scene units. Delta segments add nothing: do not
    ask for them.
    """
    return dr.sqrt(distance_squared / dr.maximum(pdf * dr.abs(cos_theta), 1e-9))


def exceeds(spread_root, a_0, threshold):
    """``a > c a_0``: the path has become so wide that the detail a cache loses would not be seen."""
    return dr.square(spread_root) > threshold * a_0


def grown(threshold: float, spp: float) -> float:
    """Constant c of the spread test for an image of `spp` samples: at least spp/256. Paths run further the more samples
    there are, so that the limit is path tracing."""
    return max(threshold, spp / GROWS_FROM)


def balanced_probability(n_cache: int, pdf):
    """``t = Nc p_f / (Nc p_f + p_g)`` with ``p_f = 1/π``: the share of the estimate that rests on the cache.

    Rough lobes stop (Nc = 1: one half at the normal), sharp lobes go on. `pdf` is that of the sampled direction.
    """
    p_f = n_cache * dr.inv_pi
    return p_f / (p_f + pdf)


def follow_probability(n_cache: int, pdf):
    """``1 - t`` of :func:`balanced_probability`, without its cancellation where it is small."""
    return dr.rcp(1 + n_cache * dr.inv_pi / pdf)


@dataclass
class PathSpread:
    """The spread of a path as it grows. A PyTree, for loops.

    root       square root of the spread a since the first vertex with a smooth lobe
    a_0        that of the pixel there
    distance   from the camera to there, along mirrors and glass
    started    whether the path has come so far
    """

    root: mi.Float
    a_0: mi.Float
    distance: mi.Float
    started: mi.Bool

    @staticmethod
    def start(n: int) -> PathSpread:
        """`n` paths at the camera."""
        return PathSpread(dr.zeros(mi.Float, n), dr.zeros(mi.Float, n), dr.zeros(mi.Float, n), dr.zeros(mi.Bool, n))

    def arrive(self, si, ray, pdf, delta, smooth) -> PathSpread:
        """After `ray`, sampled with `pdf` over solid angle or by a `delta` lobe, met `si`, which is `smooth` or not."""
        return self.reach(si.t, dr.dot(si.n, ray.d), pdf, delta, si.is_valid(), smooth)

    def reach(self, length, cos_theta, pdf, delta, arrives, smooth) -> PathSpread:
        """As :meth:`arrive`, after a segment of that `length`; `arrives`: whether it ended somewhere. In a medium
        `cos_theta` is 1: nothing there is seen at an angle."""
        grows = self.started & ~delta & arrives
        root = self.root + dr.select(grows, segment_spread(dr.square(length), pdf, cos_theta), 0)
        distance = self.distance + dr.select(self.started | ~arrives, 0, length)
        a_0 = dr.select(self.started, self.a_0, camera_spread(dr.square(distance), cos_theta))
        return PathSpread(root, a_0, distance, self.started | smooth)

    def exceeds(self, threshold):
        """See :func:`exceeds`; with a threshold of 0 wherever there is a smooth lobe."""
        wide = exceeds(self.root, self.a_0, threshold)
        return self.started & (wide | (threshold == 0))

    def restarted(self, where) -> PathSpread:
        """As wide as nothing, where `where`."""
        return PathSpread(dr.select(where, 0, self.root), self.a_0, self.distance, mi.Bool(self.started))
