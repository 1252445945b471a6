"""Russian roulette by what is expected to come, as functions of samples.

    E[kept/q x] = E[x]   for any probability q > 0 that was known before x was drawn

What is left out costs variance ``(1/q - 1) E[x²]``, and what is kept costs time. Variance times time of a pixel is
least where q is in proportion to the root of the second moment over the cost (Rath et al. 2022, EARS), relative to that
of the whole pixel: light that is small beside the noise of its pixel is not worth a ray. Here the expected radiance
stands in the place of the root of the second moment, as in adjoint-driven roulette (Vorba and Křivánek 2016). Nothing
here knows a scene or a sampler.
"""

from __future__ import annotations

import math

import drjit as dr

#: Least probability with which a path goes on, and with which a shadow ray is traced, see :func:`least_of`.
LEAST, LEAST_SHADOW = 0.1, 0.05
#: Strength of the roulette over the relative standard deviation of a camera sample. The best strengths measured were
#: 0.13 to 0.3 times it (five scenes).
STRENGTH = 0.2


def survival(expected, level, strength, least):
    """``expected / (strength level)``, cut to [`least`, 1]: the probability with which a part of a sample is kept.

    `expected`: radiance that it will bring to its pixel; `level`: of the pixel; `strength`: in units of `level`, the
    radiance below which roulette begins. 1 where `strength` is 0.
    """
    q = dr.clip(expected / dr.maximum(strength * level, 1e-30), least, 1)
    return dr.select(strength > 0, dr.select(dr.isfinite(q), q, 1), 1)


def least_of(weight, least=LEAST):
    """Least probability for a path of this throughput: what goes on has at most 1 / `least`, after any number of
    decisions. Expectations that are wrong cost variance, and not without bound."""
    return dr.clip(least * weight, least, 1)


def strength_of(variance: float) -> float:
    """The strength for a pixel whose samples have this relative variance."""
    return STRENGTH * math.sqrt(max(variance, 0.0)) if math.isfinite(variance) else 0.0
