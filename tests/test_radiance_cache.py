"""The cache of outgoing radiance with the interface of the guide: dispatch, self-training, files."""

import json
import math
import os
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from outgoing_bench import (
    BOX,
    CLEAR_I,
    CLEAR_T,
    INFERENCE,
    RATE,
    RESET,
    SMOOTHING,
    TINY,
    TRAINING,
    batch,
    cache_inputs,
    close,
    jit,
    learn,
    make,
    make_cache,
    same,
    surfaces,
    train,
    weights,
)

from mi_neural.caches.field import CacheFileError, Field
from mi_neural.caches.outgoing_field import OutgoingField
from mi_neural.caches.radiance_cache import CacheInput, DispatchFlags, RadianceCache, self_training_frame
from mi_neural.caches.weights import FieldShape

# ---------------------------------------------------------------- the cache: interface


def test_numpy_and_drjit_are_answered_alike_and_each_in_its_kind():
    a, b = make_cache(), make_cache()
    for k in range(4):
        points, radiance = batch(a, 512, k)
        targets = mi.Color3f(radiance.astype("f4").T)
        one = a.dispatch(INFERENCE | TRAINING, prediction_inputs=points, train_inputs=points, train_targets=radiance)
        points = cache_inputs(points)
        two = b.dispatch(INFERENCE | TRAINING, prediction_inputs=points, train_inputs=points, train_targets=targets)
        assert isinstance(one, np.ndarray) and one.shape == (512, 3) and one.dtype == np.float32
        assert isinstance(two, mi.Color3f)
        np.testing.assert_allclose(one, np.array(two).T, rtol=1e-3, atol=1e-6)
    b.field.restore(a.field.snapshot())
    points, _ = batch(a)
    one, two = (c.dispatch(INFERENCE, prediction_inputs=p) for c, p in ((a, points), (b, cache_inputs(points))))
    assert np.array_equal(one, np.array(two).T)


def test_packing_is_alike_in_both_kinds_and_undone_by_the_cache():
    cache = make_cache(scale=1.0)
    points = surfaces(512)
    one, two = cache.pack(*points), cache.pack(*jit(points))
    assert one[:, :3].min() >= 0 and one[:, :3].max() <= 1
    np.testing.assert_allclose(one.T, np.array([np.array(c) for c in two.columns()]), atol=2e-6)
    found = cache.dispatch(INFERENCE, prediction_inputs=one)
    twin = OutgoingField(*BOX, TINY, scale=1.0)
    np.testing.assert_allclose(found, np.array(twin.query(*jit(points))).T, rtol=1e-3, atol=1e-5)


def test_inference_comes_before_training():
    cache = make_cache()
    train(cache, 3)
    points, radiance = batch(cache)
    before = cache.dispatch(INFERENCE, prediction_inputs=points)
    both = cache.dispatch(INFERENCE | TRAINING, prediction_inputs=points, train_inputs=points, train_targets=radiance)
    after = cache.dispatch(INFERENCE, prediction_inputs=points)
    assert np.array_equal(before, both) and not np.array_equal(both, after)


def test_reset_comes_before_inference_and_is_a_new_cache_bit_for_bit():
    for scale in (None, 3.0):
        cache, new = make_cache(scale=scale), make_cache(scale=scale)
        points, _ = batch(cache)
        known = new.dispatch(INFERENCE, prediction_inputs=points)
        train(cache, 3)
        assert cache.statistics["steps"] == 3
        counters = [512, 7]
        found = cache.dispatch(RESET | INFERENCE, prediction_inputs=points, sample_counters=counters)
        assert np.array_equal(found, known) and same(weights(cache), weights(new)) and counters == [512, 7]
        a, b = cache.statistics, new.statistics
        assert a["steps"] == 0 and a.pop("loss") != b.pop("loss") and a == b


