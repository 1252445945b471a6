"""NIRC: the neural incident radiance cache (Dereviannykh et al. 2025), and how it is trained.

The cache learns ``L(x, ω)``: the radiance that arrives at x from ω after at least one reflection. What the next surface
reflects is in it, next-event estimation there included; what the next surface emits is not: that is direct light at x,
which the estimators trace. By default nothing but position and direction enters the network, because incident radiance
depends on nothing else; the authors' network also gets normal, albedo and roughness (`FieldShape.surface`).
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.sampling import PathSampler
from ..render.walk import SURFACES, SurfaceWalk, in_medium
from . import encoding, loss
from .blend import Blend
from .field import Field
from .material import material_at, needs_material
from .places import N_PLACES
from .records import TrainingRecords
from .reliability import Reliability
from .trainer import Trainer, found
from .training_paths import Suffixes, trace_training_paths
from .voxels import Ages
from .weights import FieldShape

#: Targets above this many times the scene's mean are cut (the authors clamp the cache to [0, 1e4]).
TARGET_MAX = 1e4
#: Share of the largest targets that is left out when the scene's mean is measured.
SCALE_TRIM = 1e-3
#: Scale of a field where no light was found: it answers with nothing.
NOTHING = 1e-20
#: Share of the training paths that start where records lay, if that place has left the view.
WORLD_SHARE = 0.25
#: Share of the training paths that run on to their natural end in scenes with participating media, where
#: `Training.n_vertices` are few.
UNBOUNDED_IN_MEDIA = 1.0
#: What training lessens; the second is the authors'.
LOSSES = ("local", "weighted")

#: Local means count as at least so much of themselves, whatever `local_limit`.
LEAST_LOCAL = 0.5


@dataclass(frozen=True)
class Training:
    """Constants of one training step.

    n_paths          training paths
    n_vertices       vertices of a path; it ends in the cache itself (self-training). Long suffixes carry light through
                     a closed room in a few frames and do not build on the cache's own errors (manual, measured)
    n_tail           cache queries at the end of a path
    loss             ``local``: `loss.local_relative_l2`; ``weighted``: `loss.weighted_relative_l2`
    n_local          queries that estimate the local mean of the former
    epsilon          of the loss, over the squared mean target of the scene. Where the local mean, itself a prediction,
                     is the whole norm, targets count less when it overshoots, and the cache drifts upwards: with 0.03
                     in a whole room lit through a slit (manual, measured)
    local_limit      local means count as at most so many times the scene's mean target, but at least as half of
                     themselves, for the same reason: where a place is far brighter than most, `epsilon` is nothing
                     beside its own mean. Lower ones make the cache leak light into dark rooms (`ajar_door` with 4), and
                     without the half a lamp shows through its housing (manual, measured)
    learning_rate    of Adam, at the start; see `rate`
    ema_decay        longest horizon of the averaged copy: 1 / (1 - ema_decay) steps
    last_rate        share of the learning rate that it falls to
    ema_debiased     whether the averaged copy is the exponential average of all steps, freed of the bias towards its
                     start, as published (Müller et al. 2021, METHODS 2); else it forgets the first steps, see `decay`
    """

    n_paths: int = 4096
    n_vertices: int = 8
    n_tail: int = 2
    n_local: int = 2
    epsilon: float = 10.0
    local_limit: float = 8.0
    learning_rate: float = 1e-2
    ema_decay: float = 0.99
    last_rate: float = 0.1
    loss: str = "local"
    ema_debiased: bool = False

    def __post_init__(self):
        if self.loss not in LOSSES:
            raise ValueError(f"loss is '{self.loss}'; give one of: {', '.join(LOSSES)}")
        if not 0 < self.epsilon < math.inf:
            raise ValueError(f"epsilon is {self.epsilon}; it must be a positive number")
        if not self.local_limit > 0:
            raise ValueError(f"local_limit is {self.local_limit}; it must be greater than 0")
        for name, least in (("n_paths", 1), ("n_vertices", 2), ("n_tail", 1), ("n_local", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        if not self.learning_rate > 0:
            raise ValueError(f"learning_rate is {self.learning_rate}; it must be greater than 0")
        if not 0 <= self.ema_decay <= 1:
            raise ValueError(f"ema_decay is {self.ema_decay}; it must lie in [0, 1]")
        if not 0 < self.last_rate <= 1:
            raise ValueError(f"last_rate is {self.last_rate}; it must be greater than 0 and at most 1")

    def rate(self, step):
        """Learning rate after so many steps, a number or a Dr.Jit array: a hundred steps at full speed, then falling as
        1/t to `last_rate` of it."""
        return self.learning_rate * dr.maximum(self.last_rate, 1 / (1 + step / 100))

    def decay(self, step):
        """EMA decay after so many steps: the average spans the last seventh of them, at most the full horizon. If
        `ema_debiased`: ``a η_t / η_{t+1}`` with ``η_t = 1 - a^t``, a being `ema_decay`."""
        if self.ema_debiased:
            return _debiased(self.ema_decay, step)
        return dr.minimum(self.ema_decay, 1 - 1 / (0.15 * step + 1))


def _debiased(a: float, step):
    """Weight of the average before a step in the average of the weights `a`^k of all steps so far, `step` before it."""
    if a == 0:  # powers of 0 are not finite in Dr.Jit
        return 0.0
    if a == 1:
        return 1 - 1 / (step + 1)
    filled = 1 - dr.power(a, step)
    return a * filled / (1 - a + a * filled)


def trace_records(
    scene, sensor, field: Field | Blend | None, training: Training, seed, lights=None, places: tuple | None = None,
    walk: SurfaceWalk = SURFACES,
):  # fmt: skip
    """Fresh training records, and how many were left out because they were not finite.

    Targets end in the cache as it is queried (in nothing without one), in participating media a share of them alone,
    see `UNBOUNDED_IN_MEDIA`; `lights` as in ``render.path.bounce``. `walk`: how paths go from vertex to vertex."""
    lane = dr.arange(mi.UInt32, training.n_paths)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)

    def from_cache(path, active, sampler):
        bsdf, path = path.si.bsdf(path.ray), replace(path, active=active)
        features = field.encode(*walk.place(path), **material_at(field, walk, path, bsdf, active))
        return reflect(field, features, path, bsdf, training.n_tail, sampler, walk)

    plan = Suffixes(
        training.n_paths, training.n_vertices, surfaces=needs_material(field), world_share=WORLD_SHARE,
        densities=training.loss == "weighted", arriving=True,
        n_unbounded=round(UNBOUNDED_IN_MEDIA * training.n_paths) if walk.in_media else 0,
    )  # fmt: skip
    query = from_cache if field is not None else None
    traced = trace_training_paths(scene, sensor, sampler, plan, query, lights, places, walk=walk)
    records = traced.incident
    if plan.surfaces:
        surface = traced.outgoing.surface
        records.albedo, records.roughness = surface.albedo, surface.roughness
    if plan.densities:
        finite = dr.all(dr.isfinite(traced.weight)) & dr.isfinite(traced.pdf)
        records.valid &= finite
        records.weight, records.pdf = dr.select(finite, traced.weight, 0), dr.select(finite, traced.pdf, 0)
    return records, traced.n_bad[1]


def reflect(field: Field, features: list, path, bsdf, n: int, sampler, walk: SurfaceWalk = SURFACES):
    """``1/n sum_i L(x, ω_i) f cos / p(ω_i)``: what a surface, or a point in a medium, where `path` is active sends on
    of the cache, by `n` samples of its `bsdf` or phase function.

    Delta lobes are left out. Returns (that, sampler).
    """
    active = path.active

    def add(i, total, sampler):
        turn = walk.sample(path, bsdf, sampler.next_1d(), sampler.next_2d())
        total += dr.select(active & ~turn.delta, turn.weight * field.query(features, turn.d), 0)
        return i + 1, total, sampler

    if n == 1:
        return add(0, mi.Color3f(0), sampler)[1:]
    _, total, sampler = dr.while_loop(
        (mi.UInt32(0), mi.Color3f(0), sampler), lambda i, total, sampler: active & (i < n), add, label="cache samples"
    )
    return total * (1 / n), sampler


def local_mean(field: Field, features: list, records: TrainingRecords, n: int, sampler):
    """Mean prediction, by the weights being trained, over the cosine-weighted hemisphere at each record, over `scale`,
    from `n` queries."""
    normal = dr.mulsign(records.normal, dr.dot(records.normal, records.direction))
    frame = mi.Frame3f(mi.Normal3f(normal))

    def add(i, total, sampler):
        w = frame.to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        return i + 1, total + loss.luminance(dr.maximum(field.raw(features, w, averaged=False), 0)), sampler

    _, total, _ = dr.while_loop(
        (mi.UInt32(0), mi.Float(0), sampler), lambda i, total, sampler: i < n, add, label="local mean"
    )
    return total * (1 / n)


def learn(cache: Field | Blend, records: TrainingRecords, training: Training, seed, learning_rate, decay):
    """One training step on the given records; a blend scores its predictors on them first. Returns (loss, mean target,
    mean |prediction|), 1-wide, the means over `scale`."""
    blend = None if isinstance(cache, Field) else cache
    field = cache.field if blend else cache
    n_valid = dr.maximum(dr.count(records.valid), 1)
    y = dr.select(records.valid, dr.clip(records.target / field.scale, 0, TARGET_MAX), 0)
    with dr.suspend_grad():
        mean_target = dr.sum(loss.luminance(y)) / n_valid
        field.mean = dr.lerp(mean_target, field.mean, decay)
        dr.eval(y, field.mean)
        averaged, material = None, records.material()
        if blend:
            averaged = field.query(field.encode(records.position, records.normal, **material), records.direction)
        dr.schedule(averaged)

    p = field.predict(records.position, records.direction, records.normal, **material)
    prediction = dr.detach(p)
    dr.schedule(prediction)
    error = _errors(field, records, training, seed, p, y, material)
    total = field.step(dr.select(records.valid, error, 0) / n_valid, learning_rate, decay)
    total = dr.select(field.averaged.finite(), total, math.nan)  # queries would hide it
    if blend:
        with dr.suspend_grad():
            blend.observe(records, y * field.scale, dr.maximum(prediction, 0) * field.scale, averaged)
            blend.refresh()
    mean_prediction = dr.sum(dr.select(records.valid, dr.abs(loss.luminance(prediction)), 0)) / n_valid
    return total, mean_target, mean_prediction


def _errors(field: Field, records: TrainingRecords, training: Training, seed, p, y, material: dict):
    """The loss of each record, for predictions `p` and targets `y` over `scale`."""
    if training.loss == "weighted":
        return loss.weighted_relative_l2(p, y, records.weight, records.pdf, training.epsilon)
    with dr.suspend_grad():
        sampler = PathSampler.make(dr.arange(mi.UInt32, dr.width(y)), seed)
        # Looked up as the prediction's
        features = field.encode(records.position, records.normal, averaged=False, **material)
        mean_local = local_mean(field, features, records, training.n_local, sampler)
    dr.schedule(mean_local)  # or the gradient by way of the shortcut would ask for the mean again
    epsilon = training.epsilon * dr.maximum(dr.square(field.mean), 1e-12)
    limited = dr.minimum(mean_local, training.local_limit * field.mean)
    return loss.local_relative_l2(p, y, dr.maximum(limited, LEAST_LOCAL * mean_local), epsilon)


def scale_of(targets: np.ndarray) -> float:
    """Mean of the `targets` (n,) of a probe without the largest `SCALE_TRIM` of them, or with these where all others
    are black; `NOTHING` without light."""
    targets = np.sort(targets)
    for some in (targets[: max(1, int(targets.size * (1 - SCALE_TRIM)))], targets):
        mean = float(some.mean()) if some.size else 0.0
        if NOTHING < mean < math.inf:
            return mean
    return NOTHING


class IncidentCache(Trainer):
    """A field of incident radiance together with its training: start, train, watch, recover.

    `blend`, `reliability`: which weights answer queries, see :mod:`.blend`.
    """

    #: What is trained, its sizes, and what blends its two sets of weights.
    FIELD, SHAPE, BLEND = Field, FieldShape, Blend
    #: What the mean weight of the blend is called in the statistics.
    MEASURE = "reliability"
    #: How training paths go from vertex to vertex; whoever changes it clears the recordings.
    walk: SurfaceWalk = SURFACES

    def __init__(
        self, training: Training | None = None, shape: FieldShape | None = None, seed: int = 0, *, blend: str = "ema",
        reliability: Reliability | None = None,
    ):  # fmt: skip
        self.shape = shape or self.SHAPE()
        self.blend, self.reliability = blend, reliability
        self.measure_name = None if blend == "ema" else self.MEASURE
        super().__init__(training or Training(), seed)

    def reset(self) -> None:
        super().reset()
        self._blend: Blend | None = None

    # -------------------------------------------------------------------------------------------------------------

    @property
    def queried(self) -> Field | Blend | None:
        """What answers queries: the averaged weights, or the blend of them with those being trained."""
        if self.field is None or self.blend == "ema":
            return self.field
        if self._blend is None or self._blend.field is not self.field:
            self._blend = self.BLEND(self.field, self.blend, self.reliability)
        return self._blend

    def measured(self) -> dict:
        """Further facts for statistics."""
        return {}

    def refresh(self) -> None:
        if self._blend is not None:
            self._blend.refresh()

    def probe(self, scene, sensor, lights, seed):
        """Records without a cache, to measure the scene by. Is frozen."""
        return trace_records(scene, sensor, None, self.training, seed, lights, walk=self.walk)

    def frame(self, scene, sensor, lights, cache, ages, seed, rate_factor):
        """Trace records and take a step on them: what :func:`~mi_neural.caches.trainer.found` gives. Is frozen."""
        with dr.suspend_grad():
            plain = getattr(cache, "field", cache)
            places = ages.left(1e-3 * dr.norm(1 / plain.box_inv_extent))
            records, n_bad = trace_records(scene, sensor, cache, self.training, seed, lights, places, self.walk)
            dr.eval(records, n_bad)
            sampler = PathSampler.make(dr.arange(mi.UInt32, N_PLACES), seed + 0x7F4A7C15)
            self.remember(ages, records, sampler)
            learning_rate, decay = self.pace(ages, records.position, records.valid, rate_factor, plain)
        value, mean_target, mean_prediction = self.learn(cache, records, seed + 0x9E3779B9, learning_rate, decay)
        weight = cache.mean_sigma() if hasattr(cache, "mean_sigma") else 0
        return found(value, ages, mean_target, mean_prediction, dr.count(records.valid), n_bad, weight)

    def remember(self, ages: Ages, records: TrainingRecords, sampler) -> None:
        """Keep where the records of a step lie, and from where they are seen."""
        view = records.normal
        if records.inside is not None:
            view = dr.select(in_medium(records.inside), -view, view)
        ages.places.remember(records.position, view, records.valid, sampler, records.inside)

    def forget_media(self) -> None:
        """Forget what places of records are in, whose numbers are of other media."""
        if self.field is not None:
            self.ages.places.forget_media()

    def make_field(self, low: list, high: list, scale: float):
        """A new field for records between the corners `low` and `high`, in a scene of mean radiance `scale`."""
        return self.FIELD(low, high, self.shape, scale=scale, seed=self.seed)

    def learn(self, cache, records: TrainingRecords, seed, learning_rate, decay) -> tuple:
        """One training step of the field, or of its blend, on the records; is frozen. See :func:`learn` for what it
        returns."""
        return learn(cache, records, self.training, seed, learning_rate, decay)

    def start(self, scene, sensor, lights=None) -> None:
        """Measure where light is asked for and how bright it is, and make the field; no training."""
        with dr.suspend_grad():
            seed = mi.UInt32(self.random_seed(0xFFFFFF))
            records, _ = self.call("probe", sensor, scene, sensor, lights, seed)
            valid = np.array(records.valid)
            points = np.array(records.position).T[valid]
            target = np.array(records.target).T[valid].mean(axis=-1)
        box = scene.bbox()
        low, high = encoding.record_box(points, np.array(box.min).ravel(), np.array(box.max).ravel())
        self.field, self.ages = self.make_field(low, high, scale_of(target)), Ages(low, high)
        dr.eval(self.field)

    def found_no_light(self) -> bool:
        return float(self.field.scale[0]) <= NOTHING

    def train_step(self, scene, sensor, lights=None) -> None:
        """Trace fresh records and take one step on them."""
        seed = mi.UInt32(self.random_seed(self.steps))
        self.step("frame", sensor, scene, sensor, lights, self.queried, self.ages, seed)

    # -------------------------------------------------------------------------------------------------------------
    # State and files

    def adopt(self, field: Field) -> None:
        """Go on from a field that was trained before."""
        self._unread.clear()
        self.field, self.steps, self._good = field, field.steps, None
        self.ages = Ages(*field.box, steps=field.steps)

    def save(self, path, **facts) -> None:
        """Write all that training changes, and `facts` (JSON values), to a file, whole or not at all."""
        schedule = self.schedule()
        queried, extra, constants = self.queried, {}, None
        if getattr(queried, "IN_FILES", False) and queried.grid is not None:
            extra, constants = queried.grid.arrays(), asdict(queried.grid.constants)
        extra = extra | {f"ages.{k}": v for k, v in self.ages.arrays().items()}
        self.field.save(path, extra, training=schedule, reliability=constants, **facts)

    def read(self, path) -> tuple:
        """(field, header, further arrays) of a file of such a cache; hand them to :meth:`resume`."""
        return self.FIELD.read(path)

    def resume(self, field: Field, header: dict, extra: dict[str, np.ndarray]) -> None:
        """Go on from a file as if training had not been interrupted.

        Statistics of which predictor to believe are taken over where they were found in the same way. Raises
        ``ValueError`` for what makes no sense; all is then as it was before.
        """
        before = dict(vars(self))  # what follows binds attributes anew and changes none in place
        self.reset()
        self.adopt(field)
        try:
            self.set_schedule(header["training"])
            self.ages.set_arrays({k.removeprefix("ages."): v for k, v in extra.items()})
            extra = {k: v for k, v in extra.items() if not k.startswith("ages.")}
            grid = getattr(self.queried, "grid", None)
            if grid is not None and header.get("reliability") == asdict(grid.constants):
                grid.set_arrays(extra)
        except (KeyError, TypeError, ValueError):
            vars(self).update(before)
            raise
        self.refresh()

    def checkpoint(self) -> tuple:
        return super().checkpoint(), None if self._blend is None else self._blend.snapshot()

    def rollback(self, state) -> None:
        if state is None:
            super().rollback(None)
            return
        super().rollback(state[0])
        if self._blend is not None and state[1] is not None and self.field is not None:
            self._blend.restore(state[1])
