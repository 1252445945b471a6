"""How wrong either cache is, and how noisy it is to trace on instead: measured on the training paths, by place.

An image of N samples a pixel averages noise away, but no bias. At a vertex three estimates of the light it reflects
compete, each with an expected squared error,

    outgoing cache there                        b_o²
    direct light traced, incident cache         b_i² + v_i / N
    one more bounce, outgoing cache after it    v / N

and all can be measured without a reference. Two training paths that start at the same point give independent estimates
T, T' of the last one. The noise of both cancels in the mean of ``(A - T)(A - T')``, which is A's squared bias against
it; their half squared difference is v. In the same way the product of the two caches' biases is found: they learn from
the same paths, and where they err alike, mixing them is of no use.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import loss
from .voxels import Voxels, cell_sums, check_box, main_axis

#: What is kept per cell.
ERRORS = ("noise_bounce", "noise_incident", "bias_incident", "bias_outgoing", "bias_product")
#: Relative differences are cut here: single paths of a thousand times the light would rule a cell for long.
LARGEST = 30.0
#: Added to the squared prediction that differences are relative to, over the squared scale: as in relMSE.
LEVEL_EPSILON = 1e-2
#: Pairs of the whole grid's mean that a cell's own noise starts from. A bias starts from more, see `_finish`.
PRIOR = 8
#: Time of a sample that ends in the incident cache, and of one that asks the outgoing cache at its first vertex as
#: well, over that of one that does neither. Measured at the end, in three scenes: 1.26 to 1.30, and 1.16 to 1.41.
INCIDENT_COST, OUTGOING_COST = 1.4, 1.2
#: The drift of a region without records: paths do not stop there.
UNKNOWN = 1e30
#: Shares of the outgoing cache this close to 0 or 1 count as that, so that only one of the two need be evaluated.
NEGLIGIBLE = 0.02


@dataclass(frozen=True)
class AccuracyShape:
    """Sizes of the grid: cells along the longest axis, and how many of them make a region along an axis; entries of
    the hash tables, powers of two."""

    resolution: int = 16
    region: int = 4
    n_entries: int = 2**14
    n_regions: int = 2**10

    def __post_init__(self):
        for name in ("resolution", "region", "n_entries", "n_regions"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 1")
        for name in ("n_entries", "n_regions"):
            if getattr(self, name) & (getattr(self, name) - 1):
                raise ValueError(f"{name} is {getattr(self, name)}; it must be a power of two")


@dataclass
class Pairs:
    """Two independent estimates each of what a surface reflects towards its viewer, at first vertices.

    outgoing    what the outgoing cache says
    direct      direct light, traced: two arrays
    bounce      indirect light after one more bounce: two arrays
    incident    indirect light by the incident cache: two arrays
    """

    position: mi.Point3f
    normal: mi.Vector3f
    outgoing: mi.Color3f
    direct: tuple
    bounce: tuple
    incident: tuple
    valid: mi.Bool


def mix(error, bias, cross):
    """(w, error of the mix) of least squared error: of an estimate of squared bias `bias` with weight w and one of
    squared error `error`, the product of their biases being `cross`.

    w² b² + (1-w)² e + 2 w (1-w) c is least at w = (e - c) / (e + b² - 2c). Where both errors are 0: (0, 0).
    """
    total = error + bias - 2 * cross
    w = dr.select(total > 0, dr.clip((error - cross) / dr.maximum(total, 1e-30), 0, 1), 0)
    return w, dr.square(w) * bias + dr.square(1 - w) * error + 2 * w * (1 - w) * cross


def _in_equal_time(noise, cost, bias, bias_outgoing, cross):
    """(w, error): whether and with what weight to mix the outgoing cache's answer with an estimate of these errors, and
    the squared error that follows in the time of samples of cost 1."""
    w, _ = mix(noise + bias, bias_outgoing, cross)
    alone = cost * noise + bias
    slower = (cost + OUTGOING_COST - 1) * noise + bias
    mixed = dr.square(w) * bias_outgoing + dr.square(1 - w) * slower + 2 * w * (1 - w) * cross
    return dr.select(mixed < alone, w, 0), dr.minimum(mixed, alone)


class Accuracy:
    """A hashed grid of cells with the errors above; queries are look-ups. A PyTree of fixed sizes.

    Squared errors are relative to the squared prediction of the outgoing cache. Cells split by the main axis of the
    normal. Per entry: `noise_bounce` v, `noise_incident` v_i, `bias_incident` b_i², `bias_outgoing` b_o²,
    `bias_product` b_i b_o (empty cells hold the mean of all, an empty grid 0). Per region: `drift`, see :meth:`stops`.
    `n_pairs`: decayed count of all pairs.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "voxels": object, "scale": object, "sums": object,
        "region_sums": object, "n_pairs": object, "squares": object, "noise_bounce": object, "noise_incident": object,
        "bias_incident": object, "bias_outgoing": object, "bias_product": object, "drift": object,
    }  # fmt: skip

    def __init__(self, box_min, box_max, shape: AccuracyShape | None = None, *, scale: float = 1.0):
        self.shape = shape or AccuracyShape()
        low, high = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        check_box(low, high)
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number")
        self.voxels = Voxels(low, high, self.shape.resolution)
        self.scale = mi.Float(float(scale))
        self.reset()

    def reset(self) -> None:
        """Forget all that was measured: nothing is trusted."""
        n, n_regions = self.shape.n_entries, self.shape.n_regions
        self.sums = [dr.zeros(mi.Float, n) for _ in range(len(ERRORS) + 1)]  # and the number of pairs
        self.region_sums = [dr.zeros(mi.Float, n_regions) for _ in range(3)]  # Σδ, Σδ², number of records
        self.n_pairs, self.squares = mi.Float(0), [mi.Float(0) for _ in range(3)]  # of b_i², b_o², b_i b_o
        self._finish()
        dr.make_opaque(self)

    # -----------------------------------------------------------------------------------------------------------------
    # Where

    def _entry(self, x, normal):
        return self.voxels.entry(x, self.shape.n_entries, main_axis(normal))

    def _region(self, x):
        return self.voxels.entry(x, self.shape.n_regions, times=self.shape.region)

    # -----------------------------------------------------------------------------------------------------------------
    # What to do

    def choose(self, x, normal, n_samples, active=True):
        """At the first vertex of a path, one of `n_samples` of a pixel: (share, incident).

        `share`: the weight of the outgoing cache's answer there, the rest being traced. `incident`: whether tracing
        ends right there, in the incident cache, or goes on for another bounce: whichever leads to the mix of smaller
        squared error in equal time.
        """
        i = self._entry(x, normal)
        v, v_i, b_i, b_o, c = (dr.gather(mi.Float, getattr(self, name), i, active) for name in ERRORS)
        inverse = dr.rcp(mi.Float(n_samples))
        w, error = _in_equal_time(v * inverse, 1, 0, b_o, 0)
        w_incident, error_incident = _in_equal_time(v_i * inverse, INCIDENT_COST, b_i, b_o, c)
        incident = error_incident < error
        w = dr.select(incident, w_incident, w)
        return dr.select(w < NEGLIGIBLE, 0, dr.select(w > 1 - NEGLIGIBLE, 1, w)), incident

    def stops(self, x, n_samples, active=True):
        """Probability of ending a path in the outgoing cache at a later vertex: ``1 / (1 + N m²/v)``.

        By way of a rough surface the eye sees the cache's mean over a region: m is its mean relative difference from
        the training targets there, v their mean square. Not knowing better counts as bias: without a bias m²/v is 1
        over the number of records, so with enough samples paths go on whatever was measured; without a record, always.
        """
        drift = dr.gather(mi.Float, self.drift, self._region(x), active)
        return dr.rcp(1 + mi.Float(n_samples) * drift)

    # -----------------------------------------------------------------------------------------------------------------
    # Learn

    def _relative(self, difference, level):
        value = loss.luminance(difference) * dr.rsqrt(dr.square(level) + LEVEL_EPSILON * dr.square(self.scale))
        return dr.select(dr.isfinite(value), dr.clip(value, -LARGEST, LARGEST), 0)

    def observe(self, pairs: Pairs, x, targets, predictions, valid, decay) -> None:
        """Take in a frame: `pairs`, and records at `x` with `targets` and the outgoing cache's `predictions` (Color3f,
        W/m²/sr). What a cell knew counts `decay` times as much as what it is told now. May be frozen."""
        level = loss.luminance(pairs.outgoing)
        d, g, i = pairs.direct, pairs.bounce, pairs.incident
        gain = [self._relative(d[k] + g[k] - pairs.outgoing, level) for k in range(2)]
        lack = [self._relative(i[k] - g[k], level) for k in range(2)]
        v = 0.5 * dr.square(gain[0] - gain[1])
        v_i = 0.5 * dr.square(self._relative(d[0] + i[0] - d[1] - i[1], level))
        b_i, b_o = lack[0] * lack[1], gain[0] * gain[1]
        c = -0.5 * (gain[0] * lack[1] + gain[1] * lack[0])
        one = mi.Float(1)
        entry = self._entry(pairs.position, pairs.normal)
        new = cell_sums([v, v_i, b_i, b_o, c, one], entry, pairs.valid, self.shape.n_entries)
        self.sums = [dr.fma(decay, old, s) for old, s in zip(self.sums, new, strict=True)]
        self.n_pairs = dr.fma(decay, self.n_pairs, mi.Float(dr.count(pairs.valid)))
        self.squares = [
            dr.fma(decay, old, dr.sum(dr.select(pairs.valid, dr.square(b), 0)))
            for old, b in zip(self.squares, (b_i, b_o, c), strict=True)
        ]

        δ = self._relative(targets - predictions, loss.luminance(predictions))
        new = cell_sums([δ, dr.square(δ), one], self._region(x), valid, self.shape.n_regions)
        self.region_sums = [dr.fma(decay, old, s) for old, s in zip(self.region_sums, new, strict=True)]
        self._finish()
        dr.eval(self)

    def _finish(self) -> None:
        """From sums to errors: a cell's mean, drawn towards that of all cells as far as its own pairs are few.

        The weight of the common mean, in pairs, is the variance of one pair over that between cells. For noise that is
        about 1; a product of differences varies far more, and between cells biases differ by about their mean.
        """
        dr.eval(self.sums, self.n_pairs, self.squares)
        *sums, n = self.sums
        inv_all = dr.select(self.n_pairs > 0, 1 / dr.maximum(self.n_pairs, 1e-3), 0)

        def drawn(total, mean, weight):
            return (total + weight * mean) / (n + weight)

        self.noise_bounce, self.noise_incident = (drawn(s, dr.sum(s) * inv_all, PRIOR) for s in sums[:2])
        means = [dr.sum(total) * inv_all for total in sums[2:]]
        variances = [square * inv_all for square in self.squares]
        # A squared bias counts at least as its mean's standard error: what is not known is not trusted
        means[:2] = [dr.maximum(m, dr.sqrt(s * inv_all)) for m, s in zip(means[:2], variances[:2], strict=True)]
        b_i, b_o, c = (
            drawn(total, m, dr.clip(s / dr.maximum(dr.square(m), 1e-20), PRIOR, 1e6))
            for total, m, s in zip(sums[2:], means, variances, strict=True)
        )
        self.bias_incident, self.bias_outgoing = dr.maximum(b_i, 0.1 * means[0]), dr.maximum(b_o, 0.1 * means[1])
        limit = dr.sqrt(self.bias_incident * self.bias_outgoing)
        self.bias_product = dr.clip(c, -limit, limit)

        δ, δδ, count = self.region_sums
        known = δδ > 0
        drift = dr.square(δ) / dr.select(known, δδ * count, 1)
        self.drift = dr.select(known, drift, UNKNOWN)

    # -----------------------------------------------------------------------------------------------------------------
    # State

    def snapshot(self) -> dict[str, np.ndarray]:
        """All that was measured, as NumPy arrays."""
        sums = {f"sums{k}": np.array(v) for k, v in enumerate(self.sums)}
        regions = {f"region_sums{k}": np.array(v) for k, v in enumerate(self.region_sums)}
        totals = {"totals": np.array([v[0] for v in (self.n_pairs, *self.squares)])}
        return {**sums, **regions, **totals}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Go back to a :meth:`snapshot` of a grid of equal shape."""
        self.sums = [mi.Float(arrays[f"sums{k}"]) for k in range(len(self.sums))]
        self.region_sums = [mi.Float(arrays[f"region_sums{k}"]) for k in range(len(self.region_sums))]
        self.n_pairs, *self.squares = (mi.Float(float(v)) for v in arrays["totals"])
        self._finish()
        dr.make_opaque(self)

    def summary(self) -> dict:
        """Means over all pairs, for statistics."""
        n = max(float(self.n_pairs[0]), 1e-3)
        return {name: float(dr.sum(s)[0]) / n for name, s in zip(ERRORS, self.sums, strict=False)}
