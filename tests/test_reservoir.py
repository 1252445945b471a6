"""Reservoirs against float64 NumPy: what is kept, how often, and what it counts."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_mean
from scipy import stats

from mi_neural.estimators import reservoir
from mi_neural.estimators.reservoir import Reservoir
from mi_neural.render.sampling import PathSampler

N = 2**17
#: Targets of three pixels over eight lights, with holes; what is integrated; how candidates are drawn
TARGETS = np.array([[1, 2, 0, 4, 0.5, 3, 0, 1], [2, 2, 1, 0, 0.1, 3, 0, 5], [0, 1, 1, 1, 4, 0, 2, 2]], np.float64)
G = np.array([3, 1, 4, 1, 5, 9, 2, 6], np.float64)
PMF = np.array([4, 1, 2, 2, 1, 3, 1, 2], np.float64) / 16


def table(values, index, active=True):
    return dr.gather(mi.Float, mi.Float(np.asarray(values, np.float32)), index, active)


def candidates(target, sampler, n: int, M: float = 1.0) -> Reservoir:
    """A finished reservoir of `n` candidates drawn by PMF."""
    r = Reservoir.empty(N)
    for _ in range(n):
        u = sampler.next_1d()
        index = mi.UInt32(0)
        for c in np.cumsum(PMF)[:-1]:
            index += dr.select(u >= float(c), mi.UInt32(1), 0)
        t = table(target, index)
        r = reservoir.update(r, index, sampler.next_2d(), t / table(PMF, index), t, sampler.next_1d())
    return replace(reservoir.finish(r), M=mi.Float(M))


@pytest.fixture
def sampler():
    return PathSampler.make(dr.arange(mi.UInt32, N), mi.UInt32(1))


def test_samples_are_kept_in_proportion_to_their_weights(sampler):
    weights = np.array([0.5, 0, 3, 1e-3, 2, 0, 1])
    r = Reservoir.empty(N)
    for k, w in enumerate(weights):
        r = reservoir.update(r, mi.UInt32(k), mi.Point2f(k, -k), mi.Float(w), mi.Float(10 + k), sampler.next_1d())
    index = np.array(r.index)
    counts, expected = np.bincount(index, minlength=len(weights)), N * weights / weights.sum()
    assert (counts[weights == 0] == 0).all()
    some = weights > 0
    assert stats.chisquare(counts[some], expected[some]).pvalue > 1e-4
    np.testing.assert_allclose(np.array(r.w_sum), weights.sum(), rtol=1e-6)
    assert (np.array(r.M) == len(weights)).all()
    assert (np.array(r.uv) == np.stack([index, -index.astype(float)])).all(), "the sample moves as a whole"
    assert (np.array(r.target) == 10 + index).all()


@pytest.mark.parametrize("n", [1, 4])
def test_kept_candidates_integrate_over_the_support_of_the_target(sampler, n):
    r = candidates(TARGETS[0], sampler, n)
    assert_mean(np.array(table(G, r.index) * r.W), G[TARGETS[0] > 0].sum(), f"{n} candidates", relative=1e-5)


def combined(sampler, how: str):
    """Reservoir of pixel 0, combined with those of pixels 1 and 2: what they hold beforehand, and the result."""
    Ms = (1.0, 5.0, 2.0)
    rs = [candidates(t, sampler, 3, M) for t, M in zip(TARGETS, Ms, strict=True)]
    here = [table(TARGETS[0], r.index) for r in rs]
    us = [sampler.next_1d() for _ in rs]
    if how == "1/M":
        return Ms, reservoir.combine(rs, here, us)
    if how == "1/Z":
        return Ms, reservoir.combine(rs, here, us, supports=lambda r: [table(t, r.index) for t in TARGETS])
    if how == "pairwise":
        own, total = mi.Float(rs[0].M), Reservoir.empty(N)
        for k in (1, 2):
            there = [table(TARGETS[k], r.index) for r in (rs[0], rs[k])]
            share, _ = reservoir.pairwise(rs[k].M, there[1], rs[0].M, here[k], 2)
            own += reservoir.pairwise(rs[k].M, there[0], rs[0].M, here[0], 2)[1]
            total = reservoir.merge(total, rs[k], here[k], share, us[k])
        return Ms, reservoir.finish(reservoir.merge(total, rs[0], here[0], own, us[0]))
    shares = []
    for k, r in enumerate(rs):  # balance of one against all others together
        rest = sum(M * table(t, r.index) for j, (M, t) in enumerate(zip(Ms, TARGETS, strict=True)) if j != k)
        shares.append(reservoir.balance(r.M, table(TARGETS[k], r.index), mi.Float(1), rest))
    return Ms, reservoir.combine(rs, here, us, shares)


@pytest.mark.parametrize("how", ["1/Z", "balance", "pairwise"])
def test_combination_is_unbiased_for_differing_targets(sampler, how):
    Ms, r = combined(sampler, how)
    assert_mean(np.array(table(G, r.index) * r.W), G[TARGETS[0] > 0].sum(), how, relative=1e-5)
    assert (np.array(r.M) == sum(Ms)).all()
    kept = np.array(r.W) > 0
    assert (np.array(table(TARGETS[0], r.index)) == np.array(r.target))[kept].all()


def test_biased_combination_is_too_dark_by_what_could_not_have_given_the_sample(sampler):
    Ms, r = combined(sampler, "1/M")
    Z = np.array(Ms) @ (TARGETS > 0)
    known = (G * Z / sum(Ms))[TARGETS[0] > 0].sum()
    assert known < 0.9 * G[TARGETS[0] > 0].sum()
    assert_mean(np.array(table(G, r.index) * r.W), known, "1/M", relative=1e-5)


def test_shares_have_less_noise_than_1_over_z(sampler):
    noise = [np.array(table(G, r.index) * r.W).std() for r in (combined(sampler, h)[1] for h in ("balance", "1/Z"))]
    assert noise[0] < noise[1]


def test_shares_sum_to_one_wherever_a_target_is_positive(rng):
    a, b = (10.0 ** rng.uniform(-30, 30, 256) * (rng.random(256) > 0.2) for _ in range(2))
    M_a, M_b = (rng.integers(0, 3, 256).astype(float) for _ in range(2))
    args = [mi.Float(v.astype(np.float32)) for v in (M_a, a, M_b, b)]
    found = np.array(reservoir.balance(*args) + reservoir.balance(*args[2:], *args[:2]))
    np.testing.assert_allclose(found, (M_a * a + M_b * b > 0).astype(float), rtol=1e-6)
    share = np.array(reservoir.balance(*args))
    exact = np.divide(M_a * a, M_a * a + M_b * b, out=np.zeros(256), where=M_a * a > 0)
    np.testing.assert_allclose(share, exact, rtol=1e-4, atol=1e-37)


def test_pairs_share_all_confidence(rng):
    p, c = rng.uniform(0.1, 3, (2, 64))
    first, _ = reservoir.pairwise(mi.Float(5), mi.Float(p.astype("f4")), mi.Float(2), mi.Float(c.astype("f4")), 4)
    np.testing.assert_allclose(np.array(first), 5 * (4 * 5 * p) / (4 * 5 * p + 2 * c), rtol=1e-5)
    _, rest = reservoir.pairwise(mi.Float(5), mi.Float(p.astype("f4")), mi.Float(2), mi.Float(c.astype("f4")), 4)
    np.testing.assert_allclose(np.array(first + rest), 5, rtol=1e-5)


def test_history_is_clamped_and_nothing_else():
    r = Reservoir(mi.UInt32(3), mi.Point2f(0.1), mi.Float(4), mi.Float(7, 30), mi.Float(2), mi.Float(1))
    clamped = reservoir.clamp_history(r, 20)
    assert np.array(clamped.M).tolist() == [7, 20]
    assert clamped.index[0] == 3 and clamped.W[0] == 2 and clamped.target[0] == 1


@pytest.mark.parametrize("value", [0.0, 1e-42, 1e-30, 1e30, 3e38, float("inf"), float("nan"), -1.0])
def test_extreme_numbers_stay_finite(value):
    v = dr.opaque(mi.Float, value)
    r = Reservoir.empty(1)
    for weight, target in ((v, v), (v, mi.Float(1)), (mi.Float(1), v), (v, v)):
        r = reservoir.update(r, mi.UInt32(1), mi.Point2f(0.5), weight, target, mi.Float(0.5))
        r = reservoir.finish(r)
        other = replace(r, M=mi.Float(20))
        both = reservoir.combine([r, other], [v, v], [mi.Float(0.1), mi.Float(0.9)],
                                 [reservoir.balance(r.M, v, other.M, v)] * 2)  # fmt: skip
        for number in (r.w_sum, r.W, both.w_sum, both.W, *reservoir.pairwise(r.M, v, other.M, v)):
            assert np.isfinite(np.array(number)).all()


def test_empty_reservoirs_give_nothing_and_take_anything():
    empty = Reservoir.empty(4)
    none = reservoir.combine([empty, empty], [mi.Float(0)] * 2, [mi.Float(0)] * 2)
    assert (np.array(none.W) == 0).all() and (np.array(none.M) == 0).all()
    full = reservoir.update(empty, mi.UInt32(7), mi.Point2f(0.25), mi.Float(2), mi.Float(1), mi.Float(0.999))
    full = reservoir.finish(full)
    both = reservoir.combine([empty, full], [mi.Float(0), mi.Float(1)], [mi.Float(0), mi.Float(0.999)])
    assert (np.array(both.index) == 7).all() and (np.array(both.W) == 2).all()


def test_reservoirs_can_be_read_from_other_lanes():
    r = Reservoir(mi.UInt32(1, 2), mi.Point2f(0.1, 0.2), mi.Float(1, 2), mi.Float(3, 4), mi.Float(5, 6), mi.Float(7, 8))
    other = r.at(mi.UInt32(1, 0), mi.Bool(True, False))
    assert np.array(other.index).tolist() == [2, 0] and np.array(other.M).tolist() == [4, 0]
