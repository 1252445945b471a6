"""`preset="paper"` of the plugins: constants as printed in their sources, keys before them, images with them."""

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW
from expectation import assert_mean, assert_same_mean, renders
from test_vertex import LIGHTS, lights
from test_vertex import test_scene as lit

from mi_neural import scenes
from mi_neural.caches import loss, radiance_cache, visibility
from mi_neural.caches.direct import DirectTraining, HeField, air_records
from mi_neural.caches.field import CacheFileError, Field
from mi_neural.caches.incident import Training, trace_records
from mi_neural.caches.material import material_of
from mi_neural.caches.outgoing import OutgoingTraining
from mi_neural.caches.outgoing_field import OutgoingShape
from mi_neural.caches.radiance_cache import DispatchFlags, RadianceCache
from mi_neural.caches.reliability import Reliability
from mi_neural.caches.weights import FieldShape

#: Smaller than printed, for time alone.
QUICK = {"train_samples": 256, "train_steps": 1}


def prepared(keys: dict, which: str = "several", size: int = 8):
    """The light sampler after its first training, and what it chooses by."""
    scene = lit(lights(which), size)
    sampler = mi.load_dict({"type": "nvc_lights", **keys})
    return sampler, sampler.lights(scene, scene.sensors()[0])


def test_constants_of_single_lights_are_those_printed():
    sampler, chooses = prepared({"preset": "paper"}, "all")
    shape, training = sampler.cache.field.shape, sampler.cache.training
    assert (shape.n_levels, shape.base_resolution, shape.n_features, shape.width, shape.n_hidden) == (10, 16, 4, 32, 2)
    assert (training.n_points, training.world_points, training.vertices, training.loss) == (8192, 0.5, 1, "squared")
    assert (training.first_rate, training.last_rate, training.ramp, training.ema_decay) == (0.05, 0.001, 200, 0)
    assert chooses.floor == 0.001 and sampler.cache.steps == 1 and sampler.cache.he


def test_constants_of_clusters_are_those_printed():
    sampler, chooses = prepared({"preset": "paper", "outputs": 2, "clusters": "kmeans"}, "all")
    shape = sampler.cache.field.shape
    assert (shape.n_levels, shape.base_resolution) == (8, 2) and sampler.cache.training.n_points == 49152
    several = chooses.groups.host["count"] > 1
    assert several.any() and chooses.several == several.tolist()
    within, label = np.array(chooses.groups.within), chooses.groups.host["label"]
    np.testing.assert_allclose(within, 1 / chooses.groups.host["count"][label], rtol=1e-5)


def test_keys_go_before_the_preset_and_the_default_is_as_measured():
    sampler, _ = prepared({"preset": "paper", "levels": 3, "averaging": 0.5, "train_frames": 4, **QUICK}, "all")
    assert sampler.cache.field.shape.n_levels == 3 and sampler.cache.field.shape.base_resolution == 16
    assert sampler.cache.training.ema_decay == 0.5 and sampler.cache.steps == 4
    sampler, chooses = prepared({}, "all")
    assert sampler.cache.training == visibility.VisibilityTraining() and sampler.cache.grid == visibility.GRID
    assert chooses.floor == 0.06 and chooses.several is None and sampler.cache.steps == 32


@pytest.mark.parametrize("keys", [{}, pytest.param({"outputs": 2, "clusters": "kmeans"}, marks=SLOW)],
                         ids=["lights", "clusters"])  # fmt: skip
def test_image_is_that_of_path(keys):
    scene = lit(lights("all"), 12)
    sampler = {"type": "nvc_lights", "preset": "paper", **QUICK, **keys}
    known = renders(scene, {"type": "path", "max_depth": 3}, 16, 256, first_seed=1000)
    ours = renders(scene, {"type": "plain_path", "max_depth": 3, "light_sampler": sampler}, 16, 64)
    assert_same_mean(ours, known, str(keys), relative=1e-5)


def test_weights_begin_as_he_et_al_have_them():
    """Means over 32 x 40 weights of a layer lie within 5 standard errors of 0 and 2 / inputs."""
    sampler, _ = prepared({"preset": "paper", "train_frames": 0, **QUICK}, "all")
    field = sampler.cache.field
    seen = 0
    for name, tensor in field.current.mlp.items():
        values = np.array(tensor, np.float64)
        if not name.endswith("weights"):
            assert (values == 0).all()
            continue
        n, variance = values.size, 2 / values.shape[1]
        assert abs(values.mean()) < 5 * np.sqrt(variance / n)
        assert abs(values.var() / variance - 1) < 5 * np.sqrt(2 / n)
        seen += 1
    assert seen == 3
    a, b = (np.array(w.packed["weights"]) for w in (field.current, field.averaged))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("world, vertices", [(0.25, 3), (0.5, 1), (0.0, 2), (1.0, 1), (0.3, 2)])
