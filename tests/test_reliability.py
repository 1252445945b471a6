"""The reliability grid: against a reference in NumPy, in limit cases, and in a change of light."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_neural.caches import reliability as rel
from mi_neural.caches.optimizer import own_copy
from mi_neural.caches.reliability import MEASURES, Reliability, ReliabilityGrid

BOX = ([-1.0, 0.0, 2.0], [3.0, 2.0, 5.0])


def color(a) -> mi.Color3f:
    return mi.Color3f(*np.ascontiguousarray(np.asarray(a, np.float32).T))


def make(measure, warm_up=0, box=BOX, scale=1.0, **keys) -> ReliabilityGrid:
    return ReliabilityGrid(*box, Reliability(measure=measure, warm_up=warm_up, **keys), scale=scale)


def update(grid, p, n, y, f, e, valid=None, **keys) -> None:
    valid = np.ones(len(p), bool) if valid is None else valid
    p, n = (mi.Vector3f(*np.asarray(v, np.float32).T) for v in (p, n))
    grid.update(mi.Point3f(p), n, mi.Bool(valid), color(y), color(f), color(e), **keys)


def sigma(grid, p, n=(0, 0, 1)) -> np.ndarray:
    p = mi.Point3f(*np.atleast_2d(np.asarray(p, np.float32)).T)
    return np.array(grid.sigma_at(p, mi.Vector3f(*map(float, n))))


def random_frame(rng, n=400, box=BOX, margin=0.1):
    """Positions, normals, targets and two predictions; positions also a little outside the box."""
    low, high = np.asarray(box[0]), np.asarray(box[1])
    p = (low + (high - low) * rng.uniform(-margin, 1 + margin, (n, 3))).astype(np.float32)
    normal = rng.normal(size=(n, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    truth = rng.uniform(0.2, 2, (n, 3))
    y = truth * rng.gamma(0.5, 2, (n, 1))
    f, e = truth * rng.normal(1, 0.2, (n, 1)), truth * rng.normal(0.7, 0.1, (n, 1))
    return p, normal, y.astype(np.float32), f.astype(np.float32), e.astype(np.float32)


def one_cell(grid, rng, frames, sample):
    """Frames of records in one cell; `sample(rng, n, t)` gives (y, f, e) of shape (n, 3). Returns σ after each."""
    found, n = [], 20
    p = np.broadcast_to([0.1, 1.05, 3.05], (n, 3))
    for t in range(frames):
        update(grid, p, np.broadcast_to([0, 0, 1], (n, 3)), *sample(rng, n, t))
        found.append(sigma(grid, p[0])[0])
    return np.array(found)


# ---------------------------------------------------------------------------------------------------------------------
# Reference


class Reference:
    """The grid in NumPy and double precision, entry by entry."""

    def __init__(self, constants: Reliability, box=BOX, scale=1.0):
        self.c, self.scale, n = constants, scale, constants.n_entries
        self.low, self.high = np.float32(box[0]), np.float32(box[1])
        self.inv_cell = np.float32(constants.resolution / (np.float64(box[1]) - np.float64(box[0])).max())
        self.moments, self.spread, self.weight = np.zeros((9, n, 3)), np.zeros(n), np.zeros(n)
        self.q, self.qq, self.b, self.n, self.usual, self.usual_weight = np.zeros((6, n))
        self.region, self.n_regions = np.zeros(n, int), max(16, n // 8)
        self.region_q, self.region_qq = np.zeros((2, self.n_regions))
        self.all_q = self.all_qq = 0.0
        self.updates = 0

    def cell(self, p):
        return np.floor((np.float32(p) - self.low) * self.inv_cell).astype(np.int32)

    @staticmethod
    def hash(cell, side, n):
        h = np.asarray(side, np.uint32) * np.uint32(3674653429)
        for k, factor in enumerate((1, 2654435761, 805459861)):
            h = h ^ (cell[:, k].astype(np.uint32) * np.uint32(factor))
        return (h % np.uint32(n)).astype(int)

    def entry(self, p, normal):
        side = np.zeros(len(p), np.uint32)
        if self.c.split_normals:
            axis = np.abs(normal).argmax(axis=1)
            side = 2 * axis + (normal[np.arange(len(p)), axis] < 0)
        return self.hash(self.cell(p), side, self.c.n_entries)

    def keep(self, n, lam):
        return np.where(n > 0, lam**n if self.c.per_record else lam, 1.0)

    def update(self, p, normal, y, f, e):
        c, N = self.c, self.c.n_entries
        y, f, e = (np.float64(v) / self.scale for v in (y, f, e))
        index = self.entry(p, normal)

        def total(values, index=index, size=N):
            out = np.zeros((size, *values.shape[1:]))
            np.add.at(out, index, values)
            return out

        n = total(np.ones(len(p)))
        keep, inv_n = self.keep(n, c.decay), 1 / np.maximum(n, 1)
        self.updates += 1
        self.weight = keep * self.weight + (1 - keep)
        for k, v in enumerate((y, y * y, f, f * f, y * f, e, e * e, y * e, f * e)):
            mean = total(v) * inv_n[:, None]
            self.moments[k] = keep[:, None] * self.moments[k] + (1 - keep)[:, None] * mean
        self.spread = keep**2 * self.spread + (1 - keep) ** 2 * inv_n
        self._evidence(p, index, n, keep, total, y, f, e)
        with np.errstate(all="ignore"):
            found = self.by_evidence if c.measure == "evidence" else self.by_moments()
        self.sigma = np.where((self.weight > 0) & (self.updates > c.warm_up), found, 0)

    def by_moments(self):
        y, yy, f, ff, yf, e, ee, ye, fe = self.moments / np.maximum(self.weight, 1e-30)[:, None]
        c = self.c
        if c.measure == "regression":
            up, down = (yf - ye - fe + ee).sum(1), (ff + ee - 2 * fe).sum(1)
            variance_of_up = (yy + ee - 2 * ye).sum(1) * down * self.spread / np.maximum(self.weight, 1e-30) ** 2
            shrunk = np.maximum(1 - c.shrinkage**2 * variance_of_up / up**2, 0)
            return np.where(up > 0, np.clip(up / down, 0, 1) * shrunk, 0)
        r = []
        for p, pp, yp in ((f, ff, yf), (e, ee, ye)):
            s_y, s_p, cov = np.maximum(yy - y**2, 0), np.maximum(pp - p**2, 0), yp - y * p
            if c.measure == "correlation":
                r.append((cov / np.sqrt((s_y + c.epsilon) * (s_p + c.epsilon))).mean(1))
            else:
                r.append((2 * cov / (s_y + s_p + (y - p) ** 2 + c.epsilon)).mean(1))
        return 1 / (1 + np.exp(-c.kappa * (r[0] - r[1])))

    def _evidence(self, p, index, n, keep, total, y, f, e):
        c = self.c
        w = 1 / (((f + e) / 2).mean(1) ** 2 + 0.03)
        q, b = w * ((y - e) * (f - e)).sum(1), w * ((f - e) ** 2).sum(1)
        region = self.hash(self.cell(p) >> 2, 0, self.n_regions)
        found = np.zeros(c.n_entries, int)
        np.maximum.at(found, index, region)
        self.region = np.where(n > 0, found, self.region)
        self.q, self.qq = keep * self.q + total(q), keep**2 * self.qq + total(q * q)
        keep_b = self.keep(n, c.spread_decay)
        self.b, self.n = keep_b * self.b + total(b), keep_b * self.n + n
        keep_region = self.keep(np.bincount(region, minlength=self.n_regions), c.decay)
        self.region_q = keep_region * self.region_q + total(q, region, self.n_regions)
        self.region_qq = keep_region**2 * self.region_qq + total(q * q, region, self.n_regions)
        keep_all = self.keep(np.array(len(p)), c.decay)
        self.all_q, self.all_qq = keep_all * self.all_q + q.sum(), keep_all**2 * self.all_qq + (q * q).sum()

        def z(q, qq):
            return q / np.sqrt(np.maximum(qq, 1e-30))

        def ramp(x, low, high):
            return np.clip((x - low) / (high - low), 0, 1)

        z_cell, z_region = z(self.q, self.qq), z(self.region_q, self.region_qq)[self.region]
        z_all = z(self.all_q, self.all_qq)
        opened = np.maximum(ramp(z_region, c.doubt, c.trust), ramp(z_all, c.doubt, c.trust) * ramp(z_region, 0, 2))
        gate = np.maximum(ramp(z_cell, c.doubt, c.trust), opened * ramp(z_cell, -2, -1))
        present = self.b / np.maximum(self.n, 1)
        mean_usual = self.usual.sum() / max(self.usual_weight.sum(), 1e-30)
        expected = (self.usual + 0.05 * mean_usual) / (self.usual_weight + 0.05)
        closed = (n > 0) & ((gate <= 0) | (self.updates <= c.warm_up))
        self.usual = np.where(closed, c.steady_decay * self.usual + (1 - c.steady_decay) * present, self.usual)
        self.usual_weight = np.where(closed, c.steady_decay * self.usual_weight + 1 - c.steady_decay, self.usual_weight)
        self.by_evidence = gate * ramp(1 - expected / np.maximum(present, 1e-30), 1 / 4, 2 / 3) * (present > 0)


@pytest.mark.parametrize("keys", [{}, {"split_normals": True}, {"per_record": True}], ids=str)
@pytest.mark.parametrize("measure", MEASURES)
def test_grid_equals_its_reference(measure, keys, rng):
    # Few entries: collisions are part of it; low thresholds: σ is to vary
    grid = make(measure, 2, resolution=8, n_entries=256, doubt=0.5, trust=3.0, shrinkage=0.5, **keys)
    reference = Reference(grid.constants)
    largest = 0
    for t in range(8):
        p, normal, y, f, e = random_frame(rng)
        e = f + (e - f) * (0.05 if t < 5 else 1)
        update(grid, p, normal, y, f, e)
        reference.update(p, normal, y, f, e)
        known = reference.sigma[reference.entry(p, normal)]
        found = np.array(grid.sigma_at(mi.Point3f(*p.T), mi.Vector3f(*normal.T)))
        largest = max(largest, known.max() - known.min())
        # 'regression': but for cells whose predictors differ by no more than rounding errors
        assert np.mean(np.abs(found - known) > 3e-3) < (0.02 if measure == "regression" else 1e-9), t
        assert (t >= 2) or (found == 0).all()
    print(f"{measure}: σ spans {largest:.3f}")
    assert largest > 0.1
    assert np.allclose(np.array(grid.weight), reference.weight, atol=1e-6)
    if measure != "evidence":
        weight = np.maximum(reference.weight, 1e-30)[:, None]
        for k, name in enumerate(rel.MOMENTS):
            found = np.array([np.array(v) for v in grid.means()[name]]).T
            assert np.allclose(found, reference.moments[k] / weight, rtol=1e-4, atol=1e-5), name


def test_young_averages_are_not_biased_towards_zero(rng):
    grid = make("correlation")
    for _ in range(3):
        one_cell(grid, rng, 1, lambda rng, n, t: [np.full((n, 3), v) for v in (2.0, 3.0, 5.0)])
        index = int(grid.entry(mi.Point3f(0.1, 1.05, 3.05), mi.Vector3f(0, 0, 1))[0])
        m = grid.means()
        assert [m[k][0][index] for k in ("y", "f", "e", "yf", "fe")] == pytest.approx([2, 3, 5, 6, 15], rel=1e-5)


# ---------------------------------------------------------------------------------------------------------------------
# Limit cases


def scores(y, f, epsilon=1e-6):
    y, f = mi.Float(y), mi.Float(f)
    m_y, m_f = dr.mean(y), dr.mean(f)
    s_y, s_f = rel.variance(m_y, dr.mean(y * y)), rel.variance(m_f, dr.mean(f * f))
    c = rel.covariance(dr.mean(y * f), m_y, m_f)
    return rel.correlation(c, s_y, s_f, epsilon)[0], rel.concordance(c, s_y, s_f, m_y, m_f, epsilon)[0]


def test_perfect_and_constant_predictors_score_one_and_zero(rng):
    y = rng.random(1000, np.float32)
    assert scores(y, y) == pytest.approx((1, 1), abs=1e-3)
    assert scores(y, np.full(1000, 0.5, np.float32)) == pytest.approx((0, 0), abs=1e-3)
    assert scores(y, 1 - y) == pytest.approx((-1, -1), abs=1e-2)


def test_correlation_is_blind_to_scale_and_concordance_is_not(rng):
    y = rng.random(1000, np.float32)
    r, rho = scores(y, 2 * y)
    print(f"f = 2y: correlation {r:.4f}, concordance {rho:.4f}")
    assert r == pytest.approx(1, abs=1e-3) and rho < 0.75
    blind, sharp = (
        one_cell(make(k), rng, 40, lambda rng, n, t: (x := rng.random((n, 3)), x, 2 * x))[-1]
        for k in ("correlation", "concordance")
    )
    assert blind == pytest.approx(0.5, abs=0.01) and sharp > 0.6


def test_equal_predictors_are_weighed_equally_or_give_the_average(rng):
    def sample(rng, n, t):
        f = rng.random((n, 3))
        return f * rng.gamma(0.2, 5, (n, 1)), f, f

    for measure in MEASURES:
        expected = 0.5 if measure in ("correlation", "concordance") else 0
        assert one_cell(make(measure), rng, 20, sample)[-1] == pytest.approx(expected, abs=1e-5), measure


def test_regression_finds_the_best_weight_of_noisy_targets(rng):
    """f = truth + noise of variance v, e = truth + lag b: σ* = b² / (b² + v)."""
    n = 400_000
    b, sd = 0.5, 0.5
    f, e = 1 + rng.normal(0, sd, n), np.full(n, 1 + b)
    y = rng.gamma(1 / 9, 9, n)
    up, down = np.mean((y - e) * (f - e)), np.mean((f - e) ** 2)
    error = np.std((y - e) * (f - e)) / np.sqrt(n)
    found = rel.regression(mi.Float(up), mi.Float(down), mi.Float(error), 1e-3)[0]
    print(f"found {found:.3f}, known {b * b / (b * b + sd * sd):.3f}, standard error {error / down:.3f}")
    assert abs(found - 0.5) < 4 * error / down
    assert rel.regression(mi.Float(0.02), mi.Float(0.04), mi.Float(0.01), 3.0)[0] == 0  # two standard errors
    assert rel.regression(mi.Float(-1), mi.Float(1), mi.Float(0), 3.0)[0] == 0
    assert rel.regression(mi.Float(2), mi.Float(1), mi.Float(0.01), 3.0)[0] == pytest.approx(1, abs=1e-3)
    assert rel.regression(mi.Float(0), mi.Float(0), mi.Float(0), 3.0)[0] == 0


@pytest.mark.parametrize("measure", ["regression", "evidence"])
def test_average_is_kept_while_steady_and_left_when_it_is_off(measure, rng):
    def sample(rng, n, t):
        lag = 1.0 if t >= 60 else 0.0
        y = (1 + lag) * rng.gamma(1, 1, (n, 1)) * np.ones(3)
        f = np.ones((n, 3)) * (1 + lag) * rng.normal(1, 0.1)
        return y, f, np.ones((n, 3)) * 1.0

    found = one_cell(make(measure, 40), rng, 160, sample)
    print(f"{measure}: steady {found[:60].mean():.4f}, after the change {found[-20:].mean():.3f}")
    assert found[:60].mean() < 0.01 and found[-20:].mean() > (0.5 if measure == "regression" else 0.9)


def test_one_outlier_is_no_evidence():
    q = np.float32([0.01, -0.02, 0.01, 1e6])
    assert rel.evidence(mi.Float(q.sum()), mi.Float((q * q).sum()))[0] == pytest.approx(1, abs=1e-3)
    assert rel.evidence(mi.Float(0), mi.Float(0))[0] == 0


def test_cell_that_speaks_against_it_stays_closed_however_sure_the_rest_is():
    def gate(*z):
        return rel.evidence_gate(*map(mi.Float, z), 4.0, 5.0)[0]

    assert gate(0, 0, 0) == 0 and gate(0, 6, 0) == 1 and gate(6, -3, -3) == 1
    assert gate(-2.5, 9, 9) == 0 and gate(0, -1, 9) == 0 and gate(0, 2.5, 9) == 1


def test_difference_of_usual_size_is_no_change():
    found = rel.change(mi.Float(1, 4 / 3, 2, 3, 9, 0), mi.Float(1))
    assert np.allclose(found, [0, 0, 0.6, 1, 1, 0], atol=1e-6)


# ---------------------------------------------------------------------------------------------------------------------
# A change of light


def simulate(measure, seed=0, factor=2.0, n_records=(8, 30), frames=60, before=160, noise=0.15, **keys):
    """16 x 16 cells of a floor; at frame 0 the left half becomes `factor` times as bright or dark.

    Targets have a relative deviation of 3; the fast predictor goes half of the way each frame and errs by `noise` per
    cell, correlated by 1/2 between frames; the average has decay 0.99. Returns per frame t: truth, fast, average, and σ
    in each cell (frames, 256), and which cells changed.
    """
    rng = np.random.default_rng(seed)
    grid = ReliabilityGrid([0, 0, 0], [1, 1, 1], Reliability(measure=measure, **keys))
    cells = (np.stack(np.meshgrid(np.arange(16), np.arange(16), [0], indexing="ij"), -1).reshape(-1, 3) + 0.5) / 16
    changed = cells[:, 0] < 0.5
    mean_count = rng.integers(n_records[0], n_records[1] + 1, 256)
    bright = np.exp(rng.normal(0, 0.7, (256, 1))) * [1, 0.8, 0.6]
    after = np.where(changed, np.where(rng.random(256) < 0.5, factor, 1 / factor), 1.0)
    truth, followed, error, fast, average = np.ones(256), np.ones(256), np.zeros(256), np.ones(256), np.ones(256)
    out, size = [], int(1.2 * mean_count.sum())
    for t in range(-before, frames):
        if t == 0:
            truth = after
        k = np.repeat(np.arange(256), rng.poisson(mean_count))[:size]
        valid = np.arange(size) < len(k)
        k = np.pad(k, (0, size - len(k)))
        base = bright[k] * np.exp(rng.normal(0, 0.5, (size, 1)) - 0.125)
        y = base * (truth[k] * rng.gamma(1 / 9, 9, size))[:, None]
        update(grid, cells[k], np.broadcast_to([0, 0, 1], (size, 3)), y, base * fast[k, None],
               base * average[k, None], valid)  # fmt: skip
        out.append((truth, fast, average, sigma(grid, cells)))
        followed = followed + 0.5 * (truth - followed)
        error = 0.5 * error + np.sqrt(0.75) * rng.normal(0, noise, 256)
        fast = followed * (1 + error)
        average = 0.99 * average + 0.01 * fast
    return (*(np.array(v) for v in zip(*out, strict=True)), changed)


def summary(truth, fast, average, s, changed, before=160):
    """Steady σ and flicker (over the average's), frames to σ = 1/2, error in frames 1 to 30 (over the fast one's)."""
    blend, steady = (1 - s) * average + s * fast, slice(before - 30, before)
    flicker = [np.abs(np.diff(v[steady], axis=0)).mean() for v in (blend, average)]
    errors = [
        (np.abs(v - truth) / np.maximum(truth, 1 / truth))[before + 1 : before + 30, changed].mean()
        for v in (blend, fast)
    ]
    rise = s[before:, changed].mean(axis=1) >= 0.5
    return s[steady].mean(), flicker[0] / flicker[1], rise.argmax() if rise.any() else None, errors[0] / errors[1]


def test_evidence_follows_a_change_and_keeps_still_without_one():
    steady, flicker, frames, error = summary(*simulate("evidence"))
    print(
        f"steady σ {steady:.4f}, flicker {flicker:.3f} of the average's; 1/2 after {frames} frames, error {error:.3f}"
    )
    assert steady < 1e-3 and flicker < 1.05 and frames <= 4 and error < 1.15


def test_difference_of_correlations_tells_less():
    """The paper's measure under targets this noisy: near 1/2 before and after."""
    steady, flicker, _, error = summary(*simulate("correlation"))
    print(f"steady σ {steady:.4f}, flicker {flicker:.1f} of the average's; error {error:.3f} of the fast one's")
    assert 0.4 < steady < 0.6 and flicker > 10 and error > 1.5


