"""The field of outgoing radiance: queries and learning."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from outgoing_bench import close, jit, learn, make, same, surfaces, truth

from mi_neural.caches import encoding
from mi_neural.caches.optimizer import own_copy
from mi_neural.caches.outgoing_field import ALBEDO_MIN, OutgoingShape
from mi_neural.render.frozen import undisturbed
from mi_neural.render.kernels import on_gpu

# ---------------------------------------------------------------- the field: queries


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_untrained_field_answers_about_its_scale_at_albedo_one(scale):
    field = make(OutgoingShape(), scale=scale)
    x, n, w, _, roughness = jit(surfaces(2048))
    found = np.array(field.query(x, n, w, mi.Color3f(1), roughness))
    assert 0.8 * scale < found.mean() < 1.25 * scale and found.min() >= 0


def test_field_that_is_to_measure_its_scale_answers_nothing_and_then_finds_it():
    field = make(scale=None)
    points = jit(surfaces(256))
    assert (np.array(field.query(*points)) == 0).all()
    learn(field, 1, factor=40)
    assert field.scale[0] == pytest.approx(40, rel=0.1) and np.array(field.query(*points)).mean() > 1


def test_query_is_what_the_network_says_times_the_reflectance():
    field = make(OutgoingShape(), scale=3.0)
    learn(field, 5)
    points = jit(surfaces(512))
    expected = np.maximum(np.array(field.raw(*points)), 0) * np.array(points[3]) * 3
    np.testing.assert_allclose(np.array(field.query(*points)), expected, rtol=1e-5)


def test_targets_are_divided_by_the_reflectance_before_they_are_learned():
    """Radiance in proportion to an albedo full of detail is one constant to the network, which it starts at."""
    field = make(scale=None)
    for k in range(30):
        points, half = jit(surfaces(1024, k)), dr.opaque(mi.Float, 0.5)
        value, mean_target, _, _ = field.learn(*points, points[3] * 7, mi.Bool(True), dr.opaque(mi.Float, 2e-3), half)
        assert mean_target[0] == pytest.approx(1, rel=1e-4)
    assert field.scale[0] == pytest.approx(7, rel=1e-4)
    points = jit(surfaces(1024, 99))
    found = np.array(field.query(*points)) / np.array(points[3])
    print(f"7 is found as {found.mean():.3f} +- {found.std():.3f}")
    assert abs(found.mean() - 7) < 0.2 and found.std() < 0.8 and value[0] < 5e-2


@pytest.mark.parametrize("black", [0.0, 1e-30, -1.0])
def test_black_surfaces_divide_nothing_by_zero(black):
    field = make()
    for _ in range(3):
        points = list(jit(surfaces(512)))
        points[3] = mi.Color3f(black, 0.5, 0.5)
        rate = dr.opaque(mi.Float, 1e-2)
        value, _, _, bad = field.learn(*points, mi.Color3f(0.0, 1.0, 1.0), mi.Bool(True), rate, rate)
        assert math.isfinite(value[0]) and bad[0] == 0
    found = np.array(field.query(*points))
    assert np.isfinite(found).all() and found[0].max() < 2 * ALBEDO_MIN


def test_query_in_a_symbolic_loop_is_the_query_outside():
    field = make(OutgoingShape())
    learn(field, 3)
    points = jit(surfaces(256))
    _, total = dr.while_loop(
        (mi.UInt32(0), mi.Color3f(0)), lambda i, t: i < 3, lambda i, t: (i + 1, t + field.query(*points))
    )
    np.testing.assert_allclose(np.array(total), 3 * np.array(field.query(*points)), rtol=1e-5)


def test_query_and_training_can_be_frozen():
    plain, frozen = make(), make()

    @dr.freeze(auto_opaque=False)
    def query(field, points):
        return field.query(*points)

    @dr.freeze(auto_opaque=False)
    def step(field, points, target, rate, a):
        return field.learn(*points, target, mi.Bool(True), rate, a)

    for k in range(6):
        points = surfaces(512, k)
        target = own_copy(mi.Color3f(truth(*points).astype("f4").T))
        points = tuple(own_copy(v) for v in jit(points))
        rate, a = dr.opaque(mi.Float, 1e-2 / (k + 1)), dr.opaque(mi.Float, 0.5)
        one = plain.learn(*points, target, mi.Bool(True), rate, a)
        with undisturbed():
            other = step(frozen, points, target, rate, a)
        np.testing.assert_allclose([v[0] for v in other], [v[0] for v in one], rtol=1e-4)
        found = np.array(query(frozen, points))
        np.testing.assert_allclose(found, np.array(plain.query(*points)), rtol=1e-3)
    assert step.n_recordings == 1 and query.n_recordings == 1


def test_weights_being_trained_can_be_asked_in_a_frozen_function():
    """As an integrator does that ends its training paths in them, where the averaged ones would lag behind."""
    field, points = make(), tuple(own_copy(v) for v in jit(surfaces(512)))
    target = own_copy(mi.Color3f(truth(*surfaces(512)).astype("f4").T))

    @dr.freeze(auto_opaque=False)
    def frame(field, points, target, rate, a):
        with dr.suspend_grad():
            field.sync()
            found = field.query(*points, averaged=False)
            dr.eval(found)
        field.learn(*points, target, mi.Bool(True), rate, a)
        return found

    for _ in range(4):
        field.sync()
        known = np.array(field.query(*points, averaged=False))
        with undisturbed():
            found = frame(field, points, target, dr.opaque(mi.Float, 1e-2), dr.opaque(mi.Float, 0.99))
        assert np.array_equal(np.array(found), known)
    field.sync()
    assert frame.n_recordings == 1 and not np.array_equal(np.array(field.query(*points, averaged=False)), known)


def test_training_predicts_what_queries_of_its_weights_say():
    field = make(OutgoingShape())
    learn(field, 2)
    points = jit(surfaces(512))
    predicted = np.array(dr.detach(field.predict(*points)))
    field.sync()
    np.testing.assert_allclose(np.array(field.raw(*points, averaged=False)), predicted, atol=1e-3 if on_gpu() else 2e-5)


def test_bumps_of_the_roughness_cover_all_of_it():
    v = np.linspace(0, 1, 101, dtype="f4")
    bins = np.array([np.array(b) for b in encoding.one_blob(mi.Float(v), 4)])
    assert bins.min() >= 0 and np.allclose(bins.sum(axis=0)[25:76], 1, atol=1e-6)
    assert (bins.argmax(axis=0)[[5, 37, 62, 95]] == [0, 1, 2, 3]).all() and bins.sum(axis=0).min() > 0.49


# ---------------------------------------------------------------- the field: learning


def test_loss_on_a_known_function_falls_and_the_answer_is_near():
    field = make(OutgoingShape())
    losses = learn(field, 150, smoothing=0.95)
    points = surfaces(4096, 7)
    error = np.array(field.query(*jit(points))).T - truth(*points)
    relative = (error**2).mean() / truth(*points).var()
    print(f"loss {losses[0]:.3f} -> {np.mean(losses[-10:]):.4f}, squared error over variance {relative:.4f}")
    assert np.mean(losses[-10:]) < losses[0] / 20 and relative < 0.03


def test_gradients_are_finite_differences():
    field = make()
    points = surfaces(256)
    inputs, known = jit(points), mi.Color3f((truth(*points) / points[3]).astype("f4").T)

    def value():
        return dr.mean(dr.squared_norm(field.predict(*inputs) - known))

    dr.backward(value())
    gradient = {k: np.array(field.optimizer[k].grad).astype(np.float64) for k in field.optimizer}
    for k in field.optimizer:
        start, tp = np.array(dr.detach(field.optimizer[k])), type(field.optimizer[k])
        along, h, sides = gradient[k] / np.abs(gradient[k]).max(), 2e-3, []
        for sign in (1, -1):
            field.optimizer[k] = tp((start + sign * h * along).astype("f4"))
            sides.append(float(value()[0]))
        field.optimizer[k] = tp(start)
        assert (sides[0] - sides[1]) / (2 * h) == pytest.approx((gradient[k] * along).sum(), rel=0.02), k


def test_no_smoothing_is_the_current_and_full_smoothing_is_frozen():
    field = make()
    learn(field, 3, smoothing=0.5)
    before, points = field.snapshot(), jit(surfaces(64))
    answer, eta = np.array(field.query(*points)), field.eta[0]
    learn(field, 3, smoothing=1.0, first=3)
    after = field.snapshot()
    assert all(np.array_equal(before[k], after[k]) for k in before if k.startswith("averaged"))
    assert not np.array_equal(before["current.grid"], after["current.grid"])
    assert np.array_equal(answer, np.array(field.query(*points))) and field.eta[0] == eta
    learn(field, 1, smoothing=0.0, first=6)
    after = field.snapshot()
    assert all(np.array_equal(v, after[k.replace("current", "averaged")]) for k, v in after.items() if "current" in k)


@pytest.mark.parametrize("smoothing", [0.6, 0.99])
def test_average_is_the_formula_of_the_paper(smoothing):
    field, average, eta = make(), 0.0, 0.0
    for t in range(1, 5):
        learn(field, 1, smoothing=smoothing, first=t)
        eta_next = 1 - smoothing**t
        current = field.snapshot()["current.grid"].astype(np.float64)
        average = (1 - smoothing) / eta_next * current + smoothing * eta / eta_next * average
        eta = eta_next
        assert field.eta[0] == pytest.approx(eta, rel=1e-5)
        np.testing.assert_allclose(field.snapshot()["averaged.grid"], average, atol=1e-6)


def test_average_without_one_full_step_is_free_of_the_initial_weights():
    """a = 1 first, then another: what had been frozen leaves no trace."""
    field = make()
    learn(field, 2, smoothing=1.0)
    learn(field, 1, smoothing=0.99, first=2)
    found = field.snapshot()
    np.testing.assert_allclose(found["averaged.grid"], found["current.grid"], atol=1e-8)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_targets_that_are_not_finite_are_left_out_and_counted(bad):
    field, twin = make(), make()

    def spoil(target):
        target[::2] = bad
        return target

    points = surfaces(512)
    target = truth(*points).astype("f4")
    rate = [dr.opaque(mi.Float, v) for v in (1e-2, 0.5)]
    *_, n_bad = field.learn(*jit(points), mi.Color3f(spoil(target.copy()).T), mi.Bool(True), *rate)
    half = mi.Bool(np.arange(512) % 2 == 1)
    *_, none_bad = twin.learn(*jit(points), mi.Color3f(target.T), half, *rate)
    assert n_bad[0] == 256 and none_bad[0] == 0 and close(field, twin)

    before = field.snapshot()
    losses = learn(field, 1, change=lambda target: target * np.float32(bad))  # none is left
    assert math.isnan(losses[0]) and same(before, field.snapshot())
    for f in (field, twin):
        learn(f, 2, first=5)
    assert close(field, twin, 2e-2)  # Adam has counted the step that it did not make


@pytest.mark.parametrize("column", range(5))
def test_inputs_that_are_not_finite_are_left_out_and_answered_with_zero(column):
    field = make()
    for bad in (np.nan, np.inf, 1e30):
        points = [v.copy() for v in surfaces(64)]
        points[column][:16] = bad
        found = np.array(field.query(*jit(points)))
        assert np.isfinite(found).all()
        wrong = bad != 1e30 or column in (1, 2)  # a far point and a rough surface are none, long directions are
        assert (found[:, 16:] > 0).all() and (not wrong or (found[:, :16] == 0).all())
        rate = dr.opaque(mi.Float, 1e-2)
        value, *_, n_bad = field.learn(*jit(points), mi.Color3f(1.0), mi.Bool(True), rate, rate)
        assert math.isfinite(value[0]) and n_bad[0] == 16 * wrong
    assert all(np.isfinite(v).all() for v in field.snapshot().values())


def test_reset_is_a_new_field_bit_for_bit():
    for scale in (2.0, None):
        field, new = make(scale=scale, seed=3), make(scale=scale, seed=3)
        first = field.snapshot()
        assert same(first, new.snapshot())
        learn(field, 3)
        assert not same(first, field.snapshot())
        field.reset()
        assert same(first, field.snapshot()) and field.eta[0] == 0 and field.scale[0] == new.scale[0]
        for f in (field, new):
            learn(f, 3)
        assert close(field, new)


@pytest.mark.parametrize("key, value", [
    ("normal_degree", -1), ("direction_degree", -1), ("n_outputs", 4), ("width", 0), ("normal_degree", 8),
])  # fmt: skip
def test_impossible_shape_is_refused_by_name(key, value):
    with pytest.raises(ValueError, match=f"{key}.*{value}"):
        OutgoingShape(**{key: value})
