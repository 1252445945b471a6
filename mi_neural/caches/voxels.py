"""Space in cubes, hashed into tables of fixed size: what is known by place and needs no network.

The cells go on beyond the box that they are made for, so that a camera may walk on; collisions are ignored.
"""

from __future__ import annotations

import math
from operator import attrgetter

import drjit as dr
import mitsuba as mi
import numpy as np

from .places import N_PLACES, Places

#: Factors of the spatial hash (Müller et al. 2022, eq. 4), and one more for the direction of the normal.
FACTORS = 1, 2654435761, 805459861, 3674653429
#: Numbers of cells are cut here, so that they fit into integers.
FARTHEST = 2.0**30
#: Steps after which a place counts as half known, see `Ages`.
HALF_KNOWN = 100.0
#: Stands in files for a position that is not known.
NOWHERE = 3e38


def check_box(box_min: np.ndarray, box_max: np.ndarray) -> None:
    """Refuse a box that is empty or not finite."""
    finite = box_min.shape == box_max.shape == (3,) and np.isfinite([box_min, box_max]).all()
    if not (finite and (box_max > box_min).all()):
        raise ValueError(f"the box {box_min.tolist()} .. {box_max.tolist()} is empty or not finite")


def main_axis(normal):
    """The axis (0, 1, 2) that a normal is closest to, in either direction."""
    n = dr.abs(mi.Vector3f(normal))
    return dr.select((n.x >= n.y) & (n.x >= n.z), mi.UInt32(0), dr.select(n.y >= n.z, mi.UInt32(1), 2))


def main_side(normal):
    """The face (0 .. 5) of a cube that a normal points to."""
    axis = main_axis(normal)
    along = dr.select(axis == 0, normal.x, dr.select(axis == 1, normal.y, normal.z))
    return 2 * axis + dr.select(along < 0, mi.UInt32(1), 0)


def hashed(cell, n_entries: int, side=0):
    """Entry of a cell in a table, with an integer beside it; `n_entries`: a power of two."""
    a, b, c, d = FACTORS
    key = cell.x * a ^ cell.y * b ^ cell.z * c
    return (key if isinstance(side, int) and side == 0 else key ^ side * d) & (n_entries - 1)


class Voxels:
    """Cubes, `resolution` of them along the longest axis of the box from `low` to `high`. A PyTree."""

    DRJIT_STRUCT = {"origin": object, "inv_cell": object}  # noqa: RUF012

    def __init__(self, low, high, resolution: int):
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        self.origin, self.inv_cell = mi.Point3f(low.tolist()), mi.Float(float(resolution / (high - low).max()))
        dr.make_opaque(self.origin, self.inv_cell)

    def cell(self, x, times: int = 1):
        """Three integers; those of cubes so many `times` as wide. A point that is not finite lies in the first."""
        p = (dr.select(dr.isfinite(x), mi.Point3f(x), self.origin) - self.origin) * self.inv_cell
        return mi.Vector3u(mi.Vector3i(dr.floor(dr.clip(p, -FARTHEST, FARTHEST) * (1 / times))))

    def entry(self, x, n_entries: int, side=0, times: int = 1):
        """Entry of a point in a table, see :func:`hashed`."""
        return hashed(self.cell(x, times), n_entries, side)


def cell_sums(values: list, index, active, n_entries: int) -> list:
    """Sums of `values` over the records of each entry: one array of `n_entries` per value.

    Four values at a time, which lie side by side in memory: on LLVM a scatter of packets is 5 to 20 times as fast as
    one of single values (28 values of 28,672 records on two cores: 0.6 to 1.4 ms).
    """
    out = []
    for k in range(0, len(values), 4):
        four = [*values[k : k + 4], *[mi.Float(0)] * 3][:4]
        table = dr.zeros(mi.Float, 4 * n_entries)
        dr.scatter_add(table, mi.Vector4f(*four), index, active)
        out.append(table)
    dr.eval(out)
    lanes = dr.arange(mi.UInt32, n_entries)
    return [v for table in out for v in dr.gather(mi.Vector4f, table, lanes)][: len(values)]


