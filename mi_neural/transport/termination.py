"""Where a path may stop and ask a cache.

Spread: Müller et al. 2021 (NRC), section 3.4, after Bekaert et al. 2003. Balanced heuristic: Dereviannykh et al. 2025.
"""

from __future__ import annotations

import drjit as dr


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


def balanced_probability(n_cache: int, pdf):
    """``t = Nc p_f / (Nc p_f + p_g)`` with ``p_f = 1/π``: the share of the estimate that rests on the cache.

    Rough lobes stop (Nc = 1: one half at the normal), sharp lobes go on. `pdf` is that of the sampled direction.
    """
    p_f = n_cache * dr.inv_pi
    return p_f / (p_f + pdf)
