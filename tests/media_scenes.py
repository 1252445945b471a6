"""Scenes with participating media, for tests."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

T = mi.ScalarTransform4f


def rgb(*values) -> dict:
    return {"type": "rgb", "value": list(values)}


def colour(value) -> dict | float:
    return rgb(*value) if isinstance(value, tuple) else value


def fog(density=1.0, albedo=0.8, g: float | None = None) -> dict:
    """A homogeneous medium; `g` is the mean cosine of its Henyey-Greenstein phase function, None: isotropic."""
    scale = max(density) if isinstance(density, tuple) else density
    share = tuple(v / scale for v in density) if isinstance(density, tuple) else 1.0
    keys = {"type": "homogeneous", "sigma_t": colour(share), "scale": scale, "albedo": colour(albedo)}
    return keys if g is None else keys | {"phase": {"type": "hg", "g": g}}


def smoke(density=4.0, albedo=0.8) -> dict:
    """A medium whose density varies from voxel to voxel, in a cube of side 1."""
    values = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32)
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(values), "raw": True,
            "to_world": T().translate(-0.5)}  # fmt: skip
    return {"type": "heterogeneous", "sigma_t": grid, "albedo": colour(albedo), "scale": density}


def cube(inside: dict, bsdf: dict | None = None, size=0.5, at=(0, 0, 0), **keys) -> dict:
    return {"type": "cube", "to_world": T().translate(list(at)).scale(size), "interior": inside,
            "bsdf": bsdf or {"type": "null"}, **keys}  # fmt: skip


def ball(inside: dict, bsdf: dict | None = None, radius=0.5, at=(0, 0, 0), **keys) -> dict:
    return {"type": "sphere", "center": list(at), "radius": radius, "interior": inside,
            "bsdf": bsdf or {"type": "null"}, **keys}  # fmt: skip


def wall(at, axis, angle, size=1.0, **keys) -> dict:
    return {"type": "rectangle", "to_world": T().translate(list(at)).rotate(list(axis), angle).scale(size), **keys}


def lamp(at, radiance, size=0.4, **keys) -> dict:
    return wall(at, (1, 0, 0), 90, size, emitter={"type": "area", "radiance": radiance}, **keys)


def room(camera: dict | None = None, size=8, **parts) -> mi.Scene:
    """A floor, a wall, and two lamps of two colours above the view, one of them shaded; `parts` are added."""
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 38, "to_world": T().look_at([0, 0, 3.2], [0, -0.2, 0], [0, 1, 0]),
              "film": film, **(camera or {})}  # fmt: skip
    scene = {
        "type": "scene", "sensor": sensor,
        "floor": wall((0, -1, 0), (1, 0, 0), -90, 1.5, bsdf={"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)}),
        "back": wall((0, 0, -1), (1, 0, 0), 0, 1.5, bsdf={"type": "diffuse", "reflectance": rgb(0.4, 0.5, 0.6)}),
        "left": lamp((-0.6, 1.4, 0), rgb(6.0, 4.0, 2.0)), "right": lamp((0.6, 1.4, 0.2), rgb(2.0, 4.0, 6.0)),
        "shade": wall((0.5, 1.2, 0.2), (1, 0, 0), 90, 0.2, bsdf={"type": "twosided", "bsdf": {"type": "diffuse"}}),
        **parts,
    }  # fmt: skip
    return mi.load_dict(scene)


def clouds(medium: dict) -> mi.Scene:
    """The room with two instances of a cube of `medium`."""
    of = {"type": "instance", "shapegroup": {"type": "ref", "id": "cloud"}}
    places = [T().translate([x, y, 0]).scale(0.6) for x, y in ((-0.5, 0), (0.5, -0.3))]
    return room(cloud={"type": "shapegroup", "part": cube(medium)},
                **{f"cloud{k}": of | {"to_world": place} for k, place in enumerate(places)})  # fmt: skip


def everywhere(medium: dict, **parts) -> mi.Scene:
    """The room inside of a medium that fills it; the camera is in it, too."""
    medium = medium | {"id": "air"}
    hull = {"type": "cube", "to_world": T().scale(4), "bsdf": {"type": "null"}, "interior": medium}
    air = {"type": "ref", "id": "air"}
    return room({"medium": air}, hull=hull, **parts)