def test_points_lie_where_the_keys_say(world, vertices):
    """In a closed cube every path goes on, so that what is not in the box lies on the walls."""
    scene = mi.load_file(str(scenes.path("lit_cube")), resx=8, resy=8)
    box = np.array([scene.bbox().min, scene.bbox().max]).reshape(2, 3)
    low, high = box
    field = visibility.VisibilityField(low, high, visibility.FieldShape(direction_degree=-1, n_outputs=1))
    n = 4096
    lane = dr.arange(mi.UInt32, n)
    x = visibility.training_points(scene, scene.sensors()[0], field, lane, mi.UInt32(3), world, vertices)
    x = np.array(x).T
    on_wall = (np.minimum(x - low, high - x).min(axis=1) < 1e-3 * (high - low).max()) & (x > low - 1e-3).all(axis=1)
    print(f"{on_wall.mean():.3f} lie on walls, {1 - world} were asked for")
    # Of the points in the box 6 in 1000 are so near a wall by chance
    assert abs(on_wall.mean() - (1 - world)) < 0.012
    if (world, vertices) == (0.25, 3):
        np.testing.assert_array_equal(np.flatnonzero(~on_wall) % 4, 0)  # as it was before there were keys


@pytest.mark.parametrize("key, value", [
    ("preset", "papers"), ("world_points", 1.5), ("vertices", 0), ("first_rate", 0.0), ("last_rate", -1.0),
    ("rate_steps", 0), ("averaging", 1.5), ("levels", 0), ("base_resolution", 0), ("level_scale", 1.0),
    ("init", "xavier"),
    ("floor", 0.0), ("cluster_choice", "power"), ("within", "area"),
])  # fmt: skip
def test_values_that_are_none_are_refused_by_name(key, value):
    with pytest.raises((ValueError, RuntimeError), match=f"nvc_lights: {key} is '?{value}'?; "):
        mi.load_dict({"type": "nvc_lights", key: value})


# ---------------------------------------------------------------------------------------------------------------------
# Caches of incident radiance (Dereviannykh et al. 2025, Klepikov et al.)

#: Smaller than printed, for time alone.
SMALL = {"levels": 2, "hashmap_size": 256, "width": 8, "hidden_layers": 1, "train_frames": 3, "train_samples": 32}


def room(name: str = "cornell_box", size: int = 16):
    return mi.load_file(str(scenes.path(name)), resx=size, resy=size)


@pytest.mark.parametrize("kind", ["nirc", "nirc_two_level"])
def test_constants_of_incident_radiance_are_those_printed(kind):
    integrator = mi.load_dict({"type": kind, "preset": "paper", "train_frames": 1})
    integrator.train(room(size=24), 1)
    cache = integrator.cache
    shape, training = cache.field.shape, cache.training
    assert (shape.n_levels, shape.n_features, shape.width, shape.n_hidden, shape.leak) == (12, 2, 64, 4, 0)
    assert shape.surface == ("normal", "albedo", "roughness") and shape.n_inputs == 64  # of these 25 of the direction
    assert shape.n_first == 64 - 25
    layers = [tuple(v.shape) for k, v in cache.field.current.mlp.items() if k.endswith("weights")]
    assert layers == [(64, 64)] * 4 + [(3, 64)]
    assert (training.learning_rate, training.last_rate, training.ema_decay) == (0.001, 1, 0.99)
    assert training.ema_debiased and training.loss == "weighted" and training.epsilon == 0.001
    assert training.n_paths == 9 and training.n_vertices - 1 == 3  # a path for each tile of 8x8; records
    assert float(training.rate(0)) == float(training.rate(5000)) == 0.001
    adam = cache.field.optimizer
    assert (adam.beta_1, adam.beta_2, adam.epsilon) == (0.9, 0.99, 1e-15)
    if kind == "nirc":
        assert integrator.termination == "balanced"
    else:
        assert integrator.split.alpha == 1


def test_constants_of_reliability_are_those_printed():
    integrator = mi.load_dict({"type": "nirc", "preset": "paper", "blend": "reliability", **SMALL})
    integrator.train(room(), 1)
    c = integrator.cache.queried.grid.constants
    assert (c.measure, c.decay, c.warm_up, c.kappa, c.per_record) == ("correlation", 0.9, 128, 4, False)


def test_keys_of_reliability_reach_the_statistics():
    keys = {"reliability_decay": 0.5, "reliability_warm_up": 7, "reliability_kappa": 2.0,
            "reliability_epsilon": 0.25, "reliability_resolution": 5, "reliability": "concordance"}  # fmt: skip
    for preset in ("measured", "paper"):
        integrator = mi.load_dict({"type": "nrc" if preset == "measured" else "nirc", "blend": "switch", **SMALL,
                                   **({"preset": preset} if preset == "paper" else {}), **keys})  # fmt: skip
        integrator.train(room(), 1)
        c = integrator.cache.queried.grid.constants
        assert (c.decay, c.warm_up, c.kappa, c.epsilon, c.resolution) == (0.5, 7, 2, 0.25, 5)
        assert c.measure == "concordance"


