"""Direct light by learned visibility: `sampled` is unbiased, `neural` is what its parts promise, NRC-DI learns."""

import importlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import SLOW, sweep
from expectation import assert_same_mean, renders
from test_vertex import lights, test_scene

from mi_neural.lights.table import LightTable
from mi_neural.lights.unshadowed import UnshadowedLights

test_scene.__test__ = False
T = mi.ScalarTransform4f
LAMP = {"type": "area", "radiance": {"type": "rgb", "value": [3.0, 2.0, 1.0]}}
FORMS = {
    "rectangle": {"type": "rectangle", "emitter": LAMP,
                  "to_world": T().translate([0.3, 1.5, 0.2]).rotate([1, 0.2, 0], 80).scale(0.6)},
    "disk": {"type": "disk", "emitter": LAMP,
             "to_world": T().translate([0.3, 1.5, 0.2]).rotate([1, 0.2, 0], 80).scale(0.6)},
    "sphere": {"type": "sphere", "center": [0.3, 1.2, -0.4], "radius": 0.5, "emitter": LAMP},
    "cylinder": {"type": "cylinder", "p0": [-0.5, 1, 0], "p1": [0.5, 1.3, 0], "radius": 0.1, "emitter": LAMP},
    "point": {"type": "point", "position": [0.3, 1.5, 0.2], "intensity": 3.0},
    "spot": {"type": "spot", "to_world": T().look_at([0.3, 1.5, 0.2], [0, 0, 0], [0, 0, 1]), "intensity": 3.0},
    "directional": {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 3.0},
    "constant": {"type": "constant", "radiance": 0.7},
}  # fmt: skip
COLOUR = {"type": "rgb", "value": [0.8, 0.5, 0.2]}
MATERIALS = {
    "diffuse": {"type": "diffuse", "reflectance": COLOUR},
    "twosided": {"type": "twosided", "inside": {"type": "diffuse", "reflectance": COLOUR}},
    "plastic": {"type": "plastic", "diffuse_reflectance": COLOUR},
    "roughplastic": {"type": "roughplastic", "alpha": 0.2, "distribution": "ggx", "diffuse_reflectance": COLOUR},
    "gold": {"type": "twosided",
             "inside": {"type": "roughconductor", "material": "Au", "alpha": 0.3, "distribution": "ggx"}},
    "beckmann": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "principled": {"type": "principled", "roughness": 0.4, "base_color": COLOUR},
}  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def _registered():
    importlib.import_module("mi_neural.integrators.nvc_direct")


def floor_scene(material: dict, **more) -> mi.Scene:
    """A floor seen from above, 16 x 16 pixels."""
    return mi.load_dict({
        "type": "scene", **more,
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(3), "bsdf": material},
        "sensor": {"type": "perspective", "fov": 30,
                   "to_world": T().look_at([0, 3, 3], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}},
    })  # fmt: skip


def direct(**keys):
    return mi.load_dict({"type": "nvc_direct", **keys})


def nvc(**keys) -> dict:
    return {"type": "nvc_lights", "train_samples": 1024, **keys}


def image(scene, integrator, spp: int = 16, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), np.float64)


# ---------------------------------------------------------------- unshadowed light


def unshadowed_and_monte_carlo(material: dict, lamp: dict, n: int = 256, m: int = 1024):
    """What `UnshadowedLights` says of n points seen from random directions, and the mean of m samples of each light."""
    scene = floor_scene(material, lamp=lamp)
    table = LightTable(scene)
    rng = np.random.default_rng(1)
    p = np.stack([rng.uniform(-1.5, 1.5, n), np.zeros(n), rng.uniform(-1.5, 1.5, n)])
    cos, phi = rng.uniform(0.2, 1, n), rng.uniform(0, 2 * np.pi, n)
    d = np.stack([np.sqrt(1 - cos**2) * np.cos(phi), cos, np.sqrt(1 - cos**2) * np.sin(phi)])
    o, d = (p + 0.01 * d).astype("f4"), (-d).astype("f4")
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    visible = [mi.Float(1)] * table.n_lights
    ours = UnshadowedLights(scene, table).total(scene, si, si.bsdf(), visible, si.is_valid())

    each = dr.repeat(dr.arange(mi.UInt32, n), m)
    ray = mi.Ray3f(dr.gather(mi.Point3f, mi.Point3f(o), each), dr.gather(mi.Vector3f, mi.Vector3f(d), each))
    si = scene.ray_intersect(ray)
    rng = mi.PCG32(n * m)
    total = np.zeros((3, n))
    for k in range(table.n_lights):
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        ds, weight, pdf = table.sample(scene, si, mi.UInt32(k) + dr.zeros(mi.UInt32, n * m), u, mi.Bool(True))
        f = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d), pdf > 0)
        value = dr.select(pdf > 0, f * weight, 0) + dr.zeros(mi.Color3f, n * m)
        total += np.stack([np.array(dr.block_sum(c, m)) / m for c in value])
    return np.array(ours, np.float64), total


