"""How wrong the cache of outgoing radiance is, and how noisy it is to trace instead: measured while training, by place.

An image of N samples a pixel averages noise away, but no bias. At a surface two estimates of the light that it reflects
compete: the cache's answer there, of squared error b², and another bounce, after which the path ends in the cache, of
squared error v/N. Both are measured without a reference. Two training paths that start at the same point give
independent estimates T, T' of the second; their half squared difference is v. The noise of both cancels in the mean of
``(A - T)(A - T')``, which is the squared bias of the cache's answer A against it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.surface import scene_is_glossy
from . import loss
from .outgoing import OutgoingCache, OutgoingTraining, fitted, training_paths
from .outgoing_field import OutgoingField, OutgoingShape
from .trainer import found
from .training_paths import PathRecords
from .voxels import Voxels, cell_sums, check_box, main_axis

#: Relative differences are cut here: single paths of a thousand times the light would rule a cell for long.
LARGEST = 30.0
#: Added to the squared prediction that differences are relative to, over the squared scale: as in relMSE.
LEVEL_EPSILON = 1e-2
#: Pairs of the whole grid's mean that a cell's own noise starts from. A bias starts from more, see `_finish`.
PRIOR = 8
#: Shares of the cache this close to 0 or 1 count as that, so that only one of the two need be evaluated.
NEGLIGIBLE = 0.02


@dataclass(frozen=True)
class AccuracyShape:
    """Sizes of the grid: cells along the longest axis, and entries of the hash table, a power of two."""

    resolution: int = 16
    n_entries: int = 2**14

    def __post_init__(self):
        for name in ("resolution", "n_entries"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        if self.n_entries & (self.n_entries - 1):
            raise ValueError(f"n_entries is {self.n_entries}; it must be a power of two")


@dataclass
class Pairs:
    """What surfaces at first vertices reflect towards the camera: two independent estimates `traced` of each (a pair of
    colours), and the cache's answer `cached`."""

    position: mi.Point3f
    normal: mi.Vector3f
    cached: mi.Color3f
    traced: tuple
    valid: mi.Bool