# ---------------------------------------------------------------------------------------------------------------------
# Hard cases


@pytest.mark.parametrize("measure", MEASURES)
def test_empty_cells_and_warm_up_trust_the_average(measure, rng):
    grid = make(measure, 3, doubt=0.1, trust=0.2)
    far = [2.9, 1.9, 4.9]
    found = one_cell(grid, rng, 8, lambda rng, n, t: (y := rng.random((n, 3)) + 5, y, rng.random((n, 3))))
    assert (found[:3] == 0).all() and (measure == "evidence" or (found[4:] > 0.5).all())
    assert sigma(grid, far)[0] == 0
    assert 0 <= grid.mean_sigma()[0] <= 1 and np.count_nonzero(np.array(grid.weight)) == 1
    grid.reset()
    assert sigma(grid, [0.1, 1.05, 3.05])[0] == 0 and grid.mean_sigma()[0] == 0 and grid.updates[0] == 0


def test_cells_without_records_keep_their_statistics(rng):
    for measure in MEASURES:
        grid = make(measure)
        one_cell(grid, rng, 3, lambda rng, n, t: rng.random((3, n, 3)))
        before = np.array(grid.weight), np.array((grid.moments or grid.sums[:4])[0])
        elsewhere = np.broadcast_to([2.9, 1.9, 4.9], (20, 3))
        update(grid, elsewhere, np.broadcast_to([0, 0, 1], (20, 3)), *rng.random((3, 20, 3)))
        after = np.array(grid.weight), np.array((grid.moments or grid.sums[:4])[0])
        for a, b in zip(before, after, strict=True):
            assert (b[a != 0] == a[a != 0]).all() and np.count_nonzero(b) == 2


