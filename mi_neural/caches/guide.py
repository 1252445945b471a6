"""Where light comes from, by place: a table of directions for each cell, to sample from.

Each cube, of six sides for the normal, holds a histogram over the sphere of how much light was found in each direction,
times the BSDF (path guiding, after Jensen 1995; the mix with the BSDF and learning while rendering as in Müller, Gross
and Novák 2017). A table serves all surfaces in its cube, so it is mixed with the BSDF (:class:`Guided`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render import vertex
from .voxels import Voxels, main_side

#: Cubes along the longest axis of the box, entries of the table of cells, and records that a cell must have.
CELLS, ENTRIES, FEW = 16, 2**12, 64
#: Bins of the cosine with the vertical axis and of the azimuth: all of the same solid angle.
N_Z, N_PHI = 8, 16
N_BINS = N_Z * N_PHI
#: Density of each bin over that of the sphere.
DENSITY = N_BINS / (4 * np.pi)
#: Share of each table that is uniform, and of each bin that goes to each of its four neighbours.
UNIFORM, BLUR = 0.02, 0.125
#: Light above so many times the scene's mean counts as that.
BRIGHTEST = 1e4
#: Training steps that learned tables remember, over those of the cache's average. Images that are not denoised have 0.9
#: (veach-bidir) to 0.98 times the squared error with 1 (64 samples, after 130 and 400 steps).
REMEMBERS = 4


def bin_of(d):
    """The bin of a unit direction."""
    z = mi.UInt32(dr.clip((d.z + 1) * (N_Z / 2), 0, N_Z - 1))
    φ = dr.atan2(d.y, d.x) * (N_PHI / (2 * dr.pi))
    return z * N_PHI + mi.UInt32(dr.clip(dr.select(φ < 0, φ + N_PHI, φ), 0, N_PHI - 1))


def direction_in(index, u):
    """A unit direction in a bin, uniform for uniform `u`."""
    z = (mi.Float(index // N_PHI) + u.x) * (2 / N_Z) - 1
    s, c = dr.sincos((mi.Float(index % N_PHI) + u.y) * (2 * dr.pi / N_PHI))
    r = dr.safe_sqrt(1 - z * z)
    return mi.Vector3f(r * c, r * s, z)


def shares_of(light):
    """Probabilities of the bins, from the light that was found in each, and their sums up to each bin, the last above
    all numbers."""
    lane = dr.arange(mi.UInt32, dr.width(light))
    k = lane % N_BINS
    first, z, φ = lane - k, k // N_PHI, k % N_PHI

    def at(z, φ):
        return dr.gather(mi.Float, light, first + z * N_PHI + φ % N_PHI)

    around = at(z, φ + 1) + at(z, φ + N_PHI - 1) + at(dr.minimum(z + 1, N_Z - 1), φ) + at(dr.maximum(z, 1) - 1, φ)
    wide = (1 - 4 * BLUR) * at(z, φ) + BLUR * around
    total = dr.gather(mi.Float, dr.block_sum(wide, N_BINS), lane // N_BINS)
    shares = dr.select(total > 0, wide / dr.maximum(total, 1e-30), 1 / N_BINS)
    shares = (1 - UNIFORM) * shares + UNIFORM / N_BINS
    sums = dr.block_prefix_sum(shares, N_BINS, exclusive=False)
    return shares, dr.select(k == N_BINS - 1, 2, sums)


def _first_above(value_of, n: int, u):
    """The first of `n` ascending values that is above `u`; the last one is."""
    index, step = mi.UInt32(0), 1 << (n - 1).bit_length() - 1
    while step:
        after = index + step
        index = dr.select((after < n) & (value_of(dr.minimum(after, n) - 1) <= u), after, index)
        step //= 2
    return index


class Guide:
    """Tables of directions by place. A PyTree.

    known   whether a cell has one
    shares  probabilities of its bins
    sums    of the bins up to each, that one included
    """

    DRJIT_STRUCT = {"voxels": object, "known": object, "shares": object, "sums": object}  # noqa: RUF012

    def __init__(self, low=None, high=None, light: np.ndarray | None = None, count: np.ndarray | None = None):
        if low is None:  # as Dr.Jit makes one
            return
        self.voxels = Voxels(low, high, CELLS)
        self._fill(mi.Float(np.float32(light).ravel()), mi.Float(np.float32(count)))

    def _fill(self, light, count) -> None:
        """Take the tables from the light that was found in each bin, and the number of records of each cell."""
        self.known = dr.select((count >= FEW) & (dr.block_sum(light, N_BINS) > 0), mi.UInt32(1), 0)
        self.shares, self.sums = shares_of(light)
        dr.eval(self.known, self.shares, self.sums)

    def entry(self, p, side):
        return self.voxels.entry(p, ENTRIES, side)

    def sample(self, cell, point, active):
        """A direction from the table of a cell, by a point that is uniform in the unit square: strata of points are
        strata of directions."""

        def sum_to(k):
            return dr.gather(mi.Float, self.sums, cell * N_BINS + k, active)

        def within(u, k):  # u between the sums before and up to bin k
            before = dr.select(k > 0, sum_to(dr.maximum(k, 1) - 1), 0)
            return before, dr.minimum(sum_to(k), 1) - before

        row = N_PHI * _first_above(lambda row: sum_to(row * N_PHI + N_PHI - 1), N_Z, point.x)
        low = dr.select(row > 0, sum_to(dr.maximum(row, 1) - 1), 0)
        width = dr.minimum(sum_to(row + N_PHI - 1), 1) - low
        across = low + width * point.y
        index = row + _first_above(lambda k: sum_to(row + k), N_PHI, across)
        before, share = within(across, index)
        u = (point.x - low) / dr.maximum(width, 1e-9), (across - before) / dr.maximum(share, 1e-9)
        return direction_in(index, mi.Point2f(*(dr.clip(v, 0, dr.one_minus_epsilon(mi.Float)) for v in u)))

    def guided(self, bsdf, si, share, active) -> Guided:
        """A BSDF at `si` with directions from here, see :class:`Guided`."""
        return Guided(bsdf, self, si, share, active)

    def pdf(self, cell, d, active):
        """Density of :meth:`sample`, in solid angle."""
        return DENSITY * dr.gather(mi.Float, self.shares, cell * N_BINS + bin_of(d), active)


class LearnedGuide(Guide):
    """A guide that learns from the records of training steps. A PyTree.

    light  what was found in each bin, over the scene's mean
    count  records of each cell
    scale  the scene's mean radiance

    `steps`: training steps that the tables are of; -1: none.
    """

    DRJIT_STRUCT = {**Guide.DRJIT_STRUCT, "light": object, "count": object, "scale": object}  # noqa: RUF012

    def __init__(self, low, high, scale: float = 1.0):
        self.voxels, self.scale = Voxels(low, high, CELLS), mi.Float(float(scale))
        dr.make_opaque(self.scale)
        self.reset()

    def reset(self) -> None:
        """Forget all directions."""
        self.light, self.count = dr.zeros(mi.Float, ENTRIES * N_BINS), dr.zeros(mi.Float, ENTRIES)
        dr.make_opaque(self.light, self.count)
        self._fill(self.light, self.count)
        self.steps = 0

    def observe(self, records, reflected, decay) -> None:
        """Take in incident `records` and how much light each `reflected`. `decay`: of what the cache's average holds,
        which forgets faster than a bin. May be frozen; :meth:`refresh` makes tables of it."""
        decay = 1 - (1 - decay) / REMEMBERS
        light = mi.luminance(reflected) / self.scale
        valid = records.valid & dr.isfinite(light)
        cell = self.entry(records.position, main_side(records.normal))
        self.light, self.count = self.light * decay, self.count * decay
        dr.scatter_add(self.light, dr.clip(light, 0, BRIGHTEST), cell * N_BINS + bin_of(records.direction), valid)
        dr.scatter_add(self.count, 1, cell, valid)
        dr.eval(self.light, self.count)

    def refresh(self, steps: int) -> None:
        """Bring the tables up to date after so many training steps."""
        if steps != self.steps:
            self._fill(self.light, self.count)
            self.steps = steps

    def arrays(self) -> dict[str, np.ndarray]:
        """All that was learned."""
        return {"guide.light": np.array(self.light), "guide.count": np.array(self.count)}

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from :meth:`arrays`. Raises ``ValueError`` where one does not fit."""
        if {k: v.shape for k, v in arrays.items()} != {k: v.shape for k, v in self.arrays().items()}:
            raise ValueError("its tables of directions do not have the sizes of this guide")
        self.light, self.count = (mi.Float(np.float32(v)) for v in arrays.values())
        self.steps = -1


