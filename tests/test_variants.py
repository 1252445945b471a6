"""`plain_path` with light samplers in mono and spectral variants: the image of Mitsuba's `path` there."""

import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from expectation import assert_same_mean, renders

SAMPLERS = {
    "none": {}, "uniform": {"light_sampler": {"type": "uniform_lights"}},
    "power": {"light_sampler": {"type": "power_lights"}}, "tree": {"light_sampler": {"type": "tree_lights"}},
    "nvc": {"light_sampler": {"type": "nvc_lights", "train_frames": 8, "train_samples": 256}},
    "cells": {"light_sampler": {"type": "nvc_lights", "train_frames": 2, "train_samples": 256, "environment_cells": 4}},
}  # fmt: skip
VARIANTS = ("llvm_ad_mono", "llvm_ad_spectral")
#: Comparisons of this file; together they fail by chance one choice of seeds in ten thousand.
N_TESTS = len(VARIANTS) * len(SAMPLERS)


def colour(*v):
    return {"type": "rgb", "value": list(v)}


def room() -> mi.Scene:
    """Coloured surfaces and lamps of every kind that the light table treats in a way of its own."""
    T = mi.ScalarTransform4f
    picture = {"type": "bitmap", "filter_type": "nearest",
               "bitmap": mi.Bitmap(np.linspace(0.1, 1, 12, dtype=np.float32).reshape(2, 2, 3))}  # fmt: skip

    def lamp(kind, at, size, radiance, **keys):
        place = T().translate(at).rotate([1, 0, 0], 90).scale(size)
        return {"type": kind, "to_world": place, "emitter": {"type": "area", "radiance": radiance}, **keys}

    return mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 50, "to_world": T().look_at([0, 0, 3.5], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}},
        "floor": {"type": "rectangle", "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(2),
                  "bsdf": {"type": "diffuse", "reflectance": colour(0.7, 0.4, 0.2)}},
        "back": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(2),
                 "bsdf": {"type": "roughconductor", "alpha": 0.3}},
        "panel": lamp("rectangle", [0.5, 1, 0], 0.3, colour(3, 2, 1)),
        "picture": lamp("rectangle", [-0.5, 1, 0], 0.3, picture),
        "disk": lamp("disk", [0, 1, 0.5], 0.2, colour(1, 2, 4)),
        "ball": lamp("sphere", [0.7, -0.3, 0], 0.15, colour(2, 1, 1)),
        "tube": lamp("cylinder", [-0.7, -0.3, 0], 0.15, colour(1, 2, 1)),
        "point": {"type": "point", "position": [0, 0.5, 1], "intensity": colour(0.3, 0.2, 0.5)},
        "sky": {"type": "constant", "radiance": colour(0.1, 0.2, 0.3)},
    })  # fmt: skip


@pytest.mark.parametrize("variant, name", sweep(
    [(variant, name) for variant in VARIANTS for name in SAMPLERS],
    [("llvm_ad_mono", name) for name in ("none", "power", "cells")] +
    [("llvm_ad_spectral", name) for name in ("none", "tree")],
))  # fmt: skip
def test_image_is_that_of_path(variant, name):
    mi.set_variant(variant)
    scene = room()
    known = renders(scene, {"type": "path", "max_depth": 4}, 16, 64, first_seed=500)
    ours = renders(scene, {"type": "plain_path", "max_depth": 4, **SAMPLERS[name]}, 16, 64)
    assert_same_mean(ours, known, f"{variant}, {name}", blocks=2, relative=1e-4, tests=N_TESTS)


@pytest.mark.parametrize("variant", VARIANTS)
def test_colours_are_those_of_path(variant):
    mi.set_variant(variant)
    scene = room()
    known, ours = (renders(scene, {"type": kind, "max_depth": 3}, 4, 512).mean(axis=(0, 1, 2))
                   for kind in ("path", "plain_path"))  # fmt: skip
    print(known, ours)
    np.testing.assert_allclose(ours, known, rtol=0.03)


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_holds_rgb_says_what_works(variant):
    mi.set_variant(variant)
    with pytest.raises(RuntimeError, match="RGB radiance; plain_path with any light sampler works"):
        mi.load_dict({"type": "scene", "integrator": {"type": "nirc"}})
    sampler = {"type": "nvc_lights"}
    with pytest.raises(RuntimeError, match="neural_depth works in RGB variants alone"):
        mi.load_dict({"type": "plain_path", "neural_depth": 0, "light_sampler": sampler})


def test_films_with_spectral_bands_are_those_of_path(run_python):
    """In a process of its own: in Mitsuba 3.9.1 nothing can be frozen while a ``specfilm`` exists."""
    run_python("""
import mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_spectral")
T = mi.ScalarTransform4f
view = {"type": "perspective", "fov": 50, "to_world": T().look_at([0, 0, 3.5], [0, 0, 0], [0, 1, 0])}
bands = {f"band_{b}": {"type": "spectrum", "value": [(b - 60, 0.0), (b, 1.0), (b + 60, 0.0)]} for b in (450, 550, 650)}
film = {"width": 8, "height": 8, "rfilter": {"type": "box"}}
red = {"type": "rgb", "value": [0.7, 0.4, 0.2]}
scene = mi.load_dict({
    "type": "scene", "wide": {**view, "film": {"type": "hdrfilm", **film}},
    "bands": {**view, "film": {"type": "specfilm", **film, **bands}},
    "floor": {"type": "rectangle", "to_world": T().translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(2),
              "bsdf": {"type": "diffuse", "reflectance": red}},
    "ball": {"type": "sphere", "radius": 0.3, "emitter": {"type": "area", "radiance": 2.0}},
    "point": {"type": "point", "position": [0, 0.9, 1], "intensity": 1.0},
})
def mean(integrator, sensor, seed):
    return np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=4096, seed=seed)).mean(axis=(0, 1))
path = mi.load_dict({"type": "path", "max_depth": 3})
known = [mean(path, k, 7) for k in range(2)]
for keys in ({}, {"light_sampler": {"type": "tree_lights"}},
             {"light_sampler": {"type": "nvc_lights", "train_frames": 2, "train_samples": 64}}):
    ours = mi.load_dict({"type": "plain_path", "max_depth": 3, **keys})
    for k in (0, 1, 0, 1):
        np.testing.assert_allclose(mean(ours, k, 3), known[k], rtol=0.05)

# Another scene of the process, without such a film: it is rendered, and the film remains whole
with_bands, scene = scene, mi.load_dict({
    "type": "scene", "view": {**view, "film": {"type": "hdrfilm", **film}},
    "ball": {"type": "sphere", "radius": 0.8, "emitter": {"type": "area", "radiance": 2.0}},
})
np.testing.assert_allclose(mean(ours, 0, 3), mean(path, 0, 7), rtol=0.05)
np.testing.assert_allclose(mean(mi.load_dict({"type": "plain_path"}), 0, 3), mean(path, 0, 7), rtol=0.05)
scene = with_bands
np.testing.assert_allclose(mean(path, 1, 7), known[1], rtol=1e-4)
""", quick=True)