@pytest.mark.parametrize("measure", MEASURES)
def test_records_that_are_not_finite_or_not_valid_are_left_out(measure, rng):
    clean, spoiled = make(measure, resolution=4), make(measure, resolution=4)
    for _ in range(4):
        p, normal, y, f, e = random_frame(rng, 100)
        update(clean, p, normal, y, f, e)
        bad = [np.concatenate([v, v[:6]]) for v in (p, normal, y, f, e)]
        bad[0][100], bad[2][101], bad[3][102], bad[4][103], bad[2][104] = np.nan, np.nan, np.inf, -np.inf, np.inf
        bad[2][105] = 1e5
        update(spoiled, *bad, valid=np.arange(106) != 105)
    for a, b in zip((clean.sigma, clean.weight, clean.records), (spoiled.sigma, spoiled.weight, spoiled.records),
                    strict=True):  # fmt: skip
        assert np.allclose(a, b, atol=1e-4) and np.isfinite(np.array(b)).all()


@pytest.mark.parametrize("measure", MEASURES)
def test_sigma_does_not_depend_on_the_unit_of_radiance_or_length(measure, rng):
    frames = [random_frame(rng, margin=-0.01) for _ in range(6)]  # what lies outside ends on the faces of cells
    found = []
    for radiance, length in ((1, 1), (1e-6, 1e5), (1e6, 1e-3)):
        box = [(np.float64(v) * length).tolist() for v in BOX]
        grid = make(measure, 2, box, radiance, resolution=4, doubt=0.1, trust=3.0, shrinkage=0.3)
        for t, (p, normal, y, f, e) in enumerate(frames):
            e = f + (e - f) * (0.2 if t < 3 else 1)
            update(grid, p * length, normal, *(v * radiance for v in (y, f, e)))
        centres = np.float64(BOX[0]) + np.stack(np.meshgrid(*[np.arange(3) + 0.5] * 3), -1).reshape(-1, 3)
        found.append(sigma(grid, centres * length))
    print(f"{measure}: σ {found[0].min():.3f} to {found[0].max():.3f}")
    assert np.isfinite(found).all() and found[0].max() > 0
    assert np.mean(np.abs(found[1] - found[0]) > 1e-2) < 0.1 and np.mean(np.abs(found[2] - found[0]) > 1e-2) < 0.1