@pytest.mark.parametrize("material, form, mean, each", sweep([
    # Bounds on the error of the sum, and on the mean error over the mean; 1 % (sky: 3 %) is the noise of the reference
    *[("diffuse", form, 0.01, 0.02) for form in ("rectangle", "disk", "sphere")], ("diffuse", "constant", 0.01, 0.04),
    ("diffuse", "cylinder", 0.03, 0.1),
    *[(material, form, 1e-4, 1e-4) for form in ("point", "spot", "directional") for material in ("diffuse", "gold")],
    ("twosided", "rectangle", 0.01, 0.02), ("plastic", "rectangle", 0.02, 0.03), ("plastic", "constant", 0.02, 0.05),
    ("roughplastic", "rectangle", 0.1, 0.1), ("roughplastic", "constant", 0.05, 0.07),
    ("gold", "rectangle", 0.05, 0.18), ("gold", "sphere", 0.05, 0.18), ("gold", "constant", 0.03, 0.07),
    ("beckmann", "rectangle", 0.1, 0.4), ("principled", "rectangle", 0.03, 0.05),
], [("diffuse", "disk", 0.01, 0.02), ("diffuse", "sphere", 0.01, 0.02), ("diffuse", "cylinder", 0.03, 0.1),
    ("gold", "point", 1e-4, 1e-4), ("diffuse", "spot", 1e-4, 1e-4), ("gold", "directional", 1e-4, 1e-4),
    ("twosided", "rectangle", 0.01, 0.02), ("plastic", "constant", 0.02, 0.05), ("roughplastic", "rectangle", 0.1, 0.1),
    ("gold", "rectangle", 0.05, 0.18), ("beckmann", "rectangle", 0.1, 0.4),
    ("principled", "rectangle", 0.03, 0.05)]))  # fmt: skip
def test_unshadowed_light_is_that_of_monte_carlo(material, form, mean, each):
    ours, reference = unshadowed_and_monte_carlo(MATERIALS[material], FORMS[form])
    total, error = abs(ours.sum() / reference.sum() - 1), np.abs(ours - reference).mean() / reference.mean()
    print(f"{material} under {form}: sum off by {total:.1e}, mean error {error:.1e} of the mean")
    assert total <= mean and error <= each


# ---------------------------------------------------------------- sampled


@pytest.fixture(scope="module")
def many_lights():
    """A scene of several lights and materials, and 24 images of it by `path`."""
    scene = test_scene(lights("all"))
    return scene, renders(scene, {"type": "path", "max_depth": 2}, 24, 32, first_seed=1000)


@pytest.mark.parametrize("keys", [
    {"light_sampler": nvc()}, {"light_sampler": nvc(freeze=True), "light_samples": 2},
    {"light_sampler": nvc(outputs=2)},
    pytest.param({"light_sampler": nvc(outputs=2), "light_samples": 1}, marks=SLOW),
    {"light_sampler": {"type": "tree_lights"}}, pytest.param({"light_sampler": {"type": "uniform_lights"}}, marks=SLOW),
], ids=["trained", "untrained, two shadow rays", "clusters", "clusters, one shadow ray", "tree_lights",
        "uniform_lights"])  # fmt: skip
def test_sampled_has_the_mean_of_path(many_lights, keys):
    scene, path = many_lights
    assert_same_mean(renders(scene, direct(max_depth=2, **keys), 16, 32), path, str(keys), relative=1e-5)