@pytest.mark.parametrize("kind", ["nirc", "nirc_two_level"])
def test_keys_go_before_the_preset_of_incident_radiance(kind):
    keys = {**SMALL, "direction_degree": 1, "inputs": "roughness, normal", "loss": "local", "epsilon": 0.5,
            "learning_rate": 0.02, "last_rate": 0.5, "ema_decay": 0.5, "ema_debiased": False, "train_vertices": 3}
    own = {"termination": "primary", "reliability": "regression"} if kind == "nirc" else {"alpha": 0.5}
    integrator = mi.load_dict({"type": kind, "preset": "paper", **keys, **own})
    shape, t = integrator.cache.shape, integrator.cache.training
    assert (shape.n_levels, shape.width, shape.n_hidden, shape.direction_degree) == (2, 8, 1, 1)
    assert shape.surface == ("normal", "roughness")
    assert (t.n_paths, t.n_vertices, t.loss, t.epsilon, t.learning_rate) == (32, 3, "local", 0.5, 0.02)
    assert (t.last_rate, t.ema_decay, t.ema_debiased) == (0.5, 0.5, False)
    if kind == "nirc":
        assert integrator.termination == "primary" and integrator.cache.reliability.measure == "regression"
    else:
        assert integrator.split.alpha == 0.5


@pytest.mark.parametrize("kind", ["nirc", "nirc_two_level"])
def test_default_of_incident_radiance_is_as_measured(kind):
    for keys in ({}, {"preset": "measured"}):
        cache = mi.load_dict({"type": kind, **keys}).cache
        assert cache.training == Training() and cache.shape == FieldShape()
        if kind == "nirc":
            assert cache.reliability == Reliability()


@pytest.mark.parametrize("keys", [
    {"type": "nirc"}, {"type": "nirc", "blend": "reliability", "reliability_warm_up": 0},
    *(pytest.param({"type": "nirc", **keys}, marks=SLOW) for keys in (
        {"termination": "spread"}, {"termination": "primary"}, {"blend": "fast"})),
    pytest.param({"type": "nirc", "inputs": "normal"}, marks=SLOW),
    {"type": "nirc_two_level", "cache_samples": 2, "every_vertex": True},
    pytest.param({"type": "nirc_two_level", "mode": "progressive"}, marks=SLOW),
    {"type": "nirc_two_level", "ris": True, "cache_samples": 2},
], ids=lambda keys: "-".join(str(v) for v in keys.values()))  # fmt: skip
def test_incident_radiance_renders_with_the_preset(keys):
    """Materials of all kinds; the scene's mean has to be right to 20 % after so little training."""
    scene = lit(lights("all"), 12)
    integrator = mi.load_dict({"preset": "paper", **{**SMALL, "train_samples": 256, "train_frames": 24}, **keys})
    image = np.array(mi.render(scene, integrator=integrator, spp=32))
    known = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=128))
    assert np.isfinite(image).all() and integrator.statistics()["nonfinite"] == 0
    assert integrator.statistics()["recoveries"] == 0
    print(f"mean {image.mean() / known.mean():.3f} of that of path")
    assert image.mean() == pytest.approx(known.mean(), rel=0.2)


def test_two_level_estimator_has_the_mean_of_path_with_the_preset():
    scene = lit(lights("area"), 8)
    keys = {"preset": "paper", **SMALL, "cache_samples": 2, "residual_samples": 1, "residual_probability": 0.5}
    known = renders(scene, {"type": "path"}, 16, 256, first_seed=1000)
    ours = renders(scene, {"type": "nirc_two_level", **keys}, 16, 128)
    assert_same_mean(ours, known, "nirc_two_level", relative=1e-5)


def test_weighted_loss_is_that_of_the_source(rng):
    p, y, t = (rng.uniform(0, 3, (3, 16)).astype("f4") for _ in range(3))
    pdf = rng.uniform(0.1, 9, 16).astype("f4")
    found = loss.weighted_relative_l2(mi.Color3f(p), mi.Color3f(y), mi.Color3f(t), mi.Float(pdf), 1e-3)
    wanted = pdf * ((t * p - t * y) ** 2).sum(0) / ((t * p).mean(0) ** 2 + 1e-3)
    np.testing.assert_allclose(np.array(found), wanted, rtol=1e-4)