@pytest.mark.parametrize("measure", MEASURES)
def test_fireflies_leave_sigma_finite(measure, rng):
    grid = make(measure)
    found = one_cell(grid, rng, 10, lambda rng, n, t: np.float32(10) ** rng.uniform(-30, 30, (3, n, 3)))
    assert np.isfinite(found).all() and (found >= 0).all() and (found <= 1).all()


@pytest.mark.parametrize("measure", MEASURES)
def test_all_records_may_fall_into_one_cell(measure, rng):
    n = 28672
    grid = make(measure)
    p, normal = np.broadcast_to([0.1, 1.05, 3.05], (n, 3)), np.broadcast_to([0, 0, 1], (n, 3))
    for _ in range(3):
        y = rng.random((n, 3), np.float32)
        update(grid, p, normal, y, y, y[:, ::-1] + 1)
    assert np.count_nonzero(np.array(grid.weight)) == 1 and dr.max(grid.records)[0] == pytest.approx(n * 2.71, rel=1e-4)
    if measure != "evidence":
        index = int(dr.max(dr.select(grid.weight > 0, dr.arange(mi.UInt32, grid.constants.n_entries), 0))[0])
        assert grid.means()["y"][0][index] == pytest.approx(0.5, abs=0.01)
        assert sigma(grid, p[0])[0] > 0.6