@pytest.mark.parametrize("kind", ["inference", "training"])
def test_counts_above_the_maximum_are_refused_and_nothing_is_written(kind):
    cache = RadianceCache(256, 256, *BOX, shape=TINY)
    train(cache, 1, n=256)
    before, facts = weights(cache), cache.statistics
    small, few = batch(cache, 256)
    large, many = batch(cache, 300)
    counters = np.array([256, 256])
    counters[int(kind == "training")] = 300
    for given in (counters, counters.tolist(), mi.UInt32(counters), None):
        kept = np.array(given).copy()
        arguments = (
            {"prediction_inputs": large, "train_inputs": small, "train_targets": few}
            if kind == "inference"
            else {"prediction_inputs": small, "train_inputs": large, "train_targets": many}
        )
        clear = DispatchFlags.CLEAR_ALL_COUNTERS if given is not None else TRAINING
        with pytest.raises(ValueError, match=rf"^300 {kind} samples .*maximum of 256.*max_{kind}_sample_count=300"):
            cache.dispatch(RESET | INFERENCE | TRAINING | clear, sample_counters=given, **arguments)
        assert np.array_equal(np.array(given), kept)
    assert same(before, weights(cache)) and cache.statistics == facts


@pytest.mark.parametrize("kind", ["list", "numpy", "drjit"])
def test_counters_say_how_much_counts_and_are_cleared_on_demand(kind):
    cache, twin = make_cache(), make_cache()
    points, radiance = batch(cache)
    spoilt, nonsense = points.copy(), radiance.copy()
    spoilt[300:], nonsense[200:] = np.nan, np.nan
    as_kind = {"list": list, "numpy": np.array, "drjit": lambda v: mi.UInt32(v)}[kind]
    counters = as_kind([300, 200])
    arguments = {"train_inputs": points, "train_targets": nonsense, "sample_counters": counters}
    for flag, left in ((TRAINING, [300, 200]), (CLEAR_T, [300, 0]), (CLEAR_I, [0, 0])):
        found = cache.dispatch(INFERENCE | TRAINING | flag, prediction_inputs=spoilt, **arguments)
        assert np.array(counters).tolist() == left
    twin.dispatch(TRAINING, train_inputs=points[:200], train_targets=radiance[:200])
    twin.dispatch(TRAINING, train_inputs=points[:200], train_targets=radiance[:200])
    facts = cache.statistics
    assert facts["inference_samples"] == 900 and facts["training_samples"] == 400 and facts["steps"] == 2
    assert facts["nonfinite_inference"] == facts["nonfinite_training"] == 0
    assert close(cache.field, twin.field) and found.shape == (512, 3) and (found[300:] == 0).all()
    found = cache.dispatch(INFERENCE, prediction_inputs=spoilt, sample_counters=as_kind([300, 0]))
    assert (found[300:] == 0).all() and (found[:300] > 0).all()


def test_counters_can_be_filled_by_a_renderer():
    """As in the guide: threads that find something to ask increment the counter, which gives them their place."""
    cache = make_cache(1024, scale=1.0)
    points = jit(surfaces(1024))
    asks = points[0].x > 0.3
    counters = dr.zeros(mi.UInt32, 2)
    place = dr.scatter_inc(counters, mi.UInt32(0), asks)
    buffer = dr.zeros(CacheInput, 1024)
    dr.eval(place)
    dr.scatter(buffer, cache.pack(*points), place, asks)
    found = cache.dispatch(INFERENCE | CLEAR_I, prediction_inputs=buffer, sample_counters=counters)
    found = np.array(dr.gather(mi.Color3f, found, place, asks))
    known = np.where(np.array(asks), np.array(OutgoingField(*BOX, TINY).query(*points)), 0)
    np.testing.assert_allclose(found, known, rtol=1e-3, atol=1e-5)
    assert np.array(counters).tolist() == [0, 0] and 0 < np.array(asks).sum() < 1024