def test_weighted_loss_gets_throughput_and_density_of_each_record():
    """In a room of Lambertians the throughput of a BSDF sample is its albedo, and its density cos/π."""
    scene = room("lit_cube", 8)
    training = Training(n_paths=64, n_vertices=3, loss="weighted")
    records, _ = trace_records(scene, scene.sensors()[0], None, training, mi.UInt32(1))
    valid = np.array(records.valid)
    cosine = np.array(dr.abs(dr.dot(records.normal, records.direction)))[valid]
    assert valid.sum() > 32
    np.testing.assert_allclose(np.array(records.pdf)[valid], cosine / np.pi, rtol=1e-3)
    np.testing.assert_allclose(np.array(records.weight).T[valid], 0.5, rtol=1e-3)


def test_records_have_the_material_that_queries_see():
    scene = room("lit_cube", 8)
    field = Field([-2] * 3, [2] * 3, FieldShape(n_levels=2, hashmap_size=256, surface=("albedo", "roughness")))
    records, _ = trace_records(scene, scene.sensors()[0], field, Training(n_paths=64, n_vertices=3), mi.UInt32(1))
    valid = np.array(records.valid)
    np.testing.assert_allclose(np.array(records.albedo).T[valid], 0.5, rtol=1e-3)
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, [0.4, 0.6], [0.5, 0.5])
    si = scene.ray_intersect(ray)
    albedo, roughness = material_of(field, si, si.bsdf(), mi.Bool(True))["material"]
    np.testing.assert_allclose(np.array(albedo).ravel(), 0.5, rtol=1e-3)
    np.testing.assert_allclose(np.array(records.roughness)[valid], float(roughness[0]), rtol=1e-3)
    assert material_of(Field([-2] * 3, [2] * 3), si, si.bsdf(), mi.Bool(True)) == {}


@pytest.mark.parametrize("name", ["normal", "albedo", "roughness"])
def test_prediction_and_query_agree_on_each_input(name):
    """What is trained is what is queried, and each input makes a difference."""
    field = Field([-1] * 3, [1] * 3, FieldShape(n_levels=2, hashmap_size=256, width=16, surface=(name,)))
    n = mi.Vector3f([0, 0.6, 0], [0, 0, -1], [1, 0.8, 0])
    material = mi.Color3f([0.1, 0.5, 0.9]), mi.Float([0.05, 0.3, 1])
    x, w = dr.zeros(mi.Point3f, 3), mi.Vector3f(0.6, 0, 0.8)
    known = np.array(field.raw(field.encode(x, n, False, material), w, averaged=False)).T
    found = np.array(field.predict(x, w, n, material)).T
    np.testing.assert_allclose(found, known, rtol=1e-4, atol=1e-6)
    assert len({round(float(v[0]), 6) for v in known}) == 3


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.99, 1.0])
def test_debiased_average_is_that_of_all_steps(decay):
    training, rng = Training(ema_decay=decay, ema_debiased=True), np.random.default_rng(3)
    values, average = rng.normal(size=20), 0.0
    for k, value in enumerate(values):
        d = float(mi.Float(training.decay(mi.Float(k)))[0])
        average = d * average + (1 - d) * value
        weights = decay ** np.arange(k, -1, -1.0)
        assert average == pytest.approx((weights * values[: k + 1]).sum() / weights.sum(), abs=1e-4)


def without_surface(new, old) -> None:
    """Write a cache file as it was before networks could get inputs of the surface."""
    with np.load(new) as entries:
        arrays = dict(entries)
    header = json.loads(bytes(arrays.pop("header")).decode())
    del header["shape"]["surface"]
    with open(old, "wb") as f:
        np.savez(f, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


def test_cache_files_of_before_the_keys_are_read(tmp_path):
    """Their header knows nothing of inputs of the surface."""
    scene = room()
    nirc = mi.load_dict({"type": "nirc", **SMALL})
    nirc.train(scene, 2)
    nirc.save_cache(tmp_path / "new.npz")
    without_surface(tmp_path / "new.npz", tmp_path / "old.npz")
    new = mi.load_dict({"type": "nirc", **SMALL})
    new.load_cache(tmp_path / "old.npz", scene)
    for name, value in nirc.cache.field.arrays().items():
        np.testing.assert_array_equal(new.cache.field.arrays()[name], value)


def test_cache_files_of_the_preset_are_read_by_it_alone(tmp_path):
    scene, keys = room(), {"type": "nirc", "preset": "paper", **SMALL}
    nirc = mi.load_dict(keys)
    nirc.train(scene, 2)
    nirc.save_cache(tmp_path / "a.npz")
    again = mi.load_dict(keys)
    again.load_cache(tmp_path / "a.npz", scene)
    assert again.cache.field.shape == nirc.cache.field.shape and again.cache.steps == nirc.cache.steps
    with pytest.raises(CacheFileError, match="give it the same sizes"):
        mi.load_dict({"type": "nirc", **SMALL}).load_cache(tmp_path / "a.npz")


def test_paths_by_tiles_follow_the_film(tmp_path):
    integrator = mi.load_dict({"type": "nirc", **SMALL, "train_samples": -1})
    for size, tiles in ((16, 4), (20, 9)):
        integrator.train(room(size=size), 1)
        assert integrator.cache.training.n_paths == tiles
    integrator.save_cache(tmp_path / "a.npz")
    again = mi.load_dict({"type": "nirc", **SMALL, "train_samples": -1})
    again.load_cache(tmp_path / "a.npz")
    again.train(room(size=20), 1)
    assert again.cache.training.n_paths == 9


def test_derivatives_do_not_go_through_inputs_of_the_network():
    """The derivative by an albedo that is an input, too: the light that arrives is detached, so it is nearly that with
    a network without inputs (both trained little: 10 %)."""
    scene, found = room(size=8), []
    params = mi.traverse(scene)
    for inputs in ("none", "albedo, roughness"):
        integrator = mi.load_dict({"type": "nirc", "train_samples": 512, "train_frames": 60, "inputs": inputs,
                                   **NETWORK})  # fmt: skip
        dr.enable_grad(params["white.brdf_0.reflectance.value"])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=64)))
        found.append(np.array(dr.grad(params["white.brdf_0.reflectance.value"])).ravel())
        dr.disable_grad(params["white.brdf_0.reflectance.value"])
    print(found)
    assert (found[0] > 0).all()
    np.testing.assert_allclose(found[1], found[0], rtol=0.1)


