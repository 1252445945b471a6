"""Parameters of any plugin can be read: those that Mitsuba cannot hand over are left out, and the plan says "unknown".

The materials and lights are all those of the installed Mitsuba that load without files, and some of a user's own whose
parameters are odd.
"""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_neural import integrators, parameters, plan
from mi_neural.bench.load import InputError
from mi_neural.bench.sequence import Sequence
from mi_neural.plan import SceneFacts
from mi_neural.registration import plugin_names

DIFFUSE = {"type": "diffuse"}
RAMP = np.linspace(0.05, 0.6, 64).reshape(8, 8, 1).repeat(3, 2).astype(np.float32)
#: What a plugin cannot do without.
NEEDED = {
    "blendbsdf": {"weight": 0.5, "first": DIFFUSE, "second": {"type": "hair"}},
    "bumpmap": {"texture": {"type": "checkerboard"}, "nested": DIFFUSE},
    "mask": {"nested": {"type": "hair"}},
    "normalmap": {"normalmap": {"type": "checkerboard"}, "nested": {"type": "roughplastic"}},
    "twosided": {"nested": {"type": "roughconductor", "alpha": {"type": "checkerboard"}}},
    "projector": {"irradiance": {"type": "checkerboard"}},
    "envmap": {"bitmap": RAMP},
}
#: Measured materials, whose files are not part of Mitsuba.
NEED_FILES = {"measured", "measured_polarized"}
ON_SHAPES = {"area", "directionalarea"}
ROUGH = {
    "pplastic": "alpha", "roughconductor": "alpha", "roughdielectric": "alpha", "principled": "roughness",
    "principledthin": "roughness",
}  # fmt: skip
TEXTURES = {
    "bitmap": lambda: {"type": "bitmap", "bitmap": mi.Bitmap(RAMP), "raw": True},
    "checkerboard": lambda: {"type": "checkerboard", "color0": 0.1, "color1": 0.4},
    "mesh_attribute": lambda: {"type": "mesh_attribute", "name": "vertex_alpha"},
    "volume": lambda: {"type": "volume", "volume": {"type": "constvolume", "value": 0.3}},
}


def plugins(kind: str) -> list[str]:
    """Names of the installed Mitsuba's own plugins of a kind."""
    manager = mi.PluginManager.instance()
    files = (Path(mi.__file__).parent / "plugins").glob("*.*")
    return sorted({f.stem for f in files if manager.plugin_type(f.stem) == getattr(mi.ObjectType, kind)})


def keys_of(name: str) -> dict:
    keys = {"type": name, **NEEDED.get(name, {})}
    return keys | ({"bitmap": mi.Bitmap(keys["bitmap"])} if "bitmap" in keys else {})


def ball(bsdf, **more):
    parts = {"ball": {"type": "sphere", "bsdf": bsdf}, "sky": {"type": "constant"}, **more}
    return mi.load_dict({"type": "scene", **{k: v for k, v in parts.items() if v is not None}})


def read(scene) -> SceneFacts:
    return SceneFacts.read(scene, None)


# ---------------------------------------------------------------- materials


@pytest.mark.parametrize("name", plugins("BSDF"))
def test_the_plan_reads_every_material_of_mitsuba(name):
    if name in NEED_FILES:
        pytest.skip("needs a file of measurements")
    facts = read(ball(keys_of(name)))
    assert sum(facts.surfaces.values()) == 1
    assert facts.unknown_roughness or facts.roughness or "glossy" not in facts.surfaces


@pytest.mark.parametrize("texture", TEXTURES)
@pytest.mark.parametrize("name", ROUGH)
def test_the_plan_reads_materials_of_textured_roughness(name, texture):
    """The values of a bitmap are known; those of another texture are not."""
    facts = read(ball({"type": name, ROUGH[name]: TEXTURES[texture]()}))
    assert facts.textures == 1
    if texture == "bitmap":  # raw: the values as they are
        low, high = (0.05, 0.6) if ROUGH[name] == "alpha" else (0.05**2, 0.6**2)
        assert facts.roughness == (pytest.approx(low), pytest.approx(high)) and facts.unknown_roughness == 0
    else:
        assert facts.roughness is None and facts.unknown_roughness == 1


def test_the_plan_names_what_is_known_of_roughness_and_what_is_not():
    parts = {"hair": {"type": "sphere", "bsdf": {"type": "hair"}},
             "brass": {"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": 0.25}}}  # fmt: skip
    facts = SceneFacts.read(mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **parts}), None)
    made = plan.of_integrator(facts, plan.Request("nrc", caches=("outgoing",)))
    assert made.decisions["roughness"].because == "glossy surfaces: 2, alpha 0.25 to 0.25, alpha unknown of 1"


