"""Light samplers inside integrators: images, changes of the scene, the visibility cache, refusals.

Images are compared with Mitsuba's `path` by z-tests that fail a correct sampler in one of 10,000 choices of seed.
"""

import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW, sweep
from expectation import assert_same_mean, renders
from light_scenes import glow, picture, random_triangles, row, triangles
from test_vertex import lights, test_scene

from mi_neural.caches.visibility import VisibilityTraining
from mi_neural.lights.table import LightTable

SAMPLERS = {
    "uniform": {"type": "uniform_lights"},
    "power": {"type": "power_lights"},
    "tree": {"type": "tree_lights"},
    "trained": {"type": "nvc_lights", "train_frames": 30, "train_steps": 0, "train_samples": 1024, "levels": 4},
    "untrained": {"type": "nvc_lights", "train_frames": 0, "train_steps": 0, "train_samples": 64},
    "unshadowed": {"type": "nvc_lights", "visibility": False},
    "clusters": {"type": "nvc_lights", "outputs": 8, "clusters": "kmeans", "train_frames": 20, "train_steps": 0,
                 "train_samples": 512, "levels": 4},
    "cells": {"type": "nvc_lights", "environment_cells": 16, "train_frames": 30, "train_steps": 0,
              "train_samples": 1024, "levels": 4},
    "untrained cells": {"type": "nvc_lights", "environment_cells": 8, "train_frames": 0, "train_steps": 0},
}  # fmt: skip


def path_with(sampler, depth=2):
    given = SAMPLERS[sampler] if isinstance(sampler, str) else sampler
    return mi.load_dict({"type": "plain_path", "max_depth": depth, "light_sampler": given})


def at(*position):
    return mi.ScalarTransform4f().translate(list(position))


def many(kind: str, folder) -> dict:
    """Lights over and between the spheres of `test_scene`."""
    rng = np.random.default_rng(3)
    if kind == "two":
        return {"a": lights("area")["lamp"], "b": {"type": "point", "position": [-1.5, 1.5, 1.5], "intensity": 2.0}}
    if kind == "kinds":
        torch = mi.ScalarTransform4f().look_at([2, 3, 2], [0, 0, 0], [0, 1, 0])
        return {
            **lights("all"),
            "ball": {"type": "sphere", "center": [-2, 1.5, -1], "radius": 0.3, "emitter": glow(4.0)},
            "tube": {"type": "cylinder", "p0": [-1, 1.8, -2], "p1": [1, 1.8, -2], "radius": 0.1, "emitter": glow(3.0)},
            "plate": {"type": "disk", "to_world": at(2, 1, -1).rotate([0, 1, 0], -60).scale(0.5), "emitter": glow(3.0)},
            "torch": {"type": "spot", "to_world": torch, "intensity": 15.0},
            "sun": {"type": "directional", "direction": [1.0, -2.0, 0.5], "irradiance": 0.5},
            "mirrored": {"type": "rectangle", "to_world": at(0, 1, -2.5).scale([-0.5, 0.5, 1]), "emitter": glow(2.0)},
        }  # fmt: skip
    if kind == "32":
        out = {}
        for k in range(32):
            p = rng.uniform([-2.5, 0.3, -2.5], [2.5, 2, 2.5])
            out[f"l{k}"] = {"type": "rectangle", "to_world": at(*p).rotate([1, 0, 0], 90).scale(0.1),
                            "emitter": glow(float(rng.uniform(5, 40)))}  # fmt: skip
        return out
    if kind == "mesh":
        corners = random_triangles(rng, 256, center=(0, 2, 0), spread=0.6, size=0.1)
        return {"m": {**triangles(folder / "m.ply", corners), "emitter": glow(6.0)}}
    if kind == "spotted":
        spot = np.full((64, 64, 3), 0.5, np.float32)
        spot[8:12, 8:12] = 300
        return {"a": {**lights("area")["lamp"], "emitter": glow(picture(spot))},
                "b": {"type": "point", "position": [-1.5, 1.5, 1.5], "intensity": 2.0}}  # fmt: skip
    return lights(kind)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """`place(kind, depth)`: a scene and images of `path` of it."""
    known, folder = {}, tmp_path_factory.mktemp("meshes")

    def get(kind, depth=2):
        if kind not in known:
            known[kind] = test_scene(many(kind, folder), 12)
        if (kind, depth) not in known:
            known[kind, depth] = renders(known[kind], {"type": "path", "max_depth": depth}, 16, 256, first_seed=1000)
        return known[kind], known[kind, depth]

    return get