class Accuracy:
    """A hashed grid of cells with noise and bias; queries are look-ups. A PyTree of fixed sizes.

    Squared errors are relative to the squared prediction of the cache. Cells split by the main axis of the normal. Per
    entry: `noise` v and `bias` b² (empty cells hold the mean of all, an empty grid 0: no share). `mean_bias`: the mean
    b² of all pairs, 0 for an empty grid. `n_pairs`: decayed count of all pairs; `squares`: decayed sum of the squared
    single biases.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "voxels": object, "scale": object, "sums": object, "n_pairs": object, "squares": object, "noise": object,
        "bias": object, "mean_bias": object,
    }  # fmt: skip

    def __init__(self, box_min, box_max, constants: AccuracyShape | None = None, *, scale: float = 1.0):
        self.constants = constants or AccuracyShape()
        low, high = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        check_box(low, high)
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number")
        self.voxels = Voxels(low, high, self.constants.resolution)
        self.scale = mi.Float(float(scale))
        self.reset()

    def reset(self) -> None:
        """Forget all that was measured: the cache has no share."""
        self.sums = [dr.zeros(mi.Float, self.constants.n_entries) for _ in range(3)]  # v, b², number of pairs
        self.n_pairs, self.squares = mi.Float(0), mi.Float(0)
        self._finish()
        dr.make_opaque(self)

    def entry(self, x, normal):
        """Cell of points in world space with unit normals."""
        return self.voxels.entry(x, self.constants.n_entries, main_axis(normal))

    def share(self, x, normal, n_samples, active=True):
        """Weight of the cache's answer in the mix of least squared error, ``w = v/N / (v/N + b²)``, in an image of
        `n_samples` a pixel; the rest is traced."""
        i = self.entry(x, normal)
        return self.weight(*(dr.gather(mi.Float, v, i, active) for v in (self.noise, self.bias)), n_samples)

    @staticmethod
    def weight(noise, bias, n_samples):
        """:meth:`share` where v is `noise` and b² is `bias`."""
        noise = noise * dr.rcp(mi.Float(n_samples))
        total = noise + bias
        w = dr.select(total > 0, noise / dr.maximum(total, 1e-30), 0)
        return dr.select(w < NEGLIGIBLE, 0, dr.select(w > 1 - NEGLIGIBLE, 1, w))

    def expected_bias(self, n_samples: float) -> float:
        """Squared bias that :meth:`share` leaves in an image of `n_samples` a pixel, over the squared light: the mean
        of w² b² over the pairs. What the traced part has of its own, as its paths end in the cache, is not in it."""
        count, bias = self.sums[2], self.bias
        w = self.weight(self.noise, bias, n_samples)
        return float(dr.sum(count * dr.square(w) * bias)[0] / dr.maximum(dr.sum(count), 1e-3)[0])

    def observe(self, pairs: Pairs, decay) -> None:
        """Take in the `pairs` of a step. What a cell holds counts `decay` times as much as what is new. May be frozen.
        """
        level = loss.luminance(pairs.cached)
        gain = [self._relative(traced - pairs.cached, level) for traced in pairs.traced]
        noise, bias = 0.5 * dr.square(gain[0] - gain[1]), gain[0] * gain[1]
        index = self.entry(pairs.position, pairs.normal)
        new = cell_sums([noise, bias, mi.Float(1)], index, pairs.valid, self.constants.n_entries)
        self.sums = [dr.fma(decay, old, s) for old, s in zip(self.sums, new, strict=True)]
        self.n_pairs = dr.fma(decay, self.n_pairs, mi.Float(dr.count(pairs.valid)))
        self.squares = dr.fma(decay, self.squares, dr.sum(dr.select(pairs.valid, dr.square(bias), 0)))
        self._finish()
        dr.eval(self)

    def _relative(self, difference, level):
        value = loss.luminance(difference) * dr.rsqrt(dr.square(level) + LEVEL_EPSILON * dr.square(self.scale))
        return dr.select(dr.isfinite(value), dr.clip(value, -LARGEST, LARGEST), 0)

    def _finish(self) -> None:
        """From sums to errors: a cell's mean, drawn towards that of all cells as far as its own pairs are few.

        The weight of the common mean, in pairs, is the variance of one pair over that between cells. For noise that is
        about 1; a product of differences varies far more, and between cells biases differ by about their mean.
        """
        dr.eval(self.sums, self.n_pairs, self.squares)
        noise, bias, n = self.sums
        inv_all = dr.select(self.n_pairs > 0, 1 / dr.maximum(self.n_pairs, 1e-3), 0)
        noise_of_all, bias_of_all = dr.sum(noise), dr.sum(bias)
        self.mean_bias = dr.maximum(bias_of_all, 0) * inv_all
        self.noise = (noise + PRIOR * noise_of_all * inv_all) / (n + PRIOR)
        variance = self.squares * inv_all
        # A squared bias counts at least as its mean's standard error: what is not known is not trusted
        mean = dr.maximum(bias_of_all * inv_all, dr.sqrt(variance * inv_all))
        weight = dr.clip(variance / dr.maximum(dr.square(mean), 1e-20), PRIOR, 1e6)
        self.bias = dr.maximum((bias + weight * mean) / (n + weight), 0.1 * mean)

    # -------------------------------------------------------------------------------------------------------------
    # State

    def arrays(self) -> dict[str, np.ndarray]:
        """All that was measured, as NumPy arrays."""
        sums = {f"sums{k}": np.array(v) for k, v in enumerate(self.sums)}
        return {**sums, "totals": np.array([self.n_pairs[0], self.squares[0]])}

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from :meth:`arrays` of a grid of equal constants. Raises ``ValueError`` where one does not fit."""
        if {k: v.shape for k, v in arrays.items()} != {k: v.shape for k, v in self.arrays().items()}:
            raise ValueError("its measurements of the cache do not have the sizes of this grid")
        self.sums = [mi.Float(np.float32(arrays[f"sums{k}"])) for k in range(len(self.sums))]
        self.n_pairs, self.squares = (mi.Float(float(v)) for v in arrays["totals"])
        self._finish()
        dr.make_opaque(self)

    def summary(self) -> dict:
        """Means over all pairs, for statistics."""
        n = max(float(self.n_pairs[0]), 1e-3)
        return {f"{k}_of_pairs": float(dr.sum(s)[0]) / n for k, s in zip(("noise", "bias"), self.sums, strict=False)}


