"""Cache files hold all that training changes, and what is not a whole one of ours is refused.

"As if never interrupted": equal up to the order of summation, which is not fixed from step to step.
"""

import json
import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from test_incident import load

from mi_neural.caches import files
from mi_neural.caches.files import CacheFileError
from mi_neural.caches.incident import IncidentCache, Training
from mi_neural.caches.outgoing import OutgoingCache, OutgoingTraining
from mi_neural.caches.outgoing_field import OutgoingShape
from mi_neural.caches.reliability import Reliability
from mi_neural.caches.weights import FieldShape

TINY = {"n_levels": 4, "hashmap_size": 2**10, "width": 16}
#: The same, as keys of integrators.
SMALL = {"train_samples": 256, "levels": 4, "hashmap_size": 1024, "width": 16}


@pytest.fixture(scope="module")
def cube():
    return load("lit_cube", 8)


def incident(**keys):
    return IncidentCache(Training(n_paths=256), FieldShape(**TINY), **keys)


def blended():
    """The grid of reliability begins to answer after four steps."""
    return incident(blend="reliability", reliability=Reliability(warm_up=4, n_entries=1024))


def outgoing():
    return OutgoingCache(OutgoingTraining(n_paths=256), OutgoingShape(**TINY))


CACHES = {"incident": incident, "incident, blended": blended, "outgoing": outgoing}


def through_a_file(cache, make, path):
    """A new cache that goes on from a file of another."""
    cache.save(path)
    new = make()
    new.resume(*new.read(path))
    return new


def assert_alike(a: dict, b: dict, rtol=2e-3) -> None:
    assert a.keys() == b.keys()
    for name in a:
        size = np.abs(np.nan_to_num(a[name])).max(initial=0)
        np.testing.assert_allclose(a[name], b[name], rtol=rtol, atol=rtol * size, err_msg=name)


def whole(cache) -> dict:
    grid = getattr(cache.queried, "grid", None)
    return cache.field.arrays() | (grid.arrays() if grid is not None else {})


@pytest.fixture
def one_thread():
    """Sums of records are then in the same order each time."""
    n = dr.thread_count()
    dr.set_thread_count(1)
    yield
    dr.set_thread_count(n)


@pytest.mark.parametrize("kind", CACHES)
def test_training_goes_on_from_a_file_as_if_never_interrupted(kind, cube, tmp_path, one_thread):
    cache = CACHES[kind]()
    cache.train(*cube, frames=8)
    cache.rate_factor = 0.5
    new = through_a_file(cache, CACHES[kind], tmp_path / "a.npz")
    for name, value in whole(cache).items():  # bit for bit
        assert np.array_equal(value, whole(new)[name], equal_nan=True), name
    assert new.steps == 8 and new.rate_factor == 0.5 and new.history == cache.history and new.levels == cache.levels
    assert new.field.scalars() == cache.field.scalars()

    for c in (cache, new):
        c.train(*cube, frames=3)
    assert_alike(whole(cache), whole(new))
    np.testing.assert_allclose(cache.history, new.history, rtol=1e-3)


def test_without_the_moments_training_would_go_on_otherwise(cube, tmp_path):
    """The test above would see it."""
    cache = incident()
    cache.train(*cube, frames=8)
    new = through_a_file(cache, incident, tmp_path / "a.npz")
    new.field.restore(new.field.snapshot())  # the moments start anew
    for c in (cache, new):
        c.train(*cube, frames=3)
    with pytest.raises(AssertionError):
        assert_alike(whole(cache), whole(new))


def test_integrators_that_only_prepared_train_as_those_that_did_not(cube, one_thread):
    scene, _ = cube
    fields = []
    for prepares in (False, True):
        nirc = mi.load_dict({"type": "nirc", **SMALL})
        nirc.train(scene, 8)
        if prepares:
            nirc.prepare(scene, spp=2)
        nirc.train(scene, 3)
        fields.append(nirc.cache.field.arrays())
    for name, value in fields[0].items():  # bit for bit
        assert np.array_equal(value, fields[1][name], equal_nan=True), name


def test_statistics_of_another_reliability_are_left_out(cube, tmp_path):
    cache = blended()
    cache.train(*cube, frames=8)
    cache.save(tmp_path / "a.npz")

    def other():
        return incident(blend="reliability", reliability=Reliability(measure="correlation", warm_up=4, n_entries=1024))

    new = other()
    new.resume(*new.read(tmp_path / "a.npz"))
    assert new.steps == 8 and int(new.queried.grid.updates[0]) == 0
    plain = incident()
    plain.resume(*plain.read(tmp_path / "a.npz"))
    assert plain.queried is plain.field


def small_nirc():
    return mi.load_dict({"type": "nirc", "blend": "reliability", **SMALL})


@pytest.fixture(scope="module")
def saved(cube, tmp_path_factory):
    """The file of a cache after two training steps."""
    nirc, path = small_nirc(), tmp_path_factory.mktemp("saved") / "a.npz"
    nirc.train(cube[0], 2)
    nirc.save_cache(path)
    return path


@pytest.fixture(scope="module")
def loading():
    """What loads the files. One for all of them, as it is recorded once."""
    return small_nirc()


