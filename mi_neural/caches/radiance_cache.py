"""A neural radiance cache for renderers of your own, with the interface of AMD's guide "FSR Radiance Caching" (the
seed): one :class:`RadianceCache`, one `dispatch`. What it learns: :mod:`.outgoing`."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.frozen import undisturbed
from .field import CacheFileError
from .optimizer import own_copy
from .outgoing_field import OutgoingField, OutgoingShape
from .presets import PRESETS, RadianceCacheGuide, RadianceCaching
from .voxels import check_box

#: Defaults of the guide.
LEARNING_RATE, WEIGHT_SMOOTHING = RadianceCacheGuide.learning_rate, RadianceCacheGuide.ema_decay


class DispatchFlags(enum.Flag):
    """What one :meth:`RadianceCache.dispatch` does; combine with ``|``. The order is fixed: reset, inference, training,
    clearing of counters."""

    INFERENCE = enum.auto()
    TRAINING = enum.auto()
    CLEAR_INFERENCE_COUNTER = enum.auto()
    CLEAR_TRAINING_COUNTER = enum.auto()
    CLEAR_ALL_COUNTERS = CLEAR_INFERENCE_COUNTER | CLEAR_TRAINING_COUNTER
    RESET = enum.auto()
    OVERRIDE_LEARNING_RATE = enum.auto()
    OVERRIDE_WEIGHT_SMOOTHING = enum.auto()


@dataclass
class CacheInput:
    """Surface points for a :class:`RadianceCache`, as Dr.Jit arrays; make them with :meth:`RadianceCache.pack`.

    position   over the box: [0, 1]^3 inside
    normal     polar angles (θ from +z, φ from +x) of the shading normal on the viewer's side, radians
    view_dir   of the direction towards the viewer
    albedo     diffuse and specular reflectance together, RGB
    roughness  at least 0

    As NumPy: one array (points, 11) of these columns in this order.
    """

    position: mi.Point3f
    normal: mi.Vector2f
    view_dir: mi.Vector2f
    albedo: mi.Color3f
    roughness: mi.Float

    def columns(self) -> list:
        """The eleven numbers of a point."""
        return [*self.position, *self.normal, *self.view_dir, *self.albedo, self.roughness]


N_COLUMNS = 11


def _direction(polar):
    """Polar angles to a unit vector."""
    (sin_theta, cos_theta), (sin_phi, cos_phi) = dr.sincos(polar.x), dr.sincos(polar.y)
    return mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)


def _surface(flat, width: int) -> tuple:
    """Columns one after the other to the arguments of an `OutgoingField`."""
    lane = dr.arange(mi.UInt32, width)
    c = [dr.gather(mi.Float, flat, lane + i * width) for i in range(N_COLUMNS)]
    return (
        mi.Point3f(c[:3]), _direction(mi.Vector2f(c[3:5])), _direction(mi.Vector2f(c[5:7])), mi.Color3f(c[7:10]), c[10],
    )  # fmt: skip


class RadianceCache:
    """A neural radiance cache for a renderer of your own, with the interface of AMD's "FSR Radiance Caching" guide.

    Parameters: `max_inference_sample_count`, `max_training_sample_count` (per dispatch), `box_min`, `box_max` (the
    scene's, world space; points may lie outside), `scale` (see :class:`OutgoingField`; None:
    measured on the first training samples, and until then predictions are 0), `shape`, `seed`, `preset` (``measured``
    or ``paper``, see below; a `shape` goes before it). Raises ValueError for values that make no sense.

    Points are :class:`CacheInput` (answers: `mi.Color3f`) or NumPy arrays (n, 11) (answers: (n, 3) of 32 bit). Unlike
    in the guide, targets and predictions are whole radiance: the cache divides by the albedo and multiplies it back.

        cache = RadianceCache(320 * 180, 16384, bbox.min, bbox.max)
        points = cache.pack(si.p, si.sh_frame.n, si.to_world(si.wi), albedo, roughness)
        L = cache.dispatch(DispatchFlags.INFERENCE | DispatchFlags.TRAINING, prediction_inputs=points,
                           train_inputs=..., train_targets=...)

    See :func:`self_training_frame` for a whole frame.

    Constants of ``paper`` / ``measured``, and the measurement that led from one to the other:

    - learning rate 0.002, weight smoothing 0.99 (the guide), inputs position, normal, view direction, albedo,
      roughness, ε of the loss 0.01 (Müller et al. 2021): the same in both.
    - network: 2 hidden layers of 64 (Müller et al. 2021, with a hash grid; the guide prints none) / of 32; not
      measured.
    - not printed in the guide, so ours in both: the network's kind, its loss, the grid, the initial weights. Most
      training samples of a dispatch, 1 to 5 % of the pixels in the guide, are `max_training_sample_count`.
    """

    #: Smallest size that buffers are padded to: work is recorded once per size (half, quarter, ... of the maximum).
    SMALLEST = 1024

    def __init__(
        self, max_inference_sample_count: int, max_training_sample_count: int, box_min=(0, 0, 0), box_max=(1, 1, 1),
        *, scale: float | None = None, shape: OutgoingShape | None = None, seed: int = 0, preset: str = PRESETS[0],
    ):  # fmt: skip
        if preset not in PRESETS:
            raise ValueError(f"preset is {preset!r}; give one of: {', '.join(PRESETS)}")
        if preset == "paper" and shape is None:
            shape = OutgoingShape(width=RadianceCaching.width, n_hidden=RadianceCaching.hidden_layers)
        for name, value in (
            ("max_inference_sample_count", max_inference_sample_count),
            ("max_training_sample_count", max_training_sample_count),
        ):
            if not (_is_integer(value) and 1 <= value < 2**28):
                raise ValueError(f"{name} is {value}; it must be an integer in 1..2^28 - 1")
        self.max_inference_sample_count = int(max_inference_sample_count)
        self.max_training_sample_count = int(max_training_sample_count)
        box_min, box_max = (np.array(b, np.float64).ravel() for b in (box_min, box_max))
        check_box(box_min, box_max)
        self.box = (box_min.tolist(), box_max.tolist())
        self._adopt(OutgoingField((0, 0, 0), (1, 1, 1), shape, scale=scale, seed=seed))

    def _adopt(self, field: OutgoingField) -> None:
        self.field = field
        self._inference: dict = {}  # frozen functions by width
        self._training: dict = {}
        self._forget_counts()

    def _forget_counts(self) -> None:
        self._counts = {"inference_samples": 0, "training_samples": 0, "steps": self.field.steps}
        self._bad_inference, self._bad_training = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, 0)
        self._loss = mi.Float(math.nan)

    def reset(self) -> None:
        """As if the cache had just been made, bit for bit. Compiled kernels are kept."""
        self.field.reset()
        self._forget_counts()

    @property
    def statistics(self) -> dict:
        """Counts since the start: samples asked and trained on, inputs and records that were not finite (and did not
        enter the network), steps (those before a file was written are among them); the latest loss."""
        return {
            **self._counts, "nonfinite_inference": int(self._bad_inference[0]),
            "nonfinite_training": int(self._bad_training[0]), "loss": float(self._loss[0]),
        }  # fmt: skip

    # -------------------------------------------------------------------------------------------------------------

    def pack(self, position, normal, view_dir, albedo, roughness):
        """Inputs from world-space values: `CacheInput` from Dr.Jit arrays, an array (n, 11) from NumPy's (four (n, 3)
        and one (n,)). `normal` and `view_dir` are unit vectors, see :class:`CacheInput`."""
        low, high = (np.array(b) for b in self.box)
        if isinstance(position, np.ndarray):
            angles = []
            for v in (np.asarray(normal), np.asarray(view_dir)):
                angles += [np.arccos(np.clip(v[:, 2], -1, 1)), np.arctan2(v[:, 1], v[:, 0])]
            columns = [*((position - low) / (high - low)).T, *angles, *np.asarray(albedo).T, np.asarray(roughness)]
            return np.stack(columns, axis=-1).astype(np.float32)
        inverse = mi.Vector3f((1 / (high - low)).tolist())
        position = mi.Point3f((mi.Point3f(position) - mi.Point3f(low.tolist())) * inverse)
        polar = [mi.Vector2f(dr.safe_acos(v.z), dr.atan2(v.y, v.x)) for v in map(mi.Vector3f, (normal, view_dir))]
        return CacheInput(position, *polar, mi.Color3f(albedo), mi.Float(roughness))

    def dispatch(
        self, flags: DispatchFlags, *, prediction_inputs=None, train_inputs=None, train_targets=None,
        sample_counters=None, learning_rate: float | None = None, weight_smoothing: float | None = None,
    ):  # fmt: skip
        """All that is done with the cache in a frame: reset, then inference, then training, as `flags` say.

        prediction_inputs   points to predict radiance at, with INFERENCE
        train_inputs        points to learn at, with TRAINING
        train_targets       radiance at these: `mi.Color3f`, or a NumPy array (n, 3)
        sample_counters     how many points of the two buffers count, from the front: [inference, training], a list, a
                            NumPy array or `mi.UInt32` (which `dr.scatter_inc` can fill); None: all. CLEAR_... set its
                            entries to 0 in the end
        learning_rate, weight_smoothing
                            in place of 0.002 and 0.99, with OVERRIDE_...; smoothing 0: none, 1: predictions stay

        Returns the predictions, of the kind and length of `prediction_inputs`, 0 beyond the counter; None without
        INFERENCE. Points that are not finite are predicted as 0, and not trained on. Raises ValueError for counts above
        the maxima and for all other impossible arguments; nothing has been changed then.
        """
        if not isinstance(flags, DispatchFlags):
            raise ValueError(f"flags is {flags!r}; combine DispatchFlags, as in DispatchFlags.INFERENCE")
        rate, smoothing = _overrides(flags, learning_rate, weight_smoothing)
        counters = _Counters(sample_counters, flags)
        points = n_queries = records = None
        if DispatchFlags.INFERENCE in flags:
            points = _Buffer("prediction_inputs", prediction_inputs, N_COLUMNS)
            n_queries = counters.count(0, "inference", points, self.max_inference_sample_count)
        if DispatchFlags.TRAINING in flags:
            records = _Buffer("train_inputs", train_inputs, N_COLUMNS)
            targets = _Buffer("train_targets", train_targets, 3)
            if records.width != targets.width:
                raise ValueError(f"there are {records.width} train_inputs but {targets.width} train_targets")
            known = counters.count(1, "training", records, self.max_training_sample_count)

        if DispatchFlags.RESET in flags:
            self.reset()
        predictions = None if points is None else self._infer(points, n_queries)
        if records is not None and known:
            self._train(records, targets, known, rate, smoothing)
        counters.clear()
        return predictions

    def _bucket(self, count: int, maximum: int) -> int:
        """The size that `count` points are padded to."""
        size = maximum
        while size // 2 >= max(count, self.SMALLEST):
            size = size // 2
        return size

    def _infer(self, points: _Buffer, count: int):
        if not count:
            return points.zeros()
        width = self._bucket(count, self.max_inference_sample_count)
        if width not in self._inference:
            self._inference[width] = dr.freeze(_inference_of(width), auto_opaque=False)
        flat = points.flat(width, count)
        with dr.suspend_grad(), undisturbed():
            radiance, self._bad_inference = self._inference[width](
                self.field, flat, dr.opaque(mi.UInt32, count), self._bad_inference
            )
        self._counts["inference_samples"] += count
        return points.answer(radiance, width)

    def _train(self, records: _Buffer, targets: _Buffer, count: int, rate: float, smoothing: float) -> None:
        width = self._bucket(count, self.max_training_sample_count)
        if width not in self._training:
            self._training[width] = dr.freeze(_training_of(width), auto_opaque=False)
        with undisturbed():
            self._loss, self._bad_training = self._training[width](
                self.field, records.flat(width, count), targets.flat(width, count), dr.opaque(mi.UInt32, count),
                dr.opaque(mi.Float, rate), dr.opaque(mi.Float, smoothing), self._bad_training,
            )  # fmt: skip
        self.field.steps += 1
        self._counts["steps"] += 1
        self._counts["training_samples"] += count

    # -------------------------------------------------------------------------------------------------------------

    def save(self, path) -> None:
        """Write the cache to an ``.npz`` file, whole or not at all."""
        self.field.save(
            path, max_inference_sample_count=self.max_inference_sample_count,
            max_training_sample_count=self.max_training_sample_count, scene_box=self.box,
        )  # fmt: skip

    @staticmethod
    def load(path) -> RadianceCache:
        """The cache of a file. Raises as :meth:`OutgoingField.load`."""
        field, header = OutgoingField.load(path)
        try:
            maxima = header["max_inference_sample_count"], header["max_training_sample_count"]
            cache = RadianceCache(*maxima, *header["scene_box"], shape=field.shape)
        except Exception as e:
            raise CacheFileError(f"'{path}' holds a field, but no RadianceCache, or is damaged ({e})") from None
        cache._adopt(field)
        return cache


def _is_integer(value) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _inference_of(width: int):
    """Predictions for `width` packed points, to be frozen."""

    def infer(field, flat, count, n_bad):
        inputs = _surface(flat, width)
        counted = dr.arange(mi.UInt32, width) < count
        radiance = dr.select(counted, field.query(*inputs), 0)
        bad = counted & ~field.usable(*inputs)
        dr.eval(radiance, bad)
        return radiance, n_bad + dr.count(bad)

    return infer


def _training_of(width: int):
    """A training step on `width` packed records, to be frozen."""

    def train(field, flat, targets, count, learning_rate, smoothing, n_bad):
        lane = dr.arange(mi.UInt32, width)
        target = mi.Color3f([dr.gather(mi.Float, targets, lane + i * width) for i in range(3)])
        value, _, _, bad = field.learn(*_surface(flat, width), target, lane < count, learning_rate, smoothing)
        return value, n_bad + bad

    return train


def _overrides(flags: DispatchFlags, learning_rate, weight_smoothing) -> tuple[float, float]:
    """The learning rate and the smoothing of a dispatch."""
    out = []
    for name, value, default, highest in (
        ("learning_rate", learning_rate, LEARNING_RATE, math.inf),
        ("weight_smoothing", weight_smoothing, WEIGHT_SMOOTHING, 1.0),
    ):
        flag = DispatchFlags[f"OVERRIDE_{name.upper()}"]
        if (flag in flags) != (value is not None):
            missing = name if value is None else str(flag)
            raise ValueError(f"{missing} is missing: to override, pass both {flag} and {name}")
        if value is not None and not (
            isinstance(value, float | int | np.number) and math.isfinite(value) and 0 <= value <= highest
        ):
            limits = "at least 0" if highest == math.inf else "in [0, 1]"
            raise ValueError(f"{name} is {value!r}; it must be a number {limits}")
        out.append(default if value is None else float(value))
    return out[0], out[1]


class _Buffer:
    """Points or colours given to a dispatch: of Dr.Jit, or of NumPy."""

    def __init__(self, name: str, value, n_columns: int):
        self.name = name
        if value is None:
            raise ValueError(f"{name} is missing: the flags ask for it")
        self.numpy = isinstance(value, np.ndarray)
        if self.numpy:
            if value.ndim != 2 or value.shape[1] != n_columns or value.dtype.kind not in "fiu":
                raise ValueError(
                    f"{name} is an array {value.shape} of {value.dtype}; it must be numbers, (n, {n_columns})"
                )
            self.columns, self.width = value, len(value)
            return
        if n_columns == N_COLUMNS and isinstance(value, CacheInput):
            columns = value.columns()
        elif n_columns == 3 and dr.is_jit_v(value) and dr.depth_v(value) == 2 and dr.size_v(value) == 3:
            columns = list(value)
        else:
            kind = "CacheInput" if n_columns == N_COLUMNS else "mi.Color3f"
            raise ValueError(f"{name} is of type {type(value).__name__}; it must be {kind}, or a NumPy array")
        self.columns = [mi.Float(dr.detach(c)) for c in columns]
        widths = {dr.width(c) for c in self.columns}
        self.width = max(widths)
        if widths - {1, self.width}:
            raise ValueError(f"the parts of {name} have different lengths: {sorted(widths)}")

    def flat(self, width: int, count: int):
        """The first `count` entries, column by column, each padded to `width`; in memory of its own."""
        if self.numpy:
            padded = np.zeros((self.columns.shape[1], width), np.float32)
            with np.errstate(over="ignore"):  # becomes infinite, and is counted
                padded[:, :count] = self.columns[:count].T
            return own_copy(mi.Float(padded.ravel()))
        if self.width == width:
            columns = [c + dr.zeros(mi.Float, width) for c in self.columns]
        else:
            index = dr.minimum(dr.arange(mi.UInt32, width), count - 1)
            columns = [dr.gather(mi.Float, c, index if dr.width(c) > 1 else 0 * index) for c in self.columns]
        flat = dr.concat(columns)
        dr.eval(flat)
        return flat

    def zeros(self):
        """Black, in the kind and length of this buffer."""
        return np.zeros((self.width, 3), np.float32) if self.numpy else dr.zeros(mi.Color3f, self.width)

    def answer(self, radiance, width: int):
        """Radiance of `width` points, 0 beyond the counter, in the kind and length of this buffer."""
        if self.numpy:
            out = self.zeros()
            n = min(self.width, width)
            out[:n] = np.array(radiance)[:, :n].T
            return out
        if self.width == width:
            return radiance
        lane = dr.arange(mi.UInt32, self.width)
        return dr.gather(mi.Color3f, radiance, dr.minimum(lane, width - 1), lane < width)


class _Counters:
    """The counters given to a dispatch: how many samples count, and how to clear them."""

    def __init__(self, value, flags: DispatchFlags):
        clears = (DispatchFlags.CLEAR_INFERENCE_COUNTER, DispatchFlags.CLEAR_TRAINING_COUNTER)
        self.value, self.counts = value, None
        self.cleared = [i for i in range(2) if clears[i] in flags]
        if value is None:
            if self.cleared:
                raise ValueError("sample_counters is missing: the flags ask to clear it")
            return
        counts = np.array(value)
        if counts.shape != (2,) or counts.dtype.kind not in "iu" or (counts < 0).any():
            raise ValueError(f"sample_counters is {value!r}; it must be two counts, [inference, training]")
        fixed = isinstance(value, tuple) or (isinstance(value, np.ndarray) and not value.flags.writeable)
        if self.cleared and fixed:
            raise ValueError("sample_counters cannot be written to, but the flags ask to clear it; pass a list")
        self.counts = counts.tolist()

    def count(self, which: int, name: str, buffer: _Buffer, maximum: int) -> int:
        """How many entries of `buffer` count; at most `maximum`."""
        n = buffer.width if self.counts is None else self.counts[which]
        if n > maximum:
            raise ValueError(
                f"{n} {name} samples are more than the maximum of {maximum} that this cache was made with; make it "
                f"with max_{name}_sample_count={n}, or dispatch less"
            )
        if n > buffer.width:
            raise ValueError(f"sample_counters says {n} {name} samples, but {buffer.name} holds {buffer.width}")
        return n

    def clear(self) -> None:
        for which in self.cleared:
            if dr.is_jit_v(self.value):
                dr.scatter(self.value, 0, mi.UInt32(which))
            else:
                self.value[which] = 0


def self_training_frame(
    cache: RadianceCache, train_inputs, train_targets, tail_inputs, tail_weights, tail_index, prediction_inputs=None,
    flags: DispatchFlags = DispatchFlags.TRAINING, **overrides,
):  # fmt: skip
    """One frame by the two-pass self-training recipe of the guide. Returns the radiance at `prediction_inputs`.

    Trace the training paths first. Each of their vertices is a record: the point (`train_inputs`) and the radiance
    gathered from there to the end of the path (`train_targets`). The last vertex of each path is a query
    (`tail_inputs`); record i lies on path `tail_index` [i], and `tail_weights` [i] is the throughput from the record to
    that last vertex: black for a path that left the scene. Then trace the pixels (`prediction_inputs`). What comes back
    is to be weighed with the pixels' throughput and added to the image. All of one kind, NumPy or Dr.Jit.

    `flags` and `overrides` go to the second dispatch, see :meth:`RadianceCache.dispatch`.
    """
    # 1. Training paths have been traced. 2. Queries alone; their answers complete the targets
    radiance = cache.dispatch(DispatchFlags.INFERENCE, prediction_inputs=tail_inputs)
    if isinstance(radiance, np.ndarray):
        rest = tail_weights * radiance[tail_index]
    else:
        rest = tail_weights * dr.gather(mi.Color3f, radiance, tail_index)
    # 3. Pixels have been traced. 4. Queries and training in one; the queries come first
    if prediction_inputs is not None:
        flags |= DispatchFlags.INFERENCE
    return cache.dispatch(
        flags, prediction_inputs=prediction_inputs, train_inputs=train_inputs, train_targets=train_targets + rest,
        **overrides,
    )  # fmt: skip
