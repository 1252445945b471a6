"""Properties of the pure functions, for any floats, and their values against NumPy in float64.

Each example is an array of many values, whatever 32-bit floats there are among them; the choice of examples is fixed.
"""

from dataclasses import fields

import drjit as dr
import mitsuba as mi
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mi_neural.caches import encoding, loss
from mi_neural.caches import reliability as rel
from mi_neural.caches.incident import Training
from mi_neural.caches.optimizer import attach_adam, descend
from mi_neural.caches.schedule import Ramp
from mi_neural.estimators import reservoir
from mi_neural.estimators import spread as termination
from mi_neural.estimators.mis import mis_weight
from mi_neural.estimators.reservoir import Reservoir
from mi_neural.lights import ltc
from mi_neural.render import sampling

N = 48
LARGEST = float(np.finfo(np.float32).max)
EXAMPLES = settings(derandomize=True, max_examples=25, deadline=None, database=None)

EXTREME = st.sampled_from([float("nan"), float("inf"), -float("inf"), 0.0, LARGEST, -LARGEST])
ANY = st.one_of(EXTREME, st.floats(width=32, allow_subnormal=False))
FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False)


def between(low, high):
    return st.floats(low, high, width=32, allow_subnormal=False)


POSITIVE = between(0.0, LARGEST)
UNIT = between(0.0, 1.0)
MODERATE = between(-2.0**20, 2.0**20)


def arrays(elements, *shape):
    return hnp.arrays(np.float32, (*shape, N), elements=elements)


def f(values):
    return mi.Float(np.ascontiguousarray(values))


def color(values):
    return mi.Color3f(*(f(v) for v in values))


def double(values) -> np.ndarray:
    return np.array(values, np.float64)


def unit(vectors) -> np.ndarray:
    """Unit vectors (3, N), float32, of any (3, N); +z for 0."""
    v = vectors.astype(np.float64)
    v /= np.maximum(np.abs(v).max(axis=0), 1e-300)
    norm = np.linalg.norm(v, axis=0)
    return np.where(norm > 0, v / np.maximum(norm, 1e-300), [[0], [0], [1]]).astype(np.float32)


# ---------------------------------------------------------------- MIS weights


@EXAMPLES
@given(arrays(ANY, 2))
def test_mis_weights_lie_in_the_unit_interval_for_any_densities(pdf):
    for a, b in ((pdf[0], pdf[1]), (pdf[1], pdf[0])):
        w = double(mis_weight(f(a), f(b)))
        assert ((w >= 0) & (w <= 1)).all()
        assert (w[~(a > 0)] == 0).all()


@EXAMPLES
@given(arrays(POSITIVE, 2))
def test_mis_weights_share_all_light_and_are_the_power_heuristic(pdf):
    a, b = pdf.astype(np.float64)
    some = (a > 0) | (b > 0)
    w_a, w_b = double(mis_weight(f(pdf[0]), f(pdf[1]))), double(mis_weight(f(pdf[1]), f(pdf[0])))
    np.testing.assert_allclose((w_a + w_b)[some], 1, rtol=1e-6)
    known = a**2 / np.where(some, a**2 + b**2, 1)
    np.testing.assert_allclose(w_a[some], known[some], rtol=1e-5, atol=1e-12)


# ---------------------------------------------------------------- reservoirs


@EXAMPLES
@given(arrays(ANY, 4), arrays(UNIT, 4))
def test_reservoir_holds_finite_numbers_whatever_it_is_given(weights, us):
    r = Reservoir.empty(N)
    for k in range(4):
        r = reservoir.update(r, mi.UInt32(k), mi.Point2f(0.5), f(weights[k]), f(weights[k - 1]), f(us[k]))
    done = reservoir.finish(r)
    for name in ("w_sum", "M", "W"):
        values = double(getattr(done, name))
        assert np.isfinite(values).all() and (values >= 0).all(), name
    assert (double(done.W)[~(double(done.target) > 0)] == 0).all()


