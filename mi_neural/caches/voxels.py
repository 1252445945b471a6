"""Space in cubes, hashed into tables of fixed size: what is known by place and needs no network.

The cells go on beyond the box that they are made for, so that a camera may walk on; collisions are ignored.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

#: Factors of the spatial hash (Müller et al. 2022, eq. 4), and one more for the direction of the normal.
FACTORS = 1, 2654435761, 805459861, 3674653429
#: Numbers of cells are cut here, so that they fit into integers.
FARTHEST = 2.0**30
#: Steps after which a place counts as half known, see `Ages`.
HALF_KNOWN = 100.0


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
    """How long each place has been trained: the clock of learning rates and averages. A PyTree.

    steps   of each cell, those in which a record fell into it

    A camera that has turned to places without records needs the rates of a beginning, one that sees half of what it saw
    needs something between. Each record would choose the rate of its own place; :meth:`age` is the number of steps at
    which a rate that falls as 1/t is their mean. While nothing but the same view is trained, that is the number of
    steps.
    """

    DRJIT_STRUCT = {"voxels": object, "steps": object}  # noqa: RUF012
    RESOLUTION, N_ENTRIES = 16, 2**15

    def __init__(self, low, high, steps: int = 0):
        self.voxels = Voxels(low, high, self.RESOLUTION)
        self.steps = dr.full(mi.Float, steps, self.N_ENTRIES)
        dr.make_opaque(self.steps)

    def restore(self, steps: np.ndarray) -> None:
        """Go back to known `steps`. Raises ``ValueError`` for such that make no sense."""
        if steps.shape != (self.N_ENTRIES,) or not (steps >= 0).all():
            raise ValueError("the steps of places are not those of this grid")
        self.steps = mi.Float(np.float32(steps))
        dr.make_opaque(self.steps)

    def age(self, x, valid):
        """``τ (1 / mean(1 / (1 + t/τ)) - 1)`` over the valid records at x, and one step more for their places. 1-wide.
        May be frozen."""
        i = self.voxels.entry(x, self.N_ENTRIES)
        share = dr.rcp(1 + dr.gather(mi.Float, self.steps, i, valid) * (1 / HALF_KNOWN))
        n = dr.count(valid)
        mean = dr.sum(dr.select(valid, share, 0)) / dr.maximum(n, 1)
        met = dr.zeros(mi.Float, self.N_ENTRIES)
        dr.scatter(met, mi.Float(1), i, valid)
        self.steps = self.steps + met
        dr.eval(self.steps, mean)
        return dr.select(n > 0, HALF_KNOWN * (dr.rcp(dr.maximum(mean, 1e-6)) - 1), 0)
