"""Metrics against values worked out by hand, and what they do with values that are no numbers."""

import mitsuba as mi
import numpy as np
import pytest

from mi_neural.image import metrics


def grey(value: float, height: int = 8, width: int = 10) -> np.ndarray:
    return np.full((height, width, 3), value)


def test_luminance_is_mitsubas(rng):
    image = rng.random((4, 5, 3))
    expected = mi.luminance(mi.Color3f(image.reshape(-1, 3).T))
    assert np.allclose(metrics.luminance(image).ravel(), expected, rtol=1e-6)


def test_relmse_of_a_grey_image():
    # Reference 1, image 1.1: 0.1^2 / (1 + 0.01)
    assert metrics.relmse(grey(1.1), grey(1.0)) == pytest.approx(0.01 / 1.01)


def test_relmse_does_not_depend_on_the_unit(rng):
    image, reference = rng.random((2, 8, 8, 3))
    for measure in (metrics.relmse, metrics.relmse_trimmed, metrics.smape):
        assert measure(1e4 * image, 1e4 * reference) == pytest.approx(measure(image, reference))


def test_relmse_is_zero_for_equal_images(rng):
    reference = rng.random((8, 8, 3))
    assert metrics.relmse(reference, reference) == metrics.relmse_trimmed(reference, reference) == 0.0


def test_trimming_leaves_out_single_outliers(rng):
    reference = 0.5 + rng.random((40, 40, 3))
    image = reference * 1.1
    clean = metrics.relmse(image, reference)
    image[3, 4] = 1e4  # a firefly: 3 of 4,800 values, 5 are left out
    assert metrics.relmse(image, reference) > 1e3
    assert metrics.relmse_trimmed(image, reference) == pytest.approx(clean, rel=0.02)


def test_variance_of_the_reference_is_subtracted(rng):
    exact, sigma = 0.5 + rng.random((200, 200, 3)), 0.05
    image = exact * 1.02
    reference = exact + sigma * rng.standard_normal(exact.shape)
    variance = np.full(exact.shape, sigma**2)
    truth = metrics.relmse(image, exact)
    assert metrics.relmse(image, reference) > 5 * truth
    # The weights still see the noisy reference: a bias of second order that subtraction cannot remove
    assert metrics.relmse(image, reference, variance) == pytest.approx(truth, rel=0.25)
    assert metrics.relmse(exact, reference, 2 * variance) == 0.0  # never negative


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_nonfinite_pixels_count_as_black(rng, bad):
    reference = 0.5 + rng.random((16, 16, 3))
    image, black = reference.copy(), reference.copy()
    image[2, 3, 1], black[2, 3] = bad, 0.0
    found, _ = metrics.errors(image, reference)
    expected, _ = metrics.errors(black, reference)
    assert found.nonfinite == 1 and expected.nonfinite == 0
    assert found.relmse == expected.relmse > 0.0
    assert found.relmse_trimmed == expected.relmse_trimmed
    assert found.flip == pytest.approx(expected.flip)
    assert metrics.smape(image, reference) == metrics.smape(black, reference)


def test_nonfinite_reference_is_refused():
    reference = grey(1.0)
    reference[0, 0, 0] = np.nan
    for measure in (metrics.relmse, metrics.relmse_trimmed, metrics.flip):
        with pytest.raises(ValueError, match="1 non-finite pixels"):
            measure(grey(1.0), reference)


def test_unequal_sizes_are_refused_with_both():
    for measure in (metrics.relmse, metrics.flip, metrics.smape):
        with pytest.raises(ValueError, match=r"10x8.*9x8"):
            measure(grey(1.0), grey(1.0, width=9))
    with pytest.raises(ValueError, match="expected \\(height, width, 3\\)"):
        metrics.relmse(np.ones((4, 4)), grey(1.0))
    with pytest.raises(ValueError, match="variance has shape"):
        metrics.relmse(grey(1.0), grey(1.0), np.ones((2, 2, 3)))
    with pytest.raises(ValueError, match="negative or non-finite"):
        metrics.relmse(grey(1.0), grey(1.0), grey(-1.0))


def test_black_reference_gives_numbers():
    found, _ = metrics.errors(grey(0.1), grey(0.0))
    assert np.isfinite([found.relmse, found.relmse_trimmed, found.flip]).all()
    assert metrics.errors(grey(0.0), grey(0.0))[0] == metrics.Errors(0.0, 0.0, 0.0, 0)
    assert metrics.smape(grey(0.0), grey(0.0)) == 0.0


