"""The two-level estimator as functions of samples: its mean does not depend on the cache, its constants are the best.

The integral is ∫ L dω over [0, 1), by samples of a density p that is neither L's nor the cache's. The tests of means
fail a correct estimator in one of 10,000 choices of seed.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_mean

from mi_neural.estimators import two_level
from mi_neural.render.sampling import PathSampler

N = 2**17
#: ∫ (0.2 + 3 ω²) dω; scale of the caches
KNOWN, SCALE = 1.2, 1e-3
#: Caches: right up to noise-free errors, of no use, blind, and such as no network should answer
CACHES = {
    "good": lambda w: 0.25 + 2.9 * w * w, "nonsense": lambda w: 5 * dr.abs(dr.sin(40 * w)), "black": lambda w: 0 * w,
    "bright": lambda w: 1e3 * w, "negative": lambda w: -1 - 3 * w, "NaN": lambda w: dr.select(w < 0.3, math.nan, w),
    "infinite": lambda w: dr.select(w < 1e-3, math.inf, w),
}  # fmt: skip


@pytest.fixture
def sampler():
    return PathSampler.make(dr.arange(mi.UInt32, N), mi.UInt32(3))


def draw(sampler):
    """A direction of the density 1/2 + ω, and one over it."""
    u = sampler.next_1d()
    w = 0.5 * (dr.sqrt(1 + 8 * u) - 1)
    return w, dr.rcp(0.5 + w)


def traced(w, inv_pdf):
    return (0.2 + 3 * w * w) * inv_pdf


def cached(name, w, inv_pdf):
    """The answer over the density, cut at 10 (`SCALE` times `ANSWER_MAX`), so that the tests see something."""
    return two_level.sane(CACHES[name](w), mi.Float(SCALE)) * inv_pdf


def estimate(sampler, name, n_cache, n_traced, probability, alpha):
    """The estimator as the integrator puts it together: the traced directions are the first of those asked."""
    cache, residual = mi.Float(0), mi.Float(0)
    for k in range(max(n_cache, n_traced)):
        w, inv_pdf = draw(sampler)
        c = cached(name, w, inv_pdf)
        cache += c
        if k < n_traced:
            kept = sampler.next_1d() < probability
            residual += two_level.residual(traced(w, inv_pdf), c, alpha, probability, kept)
    return two_level.combine(cache, mi.Float(max(n_cache, n_traced)), residual, mi.Float(n_traced), alpha)


@pytest.mark.parametrize("name", CACHES)
@pytest.mark.parametrize("n_cache, n_traced, probability, alpha", [
    (1, 1, 1.0, 1.0), (4, 1, 1.0, 1.0), (4, 1, 0.25, 1.0), (3, 2, 0.5, 0.37), (0, 1, 1.0, 0.0), (1, 4, 0.5, 1.0),
])  # fmt: skip
def test_mean_is_independent_of_the_cache(sampler, name, n_cache, n_traced, probability, alpha):
    found = np.array(estimate(sampler, name, n_cache, n_traced, probability, mi.Float(alpha)), np.float64)
    assert np.isfinite(found).all()
    assert_mean(found, KNOWN, f"{name}, Nc {n_cache}, Nr {n_traced}, q {probability}, alpha {alpha}", relative=1e-5)


@pytest.mark.parametrize("name", CACHES)
def test_mean_is_kept_where_alpha_depends_on_the_place(sampler, name):
    """α known before the samples are drawn, but another at each of them."""
    alpha = mi.Float(np.random.default_rng(1).random(N).astype(np.float32))
    assert_mean(np.array(estimate(sampler, name, 4, 1, 0.5, alpha)), KNOWN, name, relative=1e-5)


def test_good_cache_takes_away_variance_and_alpha_zero_is_path_tracing(sampler):
    variances = [np.array(estimate(sampler, "good", 16, 1, 1.0, mi.Float(a)), np.float64).var() for a in (0.0, 1.0)]
    plain = np.array(estimate(sampler, "black", 16, 1, 1.0, mi.Float(1)), np.float64).var()
    print(f"alpha 0: {variances[0]:.4f}, alpha 1: {variances[1]:.4f}, no cache: {plain:.4f}")
    assert variances[0] == pytest.approx(plain, rel=0.03)
    assert variances[1] < 0.15 * variances[0]


def test_one_query_at_the_traced_direction_cancels(sampler):
    """Nc = Nr = q = 1: α takes nothing away and adds nothing."""
    w, inv_pdf = draw(sampler)
    a, b = traced(w, inv_pdf), cached("nonsense", w, inv_pdf)
    for alpha in (0.0, 0.3, 1.0):
        residual = two_level.residual(a, b, mi.Float(alpha), 1.0, mi.Bool(True))
        found = two_level.combine(b, mi.Float(1), residual, mi.Float(1), mi.Float(alpha))
        np.testing.assert_allclose(np.array(found), np.array(a), rtol=1e-5)


def test_what_is_not_kept_is_nothing_at_all():
    found = two_level.residual(mi.Color3f(math.nan), mi.Color3f(math.inf), mi.Float(1), mi.Float(0.5), mi.Bool(False))
    assert (np.array(found) == 0).all()


# ---------------------------------------------------------------- answers of broken caches


def test_sane_answers_lie_between_zero_and_the_limit():
    scale = 1e-3
    given = [math.nan, math.inf, -math.inf, -1.0, -0.0, 0.0, 1e-30, 0.5 * scale, 1e38, 0.99e4 * scale, 1.01e4 * scale]
    limit = two_level.ANSWER_MAX * scale
    expected = [0, limit, 0, 0, 0, 0, 1e-30, 0.5 * scale, limit, 0.99e4 * scale, limit]
    found = np.array(two_level.sane(mi.Float(given), mi.Float(scale)))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_sane_judges_each_channel_by_itself():
    found = two_level.sane(mi.Color3f(math.nan, 2, math.inf), mi.Float(1))
    np.testing.assert_allclose(np.array(found).ravel(), [0, 2, two_level.ANSWER_MAX])


# ---------------------------------------------------------------- the best split


@pytest.mark.parametrize("var_cache, cost_cache, var_residual, cost_residual", [
    (1.0, 1.0, 1.0, 1.0), (4.0, 0.1, 1.0, 2.0), (0.3, 0.2, 5.0, 1.0), (1e-3, 1e-2, 1e3, 1.0), (50.0, 1e-3, 0.1, 1.0),
])  # fmt: skip
def test_best_split_is_the_minimum_of_variance_times_cost(var_cache, cost_cache, var_residual, cost_residual):
    ratio = np.geomspace(1e-7, 1e7, 200_001)  # Nc for Nr = 1
    product = (var_cache / ratio + var_residual) * (cost_cache * ratio + cost_residual)
    found = two_level.best_split(var_cache, cost_cache, var_residual, cost_residual)
    assert found == pytest.approx(ratio[np.argmin(product)], rel=2e-4)
    at = (var_cache / found + var_residual) * (cost_cache * found + cost_residual)
    assert at <= product.min() * (1 + 1e-9)


def test_best_split_without_variance_of_a_part():
    assert two_level.best_split(0.0, 1.0, 1.0, 1.0) == 0
    assert two_level.best_split(1.0, 1.0, 0.0, 1.0) == math.inf
    assert two_level.best_split(0.0, 1.0, 0.0, 1.0) == 0


# ---------------------------------------------------------------- the coefficient


def test_coefficient_is_that_of_regression_in_float64(rng):
    covariance, variance = rng.normal(size=500) * 10.0 ** rng.integers(-6, 6, 500), 10.0 ** rng.uniform(-8, 6, 500)
    found = np.array(two_level.coefficient(mi.Float(covariance), mi.Float(variance), 1e-6))
    expected = np.where(variance > 1e-6, np.clip(covariance / variance, 0, 1), 0)
    assert 50 < (expected == 0).sum() and 50 < (expected == 1).sum() and 50 < ((0 < expected) & (expected < 1)).sum()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-7)


def test_coefficient_has_the_least_variance_of_all(rng):
    """Of y - α (c - E[c]), c being asked so often that its mean has no noise."""
    c = rng.normal(size=20_000)
    y = 0.4 * c + rng.normal(size=c.size)
    covariance, variance = np.cov(y, c, bias=True)[0, 1], c.var()
    found = float(two_level.coefficient(mi.Float(covariance), mi.Float(variance), 1e-6)[0])
    alphas = np.linspace(0, 1, 1001)
    best = alphas[np.argmin([(y - a * c).var() for a in alphas])]
    assert found == pytest.approx(best, abs=1e-3)


def test_coefficient_of_extremes_stays_in_range():
    big = 3e38
    covariance = mi.Float([big, -big, big, 0.0, 1e-38, 1.0])
    variance = mi.Float([big, big, 1e-5, 0.0, 1e-38, math.inf])
    np.testing.assert_allclose(np.array(two_level.coefficient(covariance, variance, 1e-6)), [1, 0, 1, 0, 0, 0])


# ---------------------------------------------------------------- resampling


@pytest.mark.parametrize("name", ["good", "nonsense", "black", "infinite"])
@pytest.mark.parametrize("n", [1, 2, 8])
def test_resampled_direction_keeps_the_mean(sampler, name, n):
    """One of n candidates, kept as the integrator keeps it: with probability t_j / Σ t_i, in one pass."""
    t_sum, t_kept, value = mi.Float(0), mi.Float(0), mi.Float(0)
    for _ in range(n):
        w, inv_pdf = draw(sampler)
        t = two_level.resampling_target(mi.Color3f(cached(name, w, inv_pdf)), mi.Color3f(inv_pdf), 0.25)
        t_sum += t
        take = sampler.next_1d() * t_sum < t
        t_kept, value = dr.select(take, t, t_kept), dr.select(take, traced(w, inv_pdf), value)
    weight = two_level.resampling_weight(t_sum, mi.Float(n), t_kept)
    if n == 1:
        np.testing.assert_allclose(np.array(weight), 1, rtol=1e-6)
    assert_mean(np.array(weight * value), KNOWN, f"{name}, {n} candidates", relative=1e-5)


def test_resampling_weight_over_all_draws_is_the_mean_of_the_candidates(rng):
    """Σ_j t_j / Σ t · weight_j · g_j = 1/N Σ_j g_j, exactly."""
    t, g = rng.random(7) + 1e-3, rng.normal(size=7)
    weight = np.array(two_level.resampling_weight(mi.Float(t.sum()), mi.Float(7), mi.Float(t)), np.float64)
    assert (t / t.sum() * weight * g).sum() == pytest.approx(g.mean(), rel=1e-5)


def test_resampling_weight_without_a_target_is_zero():
    found = two_level.resampling_weight(mi.Float([0, 1, 5]), mi.Float(4), mi.Float([0, 0, -1]))
    assert (np.array(found) == 0).all()


def test_target_is_positive_wherever_light_may_be():
    weight = mi.Color3f(0.5, 0.0, 0.25)
    dark = two_level.resampling_target(mi.Color3f(0), weight, mi.Float(0.1))
    lit = two_level.resampling_target(2 * weight, weight, mi.Float(0.1))
    grey = 0.5 * 0.212671 + 0.25 * 0.072169
    assert float(dark[0]) == pytest.approx(0.1 * grey, rel=1e-4)
    assert float(lit[0]) == pytest.approx(2.1 * grey, rel=1e-4)
