"""NIRC: the neural incident radiance cache (Dereviannykh et al. 2025), and how it is trained.

The cache learns ``L(x, ω)``: the radiance that arrives at x from ω after at least one reflection. What the next surface
reflects is in it, next-event estimation there included; what the next surface emits is not: that is direct light at x,
which the estimators trace. Nothing but position and direction enters the network, because incident radiance depends on
nothing else.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render import path as paths
from ..render import vertex
from ..render.frozen import can_freeze, undisturbed
from ..render.sampling import PathSampler
from . import encoding, loss
from .blend import Blend
from .divergence import StepWatch, healthy
from .field import Field, FieldShape
from .places import N_PLACES
from .records import TrainingRecords
from .reliability import Reliability
from .schedule import pace
from .training_paths import Suffixes, trace_training_paths
from .voxels import Ages

#: Targets above this many times the scene's mean are cut (the authors clamp the cache to [0, 1e4]).
TARGET_MAX = 1e4
#: Targets are cut to this share of outliers when the scene's mean is measured.
SCALE_TRIM = 1e-3
#: Share of the training paths that start where records lay, if that place has left the view.
WORLD_SHARE = 0.25


@dataclass(frozen=True)
class Training:
    """Constants of one training step.

    n_paths          training paths
    n_vertices       vertices of a path; it ends in the cache itself (self-training). Long suffixes carry light through
                     a closed room in a few frames and do not build on the cache's own errors (manual, 6_measured)
    n_tail           cache queries at the end of a path
    n_local          queries that estimate the local mean of `loss.local_relative_l2`
    epsilon          of that loss, over the squared mean target of the scene. Where the local mean, itself a prediction,
                     is the whole norm, targets count less when it overshoots, and the cache drifts: a room lit through
                     a slit +8 to +14 % after 200 to 600 steps with 0.03, within 1 % with 10 (manual, 6_measured)
    learning_rate    of Adam, at the start; see `rate`
    ema_decay        longest horizon of the averaged copy: 1 / (1 - ema_decay) steps
    last_rate        share of the learning rate that it falls to
    """

    n_paths: int = 4096
    n_vertices: int = 8
    n_tail: int = 2
    n_local: int = 2
    epsilon: float = 10.0
    learning_rate: float = 1e-2
    ema_decay: float = 0.99
    last_rate: float = 0.1

    def __post_init__(self):
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
        """EMA decay after so many steps: the average spans the last seventh of them, at most the full
        horizon."""
        return dr.minimum(self.ema_decay, 1 - 1 / (0.15 * step + 1))


def trace_records(
    scene, sensor, field: Field | Blend | None, training: Training, seed, lights=None, places: tuple | None = None
):
    """Fresh training records, and how many were left out because they were not finite.

    Targets end in the cache as it is queried (in nothing without one); `lights` as in ``render.path.bounce``."""
    lane = dr.arange(mi.UInt32, training.n_paths)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)

    def from_cache(si, bsdf, active, sampler):
        return reflect(field, field.encode(si.p, vertex.facing(si)), si, bsdf, training.n_tail, sampler, active)

    plan = Suffixes(training.n_paths, training.n_vertices, surfaces=False, world_share=WORLD_SHARE)
    query = from_cache if field is not None else None
    traced = trace_training_paths(scene, sensor, sampler, plan, query, lights, places)
    return traced.incident, traced.n_bad[1]


def reflect(field: Field, features: list, si, bsdf, n: int, sampler, active):
    """``1/n sum_i L(x, ω_i) f cos / p(ω_i)``: what a surface reflects of the cache, by `n` BSDF samples.

    Delta lobes are left out. Returns (that, sampler).
    """

    def add(i, total, sampler):
        bs, weight, delta = paths.sample_bsdf(si, bsdf, sampler.next_1d(), sampler.next_2d(), active)
        total += dr.select(active & ~delta, weight * field.query(features, si.to_world(bs.wo)), 0)
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
        averaged = field.query(field.encode(records.position, records.normal), records.direction) if blend else None
        dr.schedule(averaged)

    p = field.predict(records.position, records.direction, records.normal)
    with dr.suspend_grad():
        sampler = PathSampler.make(dr.arange(mi.UInt32, dr.width(y)), seed)
        features = field.encode(records.position, records.normal, averaged=False)  # looked up as the prediction's
        mean_local = local_mean(field, features, records, training.n_local, sampler)
    said = dr.detach(p)
    dr.schedule(said, mean_local)  # or the gradient by way of the shortcut would ask for the mean again
    epsilon = training.epsilon * dr.maximum(dr.square(field.mean), 1e-12)
    error = loss.local_relative_l2(p, y, mean_local, epsilon)
    total = field.step(dr.select(records.valid, error, 0) / n_valid, learning_rate, decay)
    total = dr.select(field.averaged.finite(), total, math.nan)  # queries would hide it
    if blend:
        with dr.suspend_grad():
            blend.observe(records, y * field.scale, dr.maximum(said, 0) * field.scale, averaged)
            blend.refresh()
    mean_prediction = dr.sum(dr.select(records.valid, dr.abs(loss.luminance(said)), 0)) / n_valid
    return total, mean_target, mean_prediction


class IncidentCache:
    """A field of incident radiance together with its training: start, train, watch, recover.

    `statistics` counts since the start: records, steps, non-finite targets, recoveries, seconds of training.
    """

    #: Mean predictions this many times the latest mean targets are an explosion. Healthy training stayed below 1.3 in
    #: seven scenes from their first step on (1024 paths, 200 steps); all weights times 100 give 10^5.
    EXPLOSION = 10.0
    #: Targets this many times the brightness that the field was made for: it is made anew.
    BRIGHTER = 100.0
    #: Steps between snapshots that a divergence is undone with.
    SNAPSHOT_EVERY = 64
    #: Steps of a frame while the camera is in new places: 30 frames then do as much as for a cache that is new itself.
    STEPS_IN_NEW_PLACES = 3
    #: What is trained, its sizes, and what blends its two sets of weights.
    FIELD, SHAPE, BLEND = Field, FieldShape, Blend
    #: Whether functions of the scene can be frozen.
    recordable = True
    #: What the mean weight of the blend is called in the statistics.
    MEASURE = "reliability"

    def __init__(
        self, training: Training | None = None, shape: FieldShape | None = None, seed: int = 0, *, blend: str = "ema",
        reliability: Reliability | None = None,
    ):  # fmt: skip
        self.training, self.shape, self.seed = training or Training(), shape or self.SHAPE(), seed
        self.blend, self.reliability = blend, reliability
        self._frame = dr.freeze(self._frame_plain, auto_opaque=False)
        self._probe = dr.freeze(self._probe_plain, auto_opaque=False)
        self._sensor_freezes: dict[int, bool] = {}
        self.reset()

    def clear_recordings(self) -> None:
        """Forget what was recorded for a scene that is not rendered any more; it would be kept for good."""
        self._frame.clear()
        self._probe.clear()
        self._sensor_freezes.clear()

    def reset(self) -> None:
        """Forget all that was learned. Compiled kernels are kept."""
        self.field: Field | None = None
        self.ages: Ages | None = None
        self._blend: Blend | None = None
        self.steps = 0
        self.rate_factor = 1.0
        self.history: list[float] = []
        self.levels: list[float] = []  # latest mean targets, over the field's scale
        self._good: dict[str, np.ndarray] | None = None
        self._step_watch = StepWatch()
        self.statistics = {
            "steps": 0, "records": 0, "nonfinite": 0, "recoveries": 0, "seconds_train": 0.0, "loss": math.nan,
        }  # fmt: skip

    # -------------------------------------------------------------------------------------------------------------

    @property
    def asked(self) -> Field | Blend | None:
        """What answers queries: the averaged weights, or the blend of them with those being trained."""
        if self.field is None or self.blend == "ema":
            return self.field
        if self._blend is None or self._blend.field is not self.field:
            self._blend = self.BLEND(self.field, self.blend, self.reliability)
        return self._blend

    def measured(self) -> dict:
        """Further facts for statistics."""
        return {}

    def freezes(self, sensor) -> bool:
        """Whether functions of this sensor can be frozen, see :func:`can_freeze`; tried once per sensor."""
        if not self.recordable:
            return False
        if id(sensor) not in self._sensor_freezes:
            self._sensor_freezes[id(sensor)] = can_freeze(sensor)
        return self._sensor_freezes[id(sensor)]

    def _probe_plain(self, scene, sensor, lights, seed):
        return trace_records(scene, sensor, None, self.training, seed, lights)

    def _frame_plain(self, scene, sensor, lights, cache, ages, seed, rate_factor):
        with dr.suspend_grad():
            plain = getattr(cache, "field", cache)
            places = ages.left(1e-3 * dr.norm(1 / plain.box_inv_extent))
            records, n_bad = trace_records(scene, sensor, cache, self.training, seed, lights, places)
            dr.eval(records, n_bad)
            sampler = PathSampler.make(dr.arange(mi.UInt32, N_PLACES), seed + 0x7F4A7C15)
            ages.places.remember(records.position, records.normal, records.valid, sampler)
            learning_rate, decay = self.pace(ages, records.position, records.valid, rate_factor, plain)
        outputs = self.learn(cache, records, seed + 0x9E3779B9, learning_rate, decay)
        sigma = cache.mean_sigma() if hasattr(cache, "mean_sigma") else mi.Float(0)
        return *outputs, dr.count(records.valid), n_bad, sigma

    def pace(self, ages: Ages, x, valid, rate_factor, *fields) -> tuple:
        """:func:`~mi_neural.caches.schedule.pace` of this training."""
        return pace(self.training, ages, x, valid, rate_factor, *fields)

    def make_field(self, low: list, high: list, scale: float):
        """A new field for records between the corners `low` and `high`, in a scene of mean radiance `scale`."""
        return self.FIELD(low, high, self.shape, scale=scale, seed=self.seed)

    def learn(self, asked, records: TrainingRecords, seed, learning_rate, decay) -> tuple:
        """One training step of what is `asked` on the records; is frozen. See :func:`learn` for what it returns."""
        return learn(asked, records, self.training, seed, learning_rate, decay)

    def start(self, scene, sensor, lights=None) -> None:
        """Measure where light is asked for and how bright it is, and make the field; no training."""
        with dr.suspend_grad(), undisturbed():
            probe = self._probe if self.freezes(sensor) else self._probe_plain
            records, _ = probe(scene, sensor, lights, mi.UInt32(self._seed(0xFFFFFF)))
            valid = np.array(records.valid)
            points = np.array(records.position).T[valid]
            target = np.array(records.target).T[valid].mean(axis=-1)
        box = scene.bbox()
        low, high = encoding.record_box(points, np.array(box.min).ravel(), np.array(box.max).ravel())
        scale = 0.0
        if target.size:
            scale = float(np.sort(target)[: max(1, int(target.size * (1 - SCALE_TRIM)))].mean())
        if not (math.isfinite(scale) and scale > 1e-30):
            scale = 1e-20  # no indirect light found: the cache answers with nothing
        self.field, self.ages = self.make_field(low, high, scale), Ages(low, high)
        dr.eval(self.field)

    def train_frame(self, scene, sensor, lights=None) -> float:
        """Trace fresh records and take one step on them, or `STEPS_IN_NEW_PLACES` where the camera has come to places
        that were not trained before; returns the loss. Divergence is undone, see `recover`."""
        value = self._train_step(scene, sensor, lights)
        if self.ages is not None and self.ages.novel():
            for _ in range(self.STEPS_IN_NEW_PLACES - 1):
                value = self._train_step(scene, sensor, lights)
        return value

    def _train_step(self, scene, sensor, lights) -> float:
        t0 = time.perf_counter()
        if self.field is None:
            self.start(scene, sensor, lights)
        if self._good is None:
            self._good = self.field.snapshot()
        self._step_watch.begin(*self.field.optimizers())
        frame = self._frame if self.freezes(sensor) else self._frame_plain
        with dr.resume_grad(), undisturbed():
            outputs = frame(
                scene, sensor, lights, self.asked, self.ages, mi.UInt32(self._seed(self.steps)),
                dr.opaque(mi.Float, self.rate_factor),
            )  # fmt: skip
        value, mean_target, mean_prediction, n_valid, n_bad, sigma = (v[0] for v in outputs)
        self.steps += 1
        self.field.steps = self.steps
        s = self.statistics
        s["steps"] += 1
        s["loss"] = value
        s["records"] += int(n_valid)
        s["nonfinite"] += int(n_bad)
        if self.blend != "ema":
            s[self.MEASURE] = sigma
        goes_on = self._watch(value, mean_target, mean_prediction, self._step_watch.step(*self.field.optimizers()))
        if goes_on and mean_target > max(self.BRIGHTER, 10 * mean_prediction):
            # Another light: what was measured in the old one is void, and the schedule of rates begins anew
            mi.Log(mi.LogLevel.Info, "mi_neural: the scene became brighter by far; the cache starts anew")
            statistics = self.statistics
            self.reset()
            self.statistics = s = statistics
        s["seconds_train"] += time.perf_counter() - t0
        return value

    def _seed(self, step: int) -> int:
        return int(np.random.SeedSequence((self.seed, 0xCAC4E, step)).generate_state(1)[0])

    def _watch(self, value: float, mean_target: float, mean_prediction: float, step: float) -> bool:
        """Whether training is healthy; if not, it is undone.

        Divergence: numbers that are not finite, predictions far above what targets have been, or a step so long that
        nothing is left of the network (see :mod:`.divergence`). The loss itself is no sign: it is relative to the
        cache's own mean, so it stays small when the cache explodes, and single batches of healthy training exceed the
        median a thousandfold.
        """
        limit = self.EXPLOSION * max(1.0, float(np.median(self.levels)) if self.levels else 1.0)
        finite = math.isfinite(value) and math.isfinite(mean_prediction)
        if not (finite and healthy(step, self.steps)) or mean_prediction > limit:
            self.recover()
            return False
        self.history.append(value)
        self.levels = [*self.levels[-31:], mean_target]
        if self.steps % self.SNAPSHOT_EVERY == 0:
            weights = self.field.snapshot()
            if all(np.isfinite(w).all() for w in weights.values()):
                self._good = weights
        return True

    def recover(self) -> None:
        """Go back to the last good weights, with half the learning rate."""
        self.field.restore(self._good)
        if self._blend is not None:
            self._blend.refresh()
        self.rate_factor *= 0.5
        self.statistics["recoveries"] += 1
        mi.Log(
            mi.LogLevel.Warn,
            f"mi_neural: training diverged at step {self.steps}; last good weights restored, learning rate halved",
        )

    def adopt(self, field: Field) -> None:
        """Go on from a field that was trained before."""
        self.field, self.steps, self._good = field, field.steps, None
        self.ages = Ages(*field.box, steps=field.steps)

    def _schedule(self) -> dict:
        """Numbers that steer training, apart from the field's."""
        return {"rate_factor": self.rate_factor, "history": list(self.history), "levels": list(self.levels)}

    def save(self, path, **facts) -> None:
        """Write all that training changes, and `facts` (JSON values), to a file, whole or not at all."""
        asked, extra, constants = self.asked, {}, None
        if isinstance(asked, Blend) and asked.grid is not None:
            extra, constants = asked.grid.arrays(), asdict(asked.grid.constants)
        extra = extra | {f"ages.{k}": v for k, v in self.ages.arrays().items()}
        self.field.save(path, extra, training=self._schedule(), reliability=constants, **facts)

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
            found = header["training"]
            self.rate_factor = float(found["rate_factor"])
            self.history, self.levels = ([float(v) for v in found[name]] for name in ("history", "levels"))
            if not 0 < self.rate_factor <= 1:
                raise ValueError(f"it says that the learning rate was cut to {self.rate_factor}")
            self.ages.set_arrays({k.removeprefix("ages."): v for k, v in extra.items()})
            extra = {k: v for k, v in extra.items() if not k.startswith("ages.")}
            grid = getattr(self.asked, "grid", None)
            if grid is not None and header.get("reliability") == asdict(grid.constants):
                grid.set_arrays(extra)
        except (KeyError, TypeError, ValueError):
            vars(self).update(before)
            raise
        if self._blend is not None:
            self._blend.refresh()

    def checkpoint(self):
        """Everything that training changes, to go back to with :meth:`rollback`."""
        return (
            None if self.field is None else (self.field, self.field.checkpoint(), self.ages.arrays()),
            None if self._blend is None else self._blend.snapshot(),
            self.steps, self._schedule(), self._good, dict(self.statistics),
        )  # fmt: skip

    def rollback(self, state) -> None:
        """Undo training since `state` was taken; None: forget everything but the field's place and scale."""
        if state is None:
            field = self.field
            self.reset()
            field.reset()
            self.field, self.ages = field, Ages(*field.box)
            return
        held, blend, self.steps, schedule, self._good, self.statistics = state
        self.rate_factor, self.history, self.levels = (schedule[k] for k in ("rate_factor", "history", "levels"))
        if held is not None:
            self.field, kept, ages = held  # training may have begun a new one
            self.field.rollback(kept)
            self.ages.set_arrays(ages)
            if self._blend is not None and blend is not None:
                self._blend.restore(blend)

    def settled(self) -> bool:
        """Whether the loss has stopped falling: its median over the last 64 steps is within 2 % of the 64 before."""
        h = self.history
        return len(h) >= 128 and np.median(h[-64:]) > 0.98 * np.median(h[-128:-64])

    def train(
        self, scene, sensor, lights=None, *, frames: int | None = None, seconds: float | None = None,
        at_least: int = 0, at_most: int = 1000, progress: Callable | None = None,
    ) -> None:  # fmt: skip
        """Train `frames` frames, or for about `seconds`, or (neither given) until `settled`.

        `progress` is called with (done, total), in frames or seconds. The last two limits are for `settled`.
        """
        t0, done = time.perf_counter(), 0
        while True:
            elapsed = time.perf_counter() - t0
            if frames is not None:
                if done >= frames:
                    break
            elif seconds is not None:
                if elapsed * (1 + 0.5 / max(done, 1)) >= seconds:
                    break
            elif done >= at_most or (done >= at_least and self.settled()):
                break
            self.train_frame(scene, sensor, lights)
            done += 1
            if progress is not None:
                if frames is None and seconds is not None:
                    progress(min(time.perf_counter() - t0, seconds), seconds)
                else:
                    progress(done, frames if frames is not None else at_most)