def test_smape_by_hand():
    assert metrics.smape(grey(2.0), grey(1.0), epsilon=0.0) == pytest.approx(2 / 3)
    assert metrics.smape(grey(1.0), grey(0.0), epsilon=0.0) == pytest.approx(2.0)
    assert metrics.smape(grey(2.0), grey(1.0)) == pytest.approx(2 / (3 + 0.01 * 1.5))


@pytest.mark.parametrize("power", [1, 8])
def test_flip_exposures_are_those_of_flip(rng, power):
    reference = (100.0 * rng.random((32, 32, 3)) ** power).astype(np.float32)
    _, mean, used = metrics._flip_evaluator().evaluate(reference, reference * np.float32(1.1), "HDR", applyMagma=False)
    ours = metrics.flip_exposures(reference)
    assert ours.start == pytest.approx(used["startExposure"], abs=1e-3)
    assert ours.stop == pytest.approx(used["stopExposure"], abs=1e-3)
    assert ours.num == used["numExposures"]
    assert metrics.flip(reference * np.float32(1.1), reference).mean == pytest.approx(mean, abs=1e-4)


def test_flip_of_a_mostly_black_reference_has_few_exposures(rng):
    reference = rng.random((32, 32, 3))
    reference[:20] = 0.0
    assert metrics.flip_exposures(reference).num <= 4


def test_fixed_exposures_are_kept(rng):
    reference = rng.random((16, 16, 3))
    exposures = metrics.FlipExposures(-1.0, 2.0, 3)
    found = metrics.flip(0.9 * reference, reference, exposures)
    assert found.exposures == exposures
    assert found.map.shape == (16, 16) and 0.0 <= found.map.min() <= found.map.max() <= 1.0
    assert found.mean == pytest.approx(found.map.mean(), abs=1e-5)
    with pytest.raises(ValueError, match="must rise"):
        metrics.flip(reference, reference, metrics.FlipExposures(2.0, 1.0, 2))


def test_one_pixel():
    found, _ = metrics.errors(np.ones((1, 1, 3)), np.full((1, 1, 3), 2.0))
    assert found.relmse == found.relmse_trimmed == pytest.approx(0.25 / 1.01)


# ---------------------------------------------------------------- bias and variance


@pytest.mark.parametrize("n", [2, 5])
@pytest.mark.parametrize("bias", [0.0, 0.3])
def test_squared_bias_is_found_in_noise_above_it(rng, bias, n):
    """Noise of 1 in each image and 0.1 in the reference, at radiance 1: 4 standard errors, one failure in 16,000."""
    shape = (200, 200, 3)
    images = [1 + bias + rng.standard_normal(shape) for _ in range(n)]
    known = (1 + 0.1 * rng.standard_normal(shape)).astype(np.float32)
    found, spread = metrics.bias_and_variance(images, known, np.full(shape, 0.01, np.float32))
    pairs = n * (n - 1) / 2
    assert found == pytest.approx(bias**2, abs=4 * 1.1 / np.sqrt(pairs * images[0].size) + 4 * 0.3 / 346)
    assert spread == pytest.approx(1, rel=0.05)  # the largest values are left out


def test_bias_and_variance_add_up_to_the_error(rng):
    images = [1 + 0.2 * rng.standard_normal((16, 16, 3)) for _ in range(4)]
    bias, variance = metrics.bias_and_variance(images, grey(1.0, 16, 16))
    values = np.sort(np.mean([metrics.relative_squared_errors(i, grey(1.0, 16, 16))[0] for i in images], 0).ravel())
    assert bias + variance == pytest.approx(values[: len(values) - 1].mean())
    with pytest.raises(ValueError, match="two images or more, got 1"):
        metrics.bias_and_variance(images[:1], grey(1.0, 16, 16))


def test_equal_images_have_no_variance_and_their_error_is_bias(rng):
    image = 1 + 0.1 * rng.standard_normal((32, 32, 3))
    bias, variance = metrics.bias_and_variance([image, image], grey(1.0, 32, 32))
    assert bias == pytest.approx(metrics.relmse_trimmed(image, grey(1.0, 32, 32))) and abs(variance) < 1e-12