@pytest.mark.parametrize("keys, message", [
    ({"preset": "papers"}, "preset is 'papers'; give one of: measured, paper"),
    ({"inputs": "view"}, "inputs is 'view'; give none, or a list of: normal, albedo, roughness"),
    ({"loss": "squared"}, "loss is 'squared'; give one of: local, weighted"),
    ({"epsilon": 0.0}, "epsilon is 0.0; "), ({"direction_degree": 8}, "direction_degree is 8; "),
    ({"direction_degree": -1}, "direction_degree is -1; "), ({"train_samples": -2}, "train_samples is -2; "),
    ({"reliability_decay": 1.0}, "reliability_decay is 1.0; "),
    ({"reliability_warm_up": -1}, "reliability_warm_up is -1; "),
    ({"reliability_kappa": 0.0}, "reliability_kappa is 0.0; "),
    ({"reliability_epsilon": 0.0}, "reliability_epsilon is 0.0; "),
    ({"reliability_resolution": 0}, "reliability_resolution is 0; "),
    ({"preset": "paper", "cache": "spatial_hash"}, "cache is 'spatial_hash', but the preset 'paper' is of the network"),
    ({"preset": "paper", "termination": "auto"}, "termination 'auto' is neural_path, which has no preset"),
])  # fmt: skip
def test_values_that_incident_radiance_cannot_have_are_refused_by_name(keys, message):
    with pytest.raises((ValueError, RuntimeError), match=f"nirc: {message}"):
        mi.load_dict({"type": "nirc", **keys})


# ---------------------------------------------------------------------------------------------------------------------
# Caches of outgoing radiance (Müller et al. 2021, AMD's guide)


def test_constants_of_outgoing_radiance_are_those_printed():
    integrator = mi.load_dict({"type": "nrc", "preset": "paper", "train_frames": 1})
    cache, training = integrator.cache, integrator.cache.training
    integrator.train(room(), 1)
    shape = cache.field.shape
    assert (shape.width, shape.n_hidden) == (64, 2) and shape.inputs == ("normal", "view", "albedo", "roughness")
    layers = [tuple(v.shape) for k, v in cache.field.current.mlp.items() if k.endswith("weights")]
    assert layers == [(64, shape.n_inputs), (64, 64), (3, 64)]
    assert (training.learning_rate, training.last_rate, training.ema_decay) == (0.002, 1, 0.99)
    assert training.ema_debiased and training.epsilon == 0.01
    assert float(training.rate(0)) == float(training.rate(5000)) == 0.002
    assert training.capacity == 16384 and integrator.train_steps == 4
    assert (training.unbounded_share, training.world_share, training.threshold) == (1 / 16, 0, 0.01)
    assert (integrator.spread_threshold, training.roughening) == (0.01, 0)
    assert cache.reliability.measure == "correlation"


def test_averaged_weights_of_the_preset_are_those_of_the_source():
    """``w̄_t = (1 - a)/η_t w_t + a η_{t-1}/η_t w̄_{t-1}`` of all steps, with a = 0.99, whatever their age."""
    integrator = mi.load_dict({"type": "nrc", "preset": "paper", **SMALL, "train_records": 64})
    scene, weights, average = room(), [], 0
    name = None
    for _ in range(4):
        integrator.train(scene, 1)
        arrays = integrator.cache.field.snapshot()
        name = name or next(k for k in arrays if k.endswith("weights") and k.startswith("current"))
        weights.append(arrays[name])
    share = 0.99 ** np.arange(3, -1, -1.0)
    average = sum(s * w for s, w in zip(share, weights, strict=True)) / share.sum()
    np.testing.assert_allclose(arrays[name.replace("current", "averaged")], average, rtol=1e-3, atol=1e-6)