# ---------------------------------------------------------------- images


@pytest.mark.parametrize("kind, name", sweep([
    *[("two", name) for name in ("power", "tree", "trained")],
    *[("kinds", name) for name in ("uniform", "tree", "trained", "untrained", "clusters", "cells")],
    *[("32", name) for name in ("tree", "trained", "clusters")],
    *[("mesh", name) for name in ("power", "tree", "clusters")],
    *[("spotted", name) for name in ("uniform", "tree", "trained")],
    *[("envmap", name) for name in ("cells", "untrained cells")],
    ("constant", "cells"),
], [*[("kinds", name) for name in ("uniform", "tree", "trained", "clusters")], ("mesh", "clusters"),
    ("spotted", "trained"), ("envmap", "cells")]))  # fmt: skip
def test_image_is_that_of_path(place, kind, name):
    scene, path = place(kind)
    assert_same_mean(renders(scene, path_with(name), 16, 256), path, f"{kind}, {name}", relative=1e-5)


# ---------------------------------------------------------------- predicted direct light in deep bounces


@SLOW
def test_direct_light_predicted_deep_down_is_nearly_that_of_path(place):
    """A preview: within 15 % of the mean; without shadows the indirect half would be off by half."""
    scene, path = place("32", 3)
    trained = mi.load_dict({**SAMPLERS["trained"], "train_frames": 100})  # once, for all that follow
    keys = {"type": "plain_path", "max_depth": 3, "light_sampler": trained}
    means = {k: renders(scene, {**keys, "neural_depth": k}, 2, 64).mean() for k in (0, 1)}
    known = path.mean()
    print(f"path {known:.4f}, predicted from vertex: {means}")
    assert_same_mean(renders(scene, {**keys, "neural_depth": 2}, 16, 64), path, "no vertex is that deep", relative=1e-5)
    assert means[1] == pytest.approx(known, rel=0.15) and means[0] == pytest.approx(known, rel=0.25)
    direct = {"type": "nvc_direct", "mode": "neural", "max_depth": 2, "light_sampler": trained}
    same = [direct, {**keys, "max_depth": 2, "neural_depth": 0}]
    both = [renders(scene, keys, 1, 64).mean() for keys in same]
    assert both[0] == pytest.approx(both[1], rel=0.02)


@pytest.mark.parametrize("keys, says", [
    ({"neural_depth": -2}, "neural_depth is -2; give -1"),
    ({"neural_depth": 0}, "needs an nvc_lights with visibility=true"),
    ({"neural_depth": 0, "light_sampler": {"type": "power_lights"}}, "needs an nvc_lights with visibility=true"),
])  # fmt: skip
def test_neural_depth_that_cannot_be_is_refused(keys, says):
    with pytest.raises((ValueError, RuntimeError), match=says):
        mi.load_dict({"type": "plain_path", **keys})


def test_neural_depth_with_clusters_is_refused_by_render():
    scene = test_scene(many("32", None), 8)
    integrator = mi.load_dict({"type": "plain_path", "neural_depth": 1, "light_sampler": SAMPLERS["clusters"]})
    with pytest.raises(ValueError, match=r"there are 32 for 8 outputs; raise outputs"):
        integrator.render(scene, spp=1)


@SLOW
@pytest.mark.parametrize("name", ["tree", "trained", "clusters"])
def test_image_of_longer_paths_is_that_of_path(place, name):
    scene, path = place("kinds", 4)
    assert_same_mean(renders(scene, path_with(name, 4), 16, 128), path, name, relative=1e-5)


