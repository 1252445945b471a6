"""What `neural_path` measures while it trains: the cache's bias and the noise of tracing, by place, and the threshold
that follows from them."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_neural.caches.accuracy import Accuracy, AccuracyShape, Pairs
from mi_neural.integrators.neural_path import ENDS, LEAST_BIAS, YOUNG, denoised_threshold

BOX = ([0.0] * 3, [1.0] * 3)


def pairs(rng, n, bias, noise, level=1.0) -> Pairs:
    """Estimates of a radiance `level`, of relative standard deviation `noise`, by a cache that is off by `bias`."""

    def traced():
        return mi.Color3f(mi.Float((level * (1 + noise * rng.standard_normal(n))).astype(np.float32)))

    x = mi.Point3f(rng.random((3, n)).astype(np.float32))
    normal = dr.zeros(mi.Vector3f, n) + mi.Vector3f(0, 0, 1)
    cached = mi.Color3f(dr.full(mi.Float, level * (1 + bias), n))
    return Pairs(x, normal, cached, (traced(), traced()), mi.Bool(rng.random(n) < 0.9))


def observe(grid, p: Pairs, decay=1.0) -> None:
    grid.observe(p, dr.opaque(mi.Float, decay))


def share_at(grid, x, n_samples) -> float:
    return float(grid.share(mi.Point3f(x), mi.Vector3f(0, 0, 1), n_samples)[0])


@pytest.mark.parametrize("level", [1e-4, 1.0, 1e4])
def test_bias_and_noise_are_found_in_the_noise(rng, level):
    """A hundred thousand pairs, their noise three times the bias; relative to the cache's answer."""
    grid = Accuracy(*BOX, AccuracyShape(resolution=1), scale=level)
    for _ in range(10):
        observe(grid, pairs(rng, 10_000, 0.3, 1.0, level))
    square = 1.3**2 + 1e-2
    found = grid.summary()
    print(found)
    assert found["noise_of_pairs"] == pytest.approx(1 / square, rel=0.02)
    assert found["bias_of_pairs"] == pytest.approx(0.09 / square, abs=0.012)
    i = grid.entry(mi.Point3f(0.5), mi.Vector3f(0, 0, 1))
    assert float(dr.gather(mi.Float, grid.bias, i)[0]) == pytest.approx(0.09 / square, abs=0.012)


def test_each_place_has_its_own_bias(rng):
    grid = Accuracy(*BOX, AccuracyShape(resolution=2))
    for _ in range(20):
        p = pairs(rng, 10_000, 0.0, 0.5)
        left = np.array(p.position.x) < 0.5
        p.cached = mi.Color3f(mi.Float(np.where(left, 1.0, 2.0).astype(np.float32)))
        observe(grid, p)
    left, right = (share_at(grid, (x, 0.25, 0.25), 1.0) for x in (0.25, 0.75))
    print(f"share of the cache where it is right {left:.3f}, where it is twice too bright {right:.3f}")
    assert left > 0.9 > 0.35 > right


def test_little_is_trusted_of_what_is_known_by_few_pairs(rng):
    shares = []
    for n in (8, 512, 32768):
        grid = Accuracy(*BOX)
        observe(grid, pairs(rng, n, 0.0, 1.0))
        shares.append(share_at(grid, 0.5, 64.0))
    print(shares)
    assert shares[0] < shares[1] < shares[2]
    assert share_at(Accuracy(*BOX), 0.5, 1.0) == 0, "an empty grid"


