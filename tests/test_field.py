"""The field: queries, gradients, learning, the averaged copy, files."""

import dataclasses
import json
import os
import pickle
import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_neural.caches import encoding, loss
from mi_neural.caches.field import FILE_VERSION, CacheFileError, Field
from mi_neural.caches.weights import FieldShape

TINY = FieldShape(n_levels=2, hashmap_size=128, base_resolution=3, direction_degree=1, width=8, n_hidden=1)
SHAPES = {
    "tiny": TINY,
    "default": FieldShape(),
    "odd": FieldShape(n_levels=3, n_features=4, hashmap_size=256, direction_degree=2, width=24, n_hidden=3),
}
BOX = ([-1.0, -2.0, 0.0], [1.0, 2.0, 5.0])


def make(shape=TINY, **kw) -> Field:
    return Field(*BOX, shape, **kw)


def places(n: int, seed: int = 0):
    """Random points of the box and directions."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(*BOX, (n, 3)).T.astype("f4")
    w = mi.warp.square_to_uniform_sphere(mi.Point2f(*rng.random((2, n), "f4")))
    return mi.Point3f(*x), w


def train(field: Field, steps: int, function, rate=1e-2, decay=0.9, n=2048, first=0) -> list[float]:
    """Steps of plain L2 on `function` (x, w) -> Color3f; the losses."""
    losses = []
    for k in range(first, first + steps):
        x, w = places(n, seed=100 + k)
        value = dr.sum(dr.squared_norm(field.predict(x, w) - function(x, w))) / n
        losses.append(value[0])
        field.step(value, dr.opaque(mi.Float, rate), dr.opaque(mi.Float, decay))
    return losses


def wave(x, w):
    """A function of the position and the direction, with mean 1."""
    return mi.Color3f(1 + 0.7 * dr.sin(2 * x.x) * dr.cos(x.y), 1 + 0.5 * w.z, 1 + 0.3 * dr.sin(x.z) * w.x)


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[k], b[k]) for k in a)


def close(a: Field, b: Field) -> bool:
    """Whether two fields answer alike, up to the order in which threads sum up gradients."""
    x, w = places(1024, seed=9)
    a, b = (np.array(f.raw(f.encode(x), w)) for f in (a, b))
    return np.sqrt(np.mean((a - b) ** 2)) < 1e-3


# ---------------------------------------------------------------- queries


def test_untrained_field_answers_about_its_scale_everywhere():
    x, w = places(4096)
    for scale in (1e-6, 1.0, 1e6):
        field = make(FieldShape(), scale=scale)
        found = np.array(field.query(field.encode(x), w))
        assert 0.8 * scale < found.mean() < 1.25 * scale and found.min() >= 0


def test_encoding_once_and_asking_often_is_asking_each_time():
    field = make(FieldShape())
    train(field, 3, wave)
    x, _ = places(64)
    features = field.encode(x)
    for seed in range(3):
        _, w = places(64, seed)
        assert np.array_equal(np.array(field.query(features, w)), np.array(field.query(field.encode(x), w)))


def test_query_in_a_symbolic_loop_is_the_query_outside():
    field = make(FieldShape())
    train(field, 3, wave)
    x, w = places(256)
    features = field.encode(x)
    _, total = dr.while_loop(
        (mi.UInt32(0), mi.Color3f(0)), lambda i, t: i < 3, lambda i, t: (i + 1, t + field.query(features, w))
    )
    np.testing.assert_allclose(np.array(total), 3 * np.array(field.query(features, w)), rtol=1e-5)


def test_query_is_never_negative_and_never_nan():
    field = make()
    train(field, 100, lambda x, w: mi.Color3f(-5) + 0 * x.x)
    x, w = places(256)
    assert np.array(field.raw(field.encode(x), w)).max() < 0
    assert (np.array(field.query(field.encode(x), w)) == 0).all()
    field.restore({k: np.full_like(v, np.nan) for k, v in field.snapshot().items()})
    assert (np.array(field.query(field.encode(x), w)) == 0).all()


def test_points_outside_the_box_have_cells_of_their_own():
    field, w = make(), mi.Vector3f(0, 0, 1)
    out, on = (field.query(field.encode(mi.Point3f(*p)), w) for p in ((9.0, 0.0, 2.0), (1.0, 0.0, 2.0)))
    assert not np.array_equal(np.array(out), np.array(on))
    far = field.query(field.encode(mi.Point3f(float("inf"), 1e30, 0)), w)
    assert np.isfinite(np.array(far)).all()


@pytest.mark.parametrize("name", SHAPES)
def test_training_predicts_what_queries_of_its_weights_say(name):
    field = make(SHAPES[name])
    train(field, 2, wave)
    x, w = places(512)
    predicted = np.array(dr.detach(field.predict(x, w)))
    field.sync()
    found = np.array(field.raw(field.encode(x, averaged=False), w, averaged=False))
    print(f"largest difference {np.abs(predicted - found).max():.1e}")
    np.testing.assert_allclose(found, predicted, atol=2e-5)


def test_box_of_records_leaves_outliers_out_and_is_never_flat():
    points = np.random.default_rng(0).uniform(-1, 1, (10_000, 3))
    points[:, 2] = 0.5  # a flat scene
    points[0] = [1e6, np.nan, 0]
    points[1] = 1e6
    low, high = np.array(encoding.record_box(points, [0, 0, 0], [1, 1, 1]))
    assert (low < [-1, -1, 0.5]).all() and (high > [1, 1, 0.5]).all() and np.abs([low, high]).max() < 1.5
    assert (high - low)[2] == pytest.approx(1e-3 * 2, rel=0.02)


@pytest.mark.parametrize("low, high", [([0, 0, 0], [2, 4, 8]), ([1, 1, 1], [1, 1, 1]), ([np.inf] * 3, [-np.inf] * 3)])
def test_box_without_records_is_the_fallback_or_a_unit_box(low, high):
    for points in (np.empty((0, 3)), np.full((4, 3), np.nan)):
        a, b = np.array(encoding.record_box(points, low, high))
        assert np.isfinite([a, b]).all() and (b > a).all()
        Field(a, b, TINY)


# ---------------------------------------------------------------- learning


def test_gradients_are_finite_differences():
    field = make()
    x, w = places(256)

    def value():
        return dr.mean(dr.squared_norm(field.predict(x, w) - wave(x, w)))

    dr.backward(value())
    gradient = {k: np.array(field.optimizer[k].grad).astype(np.float64) for k in field.optimizer}
    rng = np.random.default_rng(0)
    for k in field.optimizer:
        start, tp = np.array(dr.detach(field.optimizer[k])), type(field.optimizer[k])
        # along the gradient: a random direction would drown in single precision
        along = gradient[k] / np.abs(gradient[k]).max() * rng.uniform(0.5, 1.5, start.shape)
        h = 2e-3
        sides = []
        for sign in (1, -1):
            field.optimizer[k] = tp((start + sign * h * along).astype("f4"))
            sides.append(float(value()[0]))
        field.optimizer[k] = tp(start)
        difference, expected = (sides[0] - sides[1]) / (2 * h), (gradient[k] * along).sum()
        print(f"{k}: {difference:.5f} against {expected:.5f}")
        assert difference == pytest.approx(expected, rel=0.02)


def test_loss_on_a_known_function_falls_by_a_factor_of_a_hundred():
    field = make(FieldShape())
    losses = train(field, 150, wave)
    print(f"loss {losses[0]:.4f} -> {np.mean(losses[-10:]):.5f}")
    assert np.mean(losses[-10:]) < losses[0] / 100
    # and the averaged copy, which is what answers, is no worse
    x, w = places(2048, seed=7)
    error = np.array(field.query(field.encode(x), w) - wave(x, w))
    assert (error**2).sum(axis=0).mean() < losses[0] / 100


def test_scale_multiplies_queries_and_nothing_else():
    fields = [make(scale=s) for s in (1.0, 2.0**20)]
    for field in fields:
        train(field, 5, wave)
    assert close(*fields)
    fields[1].restore(fields[0].snapshot())
    x, w = places(64)
    a, b = (np.array(f.query(f.encode(x), w)) for f in fields)
    assert np.array_equal(a * 2.0**20, b)


def test_average_without_decay_is_the_current_and_with_decay_one_is_frozen():
    field = make()
    train(field, 3, wave, decay=0.5)
    before = field.snapshot()
    train(field, 3, wave, decay=1.0, first=3)
    after = field.snapshot()
    assert all(np.array_equal(before[k], after[k]) for k in before if k.startswith("averaged"))
    assert not any(np.array_equal(before[k], after[k]) for k in before if k.startswith("current.grid"))
    train(field, 1, wave, decay=0.0, first=6)
    after = field.snapshot()
    assert all(np.array_equal(v, after[k.replace("current", "averaged")]) for k, v in after.items() if "current" in k)


def test_average_is_the_weighted_sum_of_its_past():
    field = make()
    expected = None
    for k, decay in enumerate((0.0, 0.5, 0.7, 0.9)):  # the first is 0: nothing of the initial weights remains
        train(field, 1, wave, decay=decay, first=k)
        current = field.snapshot()["current.grid"].astype(np.float64)
        expected = current if expected is None else decay * expected + (1 - decay) * current
    np.testing.assert_allclose(field.snapshot()["averaged.grid"], expected, atol=1e-7)


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_loss_that_is_not_finite_changes_nothing(bad):
    field, twin = make(), make()
    for f in (field, twin):
        train(f, 3, wave)
    before = field.snapshot()
    train(field, 1, lambda x, w: mi.Color3f(bad) + 0 * x.x, first=3)
    assert same(before, field.snapshot())
    for f in (field, twin):  # nor what the optimiser remembers
        train(f, 2, wave, first=4)
    assert close(twin, field)


def test_equal_seeds_give_equal_weights_and_others_do_not():
    fields = [make(seed=s) for s in (1, 1, 2)]
    for field in fields:
        train(field, 5, wave)
    a, b, c = fields
    assert close(a, b) and not close(a, c)


def test_reset_is_a_new_field_bit_for_bit():
    field, new = make(FieldShape(), seed=3), make(FieldShape(), seed=3)
    first = field.snapshot()
    assert same(first, new.snapshot())
    train(field, 4, wave)
    field.mean = mi.Float(7)
    assert not same(first, field.snapshot())
    field.reset()
    assert same(first, field.snapshot()) and field.steps == 0
    assert field.mean[0] == new.mean[0]
    for f in (field, new):
        train(f, 3, wave)
    assert close(field, new)


def test_restore_brings_weights_back_bit_for_bit():
    field = make()
    train(field, 3, wave)
    kept = field.snapshot()
    x, w = places(64)
    answer = np.array(field.query(field.encode(x), w))
    train(field, 3, wave, first=3)
    field.restore(kept)
    assert same(kept, field.snapshot())
    assert np.array_equal(answer, np.array(field.query(field.encode(x), w)))


def test_losses_are_their_formulas(rng):
    p, y = (rng.uniform(0, 2, (3, 32)).astype("f4") for _ in range(2))
    mean = rng.uniform(0, 2, 32).astype("f4")
    error = ((p - y) ** 2).sum(axis=0)
    found = loss.local_relative_l2(mi.Color3f(p), mi.Color3f(y), mi.Float(mean), 0.03)
    np.testing.assert_allclose(np.array(found), error / (mean**2 + 0.03), rtol=1e-4)
    found = loss.relative_l2(mi.Color3f(p), mi.Color3f(y), 0.03)
    np.testing.assert_allclose(np.array(found), error / (p.mean(axis=0) ** 2 + 0.03), rtol=1e-4)


# ---------------------------------------------------------------- bad input


@pytest.mark.parametrize("key, value", [
    ("n_levels", 0), ("n_features", 0), ("hashmap_size", 0), ("base_resolution", 0), ("width", 0), ("n_hidden", 0),
    ("n_outputs", 0), ("width", -4), ("per_level_scale", 1.0), ("direction_degree", -2), ("direction_degree", 8),
    ("hashmap_size", 33),
])  # fmt: skip
def test_impossible_shape_is_refused_by_name(key, value):
    with pytest.raises(ValueError, match=f"{key}.*{value}"):
        FieldShape(**{key: value})


@pytest.mark.parametrize("low, high", [
    ([0, 0, 0], [1, 0, 1]), ([0, 0, 0], [-1, 1, 1]), ([0, 0, np.nan], [1, 1, 1]), ([0, 0, 0], [1, np.inf, 1]),
])  # fmt: skip
def test_empty_box_is_refused(low, high):
    with pytest.raises(ValueError, match=r"the box .* is empty or not finite"):
        Field(low, high, TINY)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_impossible_scale_is_refused(scale):
    with pytest.raises(ValueError, match=r"scale is .*positive"):
        make(scale=scale)


# ---------------------------------------------------------------- files


@pytest.fixture
def saved(tmp_path):
    """A trained field and the file it was saved to."""
    field = make(scale=0.3, seed=5)
    train(field, 3, wave)
    field.steps, field.mean = 3, mi.Float(0.75)
    field.save(tmp_path / "cache.npz", scene="abc")
    return field, tmp_path / "cache.npz"


def test_file_gives_the_field_back_bit_for_bit(saved):
    field, file = saved
    loaded, header = Field.load(file)
    assert same(field.snapshot(), loaded.snapshot())
    assert loaded.shape == field.shape and loaded.box == field.box and loaded.seed == 5
    assert loaded.steps == 3 and loaded.mean[0] == 0.75 and loaded.scale[0] == field.scale[0]
    assert header["scene"] == "abc" and header["version"] == FILE_VERSION
    x, w = places(256)
    assert np.array_equal(*(np.array(f.query(f.encode(x), w)) for f in (field, loaded)))
    assert os.listdir(file.parent) == [file.name]


def test_any_file_name_is_kept(tmp_path):
    for name in ("no_suffix", "a.cache", "with space.npz"):
        make().save(tmp_path / name)
        Field.load(tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == ["a.cache", "no_suffix", "with space.npz"]


def refused(file) -> str:
    """The message with which `file` is refused; nothing is left open, nothing is warned of."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(CacheFileError) as error:
            Field.load(file)
    print(error.value)
    assert str(file) in str(error.value) and len(str(error.value)) < 600
    return str(error.value)


