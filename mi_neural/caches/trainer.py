"""How anything is trained: step by step while images are made, watched, undone where it diverges, kept in files.

A cache says what its records are, what its field is and what one step does (`start`, and a function that is frozen).
All else is here. A step is queued and not waited for: what it found is written to one small array, and the arrays of
several steps are read together (:meth:`Trainer.check`). Steps that would destroy a network are refused where they are
made (:func:`~mi_neural.caches.optimizer.descend`), so that no image sees their result.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.frozen import call, can_freeze
from .schedule import pace
from .voxels import Ages

#: Steps whose findings are read together.
CHECK_EVERY = 8
#: Sensors of which it is remembered, and which are held alive for it, whether they can be recorded.
MOST_SENSORS = 16


def found(loss, ages: Ages, mean_target=0, mean_prediction=0, n_records=0, n_bad=0, measure=0) -> mi.Float:
    """What a step found, in one array: what a frozen step returns.

    loss                          NaN where the step was refused
    mean_target, mean_prediction  means of the targets and of the absolute predictions, over the field's scale
    n_records, n_bad              records, and those left out because they were not finite
    measure                       mean weight of a blend, or α
    """
    values = loss, mean_target, mean_prediction, n_records, n_bad, measure, ages.total, ages.novelty
    row = dr.concat([mi.Float(v) for v in values])
    dr.eval(row)
    return row


class Trainer:
    """Base of the caches: a field and its training.

    `training` gives ``rate(step)`` and ``decay(step)``. `field` is what is trained (None before the first step; see
    :class:`~mi_neural.caches.field.TrainedField`), `ages` how long each place has been. `statistics` counts since the
    start: steps, records, non-finite records, recoveries, seconds of training, the latest loss.
    """

    #: Mean predictions this many times the latest mean targets are an explosion. Healthy training stayed below 1.3 in
    #: seven scenes from their first step on (1024 paths, 200 steps); all weights times 100 give 10^5.
    EXPLOSION = 10.0
    #: Mean targets this many times the brightness that the field was made for: it is made anew. Where that is nothing,
    #: a lit target counts 1e4 (`TARGET_MAX`), and one that ends in the untrained field 1.
    BRIGHTER, BRIGHTER_THAN_NOTHING = 100.0, 1.0
    #: Steps between snapshots that a divergence is undone with.
    SNAPSHOT_EVERY = 64
    #: Steps of a frame while the camera is in new places: 30 frames then do as much as for a cache that is new itself.
    STEPS_IN_NEW_PLACES = 3
    #: Whether functions of the scene can be frozen.
    recordable = True
    #: What is trained, in messages; what each kind of training draws its random numbers by.
    NAME, SALT = "training", 0xCAC4E
    #: Names of the statistics.
    NAMES = {  # noqa: RUF012
        "steps": "steps", "records": "records", "nonfinite": "nonfinite", "recoveries": "recoveries",
        "seconds": "seconds_train", "loss": "loss",
    }  # fmt: skip
    #: Name of the mean weight of a blend in the statistics; None: there is none.
    measure_name: str | None = None

    def __init__(self, training, seed: int = 0):
        self.training, self.seed = training, seed
        self._recorded: dict[str, Callable] = {}
        self._sensor_freezes: dict[int, tuple] = {}
        self.reset()

    def reset(self) -> None:
        """Forget all that was learned. Compiled kernels are kept."""
        self.field = None
        self.ages: Ages | None = None
        self.steps = 0
        self.rate_factor = 1.0
        self._history: list[float] = []
        self._levels: list[float] = []  # latest mean targets, over the field's scale
        self._good: dict[str, np.ndarray] | None = None
        self._unread: list[mi.Float] = []
        self._counts = {"steps": 0, "records": 0, "nonfinite": 0, "recoveries": 0, "seconds": 0.0, "loss": math.nan}
        self._measure: float | None = None
        self._novel = False

    # -------------------------------------------------------------------------------------------------------------
    # To be given by subclasses

    def start(self, *args) -> None:
        """Make the field, and `ages`, for the scene that `args` describe; no training."""
        raise NotImplementedError(f"{type(self).__name__} must define start()")

    def train_step(self, *args) -> None:
        """One step on fresh records of that scene: calls :meth:`step`."""
        raise NotImplementedError(f"{type(self).__name__} must define train_step()")

    # -------------------------------------------------------------------------------------------------------------
    # Facts

    @property
    def statistics(self) -> dict:
        """Counts since the start, under the names of `NAMES`."""
        self.check()
        facts = {name: self._counts[key] for key, name in self.NAMES.items()}
        if self.measure_name and self._measure is not None:
            facts[self.measure_name] = self._measure
        return facts

    @property
    def history(self) -> list[float]:
        """Losses of all steps but those that were undone."""
        self.check()
        return self._history

    @property
    def levels(self) -> list[float]:
        """The latest mean targets, over the field's scale."""
        self.check()
        return self._levels

    def settled(self) -> bool:
        """Whether the loss has stopped falling: its median over the last 64 steps is within 2 % of the 64 before."""
        h = self._history
        return len(h) >= 128 and np.median(h[-64:]) > 0.98 * np.median(h[-128:-64])

    # -------------------------------------------------------------------------------------------------------------
    # Steps

    def recorded(self, name: str, sensor=None) -> Callable:
        """The method `name`, frozen, or as it is where the scene or the sensor cannot be recorded."""
        method = getattr(self, name)
        if not self.recordable or (sensor is not None and not self._freezes(sensor)):
            return method
        if name not in self._recorded:
            self._recorded[name] = dr.freeze(method, auto_opaque=False)
        return self._recorded[name]

    def call(self, name: str, sensor, *args):
        """Call :meth:`recorded`; the method as it is where it cannot be recorded now."""
        plain = getattr(self, name)
        return call({} if self.recorded(name, sensor) == plain else self._recorded, name, plain, *args)

    def recordings(self) -> dict[str, int]:
        """How often each function was recorded."""
        return {name: function.n_recordings for name, function in self._recorded.items()}

    def clear_recordings(self) -> None:
        """Forget what was recorded for a scene that is not rendered any more; it would be kept for good."""
        for function in self._recorded.values():
            function.clear()
        self._sensor_freezes.clear()

    def _freezes(self, sensor) -> bool:
        """Whether functions of this sensor can be frozen, see :func:`can_freeze`; tried once per sensor."""
        if id(sensor) not in self._sensor_freezes:
            if len(self._sensor_freezes) >= MOST_SENSORS:
                self._sensor_freezes.clear()
            self._sensor_freezes[id(sensor)] = can_freeze(sensor), sensor
        return self._sensor_freezes[id(sensor)][0]

    def pace(self, ages: Ages, x, valid, rate_factor, *fields) -> tuple:
        """:func:`~mi_neural.caches.schedule.pace` of this training."""
        return pace(self.training, ages, x, valid, rate_factor, *fields)

    def step(self, name: str, sensor, *args) -> None:
        """Queue one step: the method `name` with ``(*args, rate_factor)``, which returns what :func:`found` makes."""
        if self._good is None:
            self._good = self.field.snapshot()
        with dr.resume_grad():
            self._unread.append(self.call(name, sensor, *args, dr.opaque(mi.Float, self.rate_factor)))
        self.steps += 1
        self.field.steps = self.steps

    def random_seed(self, step: int) -> int:
        """The seed of a step's random numbers."""
        return int(np.random.SeedSequence((self.seed, self.SALT, step)).generate_state(1)[0])

    # -------------------------------------------------------------------------------------------------------------
    # Health

    def check(self) -> None:
        """Read what the latest steps found; undo training that has diverged; begin anew in another light."""
        if not self._unread:
            return
        t0 = time.perf_counter()
        rows = np.array(dr.concat(self._unread)).reshape(len(self._unread), -1)
        self._unread.clear()
        first = self.steps - len(rows) + 1
        brighter = self.BRIGHTER_THAN_NOTHING if self.found_no_light() else self.BRIGHTER
        for k, row in enumerate(rows.tolist()):
            loss, mean_target, mean_prediction, n_records, n_bad, measure, total, novelty = row
            counts = self._counts
            counts["steps"] += 1
            counts["loss"] = loss
            counts["records"] += int(n_records)
            counts["nonfinite"] += int(n_bad)
            self._measure = measure
            if not self._healthy(loss, mean_prediction):
                self.recover(first + k)
                counts["steps"] += len(rows) - k - 1  # they were undone, too
                break
            self._history.append(loss)
            self._levels = [*self._levels[-31:], mean_target]
            self._novel = Ages.is_novel(total, novelty)
            if mean_target > max(brighter, 10 * mean_prediction):
                # What was measured in the old light is void, and the schedule of rates begins anew
                mi.Log(mi.LogLevel.Info, "mi_neural: the scene became brighter by far; the cache starts anew")
                counts["steps"] += len(rows) - k - 1
                self.reset()
                self._counts = counts
                break
        else:
            if self.steps // self.SNAPSHOT_EVERY > (first - 1) // self.SNAPSHOT_EVERY:
                weights = self.field.snapshot()
                if all(np.isfinite(w).all() for w in weights.values()):
                    self._good = weights
        self._counts["seconds"] += time.perf_counter() - t0

    def found_no_light(self) -> bool:
        """Whether the field was made for a scene in which no light was found."""
        return False

    def _healthy(self, loss: float, mean_prediction: float) -> bool:
        """Whether training goes on well. Divergence: numbers that are not finite, among them the loss of a step that
        was refused, or predictions far above what targets have been. Single batches of healthy training exceed the
        median loss a thousandfold."""
        limit = self.EXPLOSION * max(1.0, float(np.median(self._levels)) if self._levels else 1.0)
        return math.isfinite(loss) and mean_prediction <= limit

    def recover(self, step: int | None = None) -> None:
        """Go back to the last good weights, with half the learning rate."""
        self.field.restore(self._good)
        self.refresh()
        self.rate_factor *= 0.5
        self._counts["recoveries"] += 1
        mi.Log(
            mi.LogLevel.Warn,
            f"mi_neural: {self.NAME} diverged at step {step or self.steps}; last good weights restored, learning rate "
            "halved",
        )

    def refresh(self) -> None:
        """Bring what is made of the field's weights up to date."""

    # -------------------------------------------------------------------------------------------------------------
    # Many steps

    def train_frame(self, *args) -> None:
        """One step, or `STEPS_IN_NEW_PLACES` where the camera has come to places that were not trained before."""
        t0 = time.perf_counter()
        if self.field is None:
            self.start(*args)
        for _ in range(self.STEPS_IN_NEW_PLACES if self._novel else 1):
            self.train_step(*args)
        self._counts["seconds"] += time.perf_counter() - t0

    def train(
        self, *args, frames: int | None = None, seconds: float | None = None, at_least: int = 0, at_most: int = 1000,
        progress: Callable | None = None,
    ) -> None:  # fmt: skip
        """Train `frames` frames, or for about `seconds`, or (neither given) until `settled`; `args` as in `train_step`.

        `progress` is called with (done, total), in frames or seconds. The last two limits are for `settled`.
        """
        t0, done = time.perf_counter(), 0
        self.check()
        if self.field is None:
            self.start(*args)
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
            self.train_frame(*args)
            done += 1
            # A single frame is not waited for: the next call reads what it found
            if frames != 1 and (done == 1 or self._novel or len(self._unread) >= CHECK_EVERY or seconds is not None):
                self.check()
            if progress is not None:
                if frames is None and seconds is not None:
                    progress(min(time.perf_counter() - t0, seconds), seconds)
                else:
                    progress(done, frames if frames is not None else at_most)
        if frames != 1:
            self.check()
            if self.field is None:  # the last steps were in another light
                self.start(*args)

    # -------------------------------------------------------------------------------------------------------------
    # State

    def schedule(self) -> dict:
        """Numbers that steer training, apart from the field's."""
        self.check()
        return {"rate_factor": self.rate_factor, "history": list(self._history), "levels": list(self._levels)}

    def set_schedule(self, given: dict) -> None:
        """Go on from :meth:`schedule`. Raises ``KeyError``, ``TypeError`` or ``ValueError`` for what makes no sense."""
        self.rate_factor = float(given["rate_factor"])
        self._history, self._levels = ([float(v) for v in given[name]] for name in ("history", "levels"))
        if not 0 < self.rate_factor <= 1:
            raise ValueError(f"it says that the learning rate was cut to {self.rate_factor}")

    def checkpoint(self) -> tuple:
        """Everything that training changes, to go back to with :meth:`rollback`."""
        schedule = self.schedule()
        held = None if self.field is None else (self.field, self.field.checkpoint(), self.ages.arrays())
        return held, self.steps, schedule, self._good, dict(self._counts), self._measure, self._novel

    def rollback(self, state: tuple | None) -> None:
        """Undo training since `state` was taken; None: forget everything but the field's place and scale."""
        if state is None:
            field = self.field
            self.reset()
            field.reset()
            self.field, self.ages = field, Ages(*field.box)
            return
        held, self.steps, schedule, self._good, counts, self._measure, self._novel = state
        self._unread.clear()
        self._counts = dict(counts)
        self.set_schedule(schedule)
        if held is not None:
            self.field, kept, ages = held  # training may have begun a new one
            self.field.rollback(kept)
            self.ages.set_arrays(ages)
