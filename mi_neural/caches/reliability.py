"""Which of two predictors to believe, and where: a grid of statistics over the training records.

A network trained at a high rate follows a change within frames but flickers; its moving average is steady but lags. The
grid keeps, per cell, how either agrees with the Monte Carlo targets, and answers with σ in [0, 1] for the blend

    L = (1 - σ) f_averaged + σ f_current

(Klepikov, Hanika, Dachsbacher, "Reliability-Weighted Averaging", section 3.2). No rays are traced for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .voxels import Voxels, cell_sums, main_side

MEASURES = ("correlation", "concordance", "regression", "evidence")

#: Inputs, over the scene's radiance scale, are cut at this size (as targets are when the cache learns): squares of
#: squares stay finite in single precision.
LARGEST = 1e4
#: Added to the squared prediction in the weights of 'evidence', in units of the squared mean radiance: as in the
#: training loss, so that relative errors count, but not those of near-black.
LEVEL_EPSILON = 0.03
#: Weight of the grid's mean in a cell's usual difference; five frames of the cell's own weigh as much.
USUAL_PRIOR = 0.05
#: Relative rounding errors of single precision in a difference of moments: less than this counts as 0.
ROUNDING = 1e-6

#: Names of the moments, each of three channels: target y, fast prediction f, averaged prediction e.
MOMENTS = ("y", "yy", "f", "ff", "yf", "e", "ee", "ye", "fe")


@dataclass(frozen=True)
class Reliability:
    """Constants of the grid. Radiances are over the scene's mean radiance throughout, so they hold in every scene.

    measure        how σ is found: 'correlation' (the paper's eq. 3), 'concordance' (Lin 1989; not blind to scale),
                   'regression' (the weight of least squared error, shrunk towards 0) or 'evidence' (a test of whether
                   the fast predictor is better, pooled over neighbours, see `evidence_gate`). Simulated change to twice
                   or half the radiance, targets of relative deviation 3, 19 records a cell and frame: the blend's mean
                   error over the next 30 frames, over the fast predictor's, is 2.1, 2.1, 3.4, 1.08 (the average's 4.1);
                   steady flicker, over the average's, 50, 50, 1.8, 1.00 (the fast one's 100)
    resolution     cells along the longest axis of the box. 28,672 records a frame on the surfaces of a room fill about
                   6 * 16² = 1536 cells of 16 along an axis with 19 records each; of 32, with 5
    n_entries      of the hash table, a power of two. Cells that share an entry share their σ
    split_normals  whether the six main directions of the normal have cells of their own (fewer records in each)
    decay          λ: what a frame leaves of the statistics before it
    per_record     λ per record, not per frame. Per frame is the default: records of one frame were made for the same
                   two predictors, and with λ = 0.9 per record a cell of 20 records would forget all but this frame
    warm_up        updates in which σ stays 0
    kappa          gain of the logistic of 'correlation' and 'concordance'
    epsilon        'correlation', 'concordance': added to variances, in units of the squared mean radiance; 1e-3 is a
                   standard deviation of 3 % of it
    shrinkage      'regression': standard errors that its numerator must exceed to have any effect
    doubt, trust   'evidence': standard errors from which σ may rise, and at which it may reach 1
    spread_decay   'evidence': as `decay`, of the present squared difference of the two predictors
    steady_decay   'evidence': as `decay`, of their usual squared difference while nothing changes
    """

    measure: str = "evidence"
    resolution: int = 16
    n_entries: int = 2**15
    split_normals: bool = False
    decay: float = 0.9
    per_record: bool = False
    warm_up: int = 128
    kappa: float = 4.0
    epsilon: float = 1e-3
    shrinkage: float = 3.0
    doubt: float = 5.0
    trust: float = 6.0
    spread_decay: float = 0.8
    steady_decay: float = 0.99

    def __post_init__(self):
        if self.measure not in MEASURES:
            raise ValueError(f"measure is '{self.measure}'; it must be one of {', '.join(MEASURES)}")
        if not 1 <= self.resolution <= 4096:
            raise ValueError(f"resolution is {self.resolution}; it must lie in 1..4096")
        if not (16 <= self.n_entries <= 2**17 and self.n_entries & (self.n_entries - 1) == 0):
            raise ValueError(f"n_entries is {self.n_entries}; it must be a power of two in 16..{2**17}")
        for name in ("decay", "spread_decay", "steady_decay"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be at least 0 and less than 1")
        if self.warm_up < 0:
            raise ValueError(f"warm_up is {self.warm_up}; it must be at least 0")
        for name in ("kappa", "epsilon", "shrinkage"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}; it must be a positive number")
        if not 0 <= self.doubt < self.trust < float("inf"):
            raise ValueError(f"doubt is {self.doubt}, trust {self.trust}; type 0 <= doubt < trust")


# ---------------------------------------------------------------------------------------------------------------------
# Mathematics: functions of arrays, one value per cell. `s` are variances, `c` covariances, `m` means


def ramp(x, low, high):
    """0 up to `low`, 1 from `high` on, linear between."""
    return dr.clip((x - low) * (1 / (high - low)), 0, 1)


def variance(mean, square):
    """``(E[v²] - E[v]²)_+`` (paper, eq. 1)."""
    return dr.maximum(square - dr.square(mean), 0)


def covariance(product, mean_a, mean_b):
    """``E[a b] - E[a] E[b]`` (paper, eq. 2)."""
    return product - mean_a * mean_b


def correlation(c, s_y, s_f, epsilon):
    """``c / sqrt((s_y + ε)(s_f + ε))`` (paper, eq. 3). Blind to scale: f = 2y has 1."""
    return c / (dr.sqrt(s_y + epsilon) * dr.sqrt(s_f + epsilon))


def concordance(c, s_y, s_f, m_y, m_f, epsilon):
    """``2c / (s_y + s_f + (m_y - m_f)² + ε)`` (Lin 1989, eq. 1): 1 for f = y alone."""
    return 2 * c / (s_y + s_f + dr.square(m_y - m_f) + epsilon)


def preference(r_current, r_averaged, kappa):
    """``σ = 1 / (1 + exp(-κ (r_current - r_averaged)))`` (paper, section 3.2)."""
    return 1 / (1 + dr.exp(-kappa * (r_current - r_averaged)))


def regression(numerator, denominator, error, shrinkage):
    """The σ that minimises ``E|(1-σ) f_e + σ f_f - y|²``, cut to [0, 1] and shrunk towards 0.

        σ* = E[(y - f_e)·(f_f - f_e)] / E|f_f - f_e|²         σ = σ* (1 - (k error / numerator)²)_+

    over a frame's records, channels summed. Targets are unbiased and independent of predictions made before they were
    traced, so their noise leaves the numerator's mean alone. `error` is the numerator's standard error and k
    (`shrinkage`) how often it must be exceeded: the positive-part rule of James and Stein for one mean, with k² for
    their constant.
    """
    doubt = dr.square(shrinkage * error / dr.maximum(numerator, 1e-30))
    ok = (numerator > 0) & (denominator > 0)
    return dr.select(ok, dr.clip(numerator / dr.select(ok, denominator, 1), 0, 1) * dr.maximum(1 - doubt, 0), 0)


def evidence(sum_q, sum_qq):
    """``z = Σ w q / sqrt(Σ w² q²)``: standard errors by which the fast predictor is better; 0 without data.

    ``q = (y - f_e)·(f_f - f_e)`` of a record, times a weight known before y was traced, is the first order of what
    moving from f_e to f_f gains in squared error. If the averaged prediction is right its mean is 0 whatever the fast
    one says and however noisy y is, and z is about standard normal. One outlier, however large, gives |z| <= 1.
    """
    return sum_q / dr.sqrt(dr.maximum(sum_qq, 1e-30))


def evidence_gate(z_cell, z_region, z_all, doubt, trust):
    """Whether the fast predictor is shown to be better: 0 no, 1 yes.

    A cell's own records take about (trust * relative noise)² / n frames to tell, too many after a change; q has mean
    >= 0 in all cells that lag, whether they grow brighter or darker, so sums over a region and over the whole grid tell
    within a frame or two. A cell or region whose own records speak against it stays closed.
    """
    cell_agrees, region_agrees = ramp(z_cell, -2, -1), ramp(z_region, 0, 2)
    opened = dr.maximum(ramp(z_region, doubt, trust), ramp(z_all, doubt, trust) * region_agrees)
    return dr.maximum(ramp(z_cell, doubt, trust), opened * cell_agrees)


def change(present, usual):
    """How far the predictors are apart beyond the fast one's usual noise: 0 up to 4/3 of `usual`, 1 from 3 times on.

    Both are means of w|f_f - f_e|². With f_f = truth + noise of variance v and f_e = truth + lag b the best σ is
    b²/(b² + v) = 1 - v/(b² + v) = 1 - usual/present, and free of the noise of the targets; steepened, since it is
    multiplied with the gate and a value between costs both flicker and lag.
    """
    share = 1 - usual / dr.maximum(present, 1e-30)
    return dr.select(present > 0, ramp(share, 1 / 4, 2 / 3), 0)


# ---------------------------------------------------------------------------------------------------------------------


class ReliabilityGrid:
    """Statistics of two predictors in a hashed voxel grid; :meth:`sigma_at` is one look-up.

    Cells are cubes, ``longest axis / resolution`` wide, that go on beyond the box; one resolution, collisions ignored.
    A region is 4 x 4 x 4 cells.

    Parameters: `box_min`, `box_max` (corners in world space), `constants`, `scale` (mean radiance of the scene).

    A PyTree of fixed sizes: :meth:`update` and :meth:`sigma_at` may be called in frozen functions it is passed to.

    sigma      blend weight per entry
    weight     per entry, the sum of the frames' weights, 1 after many frames: dividing by it takes the bias towards 0
               out of young averages, as in Adam. 0: empty
    records    decayed number of records per entry
    updates    number of updates so far
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "voxels": object, "scale": object, "updates": object,
        "sigma": object, "weight": object, "records": object, "moments": object, "sums": object, "region": object,
        "region_sums": object, "all_sums": object,
    }  # fmt: skip

    def __init__(self, box_min, box_max, constants: Reliability | None = None, *, scale: float = 1.0):
        self.constants = constants or Reliability()
        low, high = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        if low.shape != (3,) or high.shape != (3,):
            raise ValueError("box_min and box_max must have three coordinates each, as in [0, 0, 0]")
        if not (np.isfinite(low).all() and np.isfinite(high).all() and (high >= low).all() and (high > low).any()):
            raise ValueError(f"the box {low.tolist()} .. {high.tolist()} is empty or not finite")
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number")
        self.voxels = Voxels(low, high, self.constants.resolution)
        self.scale = mi.Float(float(scale))
        self.reset()

    @property
    def n_regions(self) -> int:
        """Entries of the table of regions."""
        return max(16, self.constants.n_entries // 8)

    def reset(self) -> None:
        """Forget all records."""
        n, by_evidence = self.constants.n_entries, self.constants.measure == "evidence"

        def arrays(count, size):
            return [dr.zeros(mi.Float, size) for _ in range(count)]

        self.updates = mi.UInt32(0)
        self.sigma, self.weight, self.records = arrays(3, n)
        # Paper's moments, and the variance of the weighted mean of a unit noise (1 / effective number of records)
        self.moments = [] if by_evidence else arrays(3 * len(MOMENTS) + 1, n)
        # Σq, Σq²; Σb and n, decayed faster; usual b and its weight
        self.sums = arrays(6, n) if by_evidence else []
        self.region = dr.zeros(mi.UInt32, n if by_evidence else 1)
        self.region_sums = arrays(2, self.n_regions) if by_evidence else []
        self.all_sums = arrays(2, 1) if by_evidence else []
        # Memory of their own: a frozen function is recorded anew when inputs that shared a variable cease to
        state = (self.voxels, self.scale, self.updates, self.sigma, self.weight,
                 self.records, self.moments, self.sums, self.region, self.region_sums, self.all_sums)  # fmt: skip
        dr.make_opaque(state)

    #: What records change, by attribute.
    LEARNED = ("updates", "sigma", "weight", "records", "moments", "sums", "region", "region_sums", "all_sums")

    def arrays(self) -> dict[str, np.ndarray]:
        """All that records have changed, as NumPy arrays."""
        found = {}
        for name in self.LEARNED:
            value = getattr(self, name)
            values = {f"{name}.{k}": v for k, v in enumerate(value)} if isinstance(value, list) else {name: value}
            found |= {k: np.array(v) for k, v in values.items()}
        return found

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from :meth:`arrays` of a grid with equal constants. Raises ``ValueError`` where one does not fit."""
        expected = self.arrays()
        if {k: v.shape for k, v in arrays.items()} != {k: v.shape for k, v in expected.items()}:
            raise ValueError("the statistics of reliability do not have the sizes of this grid")
        for name in self.LEARNED:
            value = getattr(self, name)
            if isinstance(value, list):
                new = [type(v)(arrays[f"{name}.{k}"].astype(np.float32)) for k, v in enumerate(value)]
            else:
                new = type(value)(arrays[name].astype(expected[name].dtype))
            setattr(self, name, new)
        dr.make_opaque(*(getattr(self, name) for name in self.LEARNED))

    # -----------------------------------------------------------------------------------------------------------------
    # Where

    def entry(self, position, normal):
        """Index of the table entry of points in world space with unit normals."""
        side = main_side(normal) if self.constants.split_normals else 0
        return self.voxels.entry(position, self.constants.n_entries, side)

    def sigma_at(self, position, normal, active=True):
        """Weight of the fast predictor at points in world space with unit normals; 0 where no records fell."""
        return dr.gather(mi.Float, self.sigma, self.entry(position, normal), active)

    def mean_sigma(self):
        """Mean σ over records (decayed counts), 1-wide: how much of the light the fast predictor answers for."""
        total = dr.sum(self.records)
        return dr.sum(self.sigma * self.records) / dr.maximum(total, 1e-30)

    # -----------------------------------------------------------------------------------------------------------------
    # Learn

    def update(self, position, normal, valid, y, f_current, f_averaged, decay: float | None = None) -> None:
        """Take in one frame of records, and bring `sigma` up to date.

        `position`, `normal` (unit): world space; `y`, `f_current`, `f_averaged`: Color3f in the scene's radiance, the
        predictions made before `y` had part in their training; `decay`: λ, by default the constants'. Records that
        are not `valid`, or not finite, are left out. Statistics of cells without records stay as they are.
        """
        lam = self.constants.decay if decay is None else decay
        colors = [mi.Color3f(dr.detach(v)) / self.scale for v in (y, f_current, f_averaged)]
        ok = mi.Bool(valid)
        for v in (position, *colors):
            ok &= dr.all(dr.isfinite(v))
        y, f, e = (dr.select(ok, dr.clip(v, -LARGEST, LARGEST), 0) for v in colors)
        index = self.entry(position, normal)
        self.updates = self.updates + 1
        if self.constants.measure == "evidence":
            sigma = self._update_evidence(position, index, ok, y, f, e, lam)
        else:
            sigma = self._update_moments(index, ok, y, f, e, lam)
        warm = self.updates > self.constants.warm_up
        self.sigma = dr.select(warm & (self.weight > 0) & dr.isfinite(sigma), sigma, 0)
        dr.eval(self)

    def _keep(self, n, lam):
        """What this frame leaves of an entry's statistics, given its number of records: 1 without any."""
        kept = dr.power(mi.Float(lam), n) if self.constants.per_record else mi.Float(lam)
        return dr.select(n > 0, kept, 1)

    def _update_moments(self, index, ok, y, f, e, lam):
        products = [v[k] for v in (y, y * y, f, f * f, y * f, e, e * e, y * e, f * e) for k in range(3)]
        *sums, n = cell_sums([*products, dr.select(ok, mi.Float(1), 0)], index, ok, self.constants.n_entries)
        keep, inv_n = self._keep(n, lam), 1 / dr.maximum(n, 1)
        added = (1 - keep) * inv_n
        *moments, spread = self.moments
        moments = [dr.fma(keep, m, added * s) for m, s in zip(moments, sums, strict=True)]
        spread = dr.fma(dr.square(keep), spread, dr.square(1 - keep) * inv_n)
        self.moments = [*moments, spread]
        self.weight = dr.fma(keep, self.weight, 1 - keep)
        self.records = dr.fma(keep, self.records, n)
        return self._sigma_of_moments()

    def means(self) -> dict:
        """De-biased moments by name (`MOMENTS`), as lists of three arrays; 0 in empty cells."""
        inv = dr.select(self.weight > 0, 1 / dr.maximum(self.weight, 1e-30), 0)
        return {name: [m * inv for m in self.moments[3 * k : 3 * k + 3]] for k, name in enumerate(MOMENTS)}

    def _sigma_of_moments(self):
        c, m = self.constants, self.means()
        channels = range(3)
        if c.measure == "regression":
            numerator = sum(m["yf"][k] - m["ye"][k] - m["fe"][k] + m["ee"][k] for k in channels)
            sizes = sum(m["ff"][k] + m["ee"][k] for k in channels)
            denominator = sum(m["ff"][k] + m["ee"][k] - 2 * m["fe"][k] for k in channels)
            denominator = dr.select(denominator > ROUNDING * sizes, denominator, 0)
            # Var[Σ_k (y - e)_k (f - e)_k] <= E|y - e|² E|f - e|² if the two are independent, whatever the channels'
            # correlation; not centred, since its mean is 0 where there is nothing to find
            residual = sum(m["yy"][k] + m["ee"][k] - 2 * m["ye"][k] for k in channels)
            inv_count = self.moments[-1] / dr.maximum(dr.square(self.weight), 1e-30)
            error = dr.sqrt(dr.maximum(residual, 0) * denominator * inv_count)
            return regression(numerator, denominator, error, c.shrinkage)
        scores = []
        for p in "fe":
            total = 0
            for k in channels:
                m_y, m_p = m["y"][k], m[p][k]
                s_y, s_p = variance(m_y, m["yy"][k]), variance(m_p, m[p + p][k])
                cov = covariance(m["y" + p][k], m_y, m_p)
                if c.measure == "correlation":
                    total += correlation(cov, s_y, s_p, c.epsilon)
                else:
                    total += concordance(cov, s_y, s_p, m_y, m_p, c.epsilon)
            scores.append(total * (1 / 3))
        return preference(*scores, c.kappa)

    def _update_evidence(self, position, index, ok, y, f, e, lam):
        c = self.constants
        difference = f - e
        # As a relative error: bright records would drown the rest. The weight knows the predictions alone
        level = (f.x + f.y + f.z + e.x + e.y + e.z) * (1 / 6)
        w = 1 / (dr.square(level) + LEVEL_EPSILON)
        q = dr.select(ok, w * dr.sum((y - e) * difference), 0)
        b = dr.select(ok, w * dr.squared_norm(difference), 0)
        one = dr.select(ok, mi.Float(1), 0)
        frame_q, frame_qq, frame_b, n = cell_sums([q, q * q, b, one], index, ok, c.n_entries)

        # The region of each entry: that of its records, the largest index where entries are shared
        region = self.voxels.entry(position, self.n_regions, times=4)
        found = dr.zeros(mi.UInt32, c.n_entries)
        dr.scatter_reduce(dr.ReduceOp.Max, found, region, index, ok)
        region_q, region_qq, _, region_n = cell_sums([q, q * q, b, one], region, ok, self.n_regions)
        dr.eval(found)

        keep = self._keep(n, lam)
        Q, QQ, B, N, usual, usual_weight = self.sums
        self.weight = dr.fma(keep, self.weight, 1 - keep)
        self.records = dr.fma(keep, self.records, n)
        Q, QQ = dr.fma(keep, Q, frame_q), dr.fma(dr.square(keep), QQ, frame_qq)
        keep_b = self._keep(n, c.spread_decay)
        B, N = dr.fma(keep_b, B, frame_b), dr.fma(keep_b, N, n)
        self.region = dr.select(n > 0, found, self.region)

        keep_region = self._keep(region_n, lam)
        region_Q, region_QQ = self.region_sums
        region_Q = dr.fma(keep_region, region_Q, region_q)
        region_QQ = dr.fma(dr.square(keep_region), region_QQ, region_qq)
        keep_all = self._keep(dr.sum(region_n), lam)
        all_Q, all_QQ = self.all_sums
        all_Q = dr.fma(keep_all, all_Q, dr.sum(region_q))
        all_QQ = dr.fma(dr.square(keep_all), all_QQ, dr.sum(region_qq))
        self.region_sums, self.all_sums = [region_Q, region_QQ], [all_Q, all_QQ]

        z_region = evidence(region_Q, region_QQ)
        z_all = evidence(all_Q, all_QQ)
        # What the whole grid is used to stands in where a cell is young
        mean_usual = dr.sum(usual) / dr.maximum(dr.sum(usual_weight), 1e-30)
        dr.eval(self.sums, z_region, z_all, mean_usual)
        gate = evidence_gate(evidence(Q, QQ), dr.gather(mi.Float, z_region, self.region), z_all, c.doubt, c.trust)
        present = B / dr.maximum(N, 1)
        expected = (usual + USUAL_PRIOR * mean_usual) / (usual_weight + USUAL_PRIOR)
        closed = (n > 0) & ((gate <= 0) | (self.updates <= c.warm_up))
        keep_usual = dr.select(closed, c.steady_decay, 1)
        usual = dr.fma(keep_usual, usual, (1 - keep_usual) * present)
        usual_weight = dr.fma(keep_usual, usual_weight, 1 - keep_usual)
        self.sums = [Q, QQ, B, N, usual, usual_weight]
        return gate * change(present, expected)
