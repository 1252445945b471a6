"""Control: incident radiance as means over cells of place and direction, without anything that is trained.

Space is divided into cells on several levels, the sphere of directions into bins; each record is added to its cell and
bin on every level (a scatter-add). A query begins with the scene's mean and refines it from the coarsest level to the
finest, as far as there are records: ``m <- (S + κ m) / (W + κ)`` with the sum S of the W records of a cell and bin, κ
records standing for what the coarser levels say. Where nothing fell, that is the answer.

Queries are moved at random within a cell and a bin, by numbers that the point itself gives, so that their mean
interpolates between neighbours at the price of one.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import encoding, loss
from .field import TrainedField
from .incident import TARGET_MAX, IncidentCache
from .optimizer import own_copy
from .voxels import check_box

#: Means reach back this many times as far as averaged weights do: they have no other way to be rid of noise.
MEMORY = 6.0
#: Numbers of an entry: the sums of three colours and of weights.
N_VALUES = 4


@dataclass(frozen=True)
class HashShape:
    """Sizes of a spatial hash.

    n_levels, base_resolution, per_level_scale   levels of cells, cells along an axis on the coarsest, factor from level
                   to level
    hashmap_size   entries of a level
    n_bins         bins of directions along each side of the octahedral square
    prior          κ, records that the coarser levels count as
    """

    n_levels: int = 3
    hashmap_size: int = 2**18
    base_resolution: int = 6
    per_level_scale: float = 2.0
    n_bins: int = 4
    prior: float = 4.0

    def __post_init__(self):
        for name, most in (("n_levels", 16), ("hashmap_size", 2**22), ("base_resolution", 2**12), ("n_bins", 64)):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in 1..{most}")
        if not 1 < self.per_level_scale <= 16:
            raise ValueError(f"per_level_scale is {self.per_level_scale}; it must be greater than 1 and at most 16")
        if not self.prior > 0:
            raise ValueError(f"prior is {self.prior}; it must be greater than 0")

    @property
    def n_encoded(self) -> int:
        """Values that the encoding of a position has: one cell a level."""
        return self.n_levels

    def resolution(self, level: int) -> int:
        """Cells along an axis."""
        return max(1, round(self.base_resolution * self.per_level_scale**level))


class SpatialHash(TrainedField):
    """Mean radiance by cell and bin of direction, with the queries of a :class:`~mi_neural.caches.field.Field`.

    Parameters: as there. A PyTree. `table` holds, for each level and entry, the decayed sums of radiance over `scale`
    and of weights, one after the other.
    """

    KIND = "spatial_hash"
    DRJIT_STRUCT = {  # noqa: RUF012
        "table": object, "box_min": object, "box_inv_extent": object, "scale": object, "mean": object,
    }  # fmt: skip

    def __init__(self, box_min, box_max, shape: HashShape | None = None, *, scale: float = 1.0, seed: int = 0):
        self.shape, self.seed = shape or HashShape(), seed
        box_min, box_max = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        check_box(box_min, box_max)
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number")
        self.box = (box_min.tolist(), box_max.tolist())
        self.box_min = mi.Point3f(box_min.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (box_max - box_min)).tolist())
        self.scale = mi.Float(float(scale))
        self.reset()

    def reset(self) -> None:
        """Forget all records."""
        self.table = dr.zeros(mi.Float, self.shape.n_levels * self.shape.hashmap_size * N_VALUES)
        self.mean = mi.Float(1.0)  # running mean of the targets over `scale`
        self.steps = 0
        dr.make_opaque(self.table, self.box_min, self.box_inv_extent, self.scale, self.mean)

    # -------------------------------------------------------------------------------------------------------------
    # Query

    def cells(self, x, jitter: bool) -> list:
        """Number of the cell of x on each level, coarsest first."""
        unit = encoding.to_unit_cube(x, self.box_min, self.box_inv_extent)
        offset = _offsets(x) if jitter else mi.Vector3f(0)
        cells = []
        for level in range(self.shape.n_levels):
            n = self.shape.resolution(level)
            i = mi.Point3u(dr.clip(unit * n + offset, 0, n - 1))
            # Numbers of cells where they are few enough for the table, else hashed
            few = n**3 * self.shape.n_bins**2 <= self.shape.hashmap_size
            cells.append((i.z * n + i.y) * n + i.x if few else i.x ^ (i.y * 2654435761) ^ (i.z * 805459861))
        return cells

    def entries(self, cells: list, w, offset) -> list:
        """Entry of each level's cell in direction `w`; `offset`: two numbers in [-1/2, 1/2] to move it by, in bins."""
        n = self.shape.n_bins
        square = encoding.octahedral(w) * n + offset
        bin_ = mi.Point2u(dr.clip(square, 0, n - 1))
        within = bin_.y * n + bin_.x
        return [
            (cell * (n * n) + within) % self.shape.hashmap_size + level * self.shape.hashmap_size
            for level, cell in enumerate(cells)
        ]

    def encode(self, x, n=None, averaged: bool = True) -> list:
        """What depends on the position alone. There is one set of means, whether `averaged` or not."""
        return self.cells(x, jitter=True)

    def raw(self, features: list, w, averaged: bool = True):
        """Mean radiance over `scale`."""
        offset = _offsets(w)
        value = mi.Color3f(1)
        for entry in self.entries(features, w, mi.Vector2f(offset.x, offset.y)):
            found = dr.gather(mi.Vector4f, self.table, entry)
            share = dr.rcp(found.w + self.shape.prior)
            value = (mi.Color3f(found.x, found.y, found.z) + self.shape.prior * value) * share
        return value

    def query(self, features: list, w, averaged: bool = True):
        """Radiance from direction `w` (unit, away from the surface) at the encoded position; never negative."""
        return dr.maximum(self.raw(features, w), 0) * self.scale

    # -------------------------------------------------------------------------------------------------------------
    # Training

    def add(self, x, w, y, valid, decay) -> None:
        """Take in records of radiance `y` over `scale`; those before weigh `decay`."""
        table = self.table * decay
        for entry in self.entries(self.cells(x, jitter=False), w, mi.Vector2f(0)):
            dr.scatter_add(table, mi.Vector4f(y.x, y.y, y.z, 1), entry, valid)
        self.table = table
        dr.eval(self.table)

    # -------------------------------------------------------------------------------------------------------------
    # State and files

    def optimizers(self) -> list:
        return []

    def n_parameters(self) -> int:
        """Number of sums that are kept."""
        return dr.width(self.table)

    def snapshot(self) -> dict[str, np.ndarray]:
        return {"table": np.array(self.table)}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        self.table = own_copy(mi.Float(np.asarray(arrays["table"], np.float32)))

    def arrays(self) -> dict[str, np.ndarray]:
        return self.snapshot()

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        if arrays["table"].shape != (dr.width(self.table),):
            raise ValueError("its table does not have the size that its header says")
        if (arrays["table"][N_VALUES - 1 :: N_VALUES] < 0).any():
            raise ValueError("its table has negative weights")
        self.restore(arrays)

    def constants(self) -> dict:
        return {"shape": asdict(self.shape), "box": self.box, "scale": float(self.scale[0]), "seed": self.seed}

    @classmethod
    def make(cls, constants: dict) -> SpatialHash:
        shape, scale, seed = (constants[k] for k in ("shape", "scale", "seed"))
        return cls(*constants["box"], HashShape(**shape), scale=scale, seed=seed)

    def scalars(self) -> dict:
        return {**super().scalars(), "mean": float(self.mean[0])}

    def set_scalars(self, given: dict) -> None:
        mean = given["mean"]
        if not (np.isfinite(mean) and mean >= 0):
            raise ValueError(f"it says that targets had a mean of {mean}")
        super().set_scalars(given)
        self.mean = dr.opaque(mi.Float, mean)


