"""What a scene needs: facts, decisions with reasons, keys that have the last word, and that what is left out is not
built, at no cost in error."""

import json

import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_same_mean, renders
from light_scenes import MIXED, scene_of
from load_study import load_study
from test_cli import run
from test_incident import load

from mi_neural import plan, scenes
from mi_neural.caches.blend import Blend
from mi_neural.caches.field import CacheFileError
from mi_neural.light_noise import LightNoise, light_noise
from mi_neural.plan import Request, SceneFacts

INCIDENT, OUTGOING = ("incident",), ("outgoing",)
#: A cache that is trained in a second.
SMALL = {"train_samples": 256, "train_frames": 4, "train_steps": 0, "levels": 4, "hashmap_size": 1024, "width": 16}


def facts(lights=1, environment=False, **surfaces) -> SceneFacts:
    emitters = {"area": lights, **({"environment": 1} if environment else {})}
    return SceneFacts(emitters, 0, lights, surfaces or {"lambertian": 4}, 0, None, (64, 64), 2.0, 1, False)


def of_shipped(name: str) -> SceneFacts:
    scene = mi.load_file(str(scenes.path(name)))
    return SceneFacts.read(scene, scene.sensors()[0])


def planned(given_facts, plugin="nirc", caches=INCIDENT, **request):
    return plan.of_integrator(given_facts, Request(plugin, caches=caches, **request))


def sampler(n: int, environment=False, mode="scene", **given):
    return plan.of_sampler(facts(n, environment), Request("nvc_lights", mode, given))


# ---------------------------------------------------------------- facts


def test_facts_of_shipped_scenes():
    box, hall, bays = (of_shipped(n) for n in ("cornell_box", "glossy_hall", "lamp_bays"))
    assert (box.lights, box.emitters, box.alike, box.environment) == (1, {"area": 1}, True, False)
    assert hall.lights == 10 and hall.emitters == {"area": 8, "environment": 1, "directional": 1}
    assert not hall.alike and hall.surfaces["mirror"] == 2 and hall.roughness[0] == pytest.approx(0.05)
    assert bays.lights == 32 and bays.film == (320, 180) and not bays.media


def test_facts_of_all_kinds_of_lights():
    found = SceneFacts.read(scene_of(MIXED, "envmap"), None)
    assert found.emitters == {"area": 5, "point": 2, "directional": 1, "environment": 1}
    assert found.triangles == 12 + 2 and found.lights == 8 + 12  # the box by its triangles, the window as one
    assert found.film is None