@pytest.mark.parametrize("measure", MEASURES)
def test_equal_records_give_equal_sigma(measure, rng):
    # Threads add in any order, so the last digits may differ
    frames = [random_frame(rng, 2000) for _ in range(4)]
    found = []
    for _ in range(2):
        grid = make(measure, doubt=0.1, trust=3.0)
        for frame in frames:
            update(grid, *frame)
        found.append(np.array(grid.sigma))
    assert np.allclose(*found, atol=1e-4)


@pytest.mark.parametrize("measure", MEASURES)
def test_frozen_equals_unfrozen_with_one_recording(measure, rng):
    keys = {"doubt": 0.1, "trust": 3.0, "resolution": 4}
    plain, frozen = make(measure, 2, **keys), make(measure, 2, **keys)

    @dr.freeze
    def step(grid, p, normal, valid, y, f, e):
        grid.update(p, normal, valid, y, f, e)
        return grid.sigma_at(p, normal)

    for t in range(8):
        p, normal, *colors = random_frame(rng)
        args = mi.Point3f(*p.T), mi.Vector3f(*normal.T), mi.Bool(np.full(len(p), True)), *map(color, colors)
        args = tuple(own_copy(v) if not isinstance(v, mi.Bool) else v | dr.opaque(mi.Bool, False) for v in args)
        dr.eval(args)
        found = step(frozen, *args)
        update(plain, p, normal, *colors)
        known = plain.sigma_at(args[0], args[1])
        assert np.allclose(found, known, atol=1e-4), t
    assert step.n_recordings <= 2 and frozen.updates[0] == 8 and dr.max(frozen.sigma)[0] > 0