@EXAMPLES
@given(arrays(between(0.0, 2.0**20), 5), arrays(between(0.0, 0.96875), 5))
def test_reservoir_keeps_what_the_stream_in_double_precision_keeps(weights, us):
    r, total, kept, sure = Reservoir.empty(N), np.zeros(N), np.zeros(N, np.uint32), np.ones(N, bool)
    for k, (w, u) in enumerate(zip(weights, us, strict=True)):
        r = reservoir.update(r, mi.UInt32(k), mi.Point2f(0.25, k / 8), f(w), f(w), f(u))
        w = w.astype(np.float64)
        total += w
        take = u.astype(np.float64) * total < w
        sure &= np.abs(u * total - w) > 1e-5 * total  # not decided by rounding
        kept = np.where(take, k, kept)
    sure |= total == 0
    np.testing.assert_allclose(double(r.w_sum), total, rtol=1e-6)
    assert (np.array(r.index)[sure] == kept[sure]).all() and (double(r.M) == 5).all()
    assert (np.array(r.uv)[1] == np.array(r.index) / 8)[total > 0].all()
    W = double(reservoir.finish(r).W)
    target = weights[np.array(r.index), np.arange(N)].astype(np.float64)
    good = target > 1e-30
    np.testing.assert_allclose(W[good], (total / np.where(good, target, 1) / 5)[good], rtol=1e-5)


@EXAMPLES
@given(arrays(ANY, 4))
def test_balanced_shares_of_any_numbers_lie_in_the_unit_interval(v):
    share = double(reservoir.balance(*map(f, v)))
    assert ((share >= 0) & (share <= 1)).all()


@EXAMPLES
@given(arrays(between(2.0**-30, 2.0**30), 4))
def test_balanced_shares_are_their_formula_and_sum_to_one(v):
    a, b = double(reservoir.balance(*map(f, v))), double(reservoir.balance(*map(f, v[[2, 3, 0, 1]])))
    M_a, p_a, M_b, p_b = v.astype(np.float64)
    np.testing.assert_allclose(a + b, 1, rtol=1e-6)
    np.testing.assert_allclose(a, M_a * p_a / (M_a * p_a + M_b * p_b), rtol=1e-5, atol=1e-12)


@EXAMPLES
@given(arrays(ANY, 3, 2), arrays(UNIT, 3))
def test_combined_reservoirs_are_finite_for_any_targets(values, us):
    held = []
    for k in range(3):
        w, u = f(values[k, 0]), f(us[k])
        one = reservoir.update(Reservoir.empty(N), mi.UInt32(k), mi.Point2f(0.5), w, w, u)
        held.append(reservoir.finish(one))
    total = reservoir.combine(held, [f(v[1]) for v in values], [f(u) for u in us])
    assert np.isfinite(double(total.W)).all() and (double(total.W) >= 0).all() and (double(total.M) == 3).all()
    assert {x.name for x in fields(total)} == {"index", "uv", "w_sum", "M", "W", "target"}


# ---------------------------------------------------------------- termination


@EXAMPLES
@given(arrays(POSITIVE, 2), arrays(between(-1.0, 1.0)))
def test_spread_is_not_negative_and_never_nan(v, cos):
    root, a_0 = termination.segment_spread(f(v[0]), f(v[1]), f(cos)), termination.camera_spread(f(v[0]), f(cos))
    for value in (double(root), double(a_0)):
        assert (value >= 0).all() and not np.isnan(value).any()
    known = np.sqrt(v[0].astype(np.float64) / np.maximum(v[1].astype(np.float64) * np.abs(cos), 1e-9))
    fits = (known < 1e18) & (known > 1e-18)
    np.testing.assert_allclose(double(root)[fits], known[fits], rtol=1e-5)


@EXAMPLES
@given(arrays(between(0.0, 2.0**30), 2), between(0.0, 4.0))
def test_wider_paths_end_sooner(v, threshold):
    narrow, wide = np.sort(v, axis=0)
    a_0 = f(np.full(N, 3.0, np.float32))
    ends_narrow, ends_wide = (np.array(termination.exceeds(f(s), a_0, threshold)) for s in (narrow, wide))
    assert (ends_wide | ~ends_narrow).all()


@EXAMPLES
@given(arrays(POSITIVE), st.integers(1, 64))
def test_balanced_probability_is_one_and_falls_with_the_density(pdf, n):
    t = double(termination.balanced_probability(n, f(pdf)))
    np.testing.assert_allclose(t, (n / np.pi) / (n / np.pi + pdf.astype(np.float64)), rtol=1e-5, atol=1e-38)
    assert ((t >= 0) & (t <= 1)).all()


# ---------------------------------------------------------------- random numbers


@EXAMPLES
@given(hnp.arrays(np.uint32, (2, N)))
def test_sobol_points_lie_in_the_half_open_square(v):
    p = np.array(sampling.sobol_2d(mi.UInt32(v[0]), mi.UInt32(v[1])))
    assert ((p >= 0) & (p < 1)).all()