@pytest.mark.parametrize("kind, nonsense", sweep(
    [("kinds", "random"), ("two", "NaN"), ("32", "inverted"), ("envmap", "inverted")],
    [("kinds", "random"), ("two", "NaN"), ("envmap", "inverted")],
))  # fmt: skip
def test_network_that_says_nonsense_gives_the_same_image(place, kind, nonsense):
    scene, path = place(kind)
    integrator = path_with("cells" if kind == "envmap" else "trained")
    sampler = integrator.light_sampler
    lights = sampler.lights(scene, scene.sensors()[0])
    weights = lights.field.averaged
    rng = np.random.default_rng(1)
    parameters = {k: np.array(v) for k, v in weights.parameters().items()}
    if nonsense == "inverted":
        field = lights.field
        lights.field = type("Inverted", (), {"query": lambda self, x: [1 - v for v in field.query(x)]})()
        sampler.train = lambda scene, sensor: None
        integrator.records = False  # such a field is no argument that it could take
    else:
        scale = {"random": 30.0, "NaN": np.nan}[nonsense]
        new = {k: rng.normal(size=v.shape).astype(v.dtype) * np.array(scale, v.dtype) for k, v in parameters.items()}
        weights.assign({k: type(v)(new[k]) for k, v in weights.parameters().items()})
        weights.pack()
    # Weights of 30 are sure of themselves: noise of up to 1/0.03
    assert_same_mean(renders(scene, integrator, 24, 64), path, f"{kind}, {nonsense}", relative=1e-5)


@pytest.mark.parametrize("name", ["unshadowed"])
def test_light_of_mesh_attributes_is_that_of_bsdf_samples_alone(tmp_path, name):
    """Mitsuba 3.9.1's next-event estimation loses such light: compared with the paths that meet it by chance."""
    rng = np.random.default_rng(2)
    corners = random_triangles(rng, 24, center=(0, 2, 0), spread=0.8, size=0.5)
    mesh = triangles(tmp_path / "m.ply", corners, ("face_glow", rng.uniform(0, 6, (24, 3))))
    mesh["emitter"] = glow({"type": "mesh_attribute", "name": "face_glow"})
    scene = test_scene({"m": mesh}, 12)
    known = renders(scene, BY_CHANCE, 24, 256, first_seed=1000)
    assert_same_mean(renders(scene, path_with(name), 16, 64), known, name, relative=1e-5)


BY_CHANCE = {"type": "by_chance"}


class ByChance(mi.SamplingIntegrator):
    """Direct light of BSDF samples alone."""

    def sample(self, scene, sampler, ray, medium=None, active=True):
        si = scene.ray_intersect(ray, active)
        L = si.emitter(scene, active).eval(si, active)
        active = active & si.is_valid()
        bs, weight = si.bsdf(ray).sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active)
        si_next = scene.ray_intersect(si.spawn_ray(si.to_world(bs.wo)), active)
        return (
            L + dr.select(active, weight * si_next.emitter(scene, active).eval(si_next, active), 0),
            mi.Bool(True),
            [],
        )

    def to_string(self):
        return "ByChance[]"


@pytest.fixture(autouse=True, scope="module")
def _registered():
    mi.register_integrator("by_chance", lambda props: ByChance(props))


@pytest.mark.parametrize("kind", sweep(("area", "point", "envmap"), ("area",)))
def test_single_light_costs_and_changes_nothing(kind):
    scene = test_scene(lights(kind), 8)
    plain = np.array(mi.load_dict({"type": "plain_path", "max_depth": 3}).render(scene, spp=16, seed=5))
    for name in SAMPLERS:
        if "cells" in name:
            continue  # to them an environment is many lights
        integrator = path_with(name, 3)
        assert integrator.light_sampler.lights(scene, scene.sensors()[0]) is None
        np.testing.assert_array_equal(np.array(integrator.render(scene, spp=16, seed=5)), plain)
        assert integrator.light_sampler.statistics() == {}


def nirc(name, **keys):
    return mi.load_dict(
        {"type": "nirc", "cache_samples": 0, "light_samples": 2, "light_sampler": SAMPLERS[name], **keys}
    )