def test_several_shadow_rays_of_one_light_have_the_mean_of_path():
    """Without a light sampler, the scene itself gives the light samples."""
    scene = test_scene(lights("area"))
    ours, path = (renders(scene, {"type": t, "max_depth": 2}, 16, 32, k) for k, t in enumerate(("nvc_direct", "path")))
    assert_same_mean(ours, path, "one light", relative=1e-5)


def test_noise_falls_with_shadow_rays_of_one_camera_ray(many_lights):
    """They share the camera ray, what is known of its surface, and the BSDF ray. Lamps are out of sight, or their edges
    would be what is noisy."""
    keys = {"max_depth": 2, "hide_emitters": True, "light_sampler": {"type": "uniform_lights"}}
    noise = [renders(many_lights[0], direct(light_samples=n, **keys), 8, 4).var(axis=0).mean() for n in (1, 8)]
    print(f"variance with 1 shadow ray {noise[0]:.3g}, with 8 {noise[1]:.3g}")
    assert noise[1] < 0.5 * noise[0]


@pytest.mark.parametrize("keys", [{}, {"light_samples": 1}, {"cache": "radiance", "train_frames": 2}])
def test_holes_cover_their_pixels_as_in_path(keys):
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    scene = mi.load_dict({
        "type": "scene", "sensor": {"type": "perspective", "to_world": T().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                                    "film": film},
        "holes": {"type": "rectangle", "to_world": T().scale(3),
                  "bsdf": {"type": "mask", "opacity": 0.3, "bsdf": {"type": "diffuse"}}},
        "lamp": FORMS["point"], "second": {"type": "point", "position": [0, 0, 3], "intensity": 1.0},
    })  # fmt: skip
    alpha = np.array(mi.load_dict({"type": "nvc_direct", **keys}).render(scene, spp=256))[..., 3]
    path = np.array(mi.load_dict({"type": "path", "max_depth": 2}).render(scene, spp=256))[..., 3]
    print(f"alpha {alpha.mean():.3f}, path {path.mean():.3f}")
    assert abs(alpha.mean() - 0.3) < 0.03 and abs(path.mean() - 0.3) < 0.03  # 4 standard errors of 4,096 samples


def test_preparing_keeps_a_radiance_cache():
    scene = test_scene(lights("all"))
    integrator = mi.load_dict({"type": "nvc_direct", "cache": "radiance", "train_frames": 8, "train_samples": 256,
                               "light_sampler": {"type": "uniform_lights"}})  # fmt: skip
    integrator.prepare(scene)
    assert integrator.statistics()["direct_steps"] == 0
    integrator.render(scene, spp=1)
    integrator.prepare(scene)
    facts = integrator.statistics()
    assert facts["direct_steps"] >= 8 and 0 < facts["seconds_direct"] <= facts["seconds_train"]


def test_hides_emitters_as_path_does():
    scene = test_scene(lights("area"))
    ours, path = (renders(scene, {"type": t, "max_depth": 2, "hide_emitters": True}, 16, 32, k)
                  for k, t in enumerate(("nvc_direct", "path")))  # fmt: skip
    assert_same_mean(ours, path, "hidden", relative=1e-5)


@pytest.mark.parametrize("mode", ["sampled", "neural"])
def test_mirrors_are_followed(mode):
    """Camera, mirror, floor, point light: three segments. There is nothing else to see."""
    mirror = {"type": "rectangle", "to_world": T().translate([0, 1, -3]).scale(4), "bsdf": {"type": "conductor"}}
    scene = mi.load_dict({
        "type": "scene", "mirror": mirror, "lamp": FORMS["point"],
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(9)},
        "sensor": {"type": "perspective", "fov": 20, "to_world": T().look_at([0, 2, 1], [0, 1, -3], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}},
    })  # fmt: skip
    path = image(scene, mi.load_dict({"type": "path", "max_depth": 3}), 64)
    ours = direct(mode=mode)
    if mode == "neural":
        all_visible(ours, scene)
    assert path.mean() > 0.01
    np.testing.assert_allclose(image(scene, ours, 64).mean(), path.mean(), rtol=0.02)
    assert image(scene, direct(max_depth=2), 4).max() == 0