@EXAMPLES
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**10))
def test_sixteen_sobol_points_are_stratified_in_every_way(seed, block):
    """A (0,2)-sequence: one point in each of 16 equal boxes of every shape."""
    index = dr.arange(mi.UInt32, 16) + dr.opaque(mi.UInt32, 16 * block)
    x, y = np.array(sampling.sobol_2d(index, dr.opaque(mi.UInt32, seed))).astype(np.float64)
    for k in range(5):
        boxes = np.floor(x * 2**k) * 2 ** (4 - k) + np.floor(y * 2 ** (4 - k))
        assert len(np.unique(boxes)) == 16, f"{2**k} x {2 ** (4 - k)}"


# ---------------------------------------------------------------- encodings


@EXAMPLES
@given(arrays(FINITE, 3))
def test_positions_come_into_the_unit_cube(p):
    u = double(encoding.to_unit_cube(mi.Point3f(*map(f, p)), mi.Point3f(-1, 0, 2), mi.Vector3f(0.5, 1e-3, 1e3)))
    assert ((u >= 0) & (u <= 1)).all()
    low, inv = np.array([[-1], [0], [2]]), np.float32([[0.5], [1e-3], [1e3]]).astype(np.float64)
    np.testing.assert_allclose(u, np.clip((p - low) * inv, 0, 1), rtol=1e-4, atol=1e-4)


@EXAMPLES
@given(arrays(UNIT), st.sampled_from([1, 4, 7]))
def test_one_blob_is_a_share_for_each_bin(v, n):
    found = np.stack([double(b) for b in encoding.one_blob(f(v), n)])

    def integral(u):
        u = np.clip(u, -1, 1)
        return 0.5 + 15 / 16 * (u - 2 / 3 * u**3 + u**5 / 5)

    edges = np.arange(n + 1)[:, None] - n * v.astype(np.float64)
    np.testing.assert_allclose(found, np.diff(integral(edges), axis=0), atol=2e-6)
    assert (found >= -1e-6).all() and (found.sum(axis=0) <= 1 + 1e-6).all() and (found.sum(axis=0) >= 0.5 - 1e-6).all()


@EXAMPLES
@given(arrays(MODERATE, 3), st.integers(0, 4))
def test_harmonics_obey_the_addition_theorem(vectors, degree):
    """Squares of a band sum to (2l + 1) / 4π for any direction."""
    w = unit(vectors)
    values = np.stack([double(v) * np.ones(N) for v in encoding.direction(mi.Vector3f(*map(f, w)), degree)])
    for band in range(degree + 1):
        total = (values[band**2 : (band + 1) ** 2] ** 2).sum(axis=0)
        np.testing.assert_allclose(total, (2 * band + 1) / (4 * np.pi), rtol=1e-4)


@EXAMPLES
@given(hnp.arrays(np.float64, (30, 3), elements=st.floats(-1e30, 1e30)), st.booleans())
def test_box_of_records_is_a_box_and_holds_most_of_them(points, broken):
    if broken:
        points[::7] = np.nan
    low, high = map(np.array, encoding.record_box(points, [-1, -1, -1], [1, 1, 1]))
    assert np.isfinite([low, high]).all() and (high > low).all()
    extent = high - low
    assert extent.min() >= 0.99e-3 / (1 + encoding.MARGIN) * extent.max()  # no axis vanishes beside the others
    finite = points[np.isfinite(points).all(axis=1)]
    inside = ((finite >= low) & (finite <= high)).all(axis=1)
    assert inside.mean() >= 0.8


# ---------------------------------------------------------------- losses


@EXAMPLES
@given(arrays(between(-2.0**20, 2.0**20), 3), arrays(between(0.0, 1e4), 3), arrays(MODERATE))
def test_losses_are_not_negative_finite_and_their_formulas(p, y, local):
    P, Y, m = (v.astype(np.float64) for v in (p, y, local))
    squared = ((P - Y) ** 2).sum(axis=0)
    for found, known in (
        (loss.relative_l2(color(p), color(y), 0.03), squared / (P.mean(axis=0) ** 2 + 0.03)),
        (loss.local_relative_l2(color(p), color(y), f(local), 0.03), squared / (m**2 + 0.03)),
    ):
        found = double(found)
        assert (found >= 0).all() and np.isfinite(found).all()
        # Relative to the numbers that are subtracted: they cancel in single precision
        size = known + 1e-6 * (P**2 + Y**2).sum(axis=0) * known / np.maximum(squared, 1e-300)
        mean_error = 1e-5 * np.abs(P).max(axis=0) ** 2 / (P.mean(axis=0) ** 2 + 0.03)  # of the mean of the channels
        assert (np.abs(found - known) <= 1e-4 * size + mean_error * known + 1e-30).all()


