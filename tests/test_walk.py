"""The caches follow the camera: a walk through rooms in a row, each with light of its own."""

import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK

TINTS = (5, 1, 1), (1, 1, 8), (1, 6, 1), (4, 4, 1), (3, 1, 5)
KINDS = {"nirc": {"type": "nirc"}, "nrc": {"type": "nrc"}, "auto": {"type": "nrc", "termination": "auto"}}
FRAMES = 30
slow = pytest.mark.slow


def wall(at, axis=(0, 1, 0), angle=0, size=1.0, **keys):
    place = mi.ScalarTransform4f().translate(list(at)).rotate(list(axis), angle).scale(size)
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse", "reflectance": 0.7}, **keys}


def rooms(n: int):
    """Closed rooms in a row, a sensor in each."""
    scene = {"type": "scene"}
    for k in range(n):
        def at(x, y, z, k=k):
            return [x + 4 * k, y, z]

        light = {"type": "area", "radiance": {"type": "rgb", "value": list(TINTS[k])}}
        black = {"type": "diffuse", "reflectance": 0.0}
        view = mi.ScalarTransform4f().look_at(at(0, 0, 0.9), at(0, -0.1, -1), [0, 1, 0])
        scene |= {
            f"back{k}": wall(at(0, 0, -1)), f"front{k}": wall(at(0, 0, 1), (0, 1, 0), 180),
            f"floor{k}": wall(at(0, -1, 0), (1, 0, 0), -90), f"ceiling{k}": wall(at(0, 1, 0), (1, 0, 0), 90),
            f"left{k}": wall(at(-1, 0, 0), (0, 1, 0), 90), f"right{k}": wall(at(1, 0, 0), (0, 1, 0), -90),
            f"lamp{k}": wall(at(0, 0.98, 0), (1, 0, 0), 90, 0.3, emitter=light, bsdf=black),
            f"view{k}": {"type": "perspective", "fov": 80, "to_world": view,
                         "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}},
        }  # fmt: skip
    return mi.load_dict(scene)


def make(kind: str, n: int):
    """A small network holds two rooms; five of them need the default one to remember the first."""
    return mi.load_dict({**KINDS[kind], "train_samples": 1024, **(NETWORK if n == 2 else {})})


def errors(integrator, scene, room: int, truth) -> tuple[float, float]:
    """(relMSE, relative error of the mean) of an image without further training."""
    with integrator.previewing():
        image = np.array(mi.render(scene, integrator=integrator, sensor=room, spp=64, seed=9), np.float64)
    squared = (image - truth) ** 2 / (truth**2 + 0.01 * truth.mean() ** 2)
    return float(squared.mean()), float(image.mean() / truth.mean() - 1)


@pytest.mark.parametrize("kind, n", [("nrc", 2), *(pytest.param(k, 5, marks=slow) for k in KINDS)])
def test_each_room_of_a_walk_is_as_good_as_in_a_fresh_cache_and_the_first_is_remembered(kind, n):
    scene, path = rooms(n), mi.load_dict({"type": "path"})
    truths = [np.array(mi.render(scene, integrator=path, sensor=k, spp=2048), np.float64) for k in range(n)]
    walked = make(kind, n)
    walked.train(scene, 48, 0)
    first, _ = errors(walked, scene, 0, truths[0])
    for room in range(1, n):
        walked.train(scene, FRAMES, room)
        fresh = make(kind, n)
        fresh.train(scene, FRAMES, room)
        (known, _), (found, off) = (errors(it, scene, room, truths[room]) for it in (fresh, walked))
        print(f"{kind}, room {room}: relMSE {found:.4f}, of a fresh cache {known:.4f}; mean {off:+.2%}")
        assert found < 3 * known + 1e-3 and abs(off) < 0.02
    found, off = errors(walked, scene, 0, truths[0])
    print(f"{kind}, the first room again: relMSE {found:.4f}, before the walk {first:.4f}; mean {off:+.2%}")
    assert found < 0.05 and abs(off) < 0.06