def test_missing_file_is_refused(tmp_path):
    assert "there is no cache file" in refused(tmp_path / "no.npz")
    assert "is not a cache file" in refused(tmp_path)  # a folder


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.999])
def test_truncated_file_is_refused(saved, share):
    _, file = saved
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    assert "is not a cache file of mi_neural, or is damaged" in refused(file)


def test_file_with_a_flipped_byte_is_refused_or_harmless(saved):
    field, file = saved
    data = file.read_bytes()
    rng = np.random.default_rng(0)
    n_refused = 0
    for position in rng.integers(0, len(data), 40):
        broken = bytearray(data)
        broken[position] ^= 0xFF
        file.write_bytes(broken)
        try:
            loaded, _ = Field.load(file)
            assert same(field.snapshot(), loaded.snapshot())  # a byte that carries nothing
        except CacheFileError:
            n_refused += 1
    assert n_refused >= 30


@pytest.mark.parametrize("content", [b"", b"hello", b"PK\x03\x04", b"\x89PNG\r\n", b"\x76\x2f\x31\x01" + bytes(100)])
def test_foreign_file_is_refused(tmp_path, content):
    file = tmp_path / "foreign.npz"
    file.write_bytes(content)
    assert "is not a cache file of mi_neural" in refused(file)


def test_numpy_files_that_are_not_ours_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    np.save(tmp_path / "b.npy", np.zeros(3))
    np.savez(tmp_path / "c.npz", header=np.frombuffer(b"[1, 2]", np.uint8))
    np.savez(tmp_path / "d.npz", header=np.frombuffer(b"\xff\xfe", np.uint8))
    for name in ("a.npz", "b.npy", "c.npz", "d.npz"):
        assert "is not a cache file of mi_neural" in refused(tmp_path / name)