def test_small_and_odd_counts_are_padded_and_recorded_once_per_size():
    cache = RadianceCache(5000, 5000, *BOX, shape=TINY, scale=1.0)
    points, radiance = batch(cache, 5000)
    whole = cache.dispatch(INFERENCE, prediction_inputs=points)
    for n in (1, 3, 1000, 1024, 1250, 1251, 2500, 4999, 0):
        for p in (points[:n], cache_inputs(points[:n]) if n else dr.zeros(CacheInput, 0)):
            found = cache.dispatch(INFERENCE, prediction_inputs=p)
            found = found if isinstance(found, np.ndarray) else np.array(found).T
            assert np.array_equal(found, whole[:n])
        cache.dispatch(TRAINING | RATE | SMOOTHING, train_inputs=points[:n], train_targets=radiance[:n],
                       learning_rate=0.0, weight_smoothing=1.0)  # fmt: skip
    recordings = [f.n_recordings for f in (*cache._inference.values(), *cache._training.values())]
    assert recordings == [1] * 6 and cache.statistics["steps"] == 8


def test_frozen_dispatches_are_the_plain_ones():
    caches = make_cache(), make_cache()
    for cache, frozen in zip(caches, (True, False), strict=True):
        with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, frozen):
            train(cache, 3)
            cache.reset()
            train(cache, 6)
    assert caches[0]._training[512].n_recordings == 1 and caches[1]._training[512].n_recordings == 0
    assert close(*(c.field for c in caches))
    assert caches[0].statistics["loss"] == pytest.approx(caches[1].statistics["loss"], rel=1e-3)


def test_learning_rate_is_the_default_or_the_override():
    def moved(flags, **kw):
        cache = make_cache(scale=1.0)
        before = cache.field.snapshot()["current.grid"]
        train(cache, 1, flags, **kw)
        return np.abs(cache.field.snapshot()["current.grid"] - before).max()

    # The first step of Adam is as long as its rate
    assert moved(TRAINING) == pytest.approx(0.002, rel=1e-3)
    assert moved(RATE, learning_rate=0.03) == pytest.approx(0.03, rel=1e-3)
    assert moved(RATE, learning_rate=0.0) == 0


def test_smoothing_is_the_default_or_the_override():
    cache = make_cache()
    train(cache, 3)
    assert cache.field.eta[0] == pytest.approx(1 - 0.99**3, rel=1e-4)
    points, _ = batch(cache)
    kept = cache.dispatch(INFERENCE, prediction_inputs=points)
    train(cache, 3, SMOOTHING, weight_smoothing=1.0)
    assert np.array_equal(kept, cache.dispatch(INFERENCE, prediction_inputs=points))
    train(cache, 1, SMOOTHING, weight_smoothing=0.0)
    found = cache.field.snapshot()
    assert np.array_equal(found["averaged.grid"], found["current.grid"])


def test_points_that_are_not_finite_are_counted_and_never_enter():
    cache = make_cache()
    points, radiance = batch(cache)
    points[:10, 3], points[10:30, 9], radiance[30:60] = np.nan, np.inf, np.nan
    found = cache.dispatch(INFERENCE | TRAINING, prediction_inputs=points, train_inputs=points, train_targets=radiance)
    found = cache.dispatch(INFERENCE, prediction_inputs=points)
    assert (found[:30] == 0).all() and (found[30:] > 0).all() and np.isfinite(found).all()
    facts = cache.statistics
    assert facts["nonfinite_inference"] == 60 and facts["nonfinite_training"] == 60 and math.isfinite(facts["loss"])
    before = weights(cache)
    cache.dispatch(TRAINING, train_inputs=np.full_like(points, np.nan), train_targets=radiance)
    assert same(before, weights(cache))


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_cache_learns_alike_at_every_brightness(factor):
    answers = []
    for f in (1.0, factor):
        cache = make_cache(1024)
        for k in range(25):
            points, radiance = batch(cache, 1024, k)
            cache.dispatch(TRAINING | RATE, train_inputs=points, train_targets=radiance * f, learning_rate=0.01)
        answers.append(cache.dispatch(INFERENCE, prediction_inputs=points) / f)
    np.testing.assert_allclose(*answers, rtol=0.02, atol=2e-3)


