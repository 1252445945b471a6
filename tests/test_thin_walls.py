"""The two sides of a wall without thickness are one place: caches must tell them apart all the same."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

SIZE = 48
HOUSING = 0.12


def spotlight():
    """A dim room with a spotlight whose housing, open below, is seen from outside: thousands of times darker than
    within. Its walls have no thickness."""
    T = mi.ScalarTransform4f
    grey = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 0.2}}
    bulb = {"type": "area", "radiance": {"type": "rgb", "value": 2e4}}
    sides = {"top": ([1, 0, 0], -90), "left": ([0, 1, 0], -90), "right": ([0, 1, 0], 90), "back": ([0, 1, 0], 180),
             "front": ([0, 1, 0], 0)}  # fmt: skip
    housing = {
        f"housing_{name}": {
            "type": "rectangle", "bsdf": grey,
            "to_world": T().translate([0.3, 0.3, -0.8]).rotate(axis, angle).translate([0, 0, HOUSING]).scale(HOUSING),
        }
        for name, (axis, angle) in sides.items()
    }  # fmt: skip
    return mi.load_dict({
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 40.0, "to_world": T().look_at([0, 0.5, 2.2], [0, 0.1, -1], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent"},
        },
        "room": {"type": "cube", "bsdf": grey, "to_world": T().scale([1, 1, 2.5])},
        "lamp": {"type": "rectangle", "emitter": lamp, "bsdf": grey,
                 "to_world": T().translate([0, 0.99, 0]).rotate([1, 0, 0], 90).scale(0.5)},
        "bulb": {"type": "rectangle", "emitter": bulb, "bsdf": grey,
                 "to_world": T().translate([0.3, 0.38, -0.8]).rotate([1, 0, 0], 90).scale(0.02)},
        **housing,
    })  # fmt: skip


def of_the_housing(scene) -> np.ndarray:
    """Mask of the pixels whose centre shows the housing."""
    lane = dr.arange(mi.UInt32, SIZE * SIZE)
    centre = mi.Point2f(mi.Float(lane % SIZE) + 0.5, mi.Float(lane // SIZE) + 0.5) / SIZE
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, centre, 0.5)
    p = scene.ray_intersect(ray).p
    inside = dr.max(dr.abs(p - mi.Point3f(0.3, 0.3, -0.8))) < HOUSING * 1.001
    return np.array(inside).reshape(SIZE, SIZE)


@pytest.fixture(scope="module")
def spot():
    """The scene, which pixels show the housing, and what `path` shows there."""
    scene = spotlight()
    seen = of_the_housing(scene)
    assert seen.sum() > 30
    right = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 64}), spp=256))
    return scene, seen, right[seen]


@pytest.mark.parametrize("settings", [
    {"type": "nirc", "termination": "primary", "train_frames": 900, "train_samples": 2048},
    pytest.param({"type": "nirc", "termination": "primary", "blend": "fast", "train_frames": 300},
                 marks=pytest.mark.slow),
    {"type": "nrc", "spread_threshold": 0.0, "train_frames": 150},
], ids=["nirc", "blend", "nrc"])  # fmt: skip
def test_light_inside_a_housing_of_no_thickness_stays_there(settings, spot):
    """What the cache shows of the outside, against path tracing of 256 samples a pixel (its noise in the mean over the
    housing: below 5 %). Looked up on the surface itself, the ratio is 38 with `nirc` and 11 with `nrc`; two cells above
    it 1.6, 1.3 and 1.9. `nirc` needs time: it has up to 3.8 after 300 frames, 1.1 or 2.5 after 600 and 1.1 or 1.7 after
    900 (the same seed in several processes); looked up on the surface still 30 after 600."""
    scene, seen, right = spot
    shown = np.array(mi.render(scene, integrator=mi.load_dict({"train_steps": 0, **settings}), spp=16))[seen]
    assert 0.5 < shown.mean() / right.mean() < 3
