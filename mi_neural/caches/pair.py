"""Both caches of one scene, trained on the same paths, and the measure of what either is worth.

The radiance that a ray brings to one vertex is what the next vertex sends out: one training path gives a record to both
caches at each bounce. Paths start in twos from the same point, so that errors can be measured (:mod:`.accuracy`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render import vertex
from ..render.surface import scene_is_glossy
from .accuracy import Accuracy, Pairs
from .field import Field, FieldShape, TrainedField
from .incident import Training, learn, reflect
from .outgoing import OutgoingCache, OutgoingField, OutgoingShape, OutgoingTraining, fitted, training_paths
from .trainer import found
from .training_paths import PathRecords


class PairField(TrainedField):
    """An outgoing and an incident field, and their accuracy, with the protocol of either. A PyTree."""

    KIND = "pair"
    UNKNOWN = tuple(f"outgoing.{name}" for name in OutgoingField.UNKNOWN)
    DRJIT_STRUCT = {"outgoing": object, "incident": object, "accuracy": object}  # noqa: RUF012
    #: The parts, in the order of files.
    PARTS = ("outgoing", "incident", "accuracy")

    def __init__(self, outgoing: OutgoingField, incident: Field, accuracy: Accuracy):
        self.outgoing, self.incident, self.accuracy = outgoing, incident, accuracy

    @property
    def steps(self) -> int:
        return self.outgoing.steps

    @steps.setter
    def steps(self, value: int) -> None:
        self.outgoing.steps = self.incident.steps = value

    @property
    def shape(self) -> OutgoingShape:
        return self.outgoing.shape

    @property
    def scale(self):
        return self.outgoing.scale

    @property
    def box(self) -> tuple:
        return self.outgoing.box

    @property
    def box_min(self):
        return self.outgoing.box_min

    @property
    def box_inv_extent(self):
        return self.outgoing.box_inv_extent

    def n_parameters(self) -> int:
        return self.outgoing.n_parameters() + self.incident.n_parameters()

    def reset(self) -> None:
        """Start anew: all as it was when it was made, bit for bit."""
        for name in self.PARTS:
            getattr(self, name).reset()

    def optimizers(self) -> list:
        return [*self.outgoing.optimizers(), *self.incident.optimizers()]

    def snapshot(self) -> dict[str, np.ndarray]:
        """All weights and measurements as NumPy arrays."""
        return {f"{name}.{k}": v for name in self.PARTS for k, v in getattr(self, name).snapshot().items()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go back to a :meth:`snapshot` of a pair of equal shape; the optimisers' moments start anew."""
        for name in self.PARTS:
            getattr(self, name).restore(_part(arrays, name))

    # -------------------------------------------------------------------------------------------------------------
    # State and files

    def constants(self) -> dict:
        return {name: getattr(self, name).constants() for name in ("outgoing", "incident")}

    @classmethod
    def make(cls, constants: dict) -> PairField:
        outgoing, incident = OutgoingField.make(constants["outgoing"]), Field.make(constants["incident"])
        # The grid of errors measures in units of what the outgoing field was made for
        return cls(outgoing, incident, Accuracy(*outgoing.box, scale=constants["incident"]["scale"]))

    def scalars(self) -> dict:
        return {"steps": self.steps, "parts": {n: getattr(self, n).scalars() for n in ("outgoing", "incident")}}

    def set_scalars(self, given: dict) -> None:
        for name in ("outgoing", "incident"):
            getattr(self, name).set_scalars(given["parts"][name])

    def arrays(self) -> dict[str, np.ndarray]:
        fields = {name: getattr(self, name).arrays() for name in ("outgoing", "incident")}
        parts = {**fields, "accuracy": self.accuracy.snapshot()}
        return {f"{name}.{k}": v for name, part in parts.items() for k, v in part.items()}

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        for name in ("outgoing", "incident"):
            getattr(self, name).set_arrays(_part(arrays, name))
        measured, known = _part(arrays, "accuracy"), self.accuracy.snapshot()
        if {k: v.shape for k, v in measured.items()} != {k: v.shape for k, v in known.items()}:
            raise ValueError("its measurements do not have the sizes of this grid")
        self.accuracy.restore(measured)


def _part(arrays: dict, name: str) -> dict:
    return {k.removeprefix(f"{name}."): v for k, v in arrays.items() if k.startswith(f"{name}.")}


