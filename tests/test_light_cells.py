"""Lights chosen from a table of cells, which `nvc_lights` makes in participating media."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import SLOW, sweep
from expectation import assert_same_mean, renders
from light_scenes import mixed_lights
from media_scenes import cube, everywhere, fog, rgb, room
from test_light_choice import assert_frequencies, draws, pmf_of_all

from mi_neural.lights import cells
from mi_neural.lights.cells import CellLights
from mi_neural.lights.clusters import make_groups
from mi_neural.lights.sampling import VisibleLights

BOX = ([-4, -4, 0], [4, 4, 4])
#: On the floor, in the air, far outside of the box.
PLACES = [((0.3, 0.2, 0.01), (0, 0, 1)), ((-1, 1, 2), (0.6, 0, -0.8)), ((30, -20, 9), (0, 1, 0))]


@pytest.fixture(scope="module")
def chooser():
    _, table = mixed_lights()
    lights = VisibleLights(table, make_groups(table, 256))
    found = CellLights(lights, BOX)
    found.learn(lights, 3)
    return found, lights


@pytest.mark.parametrize("place", range(len(PLACES)))
def test_probabilities_are_those_of_what_is_drawn_and_none_is_zero(chooser, place):
    found, _ = chooser
    p, n = PLACES[place]
    pmf = pmf_of_all(found, p, n)
    assert pmf.sum() == pytest.approx(1, abs=1e-5)
    assert (pmf >= 0.99 * cells.EQUAL / len(pmf)).all()
    index, weight, chosen, _ = draws(found, p, n)
    np.testing.assert_allclose(chosen, pmf[index.astype(int)], rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(weight * chosen, 1, rtol=1e-5)
    assert_frequencies(np.bincount(index.astype(int), minlength=len(pmf)), pmf, str(p))


def test_probabilities_are_near_those_of_the_weights(chooser):
    """In the middle of the air, for points of a medium, up to what all lights have in equal shares."""
    found, lights = chooser
    si = dr.zeros(mi.Interaction3f, found.table.n_lights)
    si.p = mi.Point3f(0.25, 0.25, 1.25)
    index = dr.arange(mi.UInt32, found.table.n_lights)
    keys = mi.Vector3f(0), mi.Bool(False), index, mi.Bool(True)
    table, exact = (np.array(v.pmf(si, *keys, around=mi.Bool(True)), np.float64) for v in (found, lights))
    expected = (1 - cells.EQUAL) * exact + cells.EQUAL / len(exact)
    assert np.abs(table - expected).sum() < 0.2, "total variation"


def test_table_is_made_anew_after_some_steps(chooser):
    _, lights = chooser
    found, seeds = CellLights(lights, BOX), []
    found.learn = lambda lights, seed: seeds.append(seed)
    for steps in (8, 8, 9, 8 + cells.EVERY, 9 + cells.EVERY, 4):
        found.follow(lights, steps, steps)
    assert seeds == [8, 8 + cells.EVERY, 4], "the last one after a reset"


def of(scene, **keys):
    integrator = mi.load_dict({"type": "plain_path", "light_sampler": {"type": "nvc_lights", "train_frames": 4,
                                                                       "train_samples": 256, **keys}})  # fmt: skip
    mi.render(scene, integrator=integrator, spp=1)
    return integrator


def test_where_the_table_is_used():
    """In media, where each light has an output of its own; never without media."""
    foggy, clear = everywhere(fog(0.4)), room()
    assert isinstance(of(foggy).lights, CellLights)
    assert isinstance(of(foggy, in_media="network").lights, VisibleLights)
    assert isinstance(of(foggy, visibility=False).lights, VisibleLights)
    assert isinstance(of(clear).lights, VisibleLights)
    ball = {"type": "sphere", "radius": 0.1, "center": [0, 0.6, 0], "emitter": {"type": "area", "radiance": 1.0}}
    assert isinstance(of(everywhere(fog(0.4), third=ball), outputs=2).lights, VisibleLights)
    with pytest.raises(RuntimeError, match="in_media is 'tree'"):
        of(foggy, in_media="tree")


def test_lights_that_change_are_seen():
    scene = everywhere(fog(0.4))
    integrator = of(scene)
    table = integrator.lights.table
    params = mi.traverse(scene)
    params["left.emitter.radiance.value"] = mi.Color3f(0.0)
    params.update()
    mi.render(scene, integrator=integrator, spp=1)
    assert integrator.lights.table is not table
    integrator.reset()
    mi.render(scene, integrator=integrator, spp=1)
    assert isinstance(integrator.lights, CellLights)


@pytest.mark.parametrize("name, how", sweep(
    [(name, how) for name in ("camera inside", "colours") for how in ("cells", "network")],
    [("colours", "network")],
))  # fmt: skip
def test_image_is_that_of_volpath(name, how):
    make, reference = {"camera inside": (lambda: everywhere(fog(0.4, 0.8)), "volpath"),
                       "colours": (lambda: room(box=cube(fog((0.5, 2.0, 4.0), (0.9, 0.6, 0.8)))), "volpathmis")}[name]
    scene = make()
    known = renders(scene, {"type": reference, "max_depth": 8}, 16, 128, first_seed=500)
    sampler = {"type": "nvc_lights", "train_frames": 8, "train_samples": 256, "in_media": how}
    ours = renders(scene, {"type": "plain_path", "max_depth": 8, "light_sampler": sampler}, 16, 128)
    assert_same_mean(ours, known, f"{name}, {how}", blocks=2, relative=1e-4, tests=4)


def many_lamps(n: int) -> mi.Scene:
    """A room of fog with so many lamps, most of them behind plates."""
    T, rng, parts = mi.ScalarTransform4f, np.random.default_rng(1), {}
    for k, at in enumerate(rng.uniform(-0.9, 0.9, (n, 3))):
        parts[f"lamp{k}"] = {"type": "sphere", "center": at.tolist(), "radius": 0.01,
                             "emitter": {"type": "area", "radiance": rgb(*rng.uniform(1, 20, 3))}}  # fmt: skip
    for k in range(6):
        parts[f"plate{k}"] = {"type": "rectangle", "to_world": T().translate([0, 0, -0.9 + 0.3 * k]).scale(0.8),
                              "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}  # fmt: skip
    return everywhere(fog(0.5), **parts)


@pytest.mark.parametrize("n", [30, pytest.param(1000, marks=SLOW)])
def test_many_hidden_lamps_in_fog_are_finite(n):
    """Where lamps touch plates, and lie in one another."""
    scene = many_lamps(n)
    integrator = mi.load_dict({"type": "plain_path", "max_depth": 16, "light_sampler": {
        "type": "nvc_lights", "train_frames": 16, "train_samples": 512}})  # fmt: skip
    image = np.array(mi.render(scene, integrator=integrator, spp=64))
    assert np.isfinite(image).all() and image.mean() > 0
    assert integrator.statistics()["nonfinite"] == 0