@pytest.mark.parametrize("name", sweep(("power", "untrained"), ("untrained",)))
def test_as_on_a_gpu_image_is_that_of_path(monkeypatch, place, name):
    """There emitters that sample themselves are called through pointers."""
    monkeypatch.setattr("mi_neural.lights.table.on_gpu", lambda: True)
    scene, path = place("kinds")
    assert LightTable(scene).others is None and LightTable(place("32")[0]).others == ()
    assert_same_mean(renders(scene, path_with(name), 16, 256), path, f"pointers, {name}", relative=1e-5)


def test_parts_of_the_environment_are_refused_on_a_gpu(monkeypatch, place):
    """There Dr.Jit 1.5.0 ends the process."""
    monkeypatch.setattr("mi_neural.emitters.common.on_gpu", lambda: True)
    with pytest.raises(ValueError, match="set environment_cells=0"):
        path_with("cells").render(place("envmap")[0], spp=1)


@pytest.mark.parametrize("name, depth", sweep(
    [("power", 2), ("tree", 4), ("clusters", 2), ("trained", 4)], [("power", 2)]
))  # fmt: skip
def test_nirc_without_its_cache_is_path(place, name, depth):
    scene, path = place("kinds", depth)
    assert_same_mean(renders(scene, nirc(name, max_depth=depth), 16, 32), path, f"{name}, {depth}", relative=1e-5)


@SLOW
def test_nirc_with_a_trained_cache_is_near_path(place):
    """The cache is biased by a little; light lost or counted twice shows."""
    scene, path = place("kinds", -1)
    integrator = mi.load_dict({"type": "nirc", "train_samples": 512, "train_frames": 40, "train_steps": 0,
                               "light_sampler": SAMPLERS["trained"]})  # fmt: skip
    image = renders(scene, integrator, 4, 64)
    print(f"{image.mean():.4f}, path {path.mean():.4f}")
    assert image.mean() == pytest.approx(path.mean(), rel=0.03)


@pytest.mark.parametrize("type_, name", sweep(
    [*[("plain_path", n) for n in SAMPLERS], ("nirc", "trained")],
    [*[("plain_path", n) for n in ("uniform", "tree", "trained", "cells")], ("nirc", "trained")],
))  # fmt: skip
def test_lights_that_are_off_give_a_black_image(name, type_):
    off = {"a": {"type": "point", "position": [0, 2, 0], "intensity": 0.0},
           "b": {"type": "rectangle", "to_world": at(0, 2, 0).rotate([1, 0, 0], 90), "emitter": glow(0.0)}}  # fmt: skip
    scene = test_scene(off, 8)
    integrator = path_with(name, 3) if type_ == "plain_path" else nirc(name)
    assert (np.array(integrator.render(scene, spp=4)) == 0).all()


def test_scene_without_lights_is_refused():
    scene = test_scene({}, 8)
    for integrator in (path_with("trained"), nirc("trained")):
        with pytest.raises(ValueError, match="the scene has no emitter"):
            integrator.render(scene, spp=4)


def test_light_that_turns_into_nan_harms_no_pixel_that_does_not_see_it():
    """One light of three becomes no number after the first image, and so is not refused; elsewhere the image stays
    finite and lit by the others."""
    three = {**many("two", None), "c": {"type": "point", "position": [0, 1, 3], "intensity": 1.0}}
    scene = test_scene(three, 8)
    integrators = [path_with(name) for name in ("power", "tree", "trained")]
    for integrator in integrators:
        integrator.render(scene, spp=4)
    params = mi.traverse(scene)
    params["c.intensity.value"] = float("nan")
    params.update()
    for integrator in integrators:
        image = np.array(integrator.render(scene, spp=64))
        assert np.isfinite(image).all() and (image > 0).mean() > 0.5


# ---------------------------------------------------------------- changes of the scene


def shadow_scene(tmp_path=None):
    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 4, 6], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3)},
        "spark": {"type": "point", "position": [0.0, 2.0, 0.0], "intensity": 1.0},
        "torch": {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([1, 2, 0], [0, 0, 0], [0, 0, 1]),
            "intensity": 2.0},
        "lamp": {"type": "rectangle", "to_world": at(0, 2, 1).rotate([1, 0, 0], 90).scale(0.2), "emitter": glow(3.0)},
        "box": {"type": "cube", "to_world": at(-1, 2, -1).scale(0.1), "emitter": glow(2.0)},
        "sky": {"type": "constant", "radiance": 0.2},
        "sun": {"type": "directional", "direction": [0.3, -1.0, 0.2], "irradiance": 1.0},
    })  # fmt: skip


