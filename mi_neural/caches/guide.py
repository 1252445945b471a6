"""Where light comes from, by place: a table of directions for each cell, to sample from.

Each cube, of six sides for the normal, holds a histogram over the sphere of how much light was found in each direction,
times the BSDF. A table serves all surfaces in its cube, so it is mixed with the BSDF (:class:`Guided`).
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
N_Z, N_PHI = 12, 24
N_BINS = N_Z * N_PHI
#: Density of each bin over that of the sphere.
DENSITY = N_BINS / (4 * np.pi)
#: Share of each table that is uniform, and of each bin that goes to each of its four neighbours.
UNIFORM, BLUR = 0.02, 0.125


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


def shares_of(light: np.ndarray) -> np.ndarray:
    """Probabilities of the bins, from the light that was found in each: (cells, bins), each row adds up to 1."""
    h = light.reshape(-1, N_Z, N_PHI)
    wide = (1 - 4 * BLUR) * h + BLUR * (np.roll(h, 1, 2) + np.roll(h, -1, 2))
    up, down = np.concatenate([h[:, 1:], h[:, -1:]], 1), np.concatenate([h[:, :1], h[:, :-1]], 1)
    wide = (wide + BLUR * (up + down)).reshape(-1, N_BINS)
    total = wide.sum(axis=1, keepdims=True)
    shares = np.where(total > 0, wide / np.maximum(total, 1e-300), 1 / N_BINS)
    return (1 - UNIFORM) * shares + UNIFORM / N_BINS


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
        shares = shares_of(light)
        sums = np.cumsum(shares, axis=1)
        sums[:, -1] = 2  # above all numbers
        self.known = mi.UInt32(((count >= FEW) & (light.sum(axis=1) > 0)).astype(np.uint32))
        self.shares, self.sums = (mi.Float(v.astype(np.float32).ravel()) for v in (shares, sums))
        dr.make_opaque(self.known, self.shares, self.sums)

    def entry(self, p, side):
        return self.voxels.entry(p, ENTRIES, side)

    def sample(self, cell, u, point, active):
        """A direction from the table of a cell, by a number and a point that are uniform."""
        index, first, step = mi.UInt32(0), cell * N_BINS, 1 << (N_BINS - 1).bit_length() - 1
        while step:  # the first bin whose sum is above u
            after = index + step
            below = dr.gather(mi.Float, self.sums, first + dr.minimum(after, N_BINS) - 1, active) <= u
            index = dr.select((after < N_BINS) & below, after, index)
            step //= 2
        return direction_in(index, point)

    def guided(self, bsdf, si, share, active) -> Guided:
        """A BSDF at `si` with directions from here, see :class:`Guided`."""
        return Guided(bsdf, self, si, share, active)

    def pdf(self, cell, d, active):
        """Density of :meth:`sample`, in solid angle."""
        return DENSITY * dr.gather(mi.Float, self.shares, cell * N_BINS + bin_of(d), active)


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
        use = active & (sample1 < share)
        u = dr.select(use, sample1 / dr.maximum(share, 1e-6), (sample1 - share) / (1 - share))
        bs, weight = self.bsdf.sample(ctx, si, u, sample2, active & ~use)
        d = self.guide.sample(self.cell, u, sample2, use)
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
