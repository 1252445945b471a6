"""Random numbers: an independent stream, and low-discrepancy points that spread the samples of one pixel evenly.

The points are Owen-scrambled Sobol points by hashing (Burley, "Practical Hash-based Owen Scrambling", JCGT 9(4), 2020,
section 3 and listings 1-3), the hash being Laine and Karras' with Vegdahl's constants. Each is uniform on
[0, 1)^2, so a single one is as good as an independent number; 2^k of one pixel are stratified.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class PathSampler:
    """Per-lane random numbers of one pass: a PCG32 stream, and the state of the stratified ones.

    `index` is the number of the lane's camera sample in its pixel; `scramble` is equal for all samples of a pixel and
    different between pixels, seeds and whatever else was hashed into it; `group` is equal for pixels whose samples of
    one index shall decide together, see :meth:`together_1d`. A PyTree: it may be a loop variable.
    """

    DRJIT_STRUCT = {"pcg": object, "index": object, "scramble": object, "group": object}  # noqa: RUF012

    def __init__(self, pcg=None, index=None, scramble=None, group=None):
        self.pcg, self.index, self.scramble, self.group = pcg, index, scramble, group

    @classmethod
    def make(cls, lane, seed, index=0, scramble=None, group=None) -> PathSampler:
        """A sampler for each entry of `lane` (``mi.UInt32``); equal lanes and `seed` give equal numbers."""
        state, sequence = mi.sample_tea_32(lane, seed, 6)
        pcg = mi.PCG32(size=dr.width(lane), initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))
        scramble = state if scramble is None else mi.UInt32(scramble)
        return cls(pcg, mi.UInt32(index), scramble, scramble if group is None else mi.UInt32(group))

    def next_1d(self):
        return self.pcg.next_float32()

    def next_2d(self):
        x = self.pcg.next_float32()
        return mi.Point2f(x, self.pcg.next_float32())

    def stratified_2d(self, dimension: int, n: int = 1, i=0):
        """Point ``index * n + i`` of the pixel's sequence number `dimension`."""
        return sobol_2d(self.index * n + i, _hash(self.scramble + mi.UInt32(0x9E3779B9 * (dimension + 1) & 0xFFFFFFFF)))

    def stratified_1d(self, dimension: int, n: int = 1, i=0):
        """As `stratified_2d`, one number."""
        return self.stratified_2d(dimension, n, i).x

    def together_1d(self, dimension):
        """One number, uniform like any other, and the same for all lanes of a group and index.

        For roulette: lanes of one packet that end together end the packet's work, where one that goes on alone keeps
        the whole packet busy. Over the indices of a pixel the numbers are stratified. `dimension` may be an array.
        """
        return sobol_2d(self.index, _hash(self.group + mi.UInt32(dimension) * 0x85EBCA6B)).x


def sobol_2d(index, seed):
    """Point `index` of the Owen-scrambled (0,2)-sequence number `seed`, order shuffled (Burley 2020, listing 3)."""
    index = _owen(index, seed)
    x = dr.brev(index)
    # Second dimension: the direction numbers of Sobol's are those of Pascal's triangle modulo 2, so output bit j is the
    # parity of the input bits k of which j is a bitwise subset (Lucas): four sums over subsets, one for each bit of k.
    # Sixteen bits: 65,536 samples a pixel before the second coordinate repeats, scrambled anew.
    y = index & 0xFFFF
    for shift, mask in ((1, 0xAAAA), (2, 0xCCCC), (4, 0xF0F0), (8, 0xFF00)):
        y = y ^ ((y & mask) >> shift)
    y = dr.brev(y)
    return mi.Point2f(_to_unit(_owen(x, _hash(seed ^ 0x68BC21EB))), _to_unit(_owen(y, _hash(seed ^ 0x02E5BE93))))


def _to_unit(bits):
    return mi.Float(bits >> 8) * 2**-24


def _hash(x):
    """A 32-bit integer hash (Wellons' lowbias32)."""
    x = mi.UInt32(x)
    x = (x ^ (x >> 16)) * 0x21F0AAAD
    x = (x ^ (x >> 15)) * 0x735A2D97
    return x ^ (x >> 15)


def _laine_karras(x, seed):
    """Permute so that each bit depends on lower bits only."""
    x = x ^ (x * 0x3D20ADEA)
    x = x + seed
    x = x * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def _owen(x, seed):
    """Nested uniform (Owen) scrambling of the bits of x, the highest first."""
    return dr.brev(_laine_karras(dr.brev(mi.UInt32(x)), seed))