CHANGES = {
    "spark.position": lambda v: mi.Point3f(0.5, 1.5, -0.5),
    "spark.intensity.value": lambda v: mi.Color3f(7.0),
    "torch.to_world": lambda v: mi.Transform4f().look_at([-1, 3, 0], [0, 0, 0], [0, 0, 1]),
    "lamp.to_world": lambda v: mi.Transform4f().translate([0, 3, 1]).rotate([1, 0, 0], 90).scale(0.4),
    "lamp.emitter.radiance.value": lambda v: mi.Float(9.0),
    "box.vertex_positions": lambda v: v + 0.25,
    "sky.radiance.value": lambda v: mi.Color3f(1.5),
    "sun.to_world": lambda v: mi.Transform4f().look_at([0, 0, 0], [1, -1, 0], [0, 0, 1]),
    "sun.irradiance.value": lambda v: mi.Color3f(4.0),
}  # fmt: skip


@pytest.mark.parametrize("key", CHANGES)
def test_table_follows_a_light_that_changes(key):
    scene = shadow_scene()
    sampler = mi.load_dict({"type": "power_lights"})
    before = sampler.lights(scene, scene.sensors()[0])
    params = mi.traverse(scene)
    params[key] = CHANGES[key](params[key])
    params.update()
    after = sampler.lights(scene, scene.sensors()[0])
    known = LightTable(scene).columns
    assert any(not np.array_equal(before.table.columns[k], v) for k, v in known.items())
    for name, values in known.items():
        np.testing.assert_allclose(after.table.columns[name], values, rtol=1e-6, err_msg=name)


def test_shell_that_comes_about_a_scene_hides_all_parts_of_the_sky():
    """Points on the sky were put at twice the size that the scene had when its lights were read."""
    lid = {"type": "sphere", "center": [4, 0, 0], "radius": 0.1}
    scene = test_scene({"sky": {"type": "constant", "radiance": 1.0}, "lid": lid}, 8)
    integrator = path_with("untrained cells")
    assert np.array(integrator.render(scene, spp=16)).mean() > 0.1
    params = mi.traverse(scene)
    params["lid.to_world"] = mi.Transform4f().scale(200.0)
    params.update()
    assert (np.array(integrator.render(scene, spp=16)) == 0).all()


def test_table_follows_lights_that_change_several_times_between_images():
    """A variable's number is free again once it is gone: the last value may bear the first one's."""
    scene = shadow_scene()
    sampler = mi.load_dict({"type": "power_lights"})
    params = mi.traverse(scene)
    for k in range(12):
        for j in range(1 + k % 4):
            params["spark.position"] = mi.Point3f(k, j, 3)
            params["lamp.emitter.radiance.value"] = dr.opaque(mi.Float, 1.0 + 5 * k + j)
            params["box.vertex_positions"] = params["box.vertex_positions"] + 0.01
            params.update()
        found, known = sampler.lights(scene, scene.sensors()[0]).table.columns, LightTable(scene).columns
        for name in ("center", "intensity", "corner"):
            np.testing.assert_allclose(found[name], known[name], rtol=1e-6, err_msg=f"{name}, round {k}")


def test_table_follows_mesh_attributes(tmp_path):
    rng = np.random.default_rng(0)
    mesh = triangles(tmp_path / "m.ply", random_triangles(rng, 4), ("face_glow", np.ones((4, 3))))
    mesh["emitter"] = glow({"type": "mesh_attribute", "name": "face_glow"})
    scene = test_scene({"m": mesh}, 8)
    sampler = mi.load_dict({"type": "power_lights"})
    sampler.lights(scene, scene.sensors()[0])
    params = mi.traverse(scene)
    params["m.face_glow"] = mi.Float(np.arange(12, dtype=np.float32))
    params.update()
    found = sampler.lights(scene, scene.sensors()[0]).table.columns
    np.testing.assert_allclose(found["radiance"].ravel(), np.arange(12), rtol=1e-5)


