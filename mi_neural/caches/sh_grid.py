"""Control: incident radiance as spherical harmonics on a hash grid, without a network.

The features of the grid are the coefficients themselves, one set a level, summed over the levels; radiance is their dot
product with the harmonics of the direction. A query after the encoding is a handful of multiplications; what a network
could generalise from place to place and from direction to direction is not there. Trained, averaged, blended and filed
as a :class:`~mi_neural.caches.field.Field`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import encoding
from .field import Field
from .hash_grid import HashGrid
from .incident import IncidentCache


@dataclass(frozen=True)
class HarmonicShape:
    """Sizes of a harmonic field.

    n_levels, base_resolution, per_level_scale   of the grid, see :class:`~mi_neural.caches.weights.FieldShape`
    hashmap_size   most numbers of a level
    degree         of the spherical harmonics
    """

    n_levels: int = 4
    hashmap_size: int = 2**18
    base_resolution: int = 6
    per_level_scale: float = 2.0
    degree: int = 1

    def __post_init__(self):
        for name, most in (("n_levels", 16), ("hashmap_size", 2**24), ("base_resolution", 2**12)):
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in 1..{most}")
        if not 1 < self.per_level_scale <= 16:
            raise ValueError(f"per_level_scale is {self.per_level_scale}; it must be greater than 1 and at most 16")
        if not 0 <= self.degree <= 3:
            raise ValueError(f"degree is {self.degree}; it must lie in 0..3")

    @property
    def n_harmonics(self) -> int:
        return (self.degree + 1) ** 2

    @property
    def n_encoded(self) -> int:
        """Values that the encoding of a position has: coefficients of three colours."""
        return 3 * self.n_harmonics

    @property
    def n_stored(self) -> int:
        """Numbers of an entry: the coefficients, made even."""
        return self.n_encoded + self.n_encoded % 2


class HarmonicWeights:
    """One set of coefficients. A PyTree, with the protocol of :class:`~mi_neural.caches.weights.Weights`."""

    DRJIT_STRUCT = {"grid": object}  # noqa: RUF012
    order = None  # nothing is packed

    def __init__(self, shape: HarmonicShape, seed: int):
        size = max(shape.hashmap_size // shape.n_stored, 1) * shape.n_stored
        self.grid = HashGrid(
            mi.Float, 3, n_levels=shape.n_levels, n_features_per_level=shape.n_stored, hashmap_size=size,
            base_resolution=shape.base_resolution, per_level_scale=shape.per_level_scale, init_scale=1e-3,
            rng=dr.rng(seed=2 * seed),
        )  # fmt: skip

    def parameters(self) -> dict:
        return {"grid": mi.Float(self.grid.data)}

    def assign(self, parameters) -> None:
        self.grid.data = parameters["grid"]

    def finite(self):
        """Whether all coefficients are, 1-wide."""
        return dr.isfinite(dr.sum(dr.detach(self.grid.data)))

    def pack(self) -> None:
        """Queries read the grid itself."""


class HarmonicField(Field):
    """``query(features, w)`` is `scale` times ``max(0, 1 + sum of coefficients(x) harmonics(w))``."""

    KIND, WEIGHTS = "sh_grid", HarmonicWeights

    def __init__(self, box_min, box_max, shape: HarmonicShape | None = None, *, scale: float = 1.0, seed: int = 0):
        super().__init__(box_min, box_max, shape or HarmonicShape(), scale=scale, seed=seed)

    def features(self, weights: HarmonicWeights, x) -> list:
        values = list(weights.grid(encoding.in_box(x, self.box_min, self.box_inv_extent)))
        levels = [values[k :: self.shape.n_stored] for k in range(self.shape.n_encoded)]
        return [sum(level[1:], level[0]) for level in levels]

    def output(self, weights: HarmonicWeights, features: list, w):
        harmonics, n = encoding.direction(w, self.shape.degree), self.shape.n_harmonics
        return mi.Color3f(*(
            sum((c * y for c, y in zip(features[i * n : (i + 1) * n], harmonics, strict=True)), mi.Float(1))
            for i in range(3)
        ))  # fmt: skip

    def predict(self, x, w, n=None):
        weights = self.trainable()
        return self.output(weights, self.features(weights, self.lift(x, n)), w)

    @classmethod
    def make(cls, constants: dict) -> HarmonicField:
        return cls(*constants["box"], HarmonicShape(**constants["shape"]), scale=constants["scale"],
                   seed=constants["seed"])  # fmt: skip


class HarmonicCache(IncidentCache):
    """A harmonic field together with its training. In all but what it learns an `IncidentCache`."""

    FIELD, SHAPE = HarmonicField, HarmonicShape