class PairCache(OutgoingCache):
    """Both fields together with their training. In all but what it learns an `OutgoingCache`.

    `training`, `incident_training`: of the two fields; `sizes`: of both. `n_queries`: how often the incident field is
    asked at the end of a path.
    """

    FIELD = PairField

    def __init__(
        self, training: OutgoingTraining, incident_training: Training, sizes: FieldShape | None = None, seed: int = 0,
        *, n_queries: int = 4,
    ):  # fmt: skip
        sizes = sizes or FieldShape()
        super().__init__(training, OutgoingShape.like(sizes), seed)
        self.incident_training, self.incident_shape, self.n_queries = incident_training, sizes, n_queries

    def measured(self) -> dict:
        return {} if self.field is None else self.field.accuracy.summary()

    def start(self, scene, sensor, lights=None) -> None:
        super().start(scene, sensor, lights)
        outgoing = self.field
        scale = float(outgoing.scale[0])
        incident = Field(*outgoing.box, self.incident_shape, scale=scale, seed=self.seed + 1)
        self.field = PairField(outgoing, incident, Accuracy(*outgoing.box, scale=scale))
        dr.eval(self.field)

    def frame(self, scene, sensor, lights, field, ages, seed, rate_factor):
        outgoing, incident = field.outgoing, field.incident

        def ask(si, bsdf, active, sampler):
            features = incident.encode(si.p, vertex.facing(si))
            return reflect(incident, features, si, bsdf, self.n_queries, sampler, active)

        with dr.suspend_grad():
            traced = training_paths(
                scene, sensor, outgoing, self.training, seed, lights, scene_is_glossy(scene), twins=True, first=ask
            )
            n_valid, n_bad = dr.count(traced.outgoing.valid), traced.n_bad[0]
            dr.eval(traced, n_valid)
            pairs = pairs_of(traced, outgoing, self.training.n_paths)
            arrived = fitted(traced.incident, self.training)
            records = fitted(traced.outgoing, self.training)
            learning_rate, decay = self.pace(
                ages, records.surface.position, records.valid, rate_factor, outgoing, incident
            )
            self.note(outgoing, records, seed, decay)
            prediction = outgoing.query(*records.surface.inputs())
            dr.eval(pairs, arrived, records, prediction)
            field.accuracy.observe(pairs, records.surface.position, records.target, prediction, records.valid, decay)
        value, mean_target, mean_prediction, more = outgoing.learn(
            *records.surface.inputs(), records.target, records.valid, learning_rate, decay, self.training.epsilon
        )
        own_rate = learning_rate * (self.incident_training.learning_rate / self.training.learning_rate)
        value_i, mean_target_i, mean_prediction_i = learn(
            incident, arrived, self.incident_training, seed + 0x3C6EF372, own_rate, decay
        )
        value = dr.select(n_valid > 0, value + value_i, 0)  # nothing to learn is no divergence
        mean_target = dr.maximum(mean_target, mean_target_i)
        mean_prediction = dr.maximum(mean_prediction, mean_prediction_i)
        return found(value, ages, mean_target, mean_prediction, n_valid, n_bad + more)


def pairs_of(traced: PathRecords, outgoing: OutgoingField, n_paths: int) -> Pairs:
    """The first vertices of twin paths: both estimates of each, by one more bounce and by the incident cache.

    One more bounce is what a pixel's path does: it ends at the second vertex in the outgoing cache, if it may end
    there; else it goes on, as the training path did.
    """
    records, lane = traced.outgoing, dr.arange(mi.UInt32, n_paths)
    n_records = dr.width(records.valid)
    second = dr.minimum(lane + n_paths, n_records - 1)
    ends = dr.gather(mi.Bool, traced.stops, lane) & dr.gather(mi.Bool, records.valid, second)
    ends &= lane + n_paths < n_records
    surface = dr.gather(type(records.surface), records.surface, second)
    beyond = dr.select(ends, outgoing.query(*surface.inputs()), dr.gather(mi.Color3f, traced.incident.target, lane))
    bounce = dr.gather(mi.Color3f, traced.weight, lane) * beyond
    direct = dr.gather(mi.Color3f, traced.direct, lane)
    dr.eval(bounce, direct)

    k = dr.arange(mi.UInt32, n_paths // 2) * 2
    surface = dr.gather(type(records.surface), records.surface, k)
    twins = [(dr.gather(mi.Color3f, v, k), dr.gather(mi.Color3f, v, k + 1)) for v in (direct, bounce, traced.first)]
    valid = dr.gather(mi.Bool, records.valid, k) & dr.gather(mi.Bool, records.valid, k + 1)
    for v in twins:
        valid &= dr.all(dr.isfinite(v[0] + v[1]))
    return Pairs(surface.position, surface.normal, outgoing.query(*surface.inputs()), *twins, valid)