class Ages:
    """How long each place has been trained: the clock of learning rates and averages; and what has left the view. A
    PyTree.

    steps    of each cell, those in which a record fell into it
    first    of each cell, the first of them
    recent   of each cell, mean number of records in the latest steps
    total    steps so far; 1-wide
    novelty  share of the latest records that lay in places without a step, had all others had all steps; 1-wide
    usual    what `recent` was at the latest records, their mean; 1-wide
    places   where records lay

    A camera that has turned to places without records needs the rates of a beginning, one that sees half of what it saw
    needs something between. Each record would choose the rate of its own place; :meth:`age` is the number of steps at
    which a rate that falls as 1/t is their mean. While nothing but the same view is trained, that is the number of
    steps.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "voxels": object, "steps": object, "first": object, "recent": object, "usual": object, "total": object,
        "novelty": object, "places": object,
    }  # fmt: skip
    N_ENTRIES = 2**15
    #: A cache is no longer new after so many steps; so large a novelty is more than the rare places of any view.
    OLD, NOVEL = 32, 0.2
    #: A place into which a record falls in one of so many steps is as old as one that each step finds.
    SPARSE = 8
    #: Share of `recent` that a step leaves, and how much less than is usual means that a place has left the view.
    KEPT, RARE = 0.5, 1 / 4

    def __init__(self, low, high, steps: int = 0, resolution: int = 16):
        self.voxels = Voxels(low, high, resolution)
        self.steps, self.first = dr.full(mi.Float, steps, self.N_ENTRIES), dr.zeros(mi.Float, self.N_ENTRIES)
        self.recent, self.usual = dr.zeros(mi.Float, self.N_ENTRIES), mi.Float(0)
        self.total, self.novelty = mi.Float(steps), mi.Float(0)
        self.places = Places(N_PLACES)
        dr.make_opaque(self.steps, self.first, self.recent, self.usual, self.total, self.novelty, self.places)

    def age(self, x, valid):
        """``τ (1 / mean(1 / (1 + t/τ)) - 1)`` over the valid records at x, and one step more for their places. 1-wide.
        May be frozen."""
        i = self.voxels.entry(x, self.N_ENTRIES)
        count = dr.zeros(mi.Float, self.N_ENTRIES)
        dr.scatter_add(count, 1, i, valid)
        recent = dr.lerp(count, self.recent, self.KEPT)
        # Since when a place is known; but once seen long ago is not known
        known = dr.select(self.steps > 0, dr.minimum(self.total - self.first, self.SPARSE * self.steps), 0)
        share = dr.rcp(1 + known * (1 / HALF_KNOWN))
        n = dr.maximum(dr.sum(count), 1)
        mean, usual = dr.sum(count * share) / n, dr.sum(count * recent) / n
        least = dr.rcp(1 + self.total * (1 / HALF_KNOWN))
        self.novelty = dr.clip((mean - least) / dr.maximum(1 - least, 1e-6), 0, 1)
        self.first = dr.select((count > 0) & (self.steps == 0), self.total, self.first)
        self.steps = self.steps + dr.select(count > 0, mi.Float(1), 0)
        self.recent, self.usual, self.total = recent, usual, self.total + 1
        dr.eval(self.first, self.total, self.novelty, self.steps, self.recent, self.usual, mean)
        return dr.select(mean > 0, HALF_KNOWN * (dr.rcp(dr.maximum(mean, 1e-6)) - 1), 0)

    @classmethod
    def is_novel(cls, total: float, novelty: float) -> bool:
        """Whether the camera has come to places that are new to a cache that is not, by such values of `total` and
        `novelty`."""
        return total >= cls.OLD and novelty > cls.NOVEL

    def left(self, distance) -> tuple:
        """The places that have left the view, for :func:`~mi_neural.caches.training_paths.first_rays`, to be looked at
        from so far; the others are not finite."""
        p = self.places.position
        near = dr.gather(mi.Float, self.recent, self.voxels.entry(p, self.N_ENTRIES)) > self.RARE * self.usual
        p = dr.select(near, math.nan, p)
        dr.eval(p)
        return p, self.places.view, distance, self.places.inside

    #: What training changes.
    LEARNED = ("steps", "first", "recent", "usual", "total", "novelty", "places.position", "places.view", "places.age")

    def arrays(self) -> dict[str, np.ndarray]:
        """All that training has changed, in finite numbers."""
        return {name: np.nan_to_num(np.array(attrgetter(name)(self)), nan=NOWHERE) for name in self.LEARNED}

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from :meth:`arrays`. Raises ``KeyError`` or ``ValueError`` for such that make no sense."""
        known = self.arrays()
        if any(arrays[name].shape != known[name].shape for name in self.LEARNED) or (arrays["steps"] < 0).any():
            raise ValueError("the steps of places are not those of this grid")
        for name in self.LEARNED:
            owner, attribute = (self.places, name.split(".")[1]) if "." in name else (self, name)
            values = np.float32(arrays[name])
            values = np.where(values == np.float32(NOWHERE), np.float32(math.nan), values)
            setattr(owner, attribute, type(getattr(owner, attribute))(values) + dr.opaque(mi.Float, 0))
        dr.make_opaque(self.steps, self.first, self.recent, self.usual, self.total, self.novelty, self.places)