@EXAMPLES
@given(arrays(between(0.0, 1e4), 3))
def test_right_predictions_cost_nothing(y):
    assert (double(loss.relative_l2(color(y), color(y), 0.03)) == 0).all()


# ---------------------------------------------------------------- optimiser, average, schedules


@EXAMPLES
@given(hnp.arrays(np.float32, (6, N), elements=between(-1e6, 1e6)), hnp.arrays(np.float32, (N,), elements=MODERATE))
def test_descent_and_average_are_adam_and_its_average_in_double_precision(gradients, start):
    optimizer, averaged = attach_adam({"a": f(start)}), {"a": f(start)}
    x, mean = start.astype(np.float64), start.astype(np.float64)
    first, second, training = np.zeros(N), np.zeros(N), Training()
    for t, g in enumerate(gradients):
        decay, rate = training.decay(t), 0.01
        averaged, _ = descend(optimizer, optimizer["a"] * f(g), averaged, dr.opaque(mi.Float, rate),
                              dr.opaque(mi.Float, decay))  # fmt: skip
        g = g.astype(np.float64)
        first, second = 0.9 * first + 0.1 * g, 0.99 * second + 0.01 * g * g
        scale = np.sqrt(1 - 0.99 ** (t + 1)) / (1 - 0.9 ** (t + 1))
        x = x - rate * scale * first / (np.sqrt(second) + 1e-15)
        mean = decay * mean + (1 - decay) * x
    sure = np.all((gradients == 0) | (np.abs(gradients) > 1e-12), axis=0)  # squares that single precision holds
    size = 1e-5 * np.abs(start) + 1e-4
    for found, known in ((optimizer["a"], x), (averaged["a"], mean)):
        found = double(found)
        assert np.isfinite(found).all()
        assert (np.abs(found - known) <= size)[sure].all()


@EXAMPLES
@given(arrays(ANY))
def test_steps_that_are_not_finite_change_nothing(gradient):
    optimizer, start = attach_adam({"a": f(np.ones(N, np.float32))}), {"a": f(np.ones(N, np.float32))}
    losses = optimizer["a"] * f(gradient)
    averaged, value = descend(optimizer, losses, start, dr.opaque(mi.Float, 0.1), dr.opaque(mi.Float, 0.5))
    with np.errstate(all="ignore"):
        good = bool(np.isfinite(np.array(value)[0]))
    for found in (double(optimizer["a"]), double(averaged["a"])):
        assert np.isfinite(found).all()
        assert good or (found == 1).all()


@EXAMPLES
@given(st.integers(0, 10**9), between(0.0, 1.0), st.integers(0, 500))
def test_schedules_stay_in_their_bounds(step, most, ramp):
    for training in (Training(ema_decay=most), Ramp(8, most, 0.05, 0.001, ramp)):
        assert 0 <= training.decay(step) <= most and training.decay(0) == 0
        assert training.decay(step) <= training.decay(step + 1)
    assert 0.1 * 0.01 <= Training().rate(step) <= 0.01
    assert 0.001 * 0.999 <= Ramp(8, most, 0.05, 0.001, ramp).rate(step) <= 0.05


# ---------------------------------------------------------------- moments and weights


@EXAMPLES
@given(arrays(between(-100.0, 100.0), 2, 8))
def test_moments_are_those_in_double_precision_and_correlations_are_bounded(pairs):
    y, p = pairs.astype(np.float64)
    mean = [v.mean(axis=0) for v in (y, p, y * y, p * p, y * p)]
    m_y, m_p, yy, pp, yp = (f(v.astype(np.float32)) for v in mean)
    s_y, s_p, c = rel.variance(m_y, yy), rel.variance(m_p, pp), rel.covariance(yp, m_y, m_p)
    rounding = 1e-5 * 1e4
    for found, known in ((s_y, y.var(axis=0)), (s_p, p.var(axis=0)),
                         (c, (y * p).mean(axis=0) - y.mean(axis=0) * p.mean(axis=0))):  # fmt: skip
        assert (np.abs(double(found) - known) <= rounding).all()
    assert (double(s_y) >= 0).all() and (double(s_p) >= 0).all()
    # Bounded up to that rounding, which the epsilon covers here
    for score in (rel.correlation(c, s_y, s_p, 1.0), rel.concordance(c, s_y, s_p, m_y, m_p, 1.0)):
        assert np.isfinite(double(score)).all() and (np.abs(double(score)) <= 1 + 2 * rounding).all()