def rewrite(file, change_header=lambda h: None, change_arrays=lambda a: None) -> None:
    """Write a cache file anew with another header or other arrays."""
    with np.load(file) as f:
        arrays = {k: f[k] for k in f.files}
    header = json.loads(bytes(arrays.pop("header")).decode())
    change_header(header)
    change_arrays(arrays)
    with open(file, "wb") as f:
        np.savez(f, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)


@pytest.mark.parametrize("version", [FILE_VERSION + 1, 0, None, "1"])
def test_file_of_another_version_says_so_and_what_to_do(saved, version):
    _, file = saved
    rewrite(file, lambda h: h.update(version=version))
    text = refused(file)
    assert "train and save it again" in text and str(FILE_VERSION) in text


@pytest.mark.parametrize("change", [
    {"scale": 0}, {"scale": "big"}, {"scale": float("nan")}, {"box": [[0, 0, 0], [0, 0, 0]]}, {"box": []},
    {"shape": {}}, {"shape": {"width": -1}}, {"shape": {"unknown": 1}}, {"seed": "x"}, {"steps": "many"}, {"steps": -5},
    {"mean": float("nan")}, {"mean": -1.0}, {"mean": None},
], ids=str)  # fmt: skip
def test_file_with_an_impossible_header_is_refused(saved, change):
    _, file = saved
    rewrite(file, lambda h: h.update(change))
    assert "is not a cache file of mi_neural, or is damaged" in refused(file)


