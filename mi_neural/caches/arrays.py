"""Caches without a network: a few arrays, and any rule by which records change them.

What an integrator asks is a *field*: a PyTree with ``encode(x, n)`` and ``query(features, w)``. How it is trained is
the business of a cache: an :class:`~mi_neural.caches.incident.IncidentCache`, or a class of one's own that derives from
it and gives ``make_field`` and ``learn``. ``nirc`` takes one by ``use_cache(cache)``; notebook 08 writes one.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from . import encoding
from .field import TrainedField
from .optimizer import own_copy


class ArrayField(TrainedField):
    """Base of fields that learn by changing arrays in place. A PyTree: may be passed to frozen functions.

    ``box_min``, ``box_inv_extent``: the box in which records fall, world space; ``scale``: mean radiance of the scene,
    1-wide. Subclasses name their arrays in `ARRAYS` and give

    zeros()            the arrays as they are before training: name -> array
    encode(x, n)       what depends on the point alone: a list of arrays. `n`: unit normal on the seen side, or None
    query(features, w) radiance (Color3f) from direction `w` at the encoded position, finite and never negative
    """

    #: Names of the attributes that training changes.
    ARRAYS: tuple[str, ...] = ()

    def __init_subclass__(cls, **kw):
        super().__init_subclass__(**kw)
        cls.DRJIT_STRUCT = {k: object for k in (*cls.ARRAYS, "box_min", "box_inv_extent", "scale")}

    def __init__(self, box_min, box_max, shape=None, *, scale: float = 1.0):
        self.box = ([float(v) for v in box_min], [float(v) for v in box_max])
        self.shape, self.steps = shape, 0
        low, high = (np.asarray(corner, np.float64) for corner in self.box)
        self.box_min = mi.Point3f(low.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (high - low)).tolist())
        self.scale = mi.Float(float(scale))
        dr.make_opaque(self.box_min, self.box_inv_extent, self.scale)
        self.reset()

    # -------------------------------------------------------------------------------------------------------------
    # To be given by subclasses

    def zeros(self) -> dict:
        """The arrays of `ARRAYS` before training."""
        raise NotImplementedError(f"{type(self).__name__} must define zeros()")

    def encode(self, x, n=None) -> list:
        """What depends on the point alone, as a list of arrays."""
        raise NotImplementedError(f"{type(self).__name__} must define encode()")

    def query(self, features: list, w):
        """Radiance from direction `w` at the encoded position."""
        raise NotImplementedError(f"{type(self).__name__} must define query()")

    # -------------------------------------------------------------------------------------------------------------

    def unit(self, x):
        """World space to the unit cube; what lies outside the box is moved to its surface."""
        return encoding.to_unit_cube(x, self.box_min, self.box_inv_extent)

    def reset(self) -> None:
        """Forget what was learned."""
        for name, value in self.zeros().items():
            setattr(self, name, own_copy(value))
        self.steps = 0

    def optimizers(self) -> list:
        return []

    def sync(self) -> None:
        """There is one set of numbers: nothing to bring up to date."""

    def n_parameters(self) -> int:
        return sum(int(np.array(getattr(self, k)).size) for k in self.ARRAYS)

    def snapshot(self) -> dict[str, np.ndarray]:
        return {k: np.array(getattr(self, k)) for k in self.ARRAYS}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        for k in self.ARRAYS:
            setattr(self, k, own_copy(type(getattr(self, k))(arrays[k])))

    def arrays(self) -> dict[str, np.ndarray]:
        return self.snapshot()

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        expected = {k: v.shape for k, v in self.snapshot().items()}
        if {k: v.shape for k, v in arrays.items() if k in expected} != expected:
            raise ValueError("its arrays do not have the sizes that its header says")
        self.restore(arrays)

    def constants(self) -> dict:
        return {"shape": self.shape, "box": self.box, "scale": float(self.scale[0])}

    @classmethod
    def make(cls, constants: dict) -> ArrayField:
        return cls(*constants["box"], constants["shape"], scale=constants["scale"])
