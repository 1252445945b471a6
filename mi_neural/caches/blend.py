"""Queries that trust the weights being trained where the light has changed, and their average elsewhere.

``L = (1 - σ) f_averaged + σ f_current``, with σ per cell from :mod:`.reliability`. Where σ is 0 or 1, only one of the
two is evaluated.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .field import Field
from .optimizer import own_copy
from .reliability import Reliability, ReliabilityGrid

BLENDS = ("ema", "fast", "switch", "reliability")
#: Weights this close to 0 or 1 count as that, so that one network need not be asked.
NEGLIGIBLE = 0.02


class Blend:
    """A field's two predictors as one. A PyTree, with the queries of a :class:`~mi_neural.caches.field.Field`.

    field   the field, trained as ever
    fast    a copy of the weights being trained, for queries
    grid    σ by place; none in the mode ``fast``

    `mode`: ``fast`` (σ = 1), ``switch`` (σ rounded to 0 or 1) or ``reliability``.
    """

    DRJIT_STRUCT = {"field": object, "fast": object, "grid": object}  # noqa: RUF012
    #: The grid belongs into files.
    IN_FILES = True

    def __init__(self, field: Field, mode: str, constants: Reliability | None = None):
        self.field, self.mode = field, mode
        self.fast = type(field.averaged)(field.shape, field.seed)
        self.grid = None
        if mode != "fast":
            self.grid = ReliabilityGrid(*field.box, constants, scale=float(field.scale[0]))
        self.refresh()
        dr.eval(self.fast)

    def refresh(self) -> None:
        """Bring `fast` up to date with training. May be frozen."""
        self.fast.assign({k: own_copy(v) for k, v in self.field.optimizer.items()})
        self.fast.pack()

    def snapshot(self) -> dict:
        """The grid as it is now, for :meth:`restore`."""
        if self.grid is None:
            return {}
        return {k: copies(getattr(self.grid, k)) for k in self.grid.LEARNED}

    def restore(self, state: dict) -> None:
        """Take the grid back to a snapshot, and `fast` to what the field holds."""
        for k, v in state.items():
            setattr(self.grid, k, copies(v))
        self.refresh()

    # -------------------------------------------------------------------------------------------------------------
    # Query

    def sigma(self, x, n):
        """Weight of the fast predictor at points with unit normals."""
        if self.grid is None:
            return mi.Float(1)
        sigma = self.grid.sigma_at(x, n)
        if self.mode == "switch":
            return dr.select(sigma > 0.5, mi.Float(1), 0)
        return dr.select(sigma < NEGLIGIBLE, 0, dr.select(sigma > 1 - NEGLIGIBLE, 1, sigma))

    def encode(self, x, n, material: tuple | None = None) -> tuple:
        """What depends on the point alone, of either predictor where it counts."""
        point = mi.Point3f(self.field.lift(x, n)), *self.field.surface_inputs(n, material)
        if self.grid is None:
            return None, None, self.field.features(self.fast, *point)
        sigma, n_values = self.sigma(x, n), self.field.shape.n_encoded
        return sigma, *(
            where_active(asks, point, lambda *point, w=weights: tuple(self.field.features(w, *point)), n_values)
            for asks, weights in ((sigma < 1, self.field.averaged), (sigma > 0, self.fast))
        )

    def query(self, features: tuple, w):
        """Radiance from direction `w` at the encoded position; never negative."""
        sigma, averaged, fast = features
        if sigma is None:
            return self.field.answer(self.fast, list(fast), w)
        answers = [
            mi.Color3f(*where_active(asks, (mi.Vector3f(w), *values),
                                     lambda w, *v, weights=weights: tuple(self.field.answer(weights, list(v), w)), 3))
            for asks, values, weights in ((sigma < 1, averaged, self.field.averaged), (sigma > 0, fast, self.fast))
        ]  # fmt: skip
        return (1 - sigma) * answers[0] + sigma * answers[1]

    def mean_sigma(self):
        """Mean σ over the latest records, 1-wide."""
        return mi.Float(1) if self.grid is None else self.grid.mean_sigma()

    def observe(self, records, y, current, averaged) -> None:
        """Score both predictions (radiance, made before the step) against targets `y`."""
        if self.grid is not None:
            self.grid.update(records.position, records.normal, records.valid, y, current, averaged)


class OutgoingBlend(Blend):
    """The same of an :class:`~mi_neural.caches.outgoing_field.OutgoingField`, with its queries."""

    def query(self, x, n, w, albedo, roughness):
        """Radiance that leaves the surface towards `w`; never negative, and 0 where an input is not usable."""
        if self.grid is None:
            return self.field.answer(self.fast, x, n, w, albedo, roughness)
        sigma, inputs = self.sigma(x, n), (x, n, w, albedo, roughness)
        answers = [
            mi.Color3f(*where_active(
                asks, inputs, lambda *inputs, weights=weights: tuple(self.field.answer(weights, *inputs)), 3
            ))
            for asks, weights in ((sigma < 1, self.field.averaged), (sigma > 0, self.fast))
        ]  # fmt: skip
        return (1 - sigma) * answers[0] + sigma * answers[1]

    def observe_surfaces(self, x, n, valid, y, current, averaged) -> None:
        """Score both predictions at surfaces, made before the step, against targets `y`; all three over the
        reflectance."""
        if self.grid is not None:
            self.grid.update(x, n, valid, y, current, averaged)


def sigma_channels(cache, x, n) -> dict:
    """Channels that show which predictor answers at points with unit normals: ``sigma``, its weight, and
    ``preference``, 1 where that exceeds 1/2; both 0 where `cache` is no blend."""
    sigma = cache.sigma(x, n) if isinstance(cache, Blend) else mi.Float(0)
    return {"sigma": sigma, "preference": dr.select(sigma > 0.5, mi.Float(1), 0)}


def where_active(active, args: tuple, function, n_outputs: int) -> tuple:
    """``function(*args)``, a tuple of floats, where `active`; 0 elsewhere. Packets with no active lane skip it."""
    nothing = lambda *_: tuple(mi.Float(0) for _ in range(n_outputs))  # noqa: E731
    return dr.if_stmt(args, active, function, nothing, label="predictor")


def copies(value):
    """Copies of a Dr.Jit array, or of a list of them."""
    return [copies(v) for v in value] if isinstance(value, list) else type(value)(value)