def test_table_is_made_once_where_no_light_changes():
    scene = shadow_scene()
    sampler = mi.load_dict({"type": "power_lights"})
    table = sampler.lights(scene, scene.sensors()[0]).table
    integrator = mi.load_dict({"type": "plain_path", "max_depth": 2})
    integrator.light_sampler = sampler
    params = mi.traverse(scene)
    for k in range(3):
        integrator.render(scene, spp=1, seed=k)
        params["floor.bsdf.reflectance.value"] = dr.opaque(mi.Float, 0.1 * k)
        params["sensor.to_world"] = params["sensor.to_world"]
        params.update()
        assert sampler.lights(scene, scene.sensors()[0]).table is table


@pytest.mark.parametrize("key", [
    pytest.param("lamp.emitter.radiance.value", marks=SLOW), "spark.intensity.value",
])  # fmt: skip
def test_light_that_is_dimmed_is_not_recorded_anew(key):
    """NumPy's memory, aligned by chance, must not reach frozen functions. Two lights: more are larger kernels."""
    scene = test_scene({"lamp": lights("area")["lamp"],
                        "spark": {"type": "point", "position": [-1.5, 1.5, 1.5], "intensity": 2.0}}, 8)  # fmt: skip
    sampler = {"type": "nvc_lights", "train_frames": 2, "train_samples": 64}
    nirc_ = mi.load_dict({"type": "nirc", "train_samples": 64, "train_frames": 2, "light_samples": 1,
                          "light_sampler": sampler, **NETWORK})  # fmt: skip
    plain = mi.load_dict({"type": "plain_path", "max_depth": 2, "light_sampler": sampler})
    params = mi.traverse(scene)
    key = key if key in params else next(k for k in params.keys() if k.endswith(key.split(".", 1)[1]))
    counts = []
    for k in range(9):
        params[key] = mi.Color3f(1 + k, 2 + 0.5 * k, 3.0)
        params.update()
        for it in (nirc_, plain):
            with dr.suspend_grad():
                dr.eval(it.render(scene, spp=1, seed=k))
        counts.append([
            *(p.n_recordings for p in nirc_.film_state.passes.recorded.values()), nirc_.cache.recordings()["frame"],
            *(f.n_recordings for f in plain.film_state.passes.recorded.values()),
            plain.light_sampler.cache.recordings()["frame"],
        ])  # fmt: skip
    print(counts[0], counts[-1])
    assert counts[-1] == counts[3] and max(counts[-1]) <= 3


