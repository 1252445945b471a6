"""Lights by a table of cells: what :class:`~.sampling.VisibleLights` finds there in the mean, looked up.

A choice takes a few look-ups, where otherwise the network and the bound of every light are asked. It pays where paths
have many vertices: in media.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.sampling import PathSampler
from .sampling import Choice, VisibleLights
from .table import own

#: Cells along the longest side of the box, and points in each whose weights are averaged.
RESOLUTION, POINTS = 16, 4
#: Training steps after which a table is made anew.
EVERY = 16
#: Share of a choice that goes to all lights alike, so that none is left out; and in the tables of surfaces, share of
#: what is received from all directions.
EQUAL, AROUND = 0.05, 0.2
#: Tables of a cell: for normals along the axes (+x, -x, +y, ...), and for what receives light from everywhere.
AXES = 7


class CellLights:
    """Lights in proportion to the mean of their weights in a cell, and a twentieth to all alike. A PyTree.

    `lights` knows each light by itself; points outside of the `box` take the nearest cell. Unbiased: every light keeps
    a positive probability. `sums` are the running sums of the probabilities, cell by cell, table by table; `facts` the
    cells along each axis.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "table": object, "groups": object, "sums": object, "low": object, "scale": object, "facts": object,
    }  # fmt: skip

    def __init__(self, lights: VisibleLights, box: tuple):
        self.table, self.groups = lights.table, lights.groups
        low, high = (np.asarray(corner, np.float64) for corner in box)
        size = float(np.maximum((high - low).max() / RESOLUTION, 1e-20))
        self.facts = tuple(int(n) for n in np.clip(np.ceil((high - low) / size - 1e-6), 1, RESOLUTION))
        self.low, self.scale = own(mi.Point3f(low.tolist())), own(mi.Float(1 / size))
        self.sums = mi.Float(0)
        self.learned = None  # steps of the network that the table is of

    def follow(self, lights: VisibleLights, steps: int, seed: int) -> None:
        """Take the weights of `lights`, whose network has learned for so many `steps`, if the table is too old."""
        if self.learned is None or not self.learned <= steps < self.learned + EVERY:
            self.learn(lights, seed)
            self.learned = steps

    def learn(self, lights: VisibleLights, seed: int) -> None:
        """Take the weights of `lights` as they are now."""
        nx, ny, nz = self.facts
        n_groups, n = self.groups.n_groups, AXES * nx * ny * nz
        lane = dr.arange(mi.UInt32, n)
        axis, cell = lane % AXES, lane // AXES
        sampler = PathSampler.make(cell, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF))
        corner = mi.Vector3f(mi.Float(cell % nx), mi.Float(cell // nx % ny), mi.Float(cell // (nx * ny)))
        along, sign = axis // 2, dr.select(axis % 2 == 0, mi.Float(1), -1)
        normal = mi.Normal3f(*(dr.select(along == k, sign, 0) for k in range(3)))
        weights = dr.zeros(mi.Float, n * n_groups)

        def add(i, sampler):
            place = mi.Vector3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
            p = self.low + (corner + place) / self.scale
            for k, w in enumerate(lights.weights(p, normal, mi.Bool(False), axis == AXES - 1)):
                dr.scatter_add(weights, dr.select(dr.isfinite(w), w, 0), lane * n_groups + k)
            return i + 1, sampler

        dr.while_loop((mi.UInt32(0), sampler), lambda i, sampler: i < POINTS, add, label="cells of lights")
        dr.eval(weights)
        around = (cell * AXES + AXES - 1) * n_groups
        mixed = [dr.lerp(*(dr.gather(mi.Float, weights, i + k) for i in (lane * n_groups, around)), AROUND)
                 for k in range(n_groups)]  # fmt: skip
        total, before, sums = sum(mixed[1:], mixed[0]), mi.Float(0), dr.zeros(mi.Float, n * n_groups)
        known = (total > 0) & dr.isfinite(total)
        inverse = dr.select(known, (1 - EQUAL) * dr.rcp(total), 0)
        equal = dr.select(known, mi.Float(EQUAL / n_groups), 1 / n_groups)
        for k, w in enumerate(mixed):
            before = before + dr.select(known, w * inverse, 0) + equal
            dr.scatter(sums, before if k < n_groups - 1 else mi.Float(1), lane * n_groups + k)
        self.sums = sums
        dr.eval(self.sums)

    def _begin(self, p, n, transmits, around):
        """Where the running sums for a point begin."""
        cell = mi.UInt32(0)
        for count, x in reversed(list(zip(self.facts, (p - self.low) * self.scale, strict=True))):
            cell = cell * count + mi.UInt32(dr.clip(x, 0, count - 0.5))
        largest = dr.max(dr.abs(n))
        side = [dr.select(v < 0, mi.UInt32(2 * k + 1), 2 * k) for k, v in enumerate(n)]
        axis = dr.select(dr.abs(n.x) == largest, side[0], dr.select(dr.abs(n.y) == largest, side[1], side[2]))
        everywhere = transmits if around is None else around | transmits
        return (cell * AXES + dr.select(everywhere, AXES - 1, axis)) * self.groups.n_groups

    def _below(self, begin, group, active):
        """The running sum below a group."""
        some = active & (group > 0)
        return dr.select(some, dr.gather(mi.Float, self.sums, begin + group - 1, some), 0)

    def choose(self, si, n, transmits, u, sampler, hit, active, around=None) -> Choice:
        count, begin = self.groups.n_groups, self._begin(si.p, n, transmits, around)
        group = mi.UInt32(0)
        for bit in reversed(range((count - 1).bit_length())):
            right = group + 2**bit
            ahead = active & (right < count)
            group = dr.select(ahead & (u >= dr.gather(mi.Float, self.sums, begin + right - 1, ahead)), right, group)
        pmf = dr.gather(mi.Float, self.sums, begin + group, active) - self._below(begin, group, active)
        index = self.groups.sample_light(group, mi.Float(0), active)[0]
        return Choice(index, dr.select(pmf > 0, dr.rcp(pmf), 0), pmf, None, sampler)

    def pmf(self, si, n, transmits, index, active, around=None):
        group = dr.gather(mi.UInt32, self.groups.group_of, index, active)
        begin = self._begin(si.p, n, transmits, around)
        return dr.gather(mi.Float, self.sums, begin + group, active) - self._below(begin, group, active)