def test_keys_go_before_the_preset_of_outgoing_radiance():
    keys = {**SMALL, "train_records": 40, "learning_rate": 0.05, "last_rate": 0.5, "ema_decay": 0.9, "epsilon": 2.0,
            "ema_debiased": False, "unbounded_share": 0.5, "world_share": 0.1, "inputs": "normal", "train_steps": 2,
            "spread_threshold": 0.5}  # fmt: skip
    integrator = mi.load_dict({"type": "nrc", "preset": "paper", **keys})
    integrator.train(room(), 1)
    shape, t = integrator.cache.field.shape, integrator.cache.training
    assert (shape.n_levels, shape.width, shape.n_hidden, shape.inputs) == (2, 8, 1, ("normal",))
    assert (t.n_paths, t.capacity, t.learning_rate, t.last_rate, t.ema_decay) == (32, 40, 0.05, 0.5, 0.9)
    assert (t.ema_debiased, t.epsilon, t.unbounded_share, t.world_share) == (False, 2, 0.5, 0.1)
    assert t.threshold == integrator.spread_threshold == 0.5 and integrator.train_steps == 2


def test_default_of_outgoing_radiance_is_as_measured():
    for keys in ({}, {"preset": "measured"}):
        integrator = mi.load_dict({"type": "nrc", **keys})
        t = replace(integrator.cache.training, n_paths=OutgoingTraining.n_paths)  # more on a GPU
        assert t == OutgoingTraining() and integrator.cache.shape == OutgoingShape() and integrator.train_steps == 1


@pytest.mark.parametrize("keys", [{}, {"blend": "reliability", "reliability_warm_up": 0}], ids=["ema", "reliability"])
def test_outgoing_radiance_renders_with_the_preset(keys):
    """The scene's mean has to be right to 20 % after so little training, at a rate of 0.02 instead of 0.002."""
    scene = lit(lights("all"), 12)
    quick = {**SMALL, "train_samples": 256, "train_frames": 24, "learning_rate": 0.02}
    integrator = mi.load_dict({"type": "nrc", "preset": "paper", **quick, **keys})
    image = np.array(mi.render(scene, integrator=integrator, spp=32))
    known = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path"}), spp=128))
    facts = integrator.statistics()
    assert np.isfinite(image).all() and facts["nonfinite"] == facts["recoveries"] == 0
    print(f"mean {image.mean() / known.mean():.3f} of that of path")
    assert image.mean() == pytest.approx(known.mean(), rel=0.2)


def test_cache_files_of_outgoing_radiance_of_before_the_keys_are_read(tmp_path):
    scene = room()
    nrc = mi.load_dict({"type": "nrc", **SMALL})
    nrc.train(scene, 2)
    nrc.save_cache(tmp_path / "new.npz")
    without_surface(tmp_path / "new.npz", tmp_path / "old.npz")
    new = mi.load_dict({"type": "nrc", **SMALL})
    new.load_cache(tmp_path / "old.npz", scene)
    for name, value in nrc.cache.field.arrays().items():
        np.testing.assert_array_equal(new.cache.field.arrays()[name], value)


@pytest.mark.parametrize("keys, message", [
    ({"preset": "published"}, "preset is 'published'; give one of: measured, paper"),
    ({"train_records": 0}, "train_records is 0; "), ({"train_records": 1.5}, "train_records is 1.5; "),
    ({"epsilon": -1.0}, "epsilon is -1.0; "),
])  # fmt: skip
def test_values_that_outgoing_radiance_cannot_have_are_refused_by_name(keys, message):
    with pytest.raises((ValueError, RuntimeError), match=f"nrc: {message}"):
        mi.load_dict({"type": "nrc", **keys})


def test_radiance_cache_takes_the_preset(rng):
    cache = RadianceCache(64, 64, preset="paper")
    assert (cache.field.shape.width, cache.field.shape.n_hidden) == (64, 2)
    assert (radiance_cache.LEARNING_RATE, radiance_cache.WEIGHT_SMOOTHING) == (0.002, 0.99)
    points, targets = (rng.uniform(0.1, 0.9, (64, n)).astype("f4") for n in (11, 3))
    flags = DispatchFlags.TRAINING | DispatchFlags.INFERENCE
    cache.dispatch(flags, train_inputs=points, train_targets=targets, prediction_inputs=points)
    found = cache.dispatch(DispatchFlags.INFERENCE, prediction_inputs=points)
    assert np.isfinite(found).all() and cache.statistics["steps"] == 1

    shape = OutgoingShape(width=16)
    assert RadianceCache(64, 64, preset="paper", shape=shape).field.shape == shape
    assert RadianceCache(64, 64).field.shape == OutgoingShape()
    with pytest.raises(ValueError, match="preset is 'papers'; give one of: measured, paper"):
        RadianceCache(64, 64, preset="papers")