def test_frozen_image_is_the_one_that_is_not_frozen():
    """Whatever the seed and the number of samples; and a key that changes is seen."""
    scene = test_scene(many("two", None), 12)
    frozen, plain = path_with("unshadowed", 4), path_with("unshadowed", 4)
    plain.records = False
    for seed, spp in ((0, 4), (1, 4), (2, 4), (3, 2), (4, 4)):
        with dr.suspend_grad():
            images = [np.array(it.render(scene, seed=seed, spp=spp)) for it in (frozen, plain)]
        np.testing.assert_allclose(*images, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(np.array(scene.sensors()[0].film().develop()), images[1], rtol=1e-5, atol=1e-6)
    assert [f.n_recordings for f in frozen.film_state.passes.recorded.values()] == [2, 1]
    frozen.max_depth = 1
    with dr.suspend_grad():
        assert np.array(frozen.render(scene, seed=0, spp=4)).mean() < images[1].mean()


def test_another_scene_is_learned_anew_even_where_the_first_is_gone():
    sampler = mi.load_dict({"type": "power_lights"})
    for k in range(1, 5):
        scene = mi.load_dict({"type": "scene", "a": {"type": "point", "intensity": float(k)}, "b": {"type": "point"}})
        assert sampler.lights(scene, None).table.columns["intensity"].max() == pytest.approx(k)
        del scene


@pytest.mark.parametrize("name", sweep(("tree", "clusters"), ("clusters",)))
def test_image_after_a_change_is_that_of_a_fresh_integrator(name):
    """The pass is frozen: what it knows of lights must be recorded anew where it changes. The 24 triangles are grouped
    otherwise once they move, and a lamp gets a picture that it had not."""
    rng = np.random.default_rng(4)
    text = picture(np.ones((16, 16, 3), np.float32))
    lamp = {"type": "rectangle", "to_world": at(0, 2, 0).rotate([1, 0, 0], 90), "emitter": glow(text)}
    more = {f"c{k}": {"type": "cube", "to_world": at(*rng.uniform([-2, 1, -2], [2, 2, 2])).scale(0.1),
        "emitter": glow(5.0)}
            for k in range(2)}  # fmt: skip
    scene = test_scene({"lamp": lamp, **more}, 12)
    integrator = nirc(name, max_depth=2)
    for k in range(2):
        integrator.render(scene, spp=256, seed=k)
    params = mi.traverse(scene)
    spot = np.full((16, 16, 3), 0.1, np.float32)
    spot[2:5, 2:5] = 40
    params["lamp.emitter.radiance.data"] = mi.TensorXf(spot)
    p = np.array(params["c0.vertex_positions"]).reshape(-1, 3)
    p[:5] += [2, 0, 1]
    params["c0.vertex_positions"] = mi.Float(p.ravel())
    params.update()
    fresh = renders(scene, nirc(name, max_depth=2), 32, 256, first_seed=1000)
    assert_same_mean(renders(scene, integrator, 32, 256), fresh, name, relative=1e-5)


def test_frozen_pass_learns_that_groups_have_other_sizes(tmp_path):
    """Two groups of 20 triangles become one of 39 and one of 1: the arrays keep their sizes, the search needs a step
    more.
    """
    rng = np.random.default_rng(4)
    corners = random_triangles(rng, 40, center=(0, 2, 0), spread=0.05, size=0.1)
    corners[:20, :, 0] -= 1.5
    corners[20:, :, 0] += 1.5
    scene = test_scene({"m": {**triangles(tmp_path / "m.ply", corners), "emitter": glow(6.0)}}, 12)
    sampler = {"type": "nvc_lights", "outputs": 2, "clusters": "kmeans", "visibility": False}
    keys = {"type": "nirc", "cache_samples": 0, "light_samples": 1, "max_depth": 2, "light_sampler": sampler}
    integrator = mi.load_dict(keys)
    for k in range(3):
        integrator.render(scene, spp=64, seed=k)
    assert sorted(np.array(integrator.light_sampler.sampler.groups.count)) == [20, 20]
    corners[:19, :, 0] += 3
    params = mi.traverse(scene)
    params["m.vertex_positions"] = mi.Float(corners.ravel())
    params.update()
    found = np.array(integrator.render(scene, spp=64, seed=9))
    assert sorted(np.array(integrator.light_sampler.sampler.groups.count)) == [1, 39]
    fresh = mi.load_dict(keys)
    fresh.render(scene, spp=64, seed=8)
    np.testing.assert_allclose(found, np.array(fresh.render(scene, spp=64, seed=9)), rtol=1e-4, atol=1e-6)


# ---------------------------------------------------------------- bad input


def test_seeds_may_have_more_than_32_bits():
    scene = test_scene(many("two", None), 8)
    integrator = path_with({"type": "nvc_lights", "train_frames": 1, "train_samples": 64, "seed": 2**40})
    first = np.array(integrator.render(scene, spp=1))
    integrator.reseed(2**40 + 1)
    assert not np.array_equal(np.array(integrator.render(scene, spp=1)), first)


@pytest.mark.parametrize("key, value", [
    ("outputs", 1), ("outputs", 257), ("candidates", 0), ("train_frames", -1), ("train_steps", -1), ("train_samples",
        3),
    ("seed", -1), ("clusters", "median"),
])  # fmt: skip
def test_keys_out_of_range_are_refused_by_name(key, value):
    with pytest.raises((ValueError, RuntimeError), match=f"nvc_lights: {key} is '?{value}'?"):
        mi.load_dict({"type": "nvc_lights", key: value})


@pytest.mark.parametrize("key, value", [
    ("n_points", 3), ("ema_decay", -0.1), ("ema_decay", 1.1), ("ema_decay", float("nan")), ("first_rate", 0),
        ("last_rate", -1),
    ("last_rate", float("nan")),
])  # fmt: skip
def test_impossible_training_is_refused(key, value):
    with pytest.raises(ValueError, match=str(value)):
        VisibilityTraining(**{key: value})


def test_unknown_keys_are_refused():
    for type_ in ("uniform_lights", "power_lights", "tree_lights", "nvc_lights"):
        with pytest.raises(RuntimeError, match="outputz"):
            mi.load_dict({"type": type_, "outputz": 3})


@pytest.mark.parametrize("type_", ["plain_path", "nirc"])
@pytest.mark.parametrize("given", [{"type": "point"}, {"type": "diffuse"}, "nvc_lights"])
def test_what_is_no_light_sampler_is_refused(type_, given):
    with pytest.raises((ValueError, RuntimeError), match=f"{type_}: light_sampler is not a light sampler; nest one"):
        mi.load_dict({"type": type_, "light_sampler": given})


@pytest.mark.parametrize("type_", ["plain_path", "nirc", "restir_di"])
@pytest.mark.parametrize("name, said", [("", ""), (' name="lights"', ", not 'lights'")])
def test_a_light_sampler_by_another_name_is_refused_with_what_to_type(type_, name, said):
    text = f'<integrator version="3.0.0" type="{type_}"><emitter type="tree_lights"{name}/></integrator>'
    with pytest.raises((ValueError, RuntimeError)) as e:
        mi.load_string(text)
    assert (f"{type_}: the name of a nested light sampler is light_sampler{said}; type "
            '<emitter type="tree_lights" name="light_sampler"/>') in str(e.value)  # fmt: skip


def test_too_few_outputs_for_the_lights_are_refused_by_render():
    scene = shadow_scene()
    integrator = path_with({"type": "nvc_lights", "outputs": 2, "train_frames": 1})
    with pytest.raises(ValueError, match=r"nvc_lights: 2 lights are at infinity.*2 outputs; raise outputs"):
        integrator.render(scene, spp=1)
    integrator = path_with({"type": "nvc_lights", "outputs": 5, "clusters": "emitter"})
    with pytest.raises(ValueError, match=r"nvc_lights: there are 6 emitters.*5 outputs"):
        integrator.render(scene, spp=1)


def test_what_is_refused_once_is_refused_again():
    """Without a sampler the second image would choose lights as Mitsuba does, and not say so."""
    scene = shadow_scene()
    integrator = path_with({"type": "nvc_lights", "outputs": 2, "train_frames": 1})
    for _ in range(2):
        with pytest.raises(ValueError, match="raise outputs"):
            integrator.render(scene, spp=1)


@pytest.mark.parametrize("edited", [False, True])
def test_a_table_whose_making_was_interrupted_is_made_by_the_next_image(monkeypatch, edited):
    scene = shadow_scene()
    sampler = mi.load_dict({"type": "power_lights"})
    if edited:
        sampler.lights(scene, scene.sensors()[0])
        params = mi.traverse(scene)
        params["spark.intensity.value"] = mi.Color3f(7.0)
        params.update()

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules["mi_neural.emitters.common"], "LightTable", interrupted)
        with pytest.raises(KeyboardInterrupt):
            sampler.lights(scene, scene.sensors()[0])
    found = sampler.lights(scene, scene.sensors()[0])
    (spark,) = row(scene, found.table, "spark")
    assert found.table.columns["radiance"][spark, 0] == (7.0 if edited else 1.0)


def test_a_light_sampler_gives_no_light_where_it_stands_among_emitters():
    lit = {**many("two", None), "sampler": {"type": "power_lights"}}
    image = np.array(mi.load_dict({"type": "path", "max_depth": 2}).render(test_scene(lit, 8), spp=64))
    assert np.isfinite(image).all() and image.mean() > 0


def test_samplers_print_and_load_from_xml():
    for name in ("uniform_lights", "power_lights", "tree_lights", "nvc_lights"):
        text = (
            f'<integrator version="3.0.0" type="plain_path"><emitter type="{name}" name="light_sampler"/></integrator>'
        )
        integrator = mi.load_string(text)
        assert "Sampler" in str(integrator.light_sampler)
