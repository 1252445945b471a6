"""The incident cache as a control variate: how far it is to be believed, and where.

The training records hold what the cache was asked for and what tracing found there. Per cell, the coefficient of least
variance is that of regression,

    α = Cov(y, f) / Var(f),

y being the traced radiance and f the cache's answer for the same direction. Records belong to earlier frames than the
samples that α weighs, so that it is a constant to them (:mod:`mi_neural.estimators.two_level`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..estimators import two_level
from .blend import copies, where_active
from .field import Field
from .incident import IncidentCache, trace_records
from .reliability import Reliability, ReliabilityGrid, covariance, variance

#: Moments by cells as for the blend of two predictors, but kept for 50 frames: nothing here need be quick.
MOMENTS = Reliability(measure="correlation", decay=0.98, split_normals=True, warm_up=0)
#: Variance of answers, in units of the squared mean radiance, below which the cache tells directions not apart.
FLOOR = 1e-6
#: Share of the full weight of a cell's moments below which α stays 0: some five frames with records.
YOUNG = 0.1


class ControlVariate:
    """A field, and α by place. A PyTree, with the queries of a :class:`~mi_neural.caches.field.Field` and the protocol
    of a :class:`~mi_neural.caches.blend.Blend`: training hands it the records that it learns from.

    Answers are cut as :func:`~mi_neural.estimators.two_level.sane` says.
    """

    DRJIT_STRUCT = {"field": object, "grid": object, "alpha": object}  # noqa: RUF012

    def __init__(self, field: Field, mode: str = "control", constants: Reliability | None = None):
        self.field, self.mode = field, mode
        self.grid = ReliabilityGrid(*field.box, constants or MOMENTS, scale=float(field.scale[0]))
        self.alpha = dr.zeros(mi.Float, self.grid.constants.n_entries)
        dr.make_opaque(self.alpha)

    @property
    def scale(self):
        return self.field.scale

    def refresh(self) -> None:
        """Answers are the field's own: nothing to bring up to date."""

    def snapshot(self) -> dict:
        """The statistics as they are now, for :meth:`restore`."""
        values = {k: getattr(self.grid, k) for k in self.grid.LEARNED}
        return {k: copies(v) for k, v in {**values, "alpha": self.alpha}.items()}

    def restore(self, state: dict) -> None:
        """Take the statistics back to a snapshot."""
        for k, v in state.items():
            setattr(self if k == "alpha" else self.grid, k, copies(v))

    # -----------------------------------------------------------------------------------------------------------------

    def encode(self, x, n=None, active=True, material: tuple | None = None) -> list:
        """What depends on the point alone; where not `active` nothing, at no cost if that holds for a packet."""
        if active is True:
            return self.field.encode(x, n, material=material)

        def encode(x, n, *material):
            return tuple(self.field.encode(x, n, material=material or None))

        point = mi.Point3f(x), mi.Vector3f(n), *(material or ())
        return list(where_active(active, point, encode, self.field.shape.n_encoded))

    def query(self, features: list, w, active=True):
        """Radiance from direction `w` at the encoded position, in [0, 1e4 scale]."""

        def ask(w, *features):
            return tuple(two_level.sane(self.field.query(list(features), w), self.field.scale))

        if active is True:
            return mi.Color3f(*ask(w, *features))
        return mi.Color3f(*where_active(active, (mi.Vector3f(w), *features), ask, 3))

    def alpha_at(self, x, n, active=True):
        """α at points in world space with unit normals on the lit side; 0 where too few records fell."""
        return dr.gather(mi.Float, self.alpha, self.grid.entry(x, n), active)

    def mean_sigma(self):
        """Mean α over the latest records, 1-wide."""
        return dr.sum(self.alpha * self.grid.records) / dr.maximum(dr.sum(self.grid.records), 1e-30)

    def observe(self, records, y, current, averaged) -> None:
        """Take in a frame's records: targets `y`, and the answers `averaged` made before the step (Color3f, radiance).
        """
        self.grid.update(records.position, records.normal, records.valid, y, averaged, averaged)
        m = self.grid.means()
        channels = range(3)
        c = sum(covariance(m["ye"][k], m["y"][k], m["e"][k]) for k in channels)
        s = sum(variance(m["e"][k], m["ee"][k]) for k in channels)
        self.alpha = dr.select(self.grid.weight > YOUNG, two_level.coefficient(c, s, FLOOR), 0)
        dr.eval(self.alpha)


class ControlCache(IncidentCache):
    """An incident cache that is queried as a control variate: training also keeps the statistics of its α."""

    BLEND, MEASURE = ControlVariate, "alpha"

    def __init__(self, training=None, shape=None, seed: int = 0):
        super().__init__(training, shape, seed, blend="control")

    def adopt(self, field: Field) -> None:
        """Go on from a field that was trained before, of which no α is known yet."""
        super().adopt(field)
        self._measure = None

    def compare_frame(self, scene, sensor, lights, cache, seed):
        records, _ = trace_records(scene, sensor, cache, self.training, seed, lights, walk=self.walk)
        dr.eval(records)
        answers = cache.query(cache.encode(records.position, records.normal, **records.material()), records.direction)
        cache.observe(records, records.target, answers, answers)
        return cache.mean_sigma()

    def compare(self, scene, sensor, lights, frames: int) -> float:
        """Gather the statistics of α without training, for a cache that came from elsewhere. Returns the mean α."""
        value = mi.Float(0)
        with dr.suspend_grad():
            for k in range(frames):
                seed = mi.UInt32(self.random_seed(0x10000000 + k))
                value = self.call("compare_frame", sensor, scene, sensor, lights, self.queried, seed)
        self.check()
        self._measure = float(value[0])
        return self._measure