@pytest.mark.parametrize("change", [
    lambda a: a.pop("current.grid"),
    lambda a: a.update(extra=np.zeros(2)),
    lambda a: a.update({"current.grid": a["current.grid"][:-2]}),
    lambda a: a.update({"averaged.grid": np.full_like(a["averaged.grid"], np.nan)}),
], ids=["missing", "extra", "short", "nan"])  # fmt: skip
def test_file_with_wrong_arrays_is_refused(saved, change):
    _, file = saved
    rewrite(file, change_arrays=change)
    assert "is not a cache file of mi_neural, or is damaged" in refused(file)


class _Bomb:
    """Unpickling it makes a file."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_pickles_are_refused_and_not_executed(saved, tmp_path):
    _, file = saved
    went_off = tmp_path / "went off"
    file.write_bytes(pickle.dumps(_Bomb(went_off)))
    refused(file)
    bomb = np.array([_Bomb(went_off)], dtype=object)
    np.savez(tmp_path / "b.npz", header=bomb)
    refused(tmp_path / "b.npz")
    make().save(tmp_path / "c.npz")
    rewrite(tmp_path / "c.npz", change_arrays=lambda a: a.update({"current.grid": bomb}))
    refused(tmp_path / "c.npz")
    assert not went_off.exists()


@pytest.mark.parametrize("where", ["savez", "replace"])
def test_failed_save_leaves_the_old_file_and_no_other(saved, full_disk, where):
    field, file = saved
    before = file.read_bytes()
    full_disk(where)
    with pytest.raises(OSError, match="disk full"):
        field.save(file)
    assert file.read_bytes() == before and os.listdir(file.parent) == [file.name]


def test_fields_of_equal_shape_exchange_weights():
    a, b = make(seed=1), make(seed=2)
    b.restore(a.snapshot())
    assert same(a.snapshot(), b.snapshot())
    assert dataclasses.replace(TINY) == a.shape
