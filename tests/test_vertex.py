"""One path vertex: MIS weights, emission and direct light, against Mitsuba's own."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from expectation import assert_same_mean, renders

from mi_neural.estimators.mis import mis_weight
from mi_neural.render import path as paths
from mi_neural.render import vertex
from mi_neural.render.sampling import PathSampler

LIGHTS = {
    "area": {
        "lamp": {
            "type": "rectangle", "emitter": {"type": "area", "radiance": 3.0},
            "to_world": mi.ScalarTransform4f().translate([0, 2, 0]).rotate([1, 0, 0], 90),
        }
    },
    "point": {"lamp": {"type": "point", "position": [1.0, 2.0, 1.0], "intensity": 5.0}},
    "directional": {"lamp": {"type": "directional", "direction": [-1.0, -2.0, -1.0], "irradiance": 2.0}},
    "constant": {"sky": {"type": "constant", "radiance": 0.7}},
}  # fmt: skip


def sky() -> dict:
    """A sky with a small bright spot."""
    pixels = np.full((8, 16, 3), 0.3, np.float32)
    pixels[2, 5] = [40, 30, 20]
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 30)}


def lights(name: str) -> dict:
    if name == "envmap":
        return {"sky": sky()}
    if name == "all":
        return {**LIGHTS["area"], "sky": sky(), "spark": LIGHTS["point"]["lamp"]}
    return LIGHTS[name]


def test_scene(lamp: dict, size: int = 16) -> mi.Scene:
    """A floor, a rough conductor, a plastic and a glass sphere, under `lamp`."""
    look_at = mi.ScalarTransform4f().look_at([0, 3, 5], [0, 0.5, 0], [0, 1, 0])
    metal = {"type": "roughconductor", "alpha": 0.2}
    return mi.load_dict({
        "type": "scene", **lamp,
        "sensor": {"type": "perspective", "fov": 60, "to_world": look_at,
                   "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(3)},
        "metal": {"type": "sphere", "center": [-1, 0.7, 0], "radius": 0.7, "bsdf": metal},
        "plastic": {"type": "sphere", "center": [1, 0.7, 0], "radius": 0.7, "bsdf": {"type": "plastic"}},
        "glass": {"type": "sphere", "center": [0, 0.4, 1.5], "radius": 0.4, "bsdf": {"type": "dielectric"}},
    })  # fmt: skip


test_scene.__test__ = False


class OneVertex(mi.SamplingIntegrator):
    """Emission, and direct light at the first vertex: with a BSDF ray, or by next-event estimation alone."""

    def __init__(self, props):
        super().__init__(props)
        self.alone = props.get("alone", False)

    hide, max_depth = False, 2

    def sample(self, scene, sampler, ray, medium=None, active=True):
        path = paths.camera_vertex(self, scene, ray, active)
        keys = {}
        if self.alone:
            keys = {"alone": lambda pdf: mi.Bool(True), "follow": lambda bs, delta: delta}
        found, _ = paths.bounce(scene, None, path, sampler, **keys)
        return path.L + found.direct, mi.Bool(True), []

    def to_string(self):
        return "OneVertex[]"


@pytest.fixture(autouse=True, scope="module")
def _registered():
    mi.register_integrator("one_vertex", lambda props: OneVertex(props))


def test_mis_weights_sum_to_one(rng):
    a, b = (mi.Float((10.0 ** rng.uniform(-6, 6, 256)).astype("f4")) for _ in range(2))
    found = np.array(mis_weight(a, b) + mis_weight(b, a))
    np.testing.assert_allclose(found, 1, rtol=1e-6)
    x, y = np.array(a), np.array(b)
    np.testing.assert_allclose(np.array(mis_weight(a, b)), x**2 / (x**2 + y**2), rtol=1e-5)


def test_mis_weight_of_what_cannot_be_sampled_is_zero_and_never_nan():
    found = np.array(mis_weight(mi.Float(0, 0, 1, 1e-30), mi.Float(0, 1, 0, 1e-30)))
    assert np.isfinite(found).all() and (found[:3] == [0, 0, 1]).all() and 0 <= found[3] <= 1


@pytest.mark.parametrize("pdf", [1e10, 1e18, 1e20, 1e30])
def test_mis_weight_of_a_very_large_density_is_one_and_of_its_rival_zero(pdf):
    assert mis_weight(mi.Float(pdf), mi.Float(1))[0] == 1
    assert mis_weight(mi.Float(1), mi.Float(pdf))[0] <= 1e-19


def test_only_finite_values_pass():
    value = mi.Color3f(mi.Float(1, float("nan"), 2, 3), mi.Float(1), mi.Float(1, 1, float("inf"), 3))
    found = np.array(vertex.finite(value, mi.Bool(True, True, True, False)))
    assert (found == [[1, 0, 0, 0]] * 3).all()


@pytest.mark.parametrize("name, alone", sweep(
    [(name, alone) for name in ("area", "point", "directional", "constant", "envmap", "all")
     for alone in (False, True)],
    [("point", False), ("envmap", True), ("all", False), ("all", True)],
))  # fmt: skip
def test_direct_light_is_that_of_path(name, alone):
    """24 images of each, 17 parts of them: a false alarm in 10,000 choices of seed."""
    scene = test_scene(lights(name))
    ours = renders(scene, {"type": "one_vertex", "alone": alone}, 24, 64)
    path = renders(scene, {"type": "path", "max_depth": 2}, 24, 64, first_seed=1000)
    assert_same_mean(ours, path, f"{name}, alone={alone}", relative=1e-5)


@pytest.mark.parametrize("depth", [1, 3, -1])
def test_plain_path_is_path(depth):
    scene = test_scene(lights("all"))
    ours = renders(scene, {"type": "plain_path", "max_depth": depth}, 24, 32)
    path = renders(scene, {"type": "path", "max_depth": depth}, 24, 32, first_seed=1000)
    assert_same_mean(ours, path, f"depth {depth}", relative=1e-5)


def test_plain_path_hides_emitters_as_path_does():
    scene = test_scene(lights("all"))
    ours, path = (renders(scene, {"type": t, "max_depth": 3, "hide_emitters": True}, 24, 32, k) for k, t in
                  enumerate(("plain_path", "path")))  # fmt: skip
    assert_same_mean(ours, path, "hidden", relative=1e-5)


def test_inactive_lanes_give_nothing():
    scene = test_scene(lights("all"))
    ray = mi.Ray3f(mi.Point3f(0, 3, 0) + dr.zeros(mi.Point3f, 4), mi.Vector3f(0, -1, 0))
    si = scene.ray_intersect(ray)
    off = mi.Bool(False)
    assert (np.array(vertex.emission(scene, si, off)) == 0).all()
    found, _ = paths.bounce(scene, None, paths.start(ray, si, off), PathSampler.make(dr.arange(mi.UInt32, 4), 0))
    for value in (found.L_nee, found.weight, found.Le):
        assert (np.array(value) == 0).all()
