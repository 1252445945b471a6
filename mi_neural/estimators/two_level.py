"""The two-level estimator, as functions of samples.

    E[cache + residual] = ∫ f L cos dω   for any cache            (Dereviannykh et al. 2025, two-level estimator)

with cache    = α/Nc Σ_i f L_cache(ω_i) cos / p(ω_i)          cheap: one query a direction
and  residual = 1/Nr Σ_j f (L_j - α L_cache(ω_j)) cos / p(ω_j)  dear: L_j is traced

The cache is a control variate and α its coefficient. α may depend on the place and on anything that was known before
the samples that it weighs were drawn; then the α terms cancel in the mean, whatever the cache says. α = 1 is the
paper's choice, α = 0 path tracing. Nothing here knows a scene or a sampler.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

#: Answers of a cache above this many times its scale count as this: sums of finite answers stay finite.
ANSWER_MAX = 1e4


def sane(Li_cache, scale):
    """A cache's answer, cut to [0, `ANSWER_MAX` `scale`], 0 for NaN: just another cache, so the mean stays right, and a
    broken one costs variance and breaks no pixel."""
    ok = Li_cache >= 0  # false for NaN
    return dr.select(ok, dr.minimum(dr.select(ok, Li_cache, 0), ANSWER_MAX * scale), 0)


def residual(traced, cached, alpha, probability, kept):
    """``(traced - α cached) / q`` where `kept` (with probability q), else 0: E = E[traced] - α E[cached].

    `traced`, `cached`: f L cos / p of one direction, by tracing and by the cache.
    """
    return dr.select(kept, (traced - alpha * cached) / probability, 0)


def combine(cache_sum, n_cache, residual_sum, n_traced, alpha):
    """``α/Nc Σ cached + 1/Nr Σ residual``: E = E[traced] if both sums are of samples with the same mean `cached`."""
    return alpha * cache_sum / dr.maximum(n_cache, 1) + residual_sum / n_traced


def best_split(var_cache: float, cost_cache: float, var_residual: float, cost_residual: float) -> float:
    """``Nc/Nr = sqrt(Var_c c_r / (Var_r c_c))``: the split of least variance ``Var_c/Nc + Var_r/Nr`` for its cost.

    Variances of one sample of either part, costs in any one unit. 0 where the cache part has no variance, infinity
    where the residual has none.
    """
    if var_cache <= 0:
        return 0.0
    if var_residual <= 0:
        return math.inf
    return math.sqrt(var_cache * cost_residual / (var_residual * cost_cache))


def coefficient(covariance, variance, floor):
    """``α = Cov(traced, cached) / Var(cached)``, cut to [0, 1]: the control variate's coefficient of least variance.

    0 where the variance is at most `floor`. With Nc queries of which the traced direction is one, the best α is the
    same for every Nc > 1, and for Nc = 1 the α terms cancel in every sample.
    """
    ok = variance > floor
    return dr.select(ok, dr.clip(covariance / dr.select(ok, variance, 1), 0, 1), 0)


def resampling_weight(target_sum, n, target):
    """RIS weight ``(1/N Σ_i t_i) / t_j`` of the candidate j, kept out of N with probability t_j / Σ t_i (Talbot et al.
    2005): E[weight g(ω_j)] = E[g(ω)], all candidates being drawn from one density p.

    MIS against next-event estimation goes on using p: a function of ω like any other, its mean is kept as well.
    """
    ok = target > 0
    return dr.select(ok, target_sum / (n * dr.select(ok, target, 1)), 0)


def resampling_target(cached, weight, defensive):
    """RIS target of a direction: luminance of what the cache says arrives in the pixel, `cached` = f L_cache cos / p,
    and of a `defensive` radiance with the same `weight` = f cos / p, so that it is positive wherever light may be."""
    return mi.luminance(cached + defensive * weight)
