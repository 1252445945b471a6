"""Rooms whose derivatives are tested, gradients of images of them, and what these are compared with."""

import drjit as dr
import mitsuba as mi
import numpy as np
from cheap import NETWORK

T = mi.ScalarTransform4f
SMALL = {"train_frames": 96, "train_samples": 1024, **NETWORK}
CACHED = ("nirc", "nrc", "neural_path", "nirc_two_level")
BY_CACHE = ("nirc", "nrc", "neural_path")
#: What :func:`reference` has computed.
_REFERENCES: dict[str, tuple] = {}


def wall(at, axis, angle, bsdf, size=1.0, **keys):
    return {"type": "rectangle", "to_world": T().translate(at).rotate(axis, angle).scale(size), "bsdf": bsdf, **keys}


def colour(*rgb):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def picture(n=4, low=0.2, high=0.8, seed=0):
    values = np.random.default_rng(seed).uniform(low, high, (n, n, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest"}


def room(block=None, width=12, **more):
    """A room with a picture on its floor, an open front, a lamp and a small sun inside of it."""
    eye = {"type": "perspective", "fov": 45, "to_world": T().look_at([0, 0, 3.2], [0, 0, 0], [0, 1, 0]),
           "film": {"type": "hdrfilm", "width": width, "height": width, "rfilter": {"type": "box"},
                    "pixel_format": "rgb"}}  # fmt: skip
    return mi.load_dict({
        "type": "scene", "eye": eye, "back": wall([0, 0, -1], [0, 1, 0], 0, colour(0.6, 0.6, 0.6)),
        "floor": wall([0, -1, 0], [1, 0, 0], -90, {"type": "diffuse", "reflectance": picture()}),
        "ceiling": wall([0, 1, 0], [1, 0, 0], 90, colour(0.7, 0.7, 0.7)),
        "left": wall([-1, 0, 0], [0, 1, 0], 90, colour(0.7, 0.1, 0.1)),
        "right": wall([1, 0, 0], [0, 1, 0], -90, colour(0.1, 0.6, 0.1)),
        "block": {"type": "cube", "to_world": T().translate([0.3, -0.7, 0.1]).scale(0.3),
                  "bsdf": block or colour(0.5, 0.5, 0.5)},
        "lamp": wall([0, 0.98, 0], [1, 0, 0], 90, colour(0.1, 0.1, 0.1), 0.3,
                     emitter={"type": "area", "radiance": {"type": "rgb", "value": [6, 5, 4]}}),
        "spark": {"type": "point", "position": [-0.5, 0.2, 0.3], "intensity": 0.5}, **more,
    })  # fmt: skip


def tracked(scene, endings=("reflectance.value", "reflectance.data", "radiance.value", "intensity.value")):
    """(parameters of `scene`, the keys with these endings, whose gradients are enabled)."""
    params = mi.traverse(scene)
    keys = sorted(k for k in params.keys() if k.endswith(tuple(endings)))  # their order differs from load to load
    assert keys
    for k in keys:
        dr.enable_grad(params[k])
    params.update()
    return params, keys


def adjoint_image(scene):
    """What a loss says of the image: another factor for each pixel and colour, most of one sign."""
    height, width = scene.sensors()[0].film().crop_size()
    weights = np.random.default_rng(1).uniform(-0.2, 1, (height, width, 3))
    return mi.TensorXf((weights / weights.size).astype(np.float32))


def gradients_of(scene, params, keys, integrator, spp, seed, grad=None):
    """The gradients of `keys` in one array, by a call to ``render_backward``."""
    given = enable(params, keys)
    integrator.render_backward(scene, params, adjoint_image(scene) if grad is None else grad, 0, seed, spp)
    return np.concatenate([np.array(dr.grad(v), np.float64).ravel() for v in given])


def enable(params, keys) -> list:
    """The values of `keys`, given anew to the scene, which may keep what it computes from them (an environment map)."""
    given = []
    for k in keys:
        value = type(params[k])(dr.detach(params[k]))
        dr.enable_grad(value)
        params[k] = value
        given.append(value)
    params.update()
    return given


def spread_of(scene, params, keys, integrator, spp, n=4):
    """(mean gradients, their standard errors) over `n` seeds."""
    runs = np.array([gradients_of(scene, params, keys, integrator, spp, 10 + s) for s in range(n)])
    return runs.mean(0), runs.std(0, ddof=1) / n**0.5


def agree(name, ours, theirs, allowed=0.05):
    """The distance of two gradients (value, standard error), beyond that of noise, over the norm."""
    (a, da), (b, db) = ours, theirs
    noise = np.sum(da**2 + db**2)
    off, norm = max(np.sum((a - b) ** 2) - noise, 0) ** 0.5, np.linalg.norm(b)
    print(f"{name}: off by {off / norm:.2%} of the norm, noise {noise**0.5 / norm:.2%}")
    assert noise**0.5 < 0.05 * norm, "the test says nothing"
    assert off < allowed * norm


def train(scene, name, **keys):
    integrator = mi.load_dict({"type": name, **SMALL, **keys})
    with dr.suspend_grad():
        integrator.train_first(scene)
    return integrator


def scene_of(kind):
    """(scene, parameters, keys) of a kind of room."""
    glossy = {"type": "roughconductor", "alpha": {"type": "uniform", "value": 0.2}, "distribution": "ggx",
              "specular_reflectance": {"type": "rgb", "value": 0.8}}  # fmt: skip
    mask = {"type": "mask", "opacity": 0.5, "nested": {"type": "twosided", "bsdf": colour(0.5, 0.5, 0.5)}}
    sky = mi.Bitmap(np.random.default_rng(2).uniform(0, 1, (4, 8, 3)).astype(np.float32))
    more = {"diffuse": {}, "glossy": {"block": glossy}, "mirror": {"block": {"type": "conductor"}},
            "mask": {"block": mask}, "sky": {"sky": {"type": "envmap", "bitmap": sky}}}[kind]  # fmt: skip
    scene = room(**more)
    ends = ("reflectance.value", "reflectance.data", "radiance.value", "intensity.value", "alpha.value", "sky.data")
    return scene, *tracked(scene, ends)


def reference(kind):
    """(scene, parameters, keys, gradients by ``prb`` and their errors), the last ones computed once.

    No scene is kept: derivatives would be carried into the parameters of all scenes alive that want them.
    """
    scene, params, keys = scene_of(kind)
    if kind not in _REFERENCES:
        prb = mi.load_dict({"type": "prb", "max_depth": 24})
        _REFERENCES[kind] = spread_of(scene, params, keys, prb, 1024)
    return scene, params, keys, _REFERENCES[kind]


def black_wall():
    """(a small room whose left wall is black, its parameters, the key of the colour of that wall)."""
    scene, key = room(width=6), "left.bsdf.reflectance.value"
    params = mi.traverse(scene)
    params[key] = mi.Color3f(0)
    params.update()
    return scene, params, key


def assert_is_difference(scene, params, key, found, max_depth, allowed) -> None:
    """The derivatives `found` by the colour of a black surface are finite differences of images by ``path``."""
    path, weight, images = mi.load_dict({"type": "path", "max_depth": max_depth}), np.array(adjoint_image(scene)), []
    for value in (0.02, 0):
        params[key] = mi.Color3f(value)
        params.update()
        images.append(np.sum(np.array(mi.render(scene, integrator=path, spp=4096, seed=3)) * weight, axis=(0, 1)))
    expected = (images[0] - images[1]) / 0.02
    print(found, expected)
    np.testing.assert_allclose(found, expected, rtol=allowed)
