"""`plain_path` in participating media: the image of Mitsuba's `volpath`, or of `volpathmis` where colours differ."""

import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_same_mean, renders
from media_scenes import ball, cube, everywhere, fog, lamp, rgb, room, smoke

GLASS = {"type": "dielectric", "int_ior": 1.5}
HALF_OPEN = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
#: Largest side of what the room's camera sees; extinctions are in its inverse.
SIZE = 3.0

#: (scene, the integrator that shows the right image).
SCENES = {
    "homogeneous": (lambda: room(box=cube(fog(2.0, 0.8, g=0.5))), "volpath"),
    "heterogeneous": (lambda: room(box=cube(smoke())), "volpath"),
    "beside each other": (lambda: room(a=cube(smoke(), at=(0, 0, 0)), b=ball(fog(3.0), radius=0.3, at=(0.9, -0.5, 0.2))),
                          "volpath"),
    "boundary of index 1": (lambda: room(box=cube(fog(), {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0})),
                            "volpath"),
    "in glass": (lambda: room(ball=ball(fog(2.0, 0.9), GLASS), sky={"type": "constant", "radiance": 0.3}), "volpath"),
    "in rough glass": (lambda: room(ball=ball(fog(2.0, 0.9), {"type": "roughdielectric", "alpha": 0.3})), "volpath"),
    "colours": (lambda: room(box=cube(fog((0.5, 2.0, 4.0), (0.9, 0.6, 0.8)))), "volpathmis"),
    "coloured smoke": (lambda: room(box=cube(smoke(albedo=(0.9, 0.6, 0.3)))), "volpath"),
    "camera inside": (lambda: everywhere(fog(0.4, 0.8)), "volpath"),
    "camera in colours": (lambda: everywhere(fog((0.1, 0.3, 0.6), 0.8, g=0.3)), "volpathmis"),
    "nested": (lambda: everywhere(fog(0.3), inner=ball(fog(3.0, 0.9), exterior={"type": "ref", "id": "air"})), "volpath"),
    "albedo 1": (lambda: room(box=cube(fog(3.0, 1.0))), "volpath"),
    "albedo 0": (lambda: room(box=cube(fog(2.0, 0.0))), "volpath"),
    "thin": (lambda: room(box=cube(fog(1e-4 / SIZE, 0.8))), "volpath"),
    "thick": (lambda: room(box=cube(fog(1e4 / SIZE, 0.8))), "volpath"),
    "half open shell": (lambda: room(box=cube(fog(2.0), HALF_OPEN)), "volpath"),
    "things in it": (lambda: everywhere(fog(0.4), block={"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3)},
                                        lamp=lamp((0, 0.5, 0), rgb(2.0, 3.0, 1.0), 0.1)), "volpath"),
    "sky": (lambda: room(box=cube(fog(2.0, 0.8, g=-0.3)), sky={"type": "constant", "radiance": rgb(0.2, 0.3, 0.5)},
                         sun={"type": "directional", "direction": [0.3, -1, -0.4], "irradiance": rgb(2.0, 1.5, 1.0)}),
            "volpath"),
    "points": (lambda: room(box=cube(fog(2.0)), a={"type": "point", "position": [0.8, 0.8, 0.5], "intensity": 0.4},
                            b={"type": "spot", "intensity": 3.0, "cutoff_angle": 30,
                               "to_world": mi.ScalarTransform4f().look_at([-1, 0.5, 0], [0, 0, 0], [0, 1, 0])}),
               "volpath"),
}  # fmt: skip
SAMPLERS = {
    "uniform": {"type": "uniform_lights"}, "power": {"type": "power_lights"},
    "nvc": {"type": "nvc_lights", "train_frames": 8, "train_samples": 256},
    "clusters": {"type": "nvc_lights", "train_frames": 8, "train_samples": 256, "outputs": 2},
    "cells": {"type": "nvc_lights", "train_frames": 2, "train_samples": 256, "environment_cells": 4},
    "unlearned": {"type": "nvc_lights", "visibility": False},
}  # fmt: skip
CHOSEN = [("homogeneous", "uniform"), ("homogeneous", "power"), ("camera inside", "uniform"), ("camera inside", "nvc"),
          ("colours", "nvc"), ("things in it", "clusters"), ("sky", "cells"), ("heterogeneous", "nvc"),
          ("half open shell", "nvc"), ("half open shell", "power"), ("points", "unlearned")]  # fmt: skip
#: Comparisons of this file with a reference; together they fail by chance one choice of seeds in ten thousand.
N_TESTS = len(SCENES) + len(CHOSEN)
DEPTH = {"max_depth": 8}


def compare(name: str, scene, reference: str, keys: dict, spp: int = 256, **depth) -> None:
    depth = depth or DEPTH
    known = renders(scene, {"type": reference, **depth}, 16, spp, first_seed=500)
    ours = renders(scene, {"type": "plain_path", **depth, **keys}, 16, spp)
    assert_same_mean(ours, known, name, blocks=2, relative=1e-4, tests=N_TESTS)


@pytest.mark.parametrize("name", SCENES)
def test_image_is_that_of_volpath(name):
    make, reference = SCENES[name]
    compare(name, make(), reference, {})


@pytest.mark.parametrize("name, sampler", CHOSEN)
def test_image_by_a_light_sampler_is_that_of_volpath(name, sampler):
    make, reference = SCENES[name]
    compare(f"{name}, {sampler}", make(), reference, {"light_sampler": SAMPLERS[sampler]})