def _offsets(v) -> mi.Vector3f:
    """Three numbers in [-1/2, 1/2] that a vector's own digits give."""
    x, y, z = (dr.reinterpret_array(mi.UInt32, mi.Float(c)) for c in (v.x, v.y, v.z))
    a, b = mi.sample_tea_32(x ^ (z * 0x9E3779B9), y, 4)
    return mi.Vector3f(*(mi.Float(u & 0xFFFF) * 2**-16 - 0.5 for u in (a, a >> 16, b)))


class SpatialHashCache(IncidentCache):
    """A spatial hash together with how it is filled. In all but what it keeps an `IncidentCache`."""

    FIELD, SHAPE = SpatialHash, HashShape

    def learn(self, field: SpatialHash, records, seed, learning_rate, decay):
        """Add the records. The loss, of what was known before them, is relative to the mean target; it steers nothing
        but when training counts as settled."""
        with dr.suspend_grad():
            n_valid = dr.maximum(dr.count(records.valid), 1)
            y = dr.select(records.valid, dr.clip(records.target / field.scale, 0, TARGET_MAX), 0)
            p = field.raw(field.encode(records.position, records.normal), records.direction)
            error = dr.select(records.valid, loss.relative_l2(p, y, self.training.epsilon), 0)
            level, prediction = (dr.select(records.valid, loss.luminance(v), 0) for v in (y, p))
            dr.eval(y, error, level, prediction)
            outputs = [dr.sum(v) / n_valid for v in (error, level, prediction)]
            field.mean = dr.lerp(outputs[1], field.mean, decay)
            kept = 1 - (1 - decay) / MEMORY
            field.add(records.position, records.direction, y, records.valid, kept)
            dr.eval(outputs, field.mean)
        return tuple(outputs)