@pytest.mark.parametrize("extent", [1e-3, 1e5])
def test_cache_learns_alike_in_boxes_of_every_size(extent):
    cache = RadianceCache(64, 64, -extent * np.ones(3), extent * np.ones(3), shape=TINY, scale=1.0)
    points = list(surfaces(64))
    points[0] = points[0] / 5
    known = RadianceCache(64, 64, -np.ones(3), np.ones(3), shape=TINY, scale=1.0)
    a = cache.dispatch(INFERENCE, prediction_inputs=cache.pack(points[0] * extent, *points[1:]))
    b = known.dispatch(INFERENCE, prediction_inputs=known.pack(*points))
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize("arguments, message", [
    ((0, 1), r"max_inference_sample_count is 0"), ((1, -5), r"max_training_sample_count is -5"),
    ((1.5, 1), r"max_inference_sample_count is 1.5"), ((1, 2**40), r"max_training_sample_count is"),
    ((1, 1, (0, 0, 0), (1, 0, 1)), "the box .* is empty or not finite"),
    ((1, 1, (0, 0, 0), (1, np.nan, 1)), "the box .* is empty or not finite"), ((1, 1, (0, 0), (1, 1)), "the box"),
])  # fmt: skip
def test_impossible_cache_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RadianceCache(*arguments, shape=TINY)


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, math.inf])
def test_impossible_scale_is_refused(scale):
    for cls in (lambda **kw: RadianceCache(1, 1, **kw), lambda **kw: OutgoingField(*BOX, **kw)):
        with pytest.raises(ValueError, match=r"scale is .*positive"):
            cls(scale=scale, shape=TINY)


POINTS, COLOURS = np.ones((4, 11), "f4"), np.ones((4, 3), "f4")


@pytest.mark.parametrize("flags, arguments, message", [
    (3, {}, "combine DispatchFlags"),
    (INFERENCE, {}, "prediction_inputs is missing"),
    (TRAINING, {"train_inputs": POINTS}, "train_targets is missing"),
    (TRAINING, {"train_targets": COLOURS}, "train_inputs is missing"),
    (TRAINING, {"train_inputs": POINTS, "train_targets": COLOURS[:3]}, "4 train_inputs but 3 train_targets"),
    (INFERENCE, {"prediction_inputs": POINTS[:, :9]}, r"prediction_inputs is an array \(4, 9\).*\(n, 11\)"),
    (INFERENCE, {"prediction_inputs": POINTS.astype(str)}, "prediction_inputs is an array .*numbers"),
    (INFERENCE, {"prediction_inputs": POINTS.tolist()}, "prediction_inputs is of type list; .*CacheInput"),
    (TRAINING, {"train_inputs": POINTS, "train_targets": [1]}, "train_targets is of type list; .*Color3f"),
    (INFERENCE, {"prediction_inputs": POINTS, "sample_counters": [5, 0]}, "says 5 inference samples.*holds 4"),
    (INFERENCE, {"prediction_inputs": POINTS, "sample_counters": [1]}, "must be two counts"),
    (INFERENCE, {"prediction_inputs": POINTS, "sample_counters": [-1, 2]}, "must be two counts"),
    (INFERENCE, {"prediction_inputs": POINTS, "sample_counters": [0.5, 2]}, "must be two counts"),
    (CLEAR_I, {}, "sample_counters is missing"),
    (CLEAR_I, {"sample_counters": (1, 1)}, "cannot be written to.*pass a list"),
    (RATE, {}, "learning_rate is missing"),
    (TRAINING, {"learning_rate": 0.1}, "OVERRIDE_LEARNING_RATE is missing"),
    (RATE, {"learning_rate": -0.1}, "learning_rate is -0.1; it must be a number at least 0"),
    (RATE, {"learning_rate": math.nan}, "learning_rate is nan"),
    (RATE, {"learning_rate": "fast"}, "learning_rate is 'fast'; it must be a number"),
    (SMOOTHING, {"weight_smoothing": 1.1}, r"weight_smoothing is 1.1; it must be a number in \[0, 1\]"),
])  # fmt: skip
def test_impossible_dispatch_is_refused(flags, arguments, message):
    cache = RadianceCache(16, 16, shape=TINY)
    with pytest.raises(ValueError, match=message):
        cache.dispatch(flags, **arguments)