@pytest.mark.parametrize("bsdf, kind", [
    ({"type": "diffuse"}, "lambertian"), ({"type": "twosided", "nested": {"type": "diffuse"}}, "lambertian"),
    ({"type": "roughconductor", "alpha": 0.2}, "glossy"), ({"type": "conductor"}, "mirror"),
    ({"type": "plastic"}, "mixed"), ({"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}}, "mixed"),
])  # fmt: skip
def test_surfaces_are_told_apart(bsdf, kind):
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": bsdf}, "sky": {"type": "constant"}})
    found = SceneFacts.read(scene, None)
    assert found.surfaces == {kind: 1} and found.roughness == ((pytest.approx(0.2),) * 2 if kind == "glossy" else None)


# ---------------------------------------------------------------- decisions


def test_lights_are_chosen_by_what_is_left_of_the_noise():
    def chosen(n, *noise):
        return planned(facts(n), look=lambda: LightNoise(*noise)).decisions["light_sampler"]

    assert chosen(8, 9.0, 9.0, 0.1).value == "nvc_lights"
    assert chosen(8, 9.0, 2.0, 1.0).value == "power_lights"
    assert not chosen(8, 1.0, 9.0, 0.5).modelled and "1 chosen uniformly" in chosen(8, 1.0, 9.0, 0.5).because
    assert not planned(facts(1), look=pytest.fail).modelled("light_sampler")  # not looked at


@pytest.mark.parametrize("n, outputs, clustered", [(2, 2, False), (32, 32, False), (33, 32, True)])
def test_outputs_follow_the_lights_and_clusters_come_beyond(n, outputs, clustered):
    made = sampler(n)
    assert made["visibility"] == outputs and made.modelled("clusters") == clustered
    assert sampler(n, outputs=64)["visibility"] == n and not sampler(n, outputs=64).modelled("clusters")


def test_environment_needs_an_environment_and_a_key():
    assert not sampler(4, False, environment_cells=16).modelled("environment_cells")
    assert not sampler(4, True).modelled("environment_cells")
    assert sampler(4, True, environment_cells=16)["environment_cells"] == 16
    assert sampler(1, True, environment_cells=16).modelled("light_sampler")
    assert not sampler(1, False, environment_cells=16).modelled("light_sampler")


def test_inputs_of_the_network_follow_the_surfaces():
    def told(**surfaces):
        made = planned(facts(**surfaces), "nrc", OUTGOING)
        return {name for name in plan.INPUTS if made[name]}

    assert told(lambertian=3, mirror=2) == {"normal"}
    assert told(lambertian=3, mixed=1) == {"normal", "view", "albedo"}
    assert told(glossy=1) == set(plan.INPUTS)
    assert not any(name in planned(facts(glossy=1)).decisions for name in plan.INPUTS)  # incident: none of them


@pytest.mark.parametrize("depth, surfaces, built", [(2, {"lambertian": 1}, False), (3, {"lambertian": 1}, True),
                                                    (-1, {"mirror": 3}, False)])  # fmt: skip
def test_cache_is_left_out_where_nothing_can_ask_it(depth, surfaces, built):
    made = planned(facts(**surfaces), max_depth=depth)
    assert made.modelled("cache") == built
    assert ("reliability" in made.decisions) == built


@pytest.mark.parametrize("blend, built", [("ema", False), ("fast", False), ("reliability", True), ("switch", True)])
def test_reliability_is_kept_where_weights_are_blended(blend, built):
    assert planned(facts(), blend=blend).modelled("reliability") == built


def test_everything_is_everything_there_is():
    made = planned(facts(glossy=1), "nrc", OUTGOING, mode="everything", blend="reliability")
    made.decisions |= sampler(1, True, "everything").decisions
    assert [part for part in made.decisions if not made.modelled(part)] == ["clusters"]


def test_keys_have_the_last_word_and_are_shown():
    keys = {"light_sampler": "power_lights", "levels": 5, "view": False, "light_samples": 3}
    made = planned(facts(4, glossy=1), "nrc", OUTGOING, given=keys, sizes={"levels": 8}, look=pytest.fail)
    assert {part: made[part] for part in keys} == keys
    assert all(made.decisions[part].given for part in keys) and str(made).count("(given)") == len(keys)
    assert json.loads(json.dumps(made.to_json()))["decisions"]["levels"] == {
        "value": 5, "modelled": True, "because": "else 8", "given": True}  # fmt: skip


@pytest.mark.parametrize("noise, n", [(0.001, 1), (0.03, 2), (0.5, 4)])
def test_samples_of_direct_light_follow_its_noise(noise, n):
    assert plan.light_samples(noise).value == n


# ---------------------------------------------------------------- what choosing lights is worth


def boxes(n_hidden: int, environment=False):
    """A closed box with a lamp in it, seen from inside; beside it boxes with a lamp like it, which no one sees."""
    parts = {}
    for k in range(n_hidden + 1):
        place = mi.ScalarTransform4f().translate([10 * k, 0, 0])
        parts[f"walls{k}"] = {"type": "cube", "to_world": place.scale(2), "flip_normals": True}
        parts[f"lamp{k}"] = {"type": "sphere", "center": [10 * k, 0, 0], "radius": 0.1,
                             "emitter": {"type": "area", "radiance": 1.0}}  # fmt: skip
    if environment:
        parts["sky"] = {"type": "constant", "radiance": 1.0}
    view = mi.ScalarTransform4f().look_at([0, -1.5, 0], [0, 1, 0.1], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    return mi.load_dict({"type": "scene", "camera": {"type": "perspective", "to_world": view, "film": film}, **parts})


@pytest.mark.parametrize("n_hidden, environment", [(1, False), (3, False), (1, True)])
def test_noise_of_a_choice_is_known_where_one_light_is_seen(n_hidden, environment):
    """All but one of n lights give nothing: a uniform choice has the relative variance n - 1, as far as points are not
    much darker than most (the fixed seed's points: within 5 %). By visibility less than the floor's share of it."""
    scene = boxes(n_hidden, environment)
    noise = light_noise(scene, scene.sensors()[0], n_points=512)
    n = n_hidden + 1 + environment
    assert noise.uniform == pytest.approx(n - 1, rel=0.05)
    if not environment:  # lamps alike, so the same by power; a bright sky behind the walls is another matter
        assert noise.power == pytest.approx(n - 1, rel=0.05)
        assert noise.visibility < 0.06 * (n - 1)


def test_forty_suns_are_looked_at_though_the_network_cannot_have_them():
    """They are not clustered; an integrator that chooses by itself does without learned visibility there."""
    suns = {f"sun{k}": {"type": "directional", "direction": [np.cos(k), np.sin(k), -1]} for k in range(40)}
    scene = scene_of(suns)
    camera = mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, -4, 4], [0, 0, 0],
                                                                                            [0, 0, 1])})  # fmt: skip
    noise = light_noise(scene, camera, n_points=64)
    assert np.isinf(noise.visibility) and noise.uniform < 0.5
    assert not planned(facts(40), look=lambda: noise).modelled("light_sampler")