@pytest.mark.parametrize("type_", ["nirc", "nrc", "nirc_two_level", "nvc_direct"])
@pytest.mark.parametrize("bsdf", ["hair", "roughconductor", "principled"])
def test_integrators_plan_for_textured_roughness_and_hair(type_, bsdf):
    scene = ball({"type": bsdf, **({ROUGH[bsdf]: TEXTURES["bitmap"]()} if bsdf in ROUGH else {})}, camera=CAMERA)
    integrator = mi.load_dict({"type": type_})
    if hasattr(integrator, "make_plan"):
        assert integrator.make_plan(scene).facts.smooth == 1
    else:
        assert integrator.light_sampler.make_plan(SceneFacts.read(scene, scene.sensors()[0])).facts.smooth == 1


def test_hair_has_unknown_roughness():
    facts = read(ball({"type": "hair"}))
    assert facts.surfaces == {"glossy": 1} and facts.roughness is None and facts.unknown_roughness == 1


def test_materials_in_instances_are_unknown():
    """`Instance.bsdf()` is a grey of its own, not what is in the group."""
    group = {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": {"type": "roughconductor", "alpha": 0.2}}}
    scene = mi.load_dict({"type": "scene", "group": group, "sky": {"type": "constant"},
                          "one": {"type": "instance", "group": {"type": "ref", "id": "group"}}})  # fmt: skip
    facts = read(scene)
    assert facts.surfaces == {"unknown": 1} and facts.smooth == 1 and not facts.alike


# ---------------------------------------------------------------- plugins of a user's own

#: Values that a Python plugin may name in `traverse`; ``params[key]`` raises for some.
ODD = {
    "alpha": None, "roughness": "rough", "alpha_u": [0.1, 0.2], "alpha_v": {"u": 1}, "to_world": object(),
    "noise": np.zeros(3), "phase": 1 + 2j, "empty": (), "level": float("nan"), "radiance": None,
}  # fmt: skip


def traverse_odd(self, callback):
    if self.fails:
        raise RuntimeError("cannot be traversed")
    for key, value in ODD.items():
        callback.put(key, value, mi.ParamFlags.Differentiable)
    callback.put("gain", mi.Float(0.5), mi.ParamFlags.Differentiable)


def unprintable(self):
    raise RuntimeError("cannot be printed")


@pytest.fixture(scope="module", autouse=True)
def odd_plugins():
    class Chalk(mi.BSDF):
        traverse, to_string = traverse_odd, unprintable

        def __init__(self, props):
            super().__init__(props)
            self.fails = props.get("fails", False)
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide]
            self.m_flags = self.m_components[0]

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = mi.BSDFSample3f(mi.warp.square_to_cosine_hemisphere(sample2))
            bs.pdf, bs.eta = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo), 1.0
            bs.sampled_type, bs.sampled_component = mi.UInt32(int(mi.BSDFFlags.GlossyReflection)), 0
            return bs, dr.select(active & (mi.Frame3f.cos_theta(si.wi) > 0), mi.Color3f(0.5), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            above = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            pdf = dr.select(above, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)
            return mi.Color3f(0.5) * pdf, pdf

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

    class Lantern(mi.Emitter):
        """A point light at the height 2."""

        traverse, to_string = traverse_odd, unprintable

        def __init__(self, props):
            super().__init__(props)
            self.fails = props.get("fails", False)
            self.m_flags = +mi.EmitterFlags.DeltaPosition
            self.m_needs_sample_3 = False

        def sample_direction(self, it, sample, active=True):
            ds = dr.zeros(mi.DirectionSample3f, dr.width(it.p))
            ds.p = mi.Point3f(0, 0, 2) + 0 * it.p
            to = ds.p - it.p
            ds.dist = dr.norm(to)
            ds.d, ds.pdf, ds.delta, ds.emitter = to / ds.dist, mi.Float(1), mi.Bool(True), mi.EmitterPtr(self)
            return ds, dr.select(active, mi.Color3f(3) / dr.square(ds.dist), 0)

        def eval(self, si, active=True):
            return mi.Color3f(0)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval_direction(self, it, ds, active=True):
            return dr.select(active, mi.Color3f(3) / dr.square(ds.dist), 0)

        def bbox(self):
            return mi.ScalarBoundingBox3f([0, 0, 2])

    mi.register_bsdf("odd_chalk", lambda props: Chalk(props))
    mi.register_emitter("odd_lantern", lambda props: Lantern(props))


@pytest.mark.parametrize("fails", [False, True])
def test_values_that_cannot_be_handed_over_are_left_out(fails):
    params = parameters.traverse(mi.load_dict({"type": "odd_chalk", "fails": fails}))
    found = dict(params.items())
    assert found == {} if fails else found["gain"] == 0.5 and "alpha" not in found


def test_edits_are_noticed_whatever_else_a_light_has():
    scene = ball({"type": "diffuse"}, lantern={"type": "odd_lantern"}, spark={"type": "point", "position": [1, 2, 3]})
    lights = [parameters.traverse(emitter) for emitter in scene.emitters()]
    edits = parameters.Edits([(params, key) for params in lights for key in params.keys()])
    assert [edits.changed() for _ in range(3)] == [True, False, False]
    spark = next(params for params in lights if "position" in params)
    spark["position"] = mi.Point3f(1, 2, 4)
    spark.update()
    assert [edits.changed() for _ in range(2)] == [True, False]
    spark["sampling_weight"] = 2.0
    spark.update()
    assert [edits.changed() for _ in range(2)] == [True, False]


def test_the_smallest_step_of_a_shape_is_noticed():
    scene = ball({"type": "diffuse"})
    params = parameters.traverse(scene.shapes()[0])
    edits = parameters.Edits([(params, "to_world")])
    assert [edits.changed() for _ in range(2)] == [True, False]
    params["to_world"] = params["to_world"] @ mi.Transform4f().translate([1e-7, 0, 0])
    params.update()
    assert [edits.changed() for _ in range(2)] == [True, False]


def test_what_has_no_value_cannot_be_changed_from_frame_to_frame():
    scene = ball({"type": "hair"}, camera=CAMERA)
    with pytest.raises(InputError, match=r"sigma_a: the scene has no such parameter; .*ball\.bsdf"):
        Sequence(scene, {"ball.bsdf.sigma_a": lambda frame, value: value}, 2)


@pytest.mark.parametrize("fails", [False, True])
def test_the_plan_reads_materials_of_a_user(fails):
    chalk = {"type": "odd_chalk", "fails": fails}
    for bsdf in (chalk, {"type": "twosided", "nested": chalk}):
        facts = read(ball(bsdf, lantern={"type": "odd_lantern", "fails": fails}))
        assert facts.surfaces == {"glossy": 1} and facts.roughness is None and facts.unknown_roughness == 1
        assert facts.emitters == {"environment": 1, "point": 1}


# ---------------------------------------------------------------- lights


SAMPLERS = {
    "uniform_lights": {}, "power_lights": {}, "tree_lights": {}, "nvc_lights": {"train_frames": 1, "train_samples": 16},
}  # fmt: skip
CAMERA = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}