def test_points_of_uneven_length_are_refused():
    cache = make_cache()
    points = cache_inputs(batch(cache, 8)[0])
    points.roughness = mi.Float([0.1, 0.2])
    with pytest.raises(ValueError, match=r"parts of prediction_inputs have different lengths: \[2, 8\]"):
        cache.dispatch(INFERENCE, prediction_inputs=points)
    points.roughness = mi.Float(0.1)  # one for all is right
    assert dr.width(cache.dispatch(INFERENCE, prediction_inputs=points)) == 8


# ---------------------------------------------------------------- self-training


@pytest.mark.parametrize("kind", ["numpy", "drjit"])
def test_self_training_in_a_furnace_reaches_its_fixed_point(kind):
    """Every surface emits Le and reflects the share ρ(x) of the mean radiance m, whatever the direction: L = Le + ρ m,
    m = Le / (1 - mean ρ). Paths of two vertices know but two bounces; the cache at their ends knows the others."""
    Le, n = 0.5, 512

    def albedo(x):
        return np.clip(0.3 + 0.6 * x[:, :1] * np.ones(3), 0.3, 0.9)  # mean 0.6

    def place(seed):
        rng = np.random.default_rng(seed)
        x = rng.random((n, 3))
        normal, view = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, n, 3)))
        return x, normal, view, albedo(x), np.ones(n)

    mean = Le / (1 - 0.6)
    # The same points and colours in the kind that is to be tested
    points, colours, index = {
        "numpy": (lambda p: p, lambda c: c, lambda i: i),
        "drjit": (cache_inputs, lambda c: mi.Color3f(c.astype("f4").T), lambda i: mi.UInt32(i)),
    }[kind]
    cache = RadianceCache(2 * n, 2 * n, shape=TINY)
    errors, test = [], place(12345)
    for frame in range(300):
        first, second, last = (place(3 * frame + k) for k in range(3))
        rho1, rho2 = first[3], second[3]
        records = np.concatenate([cache.pack(*first), cache.pack(*second)])
        found = self_training_frame(
            cache, points(records), colours(np.concatenate([Le + rho1 * Le, Le + 0 * rho2])),
            points(cache.pack(*last)), colours(np.concatenate([rho1 * rho2, rho2])), index(np.tile(np.arange(n), 2)),
            points(cache.pack(*test)), TRAINING | RATE | SMOOTHING, learning_rate=0.01, weight_smoothing=0.9,
        )  # fmt: skip
        found = found if kind == "numpy" else np.array(found).T
        known = Le + test[3] * mean
        errors.append((found.mean() / known.mean() - 1, np.sqrt(((found / known - 1) ** 2).mean())))
    errors = np.array(errors)
    for k in (1, 10, 40, 299):
        print(f"frame {k}: mean off by {errors[k, 0]:+.1%}, rms {errors[k, 1]:.1%}")
    two_bounces = (Le + 0.6 * Le) / (Le + 0.6 * mean) - 1  # without the cache
    assert errors[1, 0] < two_bounces < -0.3 and abs(errors[-1, 0]) < 0.015 and errors[-1, 1] < 0.04


# ---------------------------------------------------------------- files


@pytest.fixture
def saved(tmp_path):
    """A trained cache and the file it was saved to."""
    cache = make_cache(seed=5)
    train(cache, 3)
    cache.save(tmp_path / "cache.npz")
    return cache, tmp_path / "cache.npz"


