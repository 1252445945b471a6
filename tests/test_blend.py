"""`Blend`: two predictors as one, and `nirc` and `nrc` with it: limit cases, jit, a light that changes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_incident import load, same

from mi_neural.caches.blend import BLENDS, Blend, OutgoingBlend
from mi_neural.caches.field import Field
from mi_neural.caches.incident import IncidentCache, Training
from mi_neural.caches.outgoing_field import OutgoingField, OutgoingShape
from mi_neural.caches.reliability import MEASURES, Reliability
from mi_neural.caches.weights import FieldShape

SHAPE = FieldShape(n_levels=4, hashmap_size=2**10, width=16, n_hidden=1)
N = 600


@pytest.fixture
def points():
    rng = np.random.default_rng(0)
    w = rng.normal(size=(3, N))
    x, w = rng.uniform(-1, 1, (3, N)), w / np.linalg.norm(w, axis=0)
    return mi.Point3f(x.astype(np.float32)), mi.Vector3f(w.astype(np.float32))


def blend_of(mode: str, sigma: float | None = None) -> Blend:
    """A blend of predictors that differ, σ being the same everywhere."""
    field = Field([-1] * 3, [1] * 3, SHAPE, scale=2.0, seed=3)
    rng = np.random.default_rng(1)
    field.restore({k: rng.normal(size=v.shape).astype(np.float32) for k, v in field.snapshot().items()})
    blend = Blend(field, mode)
    if sigma is not None:
        blend.grid.sigma = dr.opaque(mi.Float, sigma, blend.grid.constants.n_entries)
    return blend


def answers(asked, points) -> np.ndarray:
    x, w = points
    return np.array(asked.query(asked.encode(x, mi.Normal3f(0, 0, 1)), w))


def both(blend, points):
    blend.field.sync()
    x, w = points
    field, n = blend.field, mi.Normal3f(0, 0, 1)
    averaged = np.array(field.query(field.encode(x, n), w))
    current = np.array(field.query(field.encode(x, n, averaged=False), w, averaged=False))
    assert np.abs(averaged - current).mean() > 0.1
    return averaged, current


# ---------------------------------------------------------------- limit cases


def test_fast_is_the_weights_being_trained(points):
    blend = blend_of("fast")
    np.testing.assert_array_equal(answers(blend, points), both(blend, points)[1])
    assert blend.mean_sigma()[0] == 1 and blend.snapshot() == {}


@pytest.mark.parametrize("mode", ["switch", "reliability"])
@pytest.mark.parametrize("sigma", [0, 1])
def test_certain_blend_is_one_of_the_two(points, mode, sigma):
    blend = blend_of(mode, float(sigma))
    np.testing.assert_array_equal(answers(blend, points), both(blend, points)[sigma])


@pytest.mark.parametrize("mode, sigma, share", [
    ("reliability", 0.3, 0.3), ("reliability", 0.01, 0), ("reliability", 0.99, 1), ("switch", 0.3, 0),
    ("switch", 0.7, 1),
])  # fmt: skip
def test_blend_between_is_convex(points, mode, sigma, share):
    blend = blend_of(mode, sigma)
    averaged, current = both(blend, points)
    np.testing.assert_allclose(answers(blend, points), (1 - share) * averaged + share * current, rtol=1e-5, atol=1e-6)


def test_sigma_that_differs_from_lane_to_lane_is_that_of_each(points):
    blend = blend_of("reliability", 0.0)
    n = blend.grid.constants.n_entries
    blend.grid.sigma = mi.Float(np.random.default_rng(5).choice([0, 0.25, 0.5, 1], n).astype(np.float32))
    averaged, current = both(blend, points)
    sigma = np.array(blend.sigma(points[0], mi.Normal3f(0, 0, 1)))
    assert set(np.unique(sigma)) == {0, 0.25, 0.5, 1}
    np.testing.assert_allclose(answers(blend, points), (1 - sigma) * averaged + sigma * current, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("mode, sigma", [("fast", 1.0), ("reliability", 0.0), ("reliability", 1.0),
                                         ("reliability", 0.3), ("switch", 0.7)])  # fmt: skip
def test_outgoing_blend_is_the_mix_of_its_two_predictors(points, mode, sigma):
    field = OutgoingField([-1] * 3, [1] * 3, OutgoingShape(n_levels=2, hashmap_size=2**8, width=8, n_hidden=1))
    rng = np.random.default_rng(1)
    field.restore({k: rng.normal(size=v.shape).astype(np.float32) for k, v in field.snapshot().items()})
    blend = OutgoingBlend(field, mode)
    if blend.grid is not None:
        blend.grid.sigma = dr.opaque(mi.Float, sigma, blend.grid.constants.n_entries)
    x, w = points
    inputs = x, mi.Vector3f(0, 0, 1) + 0 * w, w, mi.Color3f(0.5) + 0 * x.x, 0 * x.x
    field.sync()
    averaged, current = (np.array(field.query(*inputs, averaged=a)) for a in (True, False))
    assert np.abs(averaged - current).mean() > 0.1
    share = round(sigma) if mode == "switch" else sigma
    expected = (1 - share) * averaged + share * current
    np.testing.assert_allclose(np.array(blend.query(*inputs)), expected, rtol=1e-5, atol=1e-6)


# ---------------------------------------------------------------- jit


def test_symbolic_and_frozen_queries_are_the_evaluated_ones(points):
    blend = blend_of("reliability", 0.4)
    x, w = points
    known = answers(blend, points)

    @dr.freeze
    def ask(blend, x, w):
        features = blend.encode(x, mi.Normal3f(0, 0, 1))

        def add(i, total):
            return i + 1, total + blend.query(features, w)

        return dr.while_loop((mi.UInt32(0), mi.Color3f(0)), lambda i, total: i < 2, add)[1]

    for _ in range(3):
        np.testing.assert_allclose(np.array(ask(blend, x, w)), 2 * known, rtol=1e-5, atol=1e-6)
    assert ask.n_recordings <= 2


@pytest.mark.parametrize("mode", BLENDS)
def test_training_is_recorded_a_constant_number_of_times(mode):
    scene, sensor = load("point_lit_sphere", 8)
    cache = IncidentCache(Training(n_paths=64), SHAPE, blend=mode)
    for _ in range(4):
        cache.train_frame(scene, sensor)
    known = cache.recordings()["frame"]
    for _ in range(4):
        cache.train_frame(scene, sensor)
    assert cache.recordings()["frame"] == known <= 3


def test_training_does_not_depend_on_who_watches():
    """Averaged and trained weights are those of plain training while σ is 0, and so while it warms up."""
    scene, sensor = load("point_lit_sphere", 8)
    found = []
    for mode in ("ema", "reliability"):
        cache = IncidentCache(Training(n_paths=64), SHAPE, blend=mode)
        cache.train(scene, sensor, frames=5)
        found.append(cache.field.snapshot())
    for k, v in found[0].items():
        np.testing.assert_allclose(v, found[1][k], atol=1e-3)


def test_checkpoint_takes_the_grid_back():
    scene, sensor = load("point_lit_sphere", 8)
    cache = IncidentCache(Training(n_paths=64), SHAPE, blend="reliability")
    cache.train(scene, sensor, frames=4)
    kept = cache.checkpoint()
    grid = cache.queried.grid
    known, weights = [np.array(v) for v in grid.sums], cache.field.snapshot()
    cache.train(scene, sensor, frames=3)
    assert grid.updates[0] == 7
    cache.rollback(kept)
    assert grid.updates[0] == 4 and all(np.array_equal(a, np.array(b)) for a, b in zip(known, grid.sums, strict=True))
    assert same(weights, cache.field.snapshot())
    np.testing.assert_array_equal(np.array(cache.queried.fast.grid.data), weights["current.grid"])
    cache.rollback(None)
    assert cache.queried.grid.updates[0] == 0


def test_rollback_brings_back_the_field_that_a_restart_replaced():
    scene, sensor = load("point_lit_sphere", 8)
    cache = IncidentCache(Training(n_paths=64), SHAPE, blend="reliability")
    cache.train(scene, sensor, frames=3)
    field, scale, kept = cache.field, cache.field.scale[0], cache.checkpoint()
    params = mi.traverse(scene)
    params["light.intensity.value"] = 1e4 * params["light.intensity.value"]
    params.update()
    cache.train(scene, sensor, frames=2)
    assert cache.field is not field and cache.field.scale[0] > 1e3 * scale
    cache.rollback(kept)
    assert cache.field is cache.queried.field is field and field.scale[0] == scale


# ---------------------------------------------------------------- integrators


#: A network of which a training step takes a third of the time.
SMALL = {"levels": 4, "hashmap_size": 1024, "width": 16}


def nirc(**keys):
    keys = {"train_samples": 256, "train_frames": 0, "light_samples": 1, **SMALL, **keys}
    return mi.load_dict({"type": "nirc", **keys})


def nrc(**keys):
    return mi.load_dict({"type": "nrc", "train_samples": 256, "train_frames": 0, **keys})


#: Each with its cache asked as early as it goes.
INTEGRATORS = {"nirc": lambda **keys: nirc(termination="primary", **keys),
               "nrc": lambda **keys: nrc(spread_threshold=0.0, **keys)}  # fmt: skip


def mean_error(images, known):
    return np.abs(np.array([i.mean() for i in images]) - known).mean() / known


@pytest.mark.parametrize("plugin", ["nirc", pytest.param("nrc", marks=pytest.mark.slow)])
def test_blend_follows_a_light_as_quickly_as_fast_and_keeps_still_as_the_average(plugin):
    """The light of the sphere becomes a quarter after 160 frames; what the cache holds of the image must follow."""
    after, still = {}, {}
    for mode in ("ema", "fast", "reliability"):
        scene, _ = load("point_lit_sphere", 8)
        integrator = INTEGRATORS[plugin](blend=mode)
        integrator.train(scene, 160)
        images = [np.array(integrator.render(scene, spp=16, seed=k)) for k in range(6)]
        still[mode] = np.mean([np.abs(np.diff(images, axis=0)).mean()])
        params = mi.traverse(scene)
        params["light.intensity.value"] = 0.25 * params["light.intensity.value"]
        params.update()
        images = [np.array(integrator.render(scene, spp=16, seed=k)) for k in range(24)]
        after[mode] = mean_error(images[8:], 0.25)
        assert np.isfinite(images).all()
    print("mean error 8 to 24 frames after:", after, "difference between frames before:", still)
    assert after["reliability"] < after["fast"] + 0.25 * (after["ema"] - after["fast"])
    assert after["fast"] < 0.7 * after["ema"]
    assert still["reliability"] < 1.1 * still["ema"]


@pytest.mark.parametrize("plugin", INTEGRATORS)
def test_channels_show_which_predictor_is_asked(plugin):
    scene, _ = load("point_lit_sphere", 8)
    for mode, value in (("ema", 0), ("fast", 1), ("reliability", 0)):
        integrator = INTEGRATORS[plugin](blend=mode, channels="sigma, preference", **SMALL)
        integrator.train(scene, 1)
        image = np.array(integrator.render(scene, spp=1))
        assert image.shape[-1] == 5 and (image[..., 3:] == value).all()
        assert integrator.statistics().get("reliability", 0) == value


@pytest.mark.parametrize("key, value, says", [
    ("blend", "both", "blend is 'both'; give one of: ema, fast, switch, reliability"),
    ("reliability", "trust", "reliability is 'trust'; give one of: correlation, concordance, regression, evidence"),
    ("last_rate", 0.0, "last_rate is 0.0; it must be greater than 0"),
    ("last_rate", 1.5, "last_rate is 1.5; it must be greater than 0 and at most 1"),
])  # fmt: skip
def test_bad_keys_are_refused(key, value, says):
    with pytest.raises((ValueError, RuntimeError), match=says):
        nirc(**{key: value})


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("by_normal", [False, True])
def test_every_measure_runs(measure, by_normal):
    scene, _ = load("point_lit_sphere", 8)
    integrator = nirc(blend="reliability", reliability=measure, reliability_normals=by_normal)
    integrator.cache.reliability = Reliability(measure=measure, split_normals=by_normal, warm_up=0)
    integrator.train(scene, 4)
    image = np.array(integrator.render(scene, spp=4))
    assert np.isfinite(image).all() and 0 <= integrator.statistics()["reliability"] <= 1
    assert integrator.cache.queried.grid.constants.measure == measure