# ---------------------------------------------------------------------------------------------------------------------
# Direct light (Bokšanský and Meister 2025, section 4.2)


def test_constants_of_direct_light_are_those_printed():
    integrator = mi.load_dict({"type": "nvc_direct", "cache": "radiance", "preset": "paper"})
    mi.render(lit(lights("all"), 8), integrator=integrator, spp=1)
    cache, training = integrator.cache, integrator.cache.training
    shape = cache.field.shape
    assert (shape.n_levels, shape.base_resolution, shape.n_features, shape.width, shape.n_hidden) == (10, 16, 4, 32, 2)
    assert (shape.n_outputs, shape.leak, shape.direction_degree) == (3, 0.01, -1)
    assert (training.n_points, training.world_points, training.loss) == (8192, 0.5, "squared")
    assert (training.first_rate, training.last_rate, training.ramp, training.ema_decay) == (0.05, 0.001, 200, 0)
    assert cache.steps == 1 and cache.he
    sampler = integrator.light_sampler
    assert sampler.preset == "paper" and sampler.constants.floor == 0.001


def test_weights_of_direct_light_begin_as_he_et_al_have_them():
    """As above; a reset leads back to them."""
    field = HeField([0] * 3, [1] * 3, FieldShape(direction_degree=-1, width=32, n_features=4))
    first = {k: np.array(v) for k, v in field.current.mlp.items()}
    field.reset()
    for name, tensor in field.current.mlp.items():
        values = np.array(tensor, np.float64)
        np.testing.assert_array_equal(values, first[name])
        if name.endswith("weights"):
            n, variance = values.size, 2 / values.shape[1]
            assert abs(values.mean()) < 5 * np.sqrt(variance / n)
            assert abs(values.var() / variance - 1) < 5 * np.sqrt(2 / n)
        else:
            assert (values == 0).all()


def test_points_in_the_air_reflect_as_white_lambertians_do():
    """Under a sky of radiance 0.7 that is 0.7, whatever the orientation."""
    scene = mi.load_dict({"type": "scene", **lights("constant"),
                          "far": {"type": "sphere", "center": [0, 0, 1e4], "radius": 0.01}})  # fmt: skip
    field = Field([-1] * 3, [1] * 3, FieldShape(direction_degree=-1))
    x, y, valid = air_records(scene, field, 2**14, mi.UInt32(5))
    assert np.array(valid).all() and (np.abs(np.array(x)) <= 1).all()
    assert_mean(np.array(y)[1], 0.7, "light in the air")


def test_keys_go_before_the_preset_of_direct_light():
    keys = {"train_frames": 3, "train_samples": 64, "world_points": 0.25, "loss": "relative", "first_rate": 0.03,
            "last_rate": 0.004, "rate_steps": 20, "averaging": 0.5, "levels": 3, "base_resolution": 4,
            "level_scale": 1.5, "init": "uniform"}  # fmt: skip
    integrator = mi.load_dict({"type": "nvc_direct", "cache": "radiance", "preset": "paper", **keys,
                               "light_sampler": {"type": "nvc_lights", **QUICK, "train_frames": 1}})  # fmt: skip
    mi.render(lit(lights("all"), 8), integrator=integrator, spp=1)
    cache, t = integrator.cache, integrator.cache.training
    shape = cache.field.shape
    assert (shape.n_levels, shape.base_resolution, shape.per_level_scale) == (3, 4, 1.5) and not cache.he
    assert (t.n_points, t.world_points, t.loss, t.ema_decay) == (64, 0.25, "relative", 0.5)
    assert (t.first_rate, t.last_rate, t.ramp) == (0.03, 0.004, 20) and cache.steps == 3
    assert integrator.light_sampler.preset == "measured"  # it has keys of its own


def test_default_of_direct_light_is_as_measured():
    for keys in ({}, {"preset": "measured"}):
        integrator = mi.load_dict({"type": "nvc_direct", **keys})
        cache = integrator.cache
        assert cache.training == DirectTraining() and integrator.train_frames == 256 and not cache.he
        assert (cache.shape.n_levels, cache.shape.base_resolution, cache.shape.per_level_scale) == (8, 8, 1.5)
        assert integrator.light_sampler.preset == "measured"