@EXAMPLES
@given(arrays(between(-4.0, 4.0), 2), between(0.125, 2.0**10))
def test_preference_is_a_weight_and_antisymmetric(r, kappa):
    a, b = (double(rel.preference(f(x), f(y), kappa)) for x, y in ((r[0], r[1]), (r[1], r[0])))
    assert ((a >= 0) & (a <= 1)).all()
    np.testing.assert_allclose(a + b, 1, atol=1e-5)
    with np.errstate(over="ignore"):
        known = 1 / (1 + np.exp(-kappa * (r[0].astype(np.float64) - r[1])))
    np.testing.assert_allclose(a, known, atol=1e-3)


@EXAMPLES
@given(arrays(FINITE, 3))
def test_gates_of_any_evidence_are_weights(z):
    gate = double(rel.evidence_gate(*map(f, z), 5.0, 6.0))
    assert ((gate >= 0) & (gate <= 1)).all()
    assert (gate[(z[0] < 5) & (z[1] < 5) & (z[2] < 5)] == 0).all()
    assert (gate[z[0] <= -2] == 0).all()  # a cell that speaks against it


@EXAMPLES
@given(arrays(POSITIVE, 2))
def test_change_is_a_weight_that_falls_with_what_is_usual(v):
    low, high = np.sort(v, axis=0)
    present = f(np.full(N, 1.0, np.float32))
    a, b = (double(rel.change(present, f(usual))) for usual in (low, high))
    assert ((a >= 0) & (a <= 1)).all() and (a >= b).all()


@EXAMPLES
@given(arrays(FINITE, 3))
def test_regression_is_a_weight(v):
    w = double(rel.regression(f(v[0]), f(v[1]), f(np.abs(v[2])), 3.0))
    assert ((w >= 0) & (w <= 1)).all()


# ---------------------------------------------------------------- linearly transformed cosines


@EXAMPLES
@given(arrays(FINITE, 3, 3))
def test_form_factors_of_any_triangles_are_shares(vertices):
    E = double(ltc.integrate_polygon([mi.Vector3f(*map(f, v)) for v in vertices]))
    assert not np.isnan(E).any() and ((E >= 0) & (E <= 1)).all()


@EXAMPLES
@given(arrays(between(-8.0, 8.0), 3, 3))
def test_form_factors_above_the_horizon_are_lamberts_sum_in_double_precision(vertices):
    v = vertices.copy()
    v[:, 2] = np.abs(v[:, 2]) + 0.25
    E = double(ltc.integrate_polygon([mi.Vector3f(*map(f, w)) for w in v]))
    d = v.astype(np.float64)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    total = 0
    for k in range(3):
        a, b = d[k], d[(k + 1) % 3]
        cross = np.cross(a, b, axis=0)
        sine, cosine = np.linalg.norm(cross, axis=0), (a * b).sum(axis=0)
        total = total + np.where(sine > 1e-12, np.arctan2(sine, cosine) * cross[2] / np.maximum(sine, 1e-300), 0)
    known = np.abs(total) / (2 * np.pi)
    # Not where the origin all but lies on an edge (the docstring says so), nor where edges are opposite
    turns = np.stack([(d[k] * d[(k + 1) % 3]).sum(axis=0) for k in range(3)])
    sure = turns.min(axis=0) > -0.95
    assert (np.abs(E - known) <= 1e-4)[sure].all()


@EXAMPLES
@given(arrays(UNIT, 2), arrays(MODERATE, 3))
def test_lobes_are_finite_and_their_albedos_shares(v, vectors):
    wi = unit(vectors)
    wi[2] = np.abs(wi[2])
    found = ltc.lobe(f(v[0]), mi.Vector3f(*map(f, wi)))
    for value in (found.x, found.y, found.a, found.b):
        assert np.isfinite(double(value)).all()
    assert (double(found.a) <= 1.01).all() and (double(found.a) >= 0).all() and (double(found.b) >= 0).all()


def test_extreme_floats_are_among_the_examples():
    """The strategies above reach infinity, NaN, 0 and the largest float: else the tests would say little."""
    seen = set()

    @EXAMPLES
    @given(arrays(ANY, 4))
    def look(v):
        seen.update(k for k, found in (("nan", np.isnan(v)), ("inf", np.isinf(v)), ("zero", v == 0),
                                       ("large", np.abs(v) > 1e30), ("small", (v != 0) & (np.abs(v) < 1e-30)))
                    if found.any())  # fmt: skip

    look()
    assert {"nan", "inf", "zero", "large"} <= seen