@pytest.mark.parametrize("noise, bias, n, share", [
    (1.0, 1.0, 1, 0.5), (1.0, 0.25, 4, 0.5), (1.0, 1.0, 64, 0.0), (1.0, 1e-4, 4, 1.0), (0.0, 0.0, 1, 0.0),
    (0.0, 1.0, 1, 0.0), (3.0, 1.0, 1, 0.75),
])  # fmt: skip
def test_share_is_that_of_least_squared_error(noise, bias, n, share):
    """w = v/N / (v/N + b²); within 2 % of 0 and 1 it is that."""
    grid = Accuracy(*BOX)
    grid.noise, grid.bias = (dr.full(mi.Float, v, grid.constants.n_entries) for v in (noise, bias))
    assert share_at(grid, 0.5, float(n)) == pytest.approx(share, abs=1e-6)
    if 0 < share < 1:
        errors = [(1 - w) ** 2 * noise / n + w**2 * bias for w in (share - 0.01, share, share + 0.01)]
        assert errors[1] < min(errors[0], errors[2])


def test_values_that_are_not_finite_or_huge_spoil_nothing(rng):
    grid = Accuracy(*BOX)
    p = pairs(rng, 512, 0.1, 1.0)
    for k, bad in enumerate((np.nan, np.inf, -np.inf, 1e30)):
        lane = dr.arange(mi.UInt32, 512) == k
        p.traced = (dr.select(lane, mi.Color3f(bad), p.traced[0]), p.traced[1])
    observe(grid, p)
    assert all(math.isfinite(v) for v in grid.summary().values())
    assert all(np.isfinite(v).all() for v in grid.arrays().values())


def test_mean_bias_is_that_of_all_pairs(rng):
    """Of 2^18 pairs: 0.25² over 1.25² + 0.01, within four standard errors of about 1 %."""
    grid = Accuracy(*BOX)
    assert float(grid.mean_bias[0]) == 0
    observe(grid, pairs(rng, 2**18, 0.25, 0.625))
    assert float(grid.mean_bias[0]) == pytest.approx(0.25**2 / (1.25**2 + 1e-2), rel=0.04)
    assert float(grid.mean_bias[0]) == pytest.approx(grid.summary()["bias_of_pairs"], rel=1e-4)
    grid.reset()
    assert float(grid.mean_bias[0]) == 0


def test_threshold_of_denoised_images_grows_with_samples_and_with_what_is_wrong():
    assert denoised_threshold(0.0, 1e3, 64) == pytest.approx(ENDS * 64 * LEAST_BIAS)
    assert denoised_threshold(0.02, 1e3, 64) == pytest.approx(ENDS * 1.28)
    assert denoised_threshold(0.01, 1e3, 64) == denoised_threshold(0.02, 1e3, 32) == pytest.approx(ENDS * 0.64)


def test_threshold_of_denoised_images_is_higher_after_few_steps():
    assert denoised_threshold(0.05, YOUNG, 20) == pytest.approx(1)
    assert denoised_threshold(0.05, YOUNG / 2, 20) == pytest.approx(2**6)
    assert denoised_threshold(0.2, YOUNG, 20) == denoised_threshold(0.05, YOUNG, 80) == pytest.approx(8)


def test_grid_is_kept_restored_and_forgotten(rng):
    grid, other = Accuracy(*BOX), Accuracy(*BOX)
    empty = grid.arrays()
    observe(grid, pairs(rng, 4096, 0.1, 1.0))
    other.set_arrays(grid.arrays())
    assert float(grid.mean_bias[0]) == float(other.mean_bias[0]) > 0
    np.testing.assert_array_equal(np.array(other.bias), np.array(grid.bias))
    np.testing.assert_array_equal(np.array(other.noise), np.array(grid.noise))
    grid.reset()
    assert all(np.array_equal(v, empty[k]) for k, v in grid.arrays().items())
    with pytest.raises(ValueError, match="sizes of this grid"):
        other.set_arrays(Accuracy(*BOX, AccuracyShape(n_entries=64)).arrays())


@pytest.mark.parametrize("key, value", [("resolution", 0), ("n_entries", 0), ("n_entries", 100)])
def test_impossible_grid_is_refused_by_name(key, value):
    with pytest.raises(ValueError, match=f"{key} is {value}"):
        AccuracyShape(**{key: value})
