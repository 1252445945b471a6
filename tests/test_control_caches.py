"""Controls: means by cell and direction, and spherical harmonics on a grid, behind the interface of the network."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_mean
from test_cache_files import assert_alike, through_a_file
from test_incident import load

from mi_neural.caches import encoding
from mi_neural.caches.field import CacheFileError
from mi_neural.caches.incident import Training
from mi_neural.caches.sh_grid import HarmonicCache, HarmonicField, HarmonicShape
from mi_neural.caches.spatial_hash import HashShape, SpatialHash, SpatialHashCache

CACHES = {"spatial_hash": SpatialHashCache, "sh_grid": HarmonicCache}
BOX = [-1] * 3, [1] * 3
ONE_LEVEL = HashShape(n_levels=1, base_resolution=2, hashmap_size=2**10, n_bins=2, prior=1.0)


def points(n, rng, low=-1.0, high=1.0):
    return mi.Point3f(rng.uniform(low, high, (3, n)).astype(np.float32))


def directions(n, rng):
    w = rng.normal(size=(3, n))
    return mi.Vector3f((w / np.linalg.norm(w, axis=0)).astype(np.float32))


def answers(field, x, w) -> np.ndarray:
    return np.array(field.query(field.encode(x), w)).T


# ---------------------------------------------------------------- spatial hash


def test_octahedral_map_is_one_to_one_and_fills_the_square(rng):
    w = directions(4096, rng)
    square = np.array(encoding.octahedral(w))
    assert square.min() >= 0 and square.max() <= 1
    counts = np.histogram2d(*square, bins=2)[0] / 4096
    assert np.abs(counts - 0.25).max() < 0.03  # its quarters are octants of the sphere, two each: 3.3 sigma
    x, y = 2 * square - 1
    z = 1 - np.abs(x) - np.abs(y)
    t = np.maximum(-z, 0)
    back = np.stack([x - np.copysign(t, x), y - np.copysign(t, y), z])
    np.testing.assert_allclose(back / np.linalg.norm(back, axis=0), np.array(w), atol=1e-5)


def test_answer_is_the_mean_of_the_records_of_a_cell_with_the_prior():
    field = SpatialHash(*BOX, ONE_LEVEL, scale=2.0)
    x, w = mi.Point3f([-0.5] * 3, [-0.5] * 3, [-0.5] * 3), mi.Vector3f([0.5] * 3, [0.5] * 3, [0.707] * 3)
    field.add(x, w, mi.Color3f(mi.Float([1.0, 2.0, 9.0])), mi.Bool([True, True, False]), mi.Float(1))
    expected = 2.0 * (1 + 2 + 1 * 1) / (2 + 1)  # two records, and one of the prior, which is the scene's mean
    np.testing.assert_allclose(answers(field, mi.Point3f(-0.5), mi.Vector3f(0.5, 0.5, 0.707)), expected, rtol=1e-5)
    field.add(x, w, mi.Color3f(0.0), mi.Bool([False] * 3), mi.Float(0.5))  # a frame without records: half forgotten
    expected = 2.0 * (0.5 * 3 + 1) / (0.5 * 2 + 1)
    np.testing.assert_allclose(answers(field, mi.Point3f(-0.5), mi.Vector3f(0.5, 0.5, 0.707)), expected, rtol=1e-5)


def test_where_nothing_fell_coarser_levels_answer():
    shape = HashShape(n_levels=3, base_resolution=1, per_level_scale=4.0, n_bins=1, prior=1e-3)
    field = SpatialHash(*BOX, shape)
    field.add(mi.Point3f(-0.9), mi.Vector3f(0, 0, 1), mi.Color3f(5.0), mi.Bool(True), mi.Float(1))
    far = answers(field, mi.Point3f(0.9), mi.Vector3f(0, 0, 1))
    np.testing.assert_allclose(far, 5.0, rtol=1e-2)  # the coarsest cell is the whole box


def test_places_and_directions_are_kept_apart(rng):
    """Light from above in one half of the box, from below in the other; away from the borders of cells and bins."""
    field, n = SpatialHash(*BOX, HashShape(n_levels=2, prior=0.1)), 2**16  # no two cells share an entry
    x, w = points(n, rng), directions(n, rng)
    y = dr.select((x.x > 0) == (w.z > 0), mi.Float(1), 0)
    field.add(x, w, mi.Color3f(y), mi.Bool(True), mi.Float(1))
    for side in (-1, 1):
        for z in (-1, 1):
            found = answers(field, mi.Point3f(0.6 * side, 0.3, 0.3), mi.Vector3f(0, 0, z))
            np.testing.assert_allclose(found, float(side == z), atol=0.05)


def test_mean_over_a_cell_interpolates_between_neighbours(rng):
    """Queries are moved at random by up to half a cell: at the border of two cells half of them meet either."""
    field = SpatialHash(*BOX, HashShape(n_levels=1, base_resolution=2, n_bins=1, prior=1e-3))
    x = points(2**12, rng)
    field.add(x, mi.Vector3f(0, 0, 1), mi.Color3f(dr.select(x.x > 0, mi.Float(1), 0)), mi.Bool(True), mi.Float(1))
    n = 2**12
    near = mi.Point3f(np.stack([rng.uniform(-1e-3, 1e-3, n), *rng.uniform(-0.4, 0.4, (2, n))]).astype(np.float32))
    assert_mean(answers(field, near, mi.Vector3f(0, 0, 1))[:, 0], 0.5, "between two cells", relative=3e-3)


@pytest.mark.parametrize("keys", [{"n_bins": 0}, {"prior": 0.0}, {"per_level_scale": 1.0}, {"hashmap_size": 2**30}])
def test_sizes_of_a_hash_out_of_range_are_refused(keys):
    with pytest.raises(ValueError, match=f"{next(iter(keys))} is"):
        HashShape(**keys)


# ---------------------------------------------------------------- spherical harmonics


def test_harmonics_learn_what_they_can_hold(rng):
    """1 + w.z is of degree 1, the same everywhere."""
    field = HarmonicField(*BOX, HarmonicShape(n_levels=2, hashmap_size=2**12))
    step = dr.freeze(harmonic_step)
    losses = [float(step(field, points(2048, rng), directions(2048, rng))[0]) for _ in range(100)]
    assert losses[0] > 0.2 and losses[-1] < 0.01
    with dr.suspend_grad():
        w = directions(64, rng)
        found = answers(field, points(64, rng), w).T
    np.testing.assert_allclose(found, np.broadcast_to(1 + np.array(w)[2], found.shape), atol=0.2)


def harmonic_step(field, x, w):
    p = field.predict(x, w)
    loss = dr.mean(dr.squared_norm(p - (1 + w.z)))
    field.step(loss, mi.Float(0.02), mi.Float(0.9))
    return dr.detach(loss)


def test_an_untrained_harmonic_field_answers_with_the_scale(rng):
    field = HarmonicField(*BOX, scale=3.0)
    np.testing.assert_allclose(answers(field, points(64, rng), directions(64, rng)), 3.0, rtol=0.05)


# ---------------------------------------------------------------- as caches


@pytest.fixture(scope="module")
def cube():
    """All incident radiance that was reflected before is 1/2 in it."""
    return load("lit_cube", 8)


def cache_of(kind):
    shapes = {"spatial_hash": HashShape(hashmap_size=2**12), "sh_grid": HarmonicShape(hashmap_size=2**12)}
    return CACHES[kind](Training(n_paths=256), shapes[kind])


@pytest.mark.parametrize("kind", CACHES)
def test_trained_as_the_network_saved_loaded_and_reset(kind, cube, tmp_path, rng):
    cache = cache_of(kind)
    cache.train(*cube, frames=12)
    assert cache.steps == 12 and np.isfinite(cache.history).all() and cache.statistics["recoveries"] == 0
    assert cache.recordings()["frame"] <= 3  # as the network's
    with dr.suspend_grad():
        w = directions(512, rng)
        found = answers(cache.field, points(512, rng, -0.8, 0.8), w)
    assert abs(found.mean() - 0.5) < 0.1

    new = through_a_file(cache, lambda: cache_of(kind), tmp_path / "a.npz")
    assert_alike(cache.field.arrays(), new.field.arrays(), rtol=0)
    for c in (cache, new):
        c.train(*cube, frames=2)
    assert_alike(cache.field.arrays(), new.field.arrays())
    with pytest.raises(CacheFileError, match="incident cache"):
        load_network(tmp_path / "a.npz")
    state = cache.checkpoint()
    cache.train(*cube, frames=1)
    cache.rollback(state)
    assert cache.steps == 14
    cache.reset()
    assert cache.field is None and cache.steps == 0


def load_network(path):
    mi.load_dict({"type": "nirc"}).load_cache(path)


@pytest.mark.parametrize("kind", CACHES)
def test_images_have_the_right_mean(kind, cube):
    """The lit cube's pixels are all 1; the cache's answers are a third of that at most by mistake of a tenth."""
    nirc = mi.load_dict({"type": "nirc", "cache": kind, "train_samples": 512, "train_frames": 40, "train_steps": 0,
                         "light_sampler": {"type": "uniform_lights"}, "light_samples": 1})  # fmt: skip
    image = np.array(nirc.render(cube[0], spp=32))
    assert abs(image.mean() - 1) < 0.05 and np.isfinite(image).all()
    assert nirc.statistics()["plan"]["decisions"]["cache"]["value"] == kind and nirc.measure_query(2**12) > 0


@pytest.mark.parametrize("keys, message", [
    ({"cache": "table"}, "cache is 'table'; give one of: plan, network, spatial_hash, sh_grid"),
    ({"cache": "spatial_hash", "blend": "fast"}, "a spatial hash has one set of means"),
    ({"cache": "sh_grid", "width": 16}, "width is a size of the network; cache is 'sh_grid'"),
    ({"cache": "sh_grid", "termination": "auto"}, "termination 'auto' needs cache 'network'"),
    ({"cache": "spatial_hash", "levels": 99}, "levels is 99"),
])  # fmt: skip
def test_what_does_not_go_together_is_refused(keys, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        mi.load_dict({"type": "nirc", **keys})