# ---------------------------------------------------------------- neural


def all_visible(integrator, scene) -> None:
    """Replace what the network of `integrator` says of `scene` by 1."""
    integrator.light_sampler.freeze = True
    integrator.bind(scene, scene.sensors()[0])
    field = integrator.lights.field
    field.query = lambda x: [mi.Float(1)] * field.shape.n_outputs


@pytest.mark.parametrize("forms, material, tolerance", sweep(
    [(forms, *case) for forms in (["rectangle"], ["rectangle", "sphere", "disk", "point"])
     for case in (("diffuse", 0.01), ("plastic", 0.02), ("gold", 0.06))],
    [(["rectangle"], "diffuse", 0.01), (["rectangle", "sphere", "disk", "point"], "plastic", 0.02),
     (["rectangle", "sphere", "disk", "point"], "gold", 0.06)],
))  # fmt: skip
def test_neural_with_all_visible_is_path_where_nothing_casts_shadows(material, tolerance, forms):
    """Four lights at different places, out of the camera's sight."""
    lamps = {f: {**FORMS[f]} for f in forms}
    if len(forms) > 1:
        lamps["sphere"]["center"], lamps["point"]["position"] = [-2.0, 1.2, 0], [2, 1.5, 1]
        lamps["disk"]["to_world"] = T().translate([1.5, 1.2, -1.5]).rotate([1, 0, 0], 90).scale(0.3)
    scene = floor_scene(MATERIALS[material], **lamps)
    ours = direct(mode="neural", max_depth=2)
    all_visible(ours, scene)
    a, b = image(scene, ours, 64), image(scene, mi.load_dict({"type": "path", "max_depth": 2}), 2048)
    seen = np.abs(image(scene, mi.load_dict({"type": "path", "max_depth": 1}), 64)).sum(axis=-1) == 0
    print(f"{material}: {a[seen].mean():.4g} and {b[seen].mean():.4g}")
    np.testing.assert_allclose(a[seen].mean(), b[seen].mean(), rtol=tolerance)
    if material == "diffuse" and len(forms) == 1:
        assert np.abs(a - b)[seen].max() < 0.05 * b[seen].max()


def shadowed(**more) -> mi.Scene:
    """A floor, a ball over it, two lamps."""
    lamps = {"a": {**FORMS["rectangle"], "to_world": T().translate([-1, 2, 0]).rotate([1, 0, 0], 90).scale(0.2)},
             "b": {**FORMS["rectangle"], "to_world": T().translate([1, 2, 0]).rotate([1, 0, 0], 90).scale(0.2)}}
    ball = {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.4}
    return floor_scene({"type": "diffuse"}, ball=ball, **lamps, **more)


def test_trained_neural_is_near_path():
    """Mean error 5 % of the mean, where no shadows at all would be 11 %; hardly noisier than the pixels' edges."""
    scene = shadowed()
    path = image(scene, mi.load_dict({"type": "path", "max_depth": 2}), 1024)
    ours = direct(mode="neural", light_sampler=nvc(train_samples=2048, train_frames=120))
    errors = [np.abs(image(scene, ours, 64, k) - path).mean() / path.mean() for k in range(2)]
    assert ours.statistics()["visibility_steps"] == 121, "an image trains as the keys of the light sampler say"
    all_visible(ours, scene)
    without = np.abs(image(scene, ours, 64) - path).mean() / path.mean()
    print(f"error {errors[-1]:.3f} of the mean, without shadows {without:.3f}")
    assert errors[-1] < min(0.05, 0.5 * without)


def test_neural_follows_a_change_of_lights_and_of_scene():
    scene, ours = shadowed(), direct(mode="neural", light_sampler=nvc())
    before = image(scene, ours).mean()
    params = mi.traverse(scene)
    for k in ("a", "b"):
        params[f"{k}.emitter.radiance.value"] *= 2
    params.update()
    np.testing.assert_allclose(image(scene, ours).mean(), 2 * before, rtol=0.05)
    single = floor_scene({"type": "diffuse"}, lamp=FORMS["point"])
    assert image(single, ours).mean() > 0
    assert ours.statistics()["lights"] == 1


