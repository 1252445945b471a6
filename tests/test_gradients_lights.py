"""Gradients where a light sampler chooses the lights: against Mitsuba's ``prb``, which chooses them by itself."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import SLOW, sweep
from gradient_scenes import T, adjoint_image, agree, colour, enable, room, spread_of, tracked, train, wall
from light_scenes import at, glow, picture
from test_gradients import warnings as warnings  # a fixture

SAMPLERS = ("uniform_lights", "power_lights", "tree_lights", "nvc_lights")
LAMP_KEYS = ("radiance.value", "radiance.data", "intensity.value", "irradiance.value", "sky.data", "reflectance.value")


def lamps(sky=True):
    """A room with one lamp of each kind, each with another colour, in front of an environment map."""
    pixels = np.random.default_rng(2).uniform(0, 1, (4, 8, 3)).astype(np.float32)
    screen = np.random.default_rng(3).uniform(0, 4, (2, 2, 3)).astype(np.float32)
    grey = colour(0.4, 0.4, 0.4)  # by default lamps are black, where prb has half of the derivative
    more = {
        "ball": {"type": "sphere", "center": [0.6, 0.5, 0], "radius": 0.12, "bsdf": grey,
                 "emitter": glow(8.0)},
        "plate": {"type": "disk", "to_world": at(-0.6, 0.6, 0).rotate([1, 0, 0], 90).scale(0.2), "bsdf": grey,
                  "emitter": glow(6.0)},
        "tube": {"type": "cylinder", "p0": [-0.8, -0.8, -0.6], "p1": [-0.8, 0.4, -0.6], "radius": 0.05,
                 "bsdf": grey, "emitter": glow(3.0)},
        "torch": {"type": "spot", "to_world": T().look_at([0.2, 0.8, 0.8], [0, -1, 0], [1, 0, 0]), "intensity": 2.0,
                  "cutoff_angle": 40.0},
        "sun": {"type": "directional", "direction": [0.1, -0.4, -1.0], "irradiance": 0.5},
        "screen": wall([0, 0, -0.98], [0, 1, 0], 0, colour(0.1, 0.1, 0.1), 0.3,
                       emitter=glow(picture(screen))),
        "box": {"type": "cube", "to_world": at(-0.3, -0.9, 0.3).scale(0.08), "bsdf": grey,
                "emitter": glow(3.0)},
    }  # fmt: skip
    if sky:
        more["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(pixels)}
    return room(width=8, **more)


_TRUE = {}


def by_prb(scene, params, keys, depth=24):
    """Gradients by ``prb`` and their errors, computed once for each list of keys: a BSDF that several shapes share has
    the name of one or another of them, from load to load."""
    if (of := (*keys, depth)) not in _TRUE:
        _TRUE[of] = spread_of(scene, params, keys, mi.load_dict({"type": "prb", "max_depth": depth}), 2048)
    return _TRUE[of]


def by_autodiff(scene, params, keys, integrator, grad, spp, seed):
    """The same by ``mi.render``, for integrators that are differentiated as they are."""
    given = enable(params, keys)
    image = mi.render(scene, params, integrator=integrator, spp=spp, seed=seed)
    dr.backward(dr.sum(image * grad, axis=None))
    return np.concatenate([np.array(dr.grad(v), np.float64).ravel() for v in given])


@pytest.mark.parametrize("sampler, depth", [("power_lights", 3), *(pytest.param(s, 24, marks=SLOW) for s in SAMPLERS)])
def test_plain_path_differentiates_what_lamps_of_all_kinds_send(sampler, depth):
    scene = lamps()
    params, keys = tracked(scene, LAMP_KEYS)
    assert len([k for k in keys if "reflectance" not in k]) >= 10, keys
    theirs = by_prb(scene, params, keys, depth)
    integrator = mi.load_dict({"type": "plain_path", "max_depth": depth, "light_sampler": {"type": sampler}})
    grad = adjoint_image(scene)
    runs = np.array([by_autodiff(scene, params, keys, integrator, grad, 512, 3 + s) for s in range(6)])
    ours = runs.mean(0), runs.std(0, ddof=1) / len(runs) ** 0.5
    agree_by_key(params, keys, sampler, ours, theirs, 0.03)


def agree_by_key(params, keys, name, ours, theirs, allowed):
    """`agree` for all parameters together, and for each lamp by itself."""
    agree(name, ours, theirs, allowed)
    start = 0
    for k in keys:
        end = start + int(np.prod(np.array(params[k]).shape))
        part = slice(start, end)
        noise = np.sum(ours[1][part] ** 2 + theirs[1][part] ** 2) ** 0.5
        off, norm = np.linalg.norm(ours[0][part] - theirs[0][part]), np.linalg.norm(theirs[0][part])
        print(f"  {k}: off by {off / norm:.1%}, noise {noise / norm:.1%}")
        assert off < allowed * norm + 4 * noise, k
        start = end


@pytest.mark.parametrize("name, sampler", sweep(
    [(n, s) for n in ("nrc", "nirc", "neural_path") for s in SAMPLERS], [("nrc", "nvc_lights")]
))  # fmt: skip
def test_cached_gradients_choose_lights_by_the_sampler(name, sampler, warnings):
    scene = lamps()
    params, keys = tracked(scene, LAMP_KEYS)
    integrator = train(scene, name, light_sampler={"type": sampler})
    ours = spread_of(scene, params, keys, integrator, 512)
    agree_by_key(params, keys, f"{name}, {sampler}", ours, by_prb(scene, params, keys), 0.05)
    assert not [w for w in warnings if "as Mitsuba does" in w]


def test_lamps_that_move_and_black_ones_are_named_once(warnings):
    scene = room(width=4, dark={"type": "point", "position": [0, 0.5, 0.5], "intensity": 0.0})
    params, keys = tracked(scene, ("dark.intensity.value",))
    integrator = mi.load_dict({"type": "plain_path", "max_depth": 3, "light_sampler": {"type": "power_lights"}})
    cached = train(scene, "nrc", train_frames=8, light_sampler={"type": "power_lights"})
    for which in (integrator, integrator, cached, cached):
        dr.backward(dr.mean(mi.render(scene, params, integrator=which, spp=1), axis=None))
    assert len([w for w in warnings if "1 lamps without extent are black" in w]) == 2
    dr.disable_grad(params[keys[0]])

    scene = room(width=4, shine={"type": "cube", "to_world": at(0, 0, 0).scale(0.1), "emitter": glow(3.0)})
    params = mi.traverse(scene)
    dr.enable_grad(params["shine.vertex_positions"])
    params.update()
    for _ in range(2):
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
    assert len([w for w in warnings if "of their shapes are wanted: shine.vertex_positions" in w]) == 1


def test_predicted_direct_light_has_no_gradient():
    scene = room(width=4)
    params, _ = tracked(scene)
    integrator = mi.load_dict({"type": "plain_path", "neural_depth": 0, "light_sampler": {"type": "nvc_lights"}})
    image = mi.render(scene, params, integrator=integrator, spp=1)
    with pytest.raises(RuntimeError, match="leave neural_depth out"):
        dr.backward(dr.mean(image, axis=None))
