"""What lies ahead of a path, by place: how much light leaves a surface, and how often its light samples arrive.

A table of cubes, each with six sides for the normal. It says how long a path is worth tracing
(:mod:`mi_neural.estimators.roulette`). A network would know the same in more detail, at 50 to 100 times the cost of a
look-up; roulette keeps its mean whatever it is told.
"""

from __future__ import annotations

from copy import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render import path as paths
from ..render import vertex
from ..render.film import film_rays
from ..render.sampling import PathSampler
from . import guide as guides
from .guide import Guide
from .voxels import Voxels, main_side

#: Cells along the longest axis of the box of what paths meet, and entries of the table.
CELLS, ENTRIES = 32, 2**16
#: Paths that are traced, and vertices of each that are records.
N_PATHS, N_VERTICES = 2**17, 8
#: Records of the scene's mean that each cell begins with.
PRIOR = 4.0
#: Luminance above which a record of the guide counts as this.
BRIGHTEST = 1e4
#: The level of a pixel is at least this share of the scene's mean.
LEVEL_MIN = 0.1


class Outlook:
    """Expected radiance and visibility by place. A PyTree.

    ahead    mean luminance that leaves the surfaces of a cell, direct light included
    visible  share of the light samples of a cell that are not shadowed
    mean     mean of `ahead` over all records; 1-wide
    guide    tables of directions; None: there are none
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "voxels": object, "ahead": object, "visible": object, "mean": object, "guide": object,
    }  # fmt: skip
    guide: Guide | None = None

    def __init__(self, low=None, high=None):
        if low is None:  # as Dr.Jit makes one
            return
        self.voxels = Voxels(low, high, CELLS)
        self.ahead, self.visible = dr.zeros(mi.Float, ENTRIES), dr.full(mi.Float, 1, ENTRIES)
        self.mean, self.guide, self.box = mi.Float(0), None, (low, high)
        dr.make_opaque(self.ahead, self.visible, self.mean)

    def entry(self, si):
        return self.voxels.entry(si.p, ENTRIES, main_side(vertex.facing(si)))

    def ahead_at(self, si, active):
        """Mean luminance that leaves the surface at `si`; 0 where not `active`."""
        return dr.gather(mi.Float, self.ahead, self.entry(si), active)

    def level_at(self, si, active):
        """The same as the level of a pixel that shows this surface, never 0 in a scene with light."""
        return dr.maximum(self.ahead_at(si, active), LEVEL_MIN * self.mean)

    def visible_at(self, si, active):
        """Share of the light samples at `si` that are not shadowed."""
        return dr.gather(mi.Float, self.visible, self.entry(si), active)

    @classmethod
    def blank(cls) -> Outlook:
        """One that knows nothing, in the place of one that is not needed yet."""
        return cls([0.0] * 3, [1.0] * 3)

    def view(self, guided: bool) -> Outlook:
        """This, without its guide where it is not `guided`."""
        if guided or self.guide is None:
            return self
        other = copy(self)
        other.guide = None
        return other

    @classmethod
    def learn(cls, scene, sensor, lights, seed: int, n_paths: int = N_PATHS) -> Outlook:
        """An outlook of what `sensor` sees, by path tracing; no other cache is asked."""
        with dr.suspend_grad():
            records, light, _ = _trace(scene, sensor, lights, seed, n_paths)
            p, side, target, valid = records
            points = np.array(p)[:, np.array(valid)]
            if points.shape[1] == 0:
                points = np.zeros((3, 1))
            low, high = points.min(axis=1), points.max(axis=1)
            high = np.maximum(high, low + 1e-6 * max(1.0, float(np.abs(points).max())))
            self = cls(low, high)
            self._fill(p, side, target, valid, light)
        return self

    def learn_guide(self, scene, sensor, lights, seed: int, n_paths: int = N_PATHS, times: int = 4) -> None:
        """See that there is a guide, from so many `times` as many paths."""
        if self.guide is not None:
            return
        found, count = np.zeros(guides.ENTRIES * guides.N_BINS), np.zeros(guides.ENTRIES)
        voxels = Voxels(*self.box, guides.CELLS)
        with dr.suspend_grad():
            for k in range(times):
                (p, side, _, valid), _, (direction, reflected) = _trace(scene, sensor, lights, seed + k + 1, n_paths)
                cell = np.array(voxels.entry(p, guides.ENTRIES, side))
                keep = np.array(valid & (direction < guides.N_BINS) & dr.isfinite(reflected))
                cell, index, light = (np.array(v)[keep] for v in (cell, direction, reflected))
                found += np.bincount(cell * guides.N_BINS + index, np.minimum(light, BRIGHTEST), found.size)
                count += np.bincount(cell, minlength=count.size)
        self.guide = Guide(*self.box, found.reshape(-1, guides.N_BINS), count)

    def _fill(self, p, side, target, valid, light) -> None:
        """Means by cell. Added up in memory order: sums of atomic additions differ from run to run."""
        valid = np.array(valid)
        index = np.array(self.voxels.entry(p, ENTRIES, side))[valid]
        target, sampled, arrived = (np.array(v)[valid].astype(np.float64) for v in (target, *light))
        n = np.bincount(index, minlength=ENTRIES)
        total, n_sampled, n_arrived = (np.bincount(index, v, ENTRIES) for v in (target, sampled, arrived))
        mean = total.sum() / max(n.sum(), 1)
        self.mean = mi.Float(float(mean))
        self.ahead = mi.Float(((total + PRIOR * mean) / (n + PRIOR)).astype(np.float32))
        self.visible = mi.Float(((n_arrived + 0.5) / (n_sampled + 0.5)).astype(np.float32))
        dr.make_opaque(self.mean, self.ahead, self.visible)


class _Watched(paths.Surface):
    """A surface that notes which light samples could arrive, and which did."""

    untested, sampled, arrived = True, None, None

    def light_arriving(self, scene, tested, ds, light, f, sampled, sampler):
        self.sampled = sampled & (dr.max(f * light) > 0)
        self.arrived = self.sampled & ~scene.ray_test(self.it.spawn_ray_to(ds.p), self.sampled)
        return light, self.arrived, sampler


def _trace(scene, sensor, lights, seed: int, n: int) -> tuple:
    """Records of `n` paths: ((position, side of the normal, luminance that leaves, valid), (sampled, arrived), (bin of
    the direction that was followed, luminance that it brought, times the BSDF over its density))."""
    lane, size = dr.arange(mi.UInt32, n), n * N_VERTICES
    sampler = PathSampler.make(lane, dr.opaque(mi.UInt32, seed & 0xFFFFFFFF))
    ray = film_rays(sensor, sampler.next_2d(), sampler)
    path = paths.start(ray, scene.ray_intersect(ray), mi.Bool(True))
    zeros = [dr.zeros(mi.Float, size) for _ in range(6)]
    x, y, z, before, between, β = zeros
    facts, bins = dr.zeros(mi.UInt32, size), dr.zeros(mi.UInt32, size)
    dr.eval(zeros, facts, bins)

    def step(path, sampler):
        seen = []

        def direct(scene, lights, path, bsdf, found, numbers, sampler, alone=None):
            seen.append(_Watched(path, bsdf, found))
            return paths.direct_light(scene, lights, path, bsdf, found, numbers, sampler, alone, seen[0])

        si = path.si
        found, sampler = paths.bounce(scene, lights, path, sampler, direct=direct)
        takes = vertex.is_smooth(si, path.active) & (path.depth <= N_VERTICES)
        k = (path.depth - 1) * n + lane
        bits = [dr.select(b, mi.UInt32(v), 0) for b, v in ((seen[0].sampled, 8), (seen[0].arrived, 16))]
        fact = main_side(vertex.facing(si)) | bits[0] | bits[1]
        L_nee = mi.luminance(path.L + path.β * found.L_nee)
        index = dr.select(found.delta | ~found.followed, guides.N_BINS, guides.bin_of(found.ray.d))
        for array, value in ((x, si.p.x), (y, si.p.y), (z, si.p.z), (before, mi.luminance(path.L)), (between, L_nee),
                             (β, mi.luminance(path.β)), (facts, fact), (bins, index)):  # fmt: skip
            dr.scatter(array, value, k, takes)
        return paths.roulette(paths.advance(path, found), sampler, N_VERTICES)

    path, _ = dr.while_loop((path, sampler), lambda path, sampler: path.active, step, label="paths of an outlook")
    L = mi.luminance(path.L)
    dr.eval(L, zeros, facts, bins)
    all_L = dr.gather(mi.Float, L, dr.arange(mi.UInt32, size) % n)
    target = dr.maximum((all_L - before) / dr.maximum(β, 1e-9), 0)
    valid = (β > 0) & dr.isfinite(target)
    reflected = dr.maximum((all_L - between) / dr.maximum(β, 1e-9), 0)
    p = mi.Point3f(x, y, z)
    dr.eval(p, target, valid, reflected)
    return (p, facts & 7, target, valid), ((facts & 8) > 0, (facts & 16) > 0), (bins, reflected)
