"""One short function per loss. All return one value per record; `p` and `y` are radiance over the scene's mean."""

from __future__ import annotations

import drjit as dr


def luminance(c):
    """Mean of the channels, as the caches' losses use it."""
    return (c.x + c.y + c.z) * (1 / 3)


def relative_l2(p, y, epsilon):
    """``|p - y|² / (mean_rgb(stopgrad p)² + ε)`` (Müller et al. 2021, eq. 5; Lehtinen et al. 2018).

    Unbiased where the network can represent the radiance; where it cannot, bright directions count less than dark ones
    and the integral over directions comes out too small (measured: -5 % on a sunlit courtyard).
    """
    return dr.squared_norm(p - y) / (dr.square(dr.detach(luminance(p))) + epsilon)


def local_relative_l2(p, y, local_mean, epsilon):
    """``|p - y|² / (E(x)² + ε)``, E(x) being the mean prediction over the hemisphere at the record's position.

    All directions of one position weigh the same, so the integral over directions, which is what a pixel sees, stays
    right; positions weigh as a relative error in the image does.
    """
    return dr.squared_norm(p - y) / (dr.square(dr.detach(local_mean)) + epsilon)


def weighted_relative_l2(p, y, weight, pdf, epsilon):
    """``pdf |t p - t y|² / (mean_rgb(stopgrad t p)² + ε)``, t being the `weight` f cos/p of the direction's BSDF sample
    and `pdf` its density: the error counts as the pixel will see it (authors' configuration of NIRC, METHODS 1)."""
    return pdf * relative_l2(weight * p, weight * y, epsilon)
