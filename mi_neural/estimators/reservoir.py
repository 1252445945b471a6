"""Reservoirs: one sample kept out of many, and what it counts.

Functions of samples alone. A sample is a light's number and the two uniform numbers that choose a point on it (primary
sample space: densities are over those numbers, so that reuse at another pixel has Jacobian 1). A *target* is the
non-negative function that samples are kept in proportion to; where it is 0 at a pixel, that pixel's reservoir never
holds the sample.

Sources: Talbot, Cline, Egbert, "Importance Resampling for Global Illumination" (EGSR 2005); Bitterli et al.,
"Spatiotemporal reservoir resampling" (SIGGRAPH 2020); pairwise weights: Bitterli, "Correlations and Reuse for Fast and
Accurate Physically Based Light Transport" (2022), and Lin et al., "Generalized Resampled Importance Sampling"
(SIGGRAPH 2022).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi


@dataclass
class Reservoir:
    """One kept sample per lane (a PyTree; it may be a loop variable).

    index   the light
    uv      two uniform numbers: the point on it
    w_sum   sum of the resampling weights seen
    M       confidence: number of samples (or of frames) that it stands for
    W       contribution weight: E[g(sample) W] = sum over lights of the integral of g where the target is positive
    target  value of the target at the sample
    """

    index: mi.UInt32
    uv: mi.Point2f
    w_sum: mi.Float
    M: mi.Float
    W: mi.Float
    target: mi.Float

    @classmethod
    def empty(cls, n: int = 1) -> Reservoir:
        """Nothing seen: contributes 0, with confidence 0."""
        zero = dr.zeros(mi.Float, n)
        return cls(dr.zeros(mi.UInt32, n), dr.zeros(mi.Point2f, n), zero, *(mi.Float(zero) for _ in range(3)))

    def at(self, lane, active=True) -> Reservoir:
        """The reservoirs of other lanes; empty ones where not `active`."""
        values = (getattr(self, f.name) for f in fields(self))
        return Reservoir(*(dr.gather(type(v), v, lane, active) for v in values))


def update(r: Reservoir, index, uv, weight, target, u, count=1) -> Reservoir:
    """`r` after one more sample: it is kept with probability weight / (new sum of weights), by the uniform `u`.

    E[g(kept) w_sum] = E[sum of g(x_i) w_i] for any g (Talbot et al. 2005; as a stream: Bitterli et al. 2020, alg. 2).
    `count` is added to M. Weights that are not finite or negative count as 0.
    """
    weight = _sane(weight)
    w_sum = dr.minimum(r.w_sum + weight, dr.largest(mi.Float))
    take = u * w_sum < weight
    index, uv, target = (dr.select(take, a, b) for a, b in ((index, r.index), (uv, r.uv), (target, r.target)))
    return Reservoir(index, uv, w_sum, r.M + count, r.W, target)


def finish(r: Reservoir, count=None) -> Reservoir:
    """Set W = w_sum / (count target), `count` being M unless given; 0 where the target is.

    E[g(kept) W] = integral of g over the target's support, if the weights were target / pdf (Bitterli et al. 2020,
    eq. 6).
    """
    return replace(r, W=_ratio(_ratio(r.w_sum, r.target), r.M if count is None else count))


def merge(r: Reservoir, other: Reservoir, target, share, u) -> Reservoir:
    """`r` after the sample of another, finished reservoir, whose target here is `target`; confidences add up.

    E[g(kept) w_sum] gains E[share(x) target(x) g(x) W_other] (Bitterli et al. 2020, alg. 4, with share = M; Lin et al.
    2022 with shares m_i(x) that sum to 1).
    """
    return update(r, other.index, other.uv, _sane(share * target) * other.W, target, u, other.M)


def combine(reservoirs: list, targets: list, us: list, shares: list | None = None, supports=None) -> Reservoir:
    """One finished reservoir out of several: their samples, resampled by `targets`, the target here of each sample.

    Three normalisations; `us` are uniform numbers, one each:

    - by default 1/M: cheap, and too dark by the share of the M that could not have given the sample
      (Bitterli et al. 2020, alg. 4 and sec. 4.2);
    - `supports`, a function of the result that gives for each reservoir the sample's target at *its* pixel: 1/Z, with
      Z = sum of the M where that is positive. E[g W] = integral of g (alg. 6 there);
    - `shares`, one MIS weight for each, which for any sample sum to 1 over those that could have given it: E[g W] =
      integral of g, with less noise than 1/Z (Lin et al. 2022).
    """
    total = Reservoir.empty()
    for k, (r, target) in enumerate(zip(reservoirs, targets, strict=True)):
        total = merge(total, r, target, shares[k] if shares is not None else r.M, us[k])
    if shares is not None:
        return finish(total, 1)
    if supports is None:
        return finish(total)
    Z = sum((dr.select(there > 0, r.M, 0) for r, there in zip(reservoirs, supports(total), strict=True)), mi.Float(0))
    return finish(total, Z)


def balance(M_a, target_a, M_b, target_b):
    """Share of a in M_a target_a + M_b target_b; 0 where a gives nothing (balance heuristic with confidences, Lin et
    al. 2022). ``balance(a, b) + balance(b, a) = 1`` where either product is positive.

    Ratios are taken before they are multiplied, so that targets of 1e30 pass; below 1e-38 they count as 0, as a GPU
    divides by them.
    """
    a, b = (
        (M > 0) & (target >= dr.smallest(mi.Float)) & dr.isfinite(M) & dr.isfinite(target)
        for M, target in ((M_a, target_a), (M_b, target_b))
    )
    ratio = (M_b / dr.select(a, M_a, 1)) * (target_b / dr.select(a, target_a, 1))
    return dr.select(a, 1 / (1 + dr.select(b, ratio, 0)), 0)


def pairwise(M, target, M_center, target_center, scale=1.0):
    """Shares of a neighbour and of the central reservoir in one pair, before both are divided by the sum of all M.

    First, of the neighbour for a sample where its target is p: M S p / (S p + M_center p_center) with S = `scale` M;
    second, the rest of M, by which the central one's own share M_center grows. Together they are the sum of all M
    wherever the central target is positive, and the first is 0 where the neighbour's target is: E[g W] = integral of g
    after `finish` (defensive pairwise MIS, Bitterli 2022; Lin et al. 2022). Any positive `scale` is allowed; the number
    of neighbours is best.
    """
    first = balance(scale * M, target, M_center, target_center)
    return M * first, M * balance(M_center, target_center, scale * M, target)


def clamp_history(r: Reservoir, M_max) -> Reservoir:
    """`r` with a confidence of at most `M_max`; its sample and W stay (Bitterli et al. 2020, sec. 5: 20 times)."""
    return replace(r, M=dr.minimum(r.M, M_max))


def _ratio(a, b):
    """a / b; 0 where b is 0 or the result is not finite."""
    ratio = a / dr.select(b > 0, b, 1)
    return dr.select((b > 0) & dr.isfinite(ratio), ratio, 0)


def _sane(weight):
    return dr.select((weight > 0) & dr.isfinite(weight), weight, 0)