# ---------------------------------------------------------------- what is built


@pytest.fixture(scope="module")
def cube():
    return load("lit_cube", 8)[0]


def parts_of(scene, **keys):
    """An integrator that has met the scene, and the plan it says."""
    integrator = mi.load_dict({**SMALL, **keys})
    integrator.train(scene, 1)
    return integrator, integrator.statistics()["plan"]["decisions"]


@pytest.fixture(scope="module")
def sphere():
    return load("point_lit_sphere", 8)[0]


@pytest.mark.parametrize("type_", ["nirc", "nrc"])
def test_what_is_left_out_is_not_built_and_everything_is(sphere, type_):
    spare, said = parts_of(sphere, type=type_)
    rich, all_said = parts_of(sphere, type=type_, plan="everything")
    assert spare.light_sampler is None and spare.state.lights is None and spare.cache.queried is spare.cache.field
    assert "visibility_steps" not in spare.statistics() and not said["reliability"]["modelled"]
    assert rich.light_sampler.plugin == "nvc_lights" and rich.statistics()["visibility_steps"] > 0
    assert isinstance(rich.cache.queried, Blend) and rich.cache.queried.grid is not None
    assert all_said["visibility"]["value"] == 1 and all_said["reliability"]["modelled"]
    assert "plan = ScenePlan" in str(spare) and "nothing" not in str(rich)
    if type_ == "nrc":
        assert spare.cache.field.shape.inputs == ("normal",) and rich.cache.field.shape.inputs == plan.INPUTS
        assert spare.cache.field.shape.n_inputs < rich.cache.field.shape.n_inputs


def test_a_scene_of_mirrors_has_no_cache_and_the_same_image():
    """Nothing can be asked there: `nirc` is a path tracer without training."""
    ball = {"type": "sphere", "bsdf": {"type": "conductor"}}
    view = mi.ScalarTransform4f().look_at([0, -4, 0], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8}
    scene = mi.load_dict({"type": "scene", "ball": ball, "sky": {"type": "constant"},
                          "camera": {"type": "perspective", "to_world": view, "film": film}})  # fmt: skip
    integrator, said = parts_of(scene, type="nirc")
    assert not said["cache"]["modelled"] and integrator.cache.field is None and integrator.statistics()["steps"] == 0
    images = [renders(scene, i, 8, 4) for i in (integrator, {"type": "path"})]
    assert_same_mean(*images, "mirrors", blocks=2, relative=1e-5)


def test_lights_are_chosen_by_the_plan_of_each_scene(sphere):
    """By visibility where one of two lamps is hidden, by nothing in a scene of one."""
    two = boxes(3)
    integrator, said = parts_of(two, type="nirc", max_depth=3)
    assert said["light_sampler"]["value"] == "nvc_lights" == integrator.light_sampler.plugin
    assert integrator.statistics()["visibility_steps"] > 0
    integrator.train(sphere, 1)
    assert integrator.light_sampler is None and integrator.state.lights is None
    assert integrator.state.plan.facts.lights == 1
    own = {"type": "nirc", "max_depth": 3, "light_sampler": {"type": "uniform_lights"}}
    assert parts_of(two, **own)[1]["light_sampler"] | {"because": ""} == {
        "value": "uniform_lights", "modelled": True, "because": "", "given": True}  # fmt: skip


def test_lights_that_the_plan_chose_leave_no_trace_of_preparing():
    integrator = mi.load_dict({"type": "nirc", **SMALL})
    integrator.prepare(boxes(3), spp=1)
    assert integrator.light_sampler.plugin == "nvc_lights" and not integrator.statistics()["visibility_steps"]


