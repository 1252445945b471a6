"""Where a path may stop: the formulas against NumPy, and their limits."""

import mitsuba as mi
import numpy as np
import pytest

from mi_neural.estimators import spread as termination


def test_camera_spread_is_that_of_the_paper(rng):
    d2, cos = rng.uniform(0.1, 100, 64).astype("f4"), rng.uniform(-1, 1, 64).astype("f4")
    cos[np.abs(cos) < 1e-3] = 1
    found = np.array(termination.camera_spread(mi.Float(d2), mi.Float(cos)))
    np.testing.assert_allclose(found, d2 / (4 * np.pi * np.abs(cos)), rtol=1e-5)


def test_segment_spread_is_that_of_the_paper(rng):
    d2, pdf, cos = (rng.uniform(0.1, 1, 64).astype("f4") for _ in range(3))
    found = np.array(termination.segment_spread(mi.Float(d2), mi.Float(pdf), mi.Float(-cos)))
    np.testing.assert_allclose(found, np.sqrt(d2 / (pdf * cos)), rtol=1e-5)


def test_path_is_wide_when_the_square_of_the_sum_exceeds_the_threshold(rng):
    segments, a_0 = rng.uniform(0, 2, (3, 256)).astype("f4"), rng.uniform(0.1, 200, 256).astype("f4")
    found = np.array(termination.exceeds(mi.Float(segments.sum(axis=0)), mi.Float(a_0), 0.01))
    assert (found == (segments.sum(axis=0) ** 2 > 0.01 * a_0)).all()
    assert 0 < found.mean() < 1


def test_spread_of_grazing_and_improbable_directions_is_finite_or_wide():
    for d2, pdf, cos in ((1.0, 0.0, 1.0), (1.0, 1.0, 0.0), (1e6, 1e-30, 1e-30)):
        spread = termination.segment_spread(mi.Float(d2), mi.Float(pdf), mi.Float(cos))
        assert np.isfinite(spread[0]) and termination.exceeds(spread, mi.Float(1), 0.01)[0]
    assert np.isfinite(termination.camera_spread(mi.Float(1), mi.Float(0))[0])


def test_ray_that_leaves_the_scene_is_wide():
    spread = termination.segment_spread(mi.Float(np.inf), mi.Float(1), mi.Float(0))
    assert termination.exceeds(spread, mi.Float(1), 0.01)[0]


def test_threshold_zero_stops_at_once_and_an_infinite_one_never():
    spread, a_0 = mi.Float(1e-3, 1, 1e3), mi.Float(1)
    assert np.array(termination.exceeds(spread, a_0, 0.0)).all()
    assert not np.array(termination.exceeds(spread, a_0, float("inf"))).any()


@pytest.mark.parametrize("n, at_lambert", [(1, 0.5), (7, 7 / 8)])
def test_balanced_probability_is_that_of_the_authors(n, at_lambert, rng):
    assert termination.balanced_probability(n, mi.Float(1 / np.pi))[0] == pytest.approx(at_lambert, rel=1e-6)
    pdf = rng.uniform(0, 50, 64).astype("f4")
    found = np.array(termination.balanced_probability(n, mi.Float(pdf)))
    np.testing.assert_allclose(found, (n / np.pi) / (n / np.pi + pdf), rtol=1e-5)


@pytest.mark.parametrize("n", [1, 4, 1000])
def test_probability_to_follow_is_the_rest_and_exact_where_it_is_small(n, rng):
    pdf = np.exp(rng.uniform(-30, 30, 1000)).astype(np.float32)
    found = np.array(termination.follow_probability(n, mi.Float(pdf)), np.float64)
    np.testing.assert_allclose(found, pdf / (n / np.pi + pdf.astype(np.float64)), rtol=1e-6)
    np.testing.assert_allclose(found, 1 - np.array(termination.balanced_probability(n, mi.Float(pdf))), atol=2e-7)
    np.testing.assert_array_equal(np.array(termination.follow_probability(n, mi.Float(0, np.inf))), [0, 1])


def test_balanced_probability_goes_from_one_to_zero_as_lobes_sharpen():
    found = np.array(termination.balanced_probability(1, mi.Float(0, 1e-3, 1, 1e6, np.inf)))
    assert found[0] == 1 and found[-1] == 0 and (np.diff(found) < 0).all()