def refused(file, load=RadianceCache.load) -> str:
    with pytest.raises(CacheFileError, match=re.escape(str(file))) as error:
        load(file)
    return str(error.value)


def rewrite(file, change) -> None:
    """Write a cache file anew with a changed header or changed arrays."""
    with np.load(file) as f:
        arrays = {k: f[k] for k in f.files}
    header = json.loads(bytes(arrays.pop("header")).decode())
    change(header, arrays)
    with open(file, "wb") as f:
        np.savez(f, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


def test_file_gives_the_cache_back_bit_for_bit(saved):
    cache, file = saved
    loaded = RadianceCache.load(file)
    assert same(weights(cache), weights(loaded)) and loaded.field.steps == loaded.statistics["steps"] == 3
    assert loaded.box == cache.box and loaded.field.shape == TINY and loaded.max_training_sample_count == 512
    points, _ = batch(cache)
    assert np.array_equal(*(c.dispatch(INFERENCE, prediction_inputs=points) for c in (cache, loaded)))
    train(loaded, 2)
    loaded.reset()
    assert same(weights(loaded), weights(make_cache(seed=5))) and os.listdir(file.parent) == [file.name]


def test_file_of_a_field_alone_is_no_cache(tmp_path):
    field = make(seed=1)
    learn(field, 2)
    field.save(tmp_path / "field.npz", scene="abc")
    loaded, header = OutgoingField.load(tmp_path / "field.npz")
    assert same(field.snapshot(), loaded.snapshot()) and loaded.eta[0] == field.eta[0] and header["scene"] == "abc"
    assert "no RadianceCache" in refused(tmp_path / "field.npz")


def test_files_of_incident_and_outgoing_radiance_are_not_taken_for_one_another(saved, tmp_path):
    Field(*BOX, FieldShape(n_levels=2, hashmap_size=128, width=8)).save(tmp_path / "incident.npz")
    assert "holds no outgoing radiance" in refused(tmp_path / "incident.npz")
    refused(saved[1], Field.load)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_truncated_file_is_refused(saved, share):
    _, file = saved
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    assert "is not a cache file of mi_neural, or is damaged" in refused(file)


def test_missing_and_foreign_files_are_refused(tmp_path):
    assert "there is no cache file" in refused(tmp_path / "no.npz")
    assert "is not a cache file" in refused(tmp_path)
    (tmp_path / "foreign.npz").write_bytes(b"hello")
    assert "is not a cache file" in refused(tmp_path / "foreign.npz")


@pytest.mark.parametrize("change", [
    lambda h, a: h.update(scale=-1.0), lambda h, a: h.update(scale=math.nan), lambda h, a: h.update(eta=2),
    lambda h, a: h.update(steps="many"), lambda h, a: h.update(shape={"width": -1}), lambda h, a: h.pop("box"),
    lambda h, a: h.update(version=99), lambda h, a: h.update(max_training_sample_count=0),
    lambda h, a: h.update(scene_box=[[0, 0, 0], [0, 0, 0]]), lambda h, a: a.pop("current.grid"),
    lambda h, a: a.update({"averaged.grid": np.full_like(a["averaged.grid"], np.nan)}),
    lambda h, a: a.update({"averaged.grid": a["averaged.grid"][:-2]}),
    lambda h, a: a.update(extra=np.array([None])),
])  # fmt: skip
def test_file_with_an_impossible_part_is_refused(saved, change):
    rewrite(saved[1], change)
    refused(saved[1])


@pytest.mark.parametrize("where", ["savez", "replace"])
def test_failed_save_leaves_the_old_file_and_no_other(saved, full_disk, where):
    cache, file = saved
    before = file.read_bytes()
    full_disk(where)
    with pytest.raises(OSError, match="disk full"):
        cache.save(file)
    assert file.read_bytes() == before and os.listdir(file.parent) == [file.name]