class MeasuredField:
    """A field of outgoing radiance, and how wrong it is by place (`grid`). A PyTree, with the protocol of a
    :class:`~mi_neural.caches.blend.Blend`."""

    DRJIT_STRUCT = {"field": object, "grid": object}  # noqa: RUF012
    #: The grid belongs into files.
    IN_FILES = True

    def __init__(self, field: OutgoingField, mode: str = "", constants: AccuracyShape | None = None):
        self.field, self.mode = field, mode
        self.grid = Accuracy(*field.box, constants, scale=float(field.scale[0]))

    def query(self, *surface):
        """The field's answer, see :meth:`~mi_neural.caches.outgoing_field.OutgoingField.query`."""
        return self.field.query(*surface)

    def refresh(self) -> None:
        """Answers are the field's own: nothing to bring up to date."""

    def snapshot(self) -> dict[str, np.ndarray]:
        """The measurements as they are now, for :meth:`restore`."""
        return self.grid.arrays()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Take the measurements back to a snapshot."""
        self.grid.set_arrays(state)


class MeasuredCache(OutgoingCache):
    """A cache of outgoing radiance whose training also measures it. In all but that an `OutgoingCache`."""

    BLEND = MeasuredField

    def __init__(self, training: OutgoingTraining, shape: OutgoingShape | None = None, seed: int = 0):
        super().__init__(training, shape, seed, blend="measured")
        self.measure_name = None

    def measured(self) -> dict:
        return {} if self.field is None else self.queried.grid.summary()

    def frame(self, scene, sensor, lights, cache, ages, seed, rate_factor):
        field = cache.field
        with dr.suspend_grad():
            glossy = scene_is_glossy(scene)
            traced = training_paths(scene, sensor, field, self.training, seed, lights, glossy, True, self.walk)
            n_valid, n_bad = dr.count(traced.outgoing.valid), traced.n_bad[0]
            dr.eval(traced, n_valid)
            pairs = pairs_of(traced, field, self.training.n_paths)
            records = fitted(traced.outgoing, self.training)
            dr.eval(pairs, records)
            learning_rate, decay = self.pace(ages, records.surface.position, records.valid, rate_factor, field)
            self.note(field, records, seed, decay)
            cache.grid.observe(pairs, decay)
        value, mean_target, mean_prediction, more = field.learn(
            *records.surface.inputs(), records.target, records.valid, learning_rate, decay, self.training.epsilon
        )
        value = dr.select(n_valid > 0, value, 0)  # nothing to learn is no divergence
        return found(value, ages, mean_target, mean_prediction, n_valid, n_bad + more)


def pairs_of(traced: PathRecords, field: OutgoingField, n_paths: int) -> Pairs:
    """The first vertices of twin paths: of each two estimates by another bounce, and the cache's answer.

    Another bounce is what a pixel's path does: it ends at the second vertex in the cache, if it may end there; else it
    goes on, as the training path did.
    """
    records, lane = traced.outgoing, dr.arange(mi.UInt32, n_paths)
    n_records = dr.width(records.valid)
    second = dr.minimum(lane + n_paths, n_records - 1)
    ends = dr.gather(mi.Bool, traced.stops, lane) & dr.gather(mi.Bool, records.valid, second)
    ends &= lane + n_paths < n_records
    surface = dr.gather(type(records.surface), records.surface, second)
    beyond = dr.select(ends, field.query(*surface.inputs()), dr.gather(mi.Color3f, traced.incident.target, lane))
    estimate = dr.gather(mi.Color3f, traced.direct, lane) + dr.gather(mi.Color3f, traced.weight, lane) * beyond
    dr.eval(estimate)

    k = dr.arange(mi.UInt32, n_paths // 2) * 2
    surface = dr.gather(type(records.surface), records.surface, k)
    twins = dr.gather(mi.Color3f, estimate, k), dr.gather(mi.Color3f, estimate, k + 1)
    valid = dr.gather(mi.Bool, records.valid, k) & dr.gather(mi.Bool, records.valid, k + 1)
    valid &= dr.all(dr.isfinite(twins[0] + twins[1]))
    return Pairs(surface.position, surface.normal, field.query(*surface.inputs()), twins, valid)