def test_normals_have_cells_of_their_own_if_asked(rng):
    for split in (False, True):
        grid = make("correlation", split_normals=split)
        directions = np.float32([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
        index = grid.entry(mi.Point3f(0.1, 1.05, 3.05), mi.Vector3f(*directions.T))
        assert len(np.unique(np.array(index))) == (6 if split else 1)


def test_derivatives_do_not_enter_the_grid(rng):
    grid = make("evidence")
    f = color(rng.random((8, 3)))
    dr.enable_grad(f)
    grid.update(dr.zeros(mi.Point3f, 8), mi.Vector3f(0, 0, 1), mi.Bool(True), f, f, f)
    assert not dr.grad_enabled(grid.sigma)


def test_bad_constants_say_what_to_type():
    for keys, text in (
        ({"measure": "trust"}, "correlation, concordance, regression, evidence"), ({"resolution": 0}, "1..4096"),
        ({"n_entries": 1000}, "power of two"), ({"n_entries": 2**20}, "power of two"), ({"decay": 1.0}, "less than 1"),
        ({"spread_decay": -0.1}, "at least 0"), ({"warm_up": -1}, "at least 0"), ({"kappa": 0}, "positive"),
        ({"epsilon": float("nan")}, "positive"), ({"doubt": 5.0, "trust": 4.0}, "0 <= doubt < trust"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=text):
            Reliability(**keys)
    for box, scale, text in (
        (([0, 0, 0], [0, 0, 0]), 1, "empty"), (([0, 0, 0], [1, 1, np.inf]), 1, "not finite"),
        (([0, 0], [1, 1]), 1, "three coordinates"), (BOX, 0, "positive"), (BOX, float("inf"), "positive"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=text):
            ReliabilityGrid(*box, scale=scale)
