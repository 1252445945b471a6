"""The correction of a biased image: what stands out of the noise is found, what does not is left alone."""

import numpy as np
import pytest

from mi_neural.estimators.combine import box_mean, correction, share_of_noise, smooth

SHAPE = (48, 64, 3)


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.fixture
def level(rng):
    """A positive image with large and small features."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return (1 + 0.5 * np.sin(x / 9) * np.cos(y / 7))[..., None] * np.array([1.0, 0.7, 0.3]) * (
        0.9 + 0.2 * rng.random(SHAPE)
    )


@pytest.mark.parametrize("shape", [SHAPE, (1, 1, 3), (1, 37, 3), (23, 1, 3), (2, 2, 1), (7, 5, 3)])
def test_without_variance_it_is_the_difference_itself(rng, shape):
    difference, level = rng.normal(size=shape), rng.random(shape)
    found = correction(difference, np.zeros(shape), level)
    np.testing.assert_allclose(found, difference, rtol=1e-6, atol=1e-9)


def test_pure_noise_leaves_next_to_nothing(rng, level):
    for relative in (0.1, 1.0, 10.0):
        noise = relative * level * rng.normal(size=SHAPE)
        found = correction(noise, (relative * level) ** 2, level)
        print(f"noise of {relative:g} of the level: {rms(found / level) / relative:.3f} of it is left")
        assert rms(found / level) < 0.2 * relative


@pytest.mark.parametrize("spread", [0.5, 3.0])
def test_relative_bias_of_the_whole_image_is_found_through_noise(rng, level, spread):
    """A cache that is 20 % too bright everywhere: seen at once in the mean over all pixels, however noisy each."""
    bias = -0.2
    difference = bias * level + spread * level * rng.normal(size=SHAPE)
    found = correction(difference, (spread * level) ** 2, level)
    ratio = found.sum() / (bias * level).sum()
    print(f"noise of {spread:g}: {ratio:.2f} of the bias is corrected, error {rms(found - bias * level):.3f}")
    assert ratio == pytest.approx(1, abs=0.25)
    assert rms(found - bias * level) < 0.5 * rms(bias * level) + 0.1 * spread * rms(level)
    assert rms(found - bias * level) < 0.2 * rms(difference - bias * level)


def test_local_bias_is_corrected_where_it_is(rng, level):
    bias = np.zeros(SHAPE)
    bias[10:26, 30:46] = 0.5
    difference = bias * level + 0.3 * level * rng.normal(size=SHAPE)
    found = correction(difference, (0.3 * level) ** 2, level) / level
    inside, outside = found[14:22, 34:42], found[:, :16]
    print(f"mean correction inside {inside.mean():.2f} of 0.5, far outside {outside.mean():.3f}")
    assert inside.mean() == pytest.approx(0.5, abs=0.1) and abs(outside.mean()) < 0.05


def test_error_falls_with_the_variance(rng, level):
    """Consistent: with less and less noise nothing is left of a bias with detail at every scale."""
    bias = 0.2 * rng.normal(size=SHAPE) * level + 0.1 * level
    noise = rng.normal(size=SHAPE)
    errors = []
    for spread in (1.0, 0.1, 0.01, 1e-3, 1e-4):
        found = correction(bias + spread * level * noise, (spread * level) ** 2, level)
        errors.append(rms(found - bias) / rms(bias))
    print("error relative to the bias:", ", ".join(f"{e:.1e}" for e in errors))
    assert errors == sorted(errors, reverse=True)
    assert errors[0] < 1.5 and errors[2] < 0.1 and errors[-1] < 1e-3


def test_it_is_better_than_either_image_alone_between_the_extremes(rng, level):
    """Smooth bias and noise of the same size: neither the biased nor the unbiased image is as near."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bias = 0.3 * np.sin(x / 12 + y / 15)[..., None] * level
    difference = bias + 0.3 * level * rng.normal(size=SHAPE)
    found = correction(difference, (0.3 * level) ** 2, level)
    error, biased, unbiased = (rms(v / level) for v in (found - bias, bias, difference - bias))
    print(f"error {error:.3f}; of the biased image {biased:.3f}, of the unbiased one {unbiased:.3f}")
    assert error < 0.7 * min(biased, unbiased)


def test_correction_scales_with_the_light(rng, level):
    difference, variance = 0.1 * level + 0.2 * rng.normal(size=SHAPE), np.full(SHAPE, 0.04)
    expected = correction(difference, variance, level)
    for factor in (1e-6, 1e6):
        found = correction(factor * difference, factor**2 * variance, factor * level)
        np.testing.assert_allclose(found, factor * expected, rtol=1e-6, atol=1e-9 * factor)


def test_what_is_not_finite_stays_where_it_is(rng, level):
    """A broken pixel is not corrected, and its neighbours are as if it were not there to speak of."""
    difference, variance = 0.2 * level + 0.01 * rng.normal(size=SHAPE), np.full(SHAPE, 1e-4)
    expected = correction(difference, variance, level)
    difference[5, 5, 0], difference[9, 9, 1], variance[20, 20, 2] = np.nan, np.inf, np.nan
    variance[30, 30] = np.inf
    found = correction(difference, variance, level)
    broken = ~(np.isfinite(difference) & np.isfinite(variance))
    assert broken.sum() == 6 and np.isfinite(found).all() and (found[broken] == 0).all()
    assert rms((found - expected)[~broken]) < 0.1 * rms(expected)


def test_black_images_are_left_black():
    zero = np.zeros(SHAPE)
    assert (correction(zero, zero, zero) == 0).all()
    assert np.isfinite(correction(np.ones(SHAPE), np.ones(SHAPE), zero)).all()


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 50, 3), (50, 1, 3), (2, 3, 3), (5, 4, 1)])
def test_tiny_images_with_noise(rng, shape):
    level = 1 + rng.random(shape)
    found = correction(rng.normal(size=shape), np.ones(shape), level)
    assert found.shape == shape and np.isfinite(found).all()
    bias = 100.0 * level  # far above the noise
    found = correction(bias + rng.normal(size=shape), np.ones(shape), level)
    np.testing.assert_allclose(found, bias, rtol=0.05)


def test_box_mean_is_a_mean_over_squares_cut_at_the_borders(rng):
    values = rng.normal(size=(2, 9, 12))
    for radius in (0, 1, 3, 20):
        found = box_mean(values, radius)
        for y, x in ((0, 0), (4, 5), (8, 11), (2, 10)):
            part = values[:, max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
            np.testing.assert_allclose(found[:, y, x], part.mean(axis=(1, 2)), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(smooth(np.full((2, 9, 12), 3.0), 2), 3.0)


def test_two_noisy_images_are_weighed_by_their_variances(rng, level):
    """Expectation: the mean with the weight found has less variance than either, and than weights nearby."""
    v_biased, v_unbiased = (0.3 * level) ** 2, (0.5 * level) ** 2
    w = share_of_noise(v_biased, v_unbiased, level)
    print(f"weight {w:.3f}, by the variances {0.09 / (0.09 + 0.25):.3f}")
    assert w == pytest.approx(0.09 / (0.09 + 0.25), rel=1e-3)
    assert share_of_noise(0 * v_biased, v_unbiased, level) == 0
    assert share_of_noise(v_biased, 0 * v_unbiased, level) == 1
    assert share_of_noise(0 * level, 0 * level, 0 * level) == 0
    v_unbiased[3, 3] = np.inf
    assert 0 <= share_of_noise(v_biased, v_unbiased, level) <= 1
    v_biased[:] = np.nan
    assert share_of_noise(v_biased, v_unbiased, level) == 0