def test_direct_light_renders_with_the_preset():
    """By the radiance cache within 25 % of the mean: half of its points lie in the air and lighten or darken what lies
    on surfaces (0.86 when this was written). Sampled, it is unbiased."""
    scene = lit(lights("area"), 8)
    known = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 2}), spp=1024))
    keys = {"train_samples": 1024, "levels": 4}
    for more, error in ({"cache": "radiance", "train_frames": 100}, 0.25), ({"mode": "sampled", "max_depth": 2}, 0.05):
        integrator = mi.load_dict({"type": "nvc_direct", "preset": "paper", **keys, **more})
        image = np.array(mi.render(scene, integrator=integrator, spp=1024))
        print(f"mean {image.mean() / known.mean():.3f} of that of path")
        assert np.isfinite(image).all() and image.mean() == pytest.approx(known.mean(), rel=error)
        assert integrator.cache.statistics["direct_recoveries"] == 0


@pytest.mark.parametrize("mode, which", [("neural", "several"), ("neural", "point"), ("sampled", "all")])
def test_direct_light_by_visibility_renders_with_the_preset(mode, which):
    """A single light, too, which has a network of its own."""
    lamps = {**LIGHTS["area"], "spark": LIGHTS["point"]["lamp"]} if which == "several" else lights(which)
    integrator = mi.load_dict({"type": "nvc_direct", "preset": "paper", "mode": mode})
    image = np.array(mi.render(lit(lamps, 8), integrator=integrator, spp=4))
    assert np.isfinite(image).all() and image.mean() > 0
    if which == "point":
        shape = integrator.only_light.field.shape
        assert (shape.n_levels, shape.base_resolution) == (10, 16) and integrator.only_light.field.he


@pytest.mark.parametrize("key, value", [
    ("preset", "papers"), ("world_points", 1.5), ("loss", "local"), ("first_rate", 0.0), ("last_rate", -1.0),
    ("rate_steps", 0), ("averaging", 1.5), ("levels", 0), ("base_resolution", 0), ("level_scale", 1.0),
    ("init", "xavier"),
])  # fmt: skip
def test_values_that_direct_light_cannot_have_are_refused_by_name(key, value):
    with pytest.raises((ValueError, RuntimeError), match=f"nvc_direct: .*{key}(=| is )'?{value}"):
        mi.load_dict({"type": "nvc_direct", key: value})


# ---------------------------------------------------------------------------------------------------------------------
# ReSTIR (Bokšanský and Meister 2025, section 4.1)


def test_constants_of_restir_are_those_printed():
    integrator = mi.load_dict({"type": "restir_di", "preset": "paper"})
    assert (integrator.initial_candidates, integrator.history, integrator.spatial_radius) == (8, 20, 32)
    assert integrator.candidate_shadow_ray and integrator.visible_target
    for keys in ({"candidates": "nvc"}, {"light_sampler": {"type": "nvc_lights"}}):
        integrator = mi.load_dict({"type": "restir_di", "preset": "paper", **keys})
        assert not integrator.candidate_shadow_ray and not integrator.visible_target
    for keys in ({}, {"candidates": "nvc"}, {"preset": "measured", "candidates": "nvc"}):
        integrator = mi.load_dict({"type": "restir_di", **keys})
        assert (integrator.initial_candidates, integrator.history, integrator.spatial_radius) == (8, 20, -1)
        assert integrator.candidate_shadow_ray and integrator.visible_target


def test_keys_go_before_the_preset_of_restir():
    keys = {"candidates": "nvc", "initial_candidates": 3, "history": 2.0, "spatial_radius": 5.0,
            "candidate_shadow_ray": True}  # fmt: skip
    integrator = mi.load_dict({"type": "restir_di", "preset": "paper", **keys})
    assert (integrator.initial_candidates, integrator.history, integrator.spatial_radius) == (3, 2, 5)
    assert integrator.candidate_shadow_ray


def test_restir_renders_with_the_preset():
    """Its candidates are those of the visibility cache as printed."""
    integrator = mi.load_dict({"type": "restir_di", "preset": "paper", "candidates": "nvc"})
    image = np.array(mi.render(lit(lights("all"), 8), integrator=integrator, spp=2))
    assert np.isfinite(image).all() and image.mean() > 0
    cache = integrator.state.chooser.cache
    assert cache.field.shape.n_levels == 10 and cache.training.n_points == 8192 and cache.steps == 2


@pytest.mark.parametrize("key, value, message", [
    ("preset", "papers", "preset is 'papers'; give one of: measured, paper"),
    ("candidate_shadow_ray", 1.5, "candidate_shadow_ray is 1.5; give true or false"),
])  # fmt: skip
def test_values_that_restir_cannot_have_are_refused_by_name(key, value, message):
    with pytest.raises((ValueError, RuntimeError), match=f"restir_di: {message}"):
        mi.load_dict({"type": "restir_di", key: value})