def test_cache_files_keep_what_their_network_is_told(cube, tmp_path):
    rich = parts_of(cube, type="nrc", plan="everything", blend="ema", light_sampler={"type": "uniform_lights"})[0]
    rich.save_cache(tmp_path / "all.npz")
    for knows in (True, False):  # the scene
        spare = mi.load_dict({"type": "nrc", **SMALL, "light_sampler": {"type": "uniform_lights"}})
        spare.load_cache(tmp_path / "all.npz", cube if knows else None)
        image = np.array(spare.render(cube, spp=1))
        assert np.isfinite(image).all() and spare.cache.field.shape.inputs == plan.INPUTS
    spare = mi.load_dict({"type": "nrc", **{**SMALL, "levels": 5}})
    with pytest.raises(CacheFileError, match="same sizes"):
        spare.load_cache(tmp_path / "all.npz")


@pytest.mark.parametrize("type_, keys, message", [
    ("nirc", {"plan": "all"}, "plan is 'all'; give one of: scene, everything"),
    ("nrc", {"inputs": "normal, colour"}, "inputs is 'normal, colour'; give a list of: normal, view"),
    ("nirc", {"light_sampler": {"type": "nvc_lights", "plan": "no"}}, "plan is 'no'"),
])  # fmt: skip
def test_what_is_no_plan_is_refused(type_, keys, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        mi.load_dict({"type": type_, **keys})


def test_inputs_can_be_given(cube):
    integrator, said = parts_of(cube, type="nrc", inputs="normal, roughness")
    assert integrator.cache.field.shape.inputs == ("normal", "roughness")
    assert said["roughness"] == {"value": True, "modelled": True, "given": True,
                                 "because": "else left out: all 6 surfaces are Lambertian"}  # fmt: skip


# ---------------------------------------------------------------- errors


def learned_error(integrator, scene) -> float:
    """Squared error of an outgoing cache at the first surface of a scene whose pixels are all 1."""
    return float(np.mean((np.array(integrator.render(scene, spp=16, seed=1)) - 1) ** 2))


@pytest.mark.slow
def test_inputs_that_are_left_out_do_not_raise_the_error():
    """The point-lit sphere is Lambertian: over four seeds the network that is told the normal alone is no worse than
    one that is told all (their standard deviations allow for a tenth)."""
    scene = load("point_lit_sphere", 32)[0]
    errors = {}
    for told in ("plan", "normal, view, albedo, roughness"):
        found = []
        for seed in range(4):
            nrc = mi.load_dict({"type": "nrc", "inputs": told, "spread_threshold": 0.0, "train_samples": 1024,
                                "train_frames": 150, "train_steps": 0, "seed": seed})  # fmt: skip
            found.append(learned_error(nrc, scene))
        errors[told] = np.mean(found), np.std(found, ddof=1) / 2
    (spare, spread), (rich, other) = errors.values()
    print(f"squared error {spare:.2e} ± {spread:.1e} told the normal, {rich:.2e} ± {other:.1e} told everything")
    assert spare <= rich + 2 * np.hypot(spread, other)


@pytest.mark.slow
@pytest.mark.parametrize("name, type_", [("cornell_box", "nirc"), ("cornell_box", "nrc"), ("ajar_door", "nirc")])
def test_planned_is_faster_than_everything_and_no_worse(name, type_, tmp_path):
    """In a scene of one light: by the ablation's own measure, at half of what it finds there."""
    from mi_neural.bench import load
    from mi_neural.bench.specs import parse_integrator

    ablation = load_study("ablation")

    loaded = load.load_scene(name, (64, 64))
    reference = ablation.reference_of(loaded, tmp_path, 512, None)
    found = ablation.measure(loaded, parse_integrator(type_), reference, frames=80, repeats=3, spp=8, images=2)
    print(found.line())
    assert found.faster.mean > 1.1 and "light_sampler" in found.left_out
    assert all(d.mean - d.half <= 0 for d in found.higher.values())


# ---------------------------------------------------------------- command


def test_command_says_the_plan_in_words_and_as_json():
    text = run("plan", "cornell_box", "-i", "nrc:levels=6").stdout
    assert "light_sampler" in text and "left out" in text and "modelled: 6 (given)" in text
    found = json.loads(run("plan", "cornell_box", "--json", "--size", "32x16").stdout)
    assert found["facts"]["film"] == [32, 16] and found["decisions"]["light_sampler"]["modelled"] is False
    assert "models nothing" in run("plan", "cornell_box", "-i", "path", code=2).stderr
