"""`preset="paper"` of `nvc_lights`: constants as printed (Bokšanský and Meister 2025), keys before them, no bias."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_same_mean, renders
from test_vertex import lights
from test_vertex import test_scene as lit

from mi_neural import scenes
from mi_neural.caches import visibility

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


@pytest.mark.parametrize("keys", [{}, {"outputs": 2, "clusters": "kmeans"}], ids=["lights", "clusters"])
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
