"""Lights for tests: scenes with one of each kind, meshes of triangles, points that look at them."""

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.lights.table import LightTable
from mi_neural.render.sampling import PathSampler


def at(*position):
    return mi.ScalarTransform4f().translate(list(position))


def glow(radiance=1.0):
    return {"type": "area", "radiance": radiance}


MIXED = {
    "ball": {"type": "sphere", "center": [-3, 0, 2], "radius": 0.5, "emitter": glow(2.0)},
    "plate": {"type": "disk", "to_world": at(3, 0, 2).rotate([1, 0, 0], 180), "emitter": glow(3.0)},
    "tube": {"type": "cylinder", "p0": [0, 3, 1], "p1": [0, 3, 3], "radius": 0.25, "emitter": glow(1.5)},
    "spark": {"type": "point", "position": [0.5, 0.5, 2.5], "intensity": 4.0},
    "torch": {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([1, -3, 3], [0, 0, 0], [0, 0, 1]),
              "intensity": 20.0, "cutoff_angle": 40.0},
    "sun": {"type": "directional", "direction": [0.3, -0.2, -1.0], "irradiance": 0.5},
    "window": {"type": "rectangle", "to_world": at(0, -3, 2).rotate([1, 0, 0], -90).scale([1.5, 0.5, 1]),
               "emitter": glow({"type": "rgb", "value": [1, 2, 3]})},
    "box": {"type": "cube", "to_world": at(-2, 2, 3).scale(0.3), "emitter": glow(5.0)},
}  # fmt: skip


def pixels(seed=0):
    return np.random.default_rng(seed).uniform(0, 2, (8, 16, 3)).astype(np.float32)


def picture(values) -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest"}


def scene_of(lights: dict, sky: str | None = None) -> mi.Scene:
    """`lights` over a floor at z = 0."""
    skies = {
        "constant": {"type": "constant", "radiance": 0.3},
        "envmap": {"type": "envmap", "bitmap": mi.Bitmap(pixels())},
    }
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(5)}
    return mi.load_dict({"type": "scene", **lights, "floor": floor, **({"sky": skies[sky]} if sky else {})})


def triangles(path, corners, attribute=None) -> dict:
    """A mesh of separate triangles, `corners` (n, 3, 3); `attribute`: (name, values)."""
    n = len(corners)
    mesh = mi.Mesh("mesh", 3 * n, n)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.asarray(corners, np.float32).ravel())
    params["faces"] = mi.UInt32(np.arange(3 * n, dtype=np.uint32))
    params.update()
    if attribute:
        mesh.add_attribute(attribute[0], 3, np.asarray(attribute[1], np.float32).ravel())
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


def random_triangles(rng, n, center=(0, 0, 3), spread=1.5, size=0.5) -> np.ndarray:
    return (np.asarray(center) + rng.normal(size=(n, 1, 3)) * spread + rng.normal(size=(n, 3, 3)) * size).astype(
        np.float32
    )


def shining_triangles(path, rng, scale) -> tuple:
    """64 random triangles about the origin, `scale` times their usual size, as lights of a scene: (corners, table)."""
    corners = random_triangles(rng, 64, center=(0, 0, 0)) * scale
    scene = mi.load_dict({"type": "scene", "m": {**triangles(path / "m.ply", corners), "emitter": glow()}})
    return corners, LightTable(scene)


def place(p, n=1):
    """A surface interaction at `p`, `n` lanes."""
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.p = mi.Point3f(*[float(x) for x in p]) if np.ndim(p) == 1 else mi.Point3f(*np.asarray(p, np.float32).T)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.wi = mi.Vector3f(0, 0, 1)
    return si


def uniforms(n, seed=0):
    return PathSampler.make(dr.arange(mi.UInt32, n), mi.UInt32(seed))


class CountingSampler:
    """In the place of a PathSampler: numbers of its own, and how often each of them was used, by stream and lane."""

    DRJIT_STRUCT = {"lane": object, "drawn": object, "stream": object}  # noqa: RUF012
    MOST = 256  # numbers of a lane
    uses: list = []  # noqa: RUF012
    points: list = []  # noqa: RUF012

    def __init__(self, lane=None, drawn=None, stream=None):
        self.lane, self.drawn, self.stream = lane, drawn, stream

    @classmethod
    def make(cls, lane, seed=0, index=0, scramble=None, group=None):
        n = dr.width(lane)
        cls.uses.append(dr.zeros(mi.UInt32, n * cls.MOST))
        return cls(dr.arange(mi.UInt32, n), dr.zeros(mi.UInt32, n), len(cls.uses) - 1)

    def next_1d(self):
        at = self.lane * self.MOST + self.drawn
        dr.scatter_reduce(dr.ReduceOp.Add, self.uses[self.stream], mi.UInt32(1), at)
        self.drawn = self.drawn + 1
        return mi.sample_tea_float32(at, self.stream)

    def next_2d(self):
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())

    def stratified_2d(self, dimension: int, n: int = 1, i=0):
        self.points.append((self.stream, dimension))
        return mi.Point2f(mi.sample_tea_float32(self.lane, 1000 + dimension), 0.5)

    @classmethod
    def most_uses(cls) -> int:
        """How often the number is used that is used most."""
        counts = max((int(dr.max(uses)[0]) for uses in cls.uses), default=0)
        return max(counts, max((cls.points.count(p) for p in cls.points), default=0))


def mixed_lights():
    """All kinds of emitters, an environment map included."""
    scene = scene_of(MIXED, "envmap")
    return scene, LightTable(scene)


def row(scene, table, shape_or_emitter: str) -> np.ndarray:
    """Entries of the emitter, or the emitter of the shape, with this name."""
    number = next(k for k, e in enumerate(scene.emitters())
                  if shape_or_emitter in (e.id(), e.get_shape().id() if e.get_shape() else None))  # fmt: skip
    return np.flatnonzero(table.columns["emitter"] == number)