# ---------------------------------------------------------------- NRC-DI


def test_radiance_cache_learns_an_evenly_lit_floor():
    """Under a sky of radiance 0.7 a floor of albedo (0.8, 0.5, 0.2) has 0.7 times that."""
    scene = floor_scene(MATERIALS["diffuse"], lamp=FORMS["constant"])
    ours = direct(cache="radiance", train_frames=60, train_samples=1024)
    found = image(scene, ours, 4)
    np.testing.assert_allclose(found.mean(axis=(0, 1)), [0.56, 0.35, 0.14], rtol=0.01)
    assert found.std(axis=(0, 1)).max() < 0.03
    assert ours.statistics()["direct_steps"] == 60
    frozen = direct(cache="radiance", freeze_cache=True)
    assert np.isfinite(image(scene, frozen, 1)).all() and frozen.statistics()["direct_steps"] == 0


# ---------------------------------------------------------------- channels and errors


@pytest.mark.parametrize("mode", ["sampled", "neural"])
def test_channels(mode):
    scene = shadowed()
    ours = direct(mode=mode, channels="visibility, light, pmf", light=1, light_sampler=nvc())
    found = image(scene, ours, 1)
    assert found.shape[-1] == 6 and ours.aov_names() == ["visibility", "light", "pmf"]
    visibility, light, pmf = found[..., 3], found[..., 4], found[..., 5]
    assert ((0 <= visibility) & (visibility <= 1)).all() and visibility.max() > 0.3
    assert set(np.unique(light)) <= {-1, 0, 1}
    assert ((pmf > 0) == (light >= 0)).all() and pmf.max() <= 1 and (light >= 0).mean() > 0.5


@pytest.mark.parametrize("keys, message", [
    ({"mode": "nonsense"}, "mode is 'nonsense'; give one of: sampled, neural"),
    ({"cache": "nonsense"}, "cache is 'nonsense'"),
    ({"light_samples": 0}, "light_samples is 0"),
    ({"max_depth": -2}, "max_depth is -2"),
    ({"seed": -1}, "seed is -1"),
    ({"light": -1}, "light is -1"),
    ({"train_samples": 3}, "train_samples is 3"),
    ({"channels": "direct"}, "unknown channel 'direct'; it has: visibility, light, pmf"),
    ({"light_sampler": {"type": "point"}}, "light_sampler is not a light sampler"),
], ids=lambda v: next(iter(v)) if isinstance(v, dict) else None)  # fmt: skip
def test_bad_keys_are_one_error(keys, message):
    with pytest.raises(Exception, match=message):
        direct(**keys)


@pytest.mark.parametrize("keys, message", [
    ({"mode": "neural", "light_sampler": nvc(outputs=2)},
     "3 lights for 2 outputs; use mode=\"sampled\", or raise outputs"),
    ({"mode": "neural", "light_sampler": {"type": "uniform_lights"}}, "needs an nvc_lights"),
    ({"channels": "visibility", "light_sampler": {"type": "uniform_lights"}}, "needs an nvc_lights"),
    ({"channels": "visibility", "light": 3}, r"light is 3; the scene has lights 0\.\.2"),
], ids=["outputs", "sampler", "channel", "light"])  # fmt: skip
def test_what_a_scene_cannot_do_is_one_error(keys, message):
    scene = shadowed(c={**FORMS["point"]})
    with pytest.raises(ValueError, match=message):
        direct(**keys).render(scene, spp=1)


def test_every_light_is_summed_and_clustered_lights_can_be_sampled():
    """Six lamps for two outputs: `sampled` works with clusters."""
    lamps = {f"lamp{k}": {"type": "point", "position": [k - 2.5, 1, 0], "intensity": 1.0} for k in range(6)}
    scene = floor_scene({"type": "diffuse"}, **lamps)
    path = image(scene, mi.load_dict({"type": "path", "max_depth": 2}), 256).mean()
    np.testing.assert_allclose(image(scene, direct(light_sampler=nvc(outputs=2)), 256).mean(), path, rtol=0.02)
    ours = direct(mode="neural")
    all_visible(ours, scene)
    np.testing.assert_allclose(image(scene, ours, 64).mean(), path, rtol=0.02)
