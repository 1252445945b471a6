"""Random numbers of the paths: each point uniform, the points of a pixel stratified, dimensions and pixels independent.

The chi-square tests fail a correct sampler in one of 10,000 choices of seed each.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import ERROR_RATE
from scipy import stats

from mi_neural.render.film import PACKET, Area, Samples
from mi_neural.render.sampling import PathSampler, sobol_2d

N = 2**16


def points(pixels, samples, dimension=0, seed=1) -> np.ndarray:
    """Stratified points of samples `samples` of pixels `pixels`, shape (2, n)."""
    pixels, samples = np.broadcast_arrays(np.uint32(pixels), np.uint32(samples))
    scramble, _ = mi.sample_tea_32(mi.UInt32(pixels.ravel()), mi.UInt32(seed), 4)
    sampler = PathSampler.make(dr.arange(mi.UInt32, pixels.size), seed, mi.UInt32(samples.ravel()), scramble)
    return np.array(sampler.stratified_2d(dimension), dtype=np.float64)


def assert_uniform(x, y, what, cells=16):
    """Pairs of numbers in [0, 1) fall into the cells of a square equally often."""
    assert (x >= 0).all() and (x < 1).all() and (y >= 0).all() and (y < 1).all()
    counts = np.histogram2d(x, y, bins=cells, range=[[0, 1], [0, 1]])[0].ravel()
    expected = x.size / counts.size
    p = stats.chi2.sf(((counts - expected) ** 2 / expected).sum(), counts.size - 1)
    visible = np.sqrt(stats.chi2.isf(ERROR_RATE, counts.size - 1) - counts.size + 1) / np.sqrt(x.size)
    print(f"{what}: p = {p:.3f}; smallest visible rms deviation of the density {visible:.1e}")
    assert p > ERROR_RATE


@pytest.mark.parametrize("sample", [0, 1, 5, 1000])
@pytest.mark.parametrize("dimension", [0, 3])
def test_each_point_is_uniform_over_pixels(sample, dimension):
    x, y = points(np.arange(N), sample, dimension)
    assert_uniform(x, y, f"sample {sample}, dimension {dimension}")


def test_independent_numbers_are_uniform_and_pairs_of_them():
    sampler = PathSampler.make(dr.arange(mi.UInt32, N), 7)
    a, b = np.array(sampler.next_1d(), np.float64), np.array(sampler.next_1d(), np.float64)
    x, y = np.array(sampler.next_2d(), np.float64)
    assert_uniform(a, b, "1d, 1d")
    assert_uniform(x, y, "2d")
    assert_uniform(b[1:], b[:-1], "neighbouring lanes")


@pytest.mark.parametrize("start", [0, 512])
@pytest.mark.parametrize("k", [1, 2, 4, 6, 9])
def test_every_power_of_two_is_stratified(k, start):
    """2^k points, beginning at a multiple of 2^k: one in each elementary interval of whatever shape."""
    for pixel in range(3):
        x, y = points(pixel, start + np.arange(2**k))
        for a in range(k + 1):
            cells = np.floor(x * 2**a) * 2 ** (k - a) + np.floor(y * 2 ** (k - a))
            assert np.unique(cells).size == 2**k, f"pixel {pixel}: intervals of 2^-{a} x 2^-{k - a}"


@pytest.mark.parametrize("second", [1, 2, 5])
def test_two_dimensions_are_decorrelated(second):
    sample = np.arange(N) % 64  # one sample of each pixel: independent draws
    a, b = (points(np.arange(N), sample, d) for d in (0, second))
    assert_uniform(a[0], b[0], f"x of dimensions 0, {second}")
    assert_uniform(a[1], b[1], f"y of dimensions 0, {second}")

    # and within a pixel: the correlation of its 16 samples is 0 on average
    pixel, sample = np.repeat(np.arange(4096), 16), np.tile(np.arange(16), 4096)
    a, b = (points(pixel, sample, d).reshape(2, 4096, 16) - 0.5 for d in (0, second))
    z = (a * b).mean(axis=2)
    z = z.mean(axis=1) / (z.std(axis=1, ddof=1) / 64)
    print(f"z of the correlation within pixels: {z}")
    assert (np.abs(z) < stats.norm.isf(ERROR_RATE / 4)).all()


def test_points_are_equal_in_a_pixel_and_differ_across_pixels_seeds_and_dimensions():
    base = points(3, np.arange(64))
    assert (base == points(3, np.arange(64))).all()
    for other in (points(4, np.arange(64)), points(3, np.arange(64), seed=2), points(3, np.arange(64), dimension=1)):
        assert (base == other).mean() < 0.05


def test_sequence_of_a_pixel_does_not_depend_on_how_it_is_cut():
    """n numbers of each of m samples are the first n m points, whichever pass they are drawn in."""
    lane = dr.arange(mi.UInt32, 8)
    sampler = PathSampler.make(lane, 1, index=lane, scramble=mi.UInt32(99))
    cut = np.stack([np.array(sampler.stratified_2d(2, 4, i)) for i in range(4)], axis=-1).reshape(2, 32)
    whole = PathSampler.make(dr.arange(mi.UInt32, 32), 5, index=dr.arange(mi.UInt32, 32), scramble=mi.UInt32(99))
    assert (cut == np.array(whole.stratified_2d(2))).all()
    assert (np.array(sampler.stratified_1d(2)) == np.array(sampler.stratified_2d(2))[0]).all()


def test_points_of_a_long_sequence_stay_uniform():
    """Beyond 2^16 samples of one pixel the second coordinate starts anew; no number leaves [0, 1)."""
    x, y = np.array(sobol_2d(dr.arange(mi.UInt32, 2**18), mi.UInt32(5)), np.float64)
    assert np.histogram2d(x, y, 64, [[0, 1], [0, 1]])[0].std() < 3 * np.sqrt(2**18 / 64**2)
    assert x.max() < 1 and y.max() < 1 and x.min() >= 0 and y.min() >= 0
    assert np.unique(x).size > 0.98 * 2**18


def test_equal_lanes_and_seeds_give_equal_numbers():
    def draw(seed):
        return np.array(PathSampler.make(dr.arange(mi.UInt32, 100), seed).next_2d())

    assert (draw(1) == draw(1)).all()
    assert (draw(1) != draw(2)).mean() > 0.99


# ---------------------------------------------------------------- numbers of a group


def together(pixels, samples, dimension=0, packet=16, seed=1) -> np.ndarray:
    """`together_1d` of samples `samples` of pixels `pixels`, `packet` of which are a group."""
    pixels, samples = np.broadcast_arrays(np.uint32(pixels), np.uint32(samples))
    group, _ = mi.sample_tea_32(mi.UInt32(pixels.ravel() // packet), mi.UInt32(seed), 4)
    scramble, _ = mi.sample_tea_32(mi.UInt32(pixels.ravel()), mi.UInt32(seed), 4)
    sampler = PathSampler.make(
        dr.arange(mi.UInt32, pixels.size), seed, mi.UInt32(samples.ravel()), scramble, group
    )
    return np.array(sampler.together_1d(dimension), dtype=np.float64).reshape(pixels.shape)


def test_numbers_are_equal_in_a_group_and_independent_between_groups_dimensions_and_seeds():
    found = together(np.arange(64)[:, None], np.arange(32)).reshape(4, 16, 32)
    assert (found == found[:, :1]).all()
    for k in range(3):
        assert (found[k, 0] == found[k + 1, 0]).mean() < 0.05
    for other in (together(0, np.arange(32), dimension=1), together(0, np.arange(32), seed=2)):
        assert (found[0, 0] == other).mean() < 0.05


@pytest.mark.parametrize("sample", [0, 3, 1000])
@pytest.mark.parametrize("dimension", [7, 40])
def test_numbers_of_groups_are_uniform_and_so_are_pairs_of_dimensions(sample, dimension):
    """A number decides about a path together with others of the same sample: another dimension, the stratified ones."""
    pixels = np.arange(N)
    x = together(pixels, sample, dimension, packet=1)
    y = together(pixels, sample, dimension + 1, packet=1)
    assert_uniform(x, y, f"sample {sample}, dimensions {dimension}, {dimension + 1}")
    for other in (dimension, 2):
        assert_uniform(x, points(pixels, sample, other)[0], f"dimension {dimension} and stratified {other}")


@pytest.mark.parametrize("k", [1, 3, 6])
def test_numbers_of_a_pixel_are_stratified_over_its_samples(k):
    for dimension in (7, 20):
        found = together(5, 2**k + np.arange(2**k), dimension)
        assert np.unique(np.floor(found * 2**k)).size == 2**k


def test_dimension_of_each_lane_may_be_its_own():
    """Paths of one packet stand at different depths."""
    lane = dr.arange(mi.UInt32, 64)
    sampler = PathSampler.make(lane, 1, index=mi.UInt32(3), scramble=lane, group=mi.UInt32(9))
    found = np.array(sampler.together_1d(lane % 4))
    for d in range(4):
        assert (found[d::4] == np.array(sampler.together_1d(d))[0]).all()
    assert np.unique(found).size == 4


def test_passes_with_one_sequence_are_one_set_of_stratified_numbers():
    """Four passes of 4 samples have the stratified points of one pass of 16; their independent numbers are others."""

    def numbers(seed, first, n):
        samples = Samples(*(mi.UInt32(v) for v in (seed, 5, first, n, 0, 2, 16)))
        pixel, sample, active = samples.lanes(area, 2 * PACKET * n)
        sampler = samples.sampler(pixel, sample, 1)
        order = np.lexsort((np.array(sample), np.array(pixel)))
        assert np.array(active).all()
        columns = [*sampler.stratified_2d(2), sampler.together_1d(3), sampler.next_1d()]
        return np.array([np.array(c)[order].reshape(-1, n) for c in columns])

    area = Area(PACKET, 2, (PACKET, 2), (0, 0), 0, True)
    whole = numbers(9, 0, 16)
    parts = np.concatenate([numbers(seed, 4 * k, 4) for k, seed in enumerate((9, 10, 11, 12))], axis=2)
    assert np.array_equal(whole[:3], parts[:3])
    assert not np.isin(parts[3, :, 4:], whole[3]).any()