class Guided:
    """A BSDF whose directions come from a guide with probability `share`, where there is a table and nothing shines
    through. In the place of a BSDF: E[f cos / p L] is kept."""

    def __init__(self, bsdf, guide: Guide, si, share, active):
        self.bsdf, self.guide = bsdf, guide
        self.cell = guide.entry(si.p, main_side(vertex.facing(si)))
        may = active & vertex.has_smooth(bsdf) & ~vertex.transmits(bsdf) & (share > 0)
        self.share = dr.select(may & (dr.gather(mi.UInt32, guide.known, self.cell, may) > 0), share, 0)

    def flags(self):
        return self.bsdf.flags()

    def sample(self, ctx, si, sample1, sample2, active=True):
        share = self.share
        # Points are divided, not lobes: either part of a stratified square is one
        use = active & (sample2.x < share)
        x = dr.select(use, sample2.x / dr.maximum(share, 1e-6), (sample2.x - share) / (1 - share))
        point = mi.Point2f(dr.minimum(x, dr.one_minus_epsilon(mi.Float)), sample2.y)
        bs, weight = self.bsdf.sample(ctx, si, sample1, point, active & ~use)
        d = self.guide.sample(self.cell, point, use)
        bs.wo = dr.select(use, si.to_local(d), bs.wo)
        f, pdf = self.bsdf.eval_pdf(ctx, si, bs.wo, use)
        f, pdf = dr.select(use, f, weight * bs.pdf), dr.select(use, pdf, bs.pdf)
        single = ~use & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        mixed = (share > 0) & ~single
        both = (1 - share) * pdf + share * self.guide.pdf(self.cell, si.to_world(bs.wo), mixed & active)
        weight = dr.select(single, weight / (1 - share), dr.select(mixed, f / dr.maximum(both, 1e-20), weight))
        bs.pdf = dr.select(mixed, both, bs.pdf)
        bs.eta = dr.select(use, 1, bs.eta)
        bs.sampled_type = dr.select(use, mi.UInt32(int(mi.BSDFFlags.DiffuseReflection)), bs.sampled_type)
        return bs, weight

    def eval_pdf(self, ctx, si, wo, active=True):
        f, pdf = self.bsdf.eval_pdf(ctx, si, wo, active)
        guided = (self.share > 0) & active
        return f, (1 - self.share) * pdf + self.share * self.guide.pdf(self.cell, si.to_world(wo), guided)
