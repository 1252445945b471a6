"""A multiresolution hash grid (Müller et al. 2022) over all of space: the box that it is made for has no border.

Cells go on beyond the box at the size that they have in it, so that a camera may walk on to where it began with nothing
to be grown, fitted or forgotten; entries are shared by hashing, as they are within the box on fine levels.
"""

from __future__ import annotations

import drjit as dr
import drjit.nn as nn

#: Points are moved to so many boxes from the box at most: numbers of cells then fit into integers.
FARTHEST = 2.0**14
#: Factors of the hash of a cell (Müller et al. 2022, eq. 4), and of that of a tile, a block of cells of a dense level.
CELL_FACTORS = 1, 2654435761, 805459861
TILE_FACTORS = 2097192037, 1434869437, 2165219737
#: Tiles have at least so many digits along an axis.
MIN_BITS = 4


class HashGrid(nn.HashGridEncoding):
    """As its base class in three dimensions, but for points anywhere: the unit cube is where most of them lie.

    Where a level's cells in the cube, padded to a power of two along each axis, are no more than `hashmap_size`, each
    has an entry of its own. All of space is tiled by such blocks, and the entry of a cell is its number in its tile
    XOR a hash of the tile: cells of one tile never share an entry, cells of two tiles share them at random.
    """

    def __init__(self, *args, **keys):
        super().__init__(*args, **keys)
        offset = 0
        for level in range(self.n_levels):
            self._level_offsets[level] = offset
            bits = self._tile_bits(level)
            offset += self.hashmap_size if bits is None else 2 ** (3 * bits)
        self._level_offsets[-1] = offset
        self._n_params = offset * self.n_features_per_level
        low, high = -self.init_scale, self.init_scale
        self.data = keys["rng"].random(self.dtype, self._n_params) * (high - low) + low
        dr.schedule(self.data)

    def _tile_bits(self, level: int) -> int | None:
        """Digits of a cell's number along each axis of a tile; None: the level has no tiles, all its cells are hashed.
        """
        # Cells of the cube have corners 0 .. resolution; in tables of a few entries most tiles would share them all
        bits = max(MIN_BITS, int(self._resolution(self._level_scale(level))).bit_length())
        return bits if 2 ** (3 * bits) <= self.hashmap_size else None

    def _keys(self, cell, level: int) -> list:
        """What the three coordinates of a cell contribute to its entry: the entry is their XOR."""
        bits, cell = self._tile_bits(level), [self.Int32(c) for c in cell]
        if bits is None:
            return [self.UInt32(c) * f for c, f in zip(cell, CELL_FACTORS, strict=True)]
        return [
            (self.UInt32(c & (2**bits - 1)) << (bits * axis)) ^ (self.UInt32(c >> bits) * f)
            for axis, (c, f) in enumerate(zip(cell, TILE_FACTORS, strict=True))
        ]

    def __call__(self, p, active=True):
        p = [dr.clip(c, -FARTHEST, FARTHEST) for c in p]
        values = [self.StorageFloat(0)] * (self.n_features_per_level * self.n_levels)
        for level in range(self.n_levels):
            first, size = self._level_offsets[level], self._level_offsets[level + 1] - self._level_offsets[level]
            position = [dr.fma(c, self._level_scale(level), 0.5) for c in p]
            cell = [dr.floor(c) for c in position]
            share = [c - f for c, f in zip(position, cell, strict=True)]
            low = [self.Int32(f) for f in cell]
            keys = self._keys(low, level), self._keys([c + 1 for c in low], level)
            shares = [1 - s for s in share], share
            for corner in range(8):
                i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
                weight = shares[i][0] * shares[j][1] * shares[k][2]
                key = keys[i][0] ^ keys[j][1] ^ keys[k][2]
                key = key & (size - 1) if size & (size - 1) == 0 else key % self.UInt32(size)
                self._acc_features(level, weight, first + key, values, active)
        return self.StorageFloatXf(*values) & active