@pytest.mark.parametrize("change", [
    lambda h, a: h.pop("training"), lambda h, a: h["training"].update(rate_factor=0),
    lambda h, a: h["training"].update(history="long"), lambda h, a: h["training"].update(levels=[None]),
    lambda h, a: a.pop("extra.sigma"), lambda h, a: a.update({"extra.sigma": np.zeros(3, np.float32)}),
    lambda h, a: a.pop("first.grid"), lambda h, a: a.update({"second.grid": np.zeros(5, np.float32)}),
    lambda h, a: a.update({"adam_steps.grid": np.array([-1])}), lambda h, a: h.update(mean="much"),
    lambda h, a: h["shape"].update(hashmap_size=2**40), lambda h, a: h["shape"].update(width=10**6),
    lambda h, a: a.update(beside=np.zeros(1)),
])  # fmt: skip
def test_damaged_state_is_refused_and_nothing_is_half_loaded(cube, saved, loading, tmp_path, change):
    scene, _ = cube
    header, arrays = files.read(saved, "incident")
    change(header, arrays)
    files.write(tmp_path / "b.npz", "incident", header, arrays)
    new = loading
    new.reset()
    new.train(scene, 1)
    field = new.cache.field
    with pytest.raises(CacheFileError, match=r"b\.npz"):
        new.load_cache(tmp_path / "b.npz", scene)
    assert new.cache.steps == 1 and new.cache.field is field and len(new.cache.history) == 1
    new.load_cache(saved, scene)
    assert new.cache.steps == 2


# ---------------------------------------------------------------- files


@pytest.fixture(scope="module")
def small_file(tmp_path_factory):
    """A small file, and what is in it."""
    path = tmp_path_factory.mktemp("files") / "a.npz"
    arrays = {"a": np.arange(60, dtype=np.float32), "b": np.ones((3, 4), np.float32)}
    files.write(path, "incident", {"steps": 3}, arrays)
    return path.read_bytes(), arrays


def assert_refused_or_whole(path, arrays) -> bool:
    """Whether a file is refused, in one way; one that is not has everything that was written."""
    try:
        header, found = files.read(path, "incident")
    except CacheFileError as error:
        assert str(path) in str(error)
        return True
    assert header["steps"] == 3 and found.keys() == arrays.keys()
    assert all(np.array_equal(found[k], arrays[k]) for k in arrays)
    return False


def test_file_cut_anywhere_is_refused(small_file, tmp_path):
    data, arrays = small_file
    for k in range(50):
        (tmp_path / "cut.npz").write_bytes(data[: k * len(data) // 50])
        assert assert_refused_or_whole(tmp_path / "cut.npz", arrays), f"{k}/50"


def test_file_with_any_byte_changed_is_refused_or_means_the_same(small_file, tmp_path, rng):
    data, arrays = small_file
    refused = 0
    for position in range(len(data)):
        broken = bytearray(data)
        broken[position] ^= int(rng.integers(1, 256))
        (tmp_path / "flipped.npz").write_bytes(broken)
        refused += assert_refused_or_whole(tmp_path / "flipped.npz", arrays)
    print(f"{refused} of {len(data)} refused")
    assert refused > 0.7 * len(data)


def test_files_of_noise_are_refused(small_file, tmp_path, rng):
    data, arrays = small_file
    for k in range(200):
        noise = bytearray(data)
        at = rng.integers(0, len(data), 1 + k % 20)
        noise[: len(at)] = bytes(rng.integers(0, 256, len(at), dtype=np.uint8))
        (tmp_path / "noise.npz").write_bytes(bytes(rng.integers(0, 256, 500, dtype=np.uint8)) if k % 2 else noise)
        assert_refused_or_whole(tmp_path / "noise.npz", arrays)


def test_file_that_would_fill_the_memory_is_refused_unread(tmp_path, monkeypatch):
    files.write(tmp_path / "a.npz", "incident", {}, {"a": np.zeros(1000)})
    monkeypatch.setattr(files, "LARGEST", 4000)
    with pytest.raises(CacheFileError, match="bytes of memory"):
        files.read(tmp_path / "a.npz", "incident")


def test_numbers_that_are_not_finite_are_refused_unless_they_mean_unknown(tmp_path):
    files.write(tmp_path / "a.npz", "incident", {}, {"a": np.array([1.0, np.nan])})
    with pytest.raises(CacheFileError, match="not finite"):
        files.read(tmp_path / "a.npz", "incident")
    assert np.isnan(files.read(tmp_path / "a.npz", "incident", unknown=("a",))[1]["a"][1])


def test_header_is_read_as_data(tmp_path):
    """JSON cannot hold code; text that looks like it stays text."""
    text = "__import__('os').mkdir('/nowhere')"
    files.write(tmp_path / "a.npz", "incident", {"fact": text}, {})
    assert files.read(tmp_path / "a.npz", "incident")[0]["fact"] == text


def test_whole_cache_of_an_integrator_is_written_or_none(cube, tmp_path, monkeypatch):
    scene, _ = cube
    nirc = mi.load_dict({"type": "nirc", **SMALL})
    nirc.train(scene, 1)
    nirc.save_cache(tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    nirc.train(scene, 1)
    with pytest.raises(OSError, match="No space"):
        nirc.save_cache(tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before and os.listdir(tmp_path) == ["a.npz"]


def test_cache_is_written_through_a_link(tmp_path):
    files.write(tmp_path / "a.npz", "fake", {}, {"x": np.ones(3)})
    (tmp_path / "link.npz").symlink_to("a.npz")
    files.write(tmp_path / "link.npz", "fake", {}, {"x": np.zeros(3)})
    assert (files.read(tmp_path / "a.npz", "fake")[1]["x"] == 0).all() and (tmp_path / "link.npz").is_symlink()


def test_facts_in_the_header_are_those_of_the_integrator(cube, tmp_path):
    scene, _ = cube
    nrc = mi.load_dict({"type": "nrc", **SMALL})
    with dr.suspend_grad():
        nrc.train(scene, 2)
    nrc.save_cache(tmp_path / "a.npz")
    header, _ = files.read(tmp_path / "a.npz", "outgoing", ("beside.places.position",))
    assert header["plugin"] == "nrc" and header["steps"] == 2 and header["scene"] == nrc.state.signature
    assert json.dumps(header["statistics"])