def lit_by(name: str, **keys) -> mi.Scene:
    """A ball of odd material under a light of that type and another one."""
    light = keys_of(name) | keys
    if name in ON_SHAPES:
        light = {"type": "cylinder", "p0": [-1, 0, 2], "p1": [1, 0, 2], "radius": 0.1, "emitter": light}
    view = mi.ScalarTransform4f().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1])
    return ball({"type": "odd_chalk"}, sky=None, light=light, spark={"type": "point", "position": [1, 1, 3]},
                camera={**CAMERA, "to_world": view})  # fmt: skip


LIGHTS = [name for name in plugins("Emitter") if name not in SAMPLERS]
#: Of Mitsuba 3.9.1, which `path` cannot render either: "symbolic variables" in its own `sample_direction`.
NOT_RENDERED = {"timed_sunsky"}


@pytest.mark.parametrize("light", sorted(NOT_RENDERED))
def test_lights_that_fail_in_mitsuba_are_refused_by_every_integrator(light):
    scene = lit_by(light)
    for name in plugin_names(integrators):
        with pytest.raises(ValueError, match=f"^{name}: emitter 'light' is a {light}, .*; use <emitter type="):
            mi.load_dict({"type": name}).render(scene)


@pytest.mark.parametrize("light", [*LIGHTS, "odd_lantern"])
def test_all_lights_of_mitsuba_and_of_a_user_can_be_chosen_among(light):
    if light in NOT_RENDERED:
        assert SceneFacts.read(lit_by(light), None).environment
        pytest.skip("not rendered by `path` either")
    for name, keys in SAMPLERS.items():
        scene, sampler = lit_by(light), mi.load_dict({"type": name, **keys})
        for _ in range(2):  # and the table need not be made anew
            chosen, table = sampler.lights(scene, scene.sensors()[0]), sampler.sampler.table
            assert chosen is not None and all(np.isfinite(v).all() for v in table.columns.values())
        assert sampler.lights(scene, scene.sensors()[0]).table is table
