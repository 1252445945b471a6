"""A cache of one's own in place of the network: `use_cache`, `ArrayField`, `make_field` and `learn`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_neural import scenes
from mi_neural.caches.arrays import ArrayField
from mi_neural.caches.field import CacheFileError
from mi_neural.caches.incident import IncidentCache, Training
from mi_neural.caches.outgoing import OutgoingCache


class MeanField(ArrayField):
    """One number for all places and directions: the running mean of the targets; `shape` is not used."""

    KIND = "mean"
    ARRAYS = ("total", "weight")

    def zeros(self):
        return {"total": dr.zeros(mi.Float, 3), "weight": dr.zeros(mi.Float, 1)}

    def encode(self, x, n=None):
        return [dr.zeros(mi.Float, dr.width(x))]

    def query(self, features, w):
        i = mi.UInt32(0) + dr.zeros(mi.UInt32, dr.width(w))
        total = mi.Color3f(*(dr.gather(mi.Float, self.total, i + c) for c in range(3)))
        return total / dr.maximum(dr.gather(mi.Float, self.weight, i), 1)


class MeanCache(IncidentCache):
    FIELD = MeanField

    def __init__(self):
        super().__init__(Training(n_paths=256), shape=1)

    def make_field(self, low, high, scale):
        return MeanField(low, high, self.shape, scale=scale)

    def learn(self, field, records, seed, learning_rate, decay):
        with dr.suspend_grad():
            n = dr.count(records.valid)
            sums = [dr.sum(dr.select(records.valid, records.target[c], 0)) for c in range(3)]
            field.total = field.total + dr.concat(sums)
            field.weight = field.weight + mi.Float(n)
            dr.eval(field)
        return mi.Float(0), mi.Float(1), mi.Float(1)


KEYS = {"type": "nirc", "train_frames": 8, "train_steps": 0, "light_samples": 1}


@pytest.fixture(scope="module")
def sphere():
    return mi.load_file(str(scenes.path("point_lit_sphere")), resx=8, resy=8)


@pytest.fixture(scope="module")
def nirc(sphere):
    made = mi.load_dict(KEYS)
    made.use_cache(MeanCache())
    made.train(sphere, 8)
    return made


def test_nirc_renders_with_it(sphere, nirc):
    """In the sphere 1 arrives everywhere from all sides, so that one number is an exact cache; paths of eight vertices
    find all of it but 2^-7 from the start."""
    image = np.array(mi.render(sphere, integrator=nirc, spp=16))
    assert image.mean() == pytest.approx(1.0, abs=0.02)
    facts = nirc.statistics()
    assert facts["steps"] == 8 and facts["records"] > 0 and facts["parameters"] == 4 and facts["recoveries"] == 0


def test_it_is_recorded_once(sphere, nirc):
    """The training step is frozen as the network's is: once recorded, which takes up to three goes, it is replayed."""
    nirc.train(sphere, 3)
    before = nirc.cache.recordings()["frame"]
    nirc.train(sphere, 4)
    assert nirc.cache.recordings()["frame"] == before <= 3


def test_its_files_are_its_own(sphere, nirc, tmp_path):
    file = tmp_path / "mean.npz"
    nirc.save_cache(file)
    again = mi.load_dict(KEYS)
    with pytest.raises(CacheFileError, match="incident"):
        again.load_cache(file, sphere)
    again.use_cache(MeanCache())
    again.load_cache(file, sphere)
    assert again.cache.steps == nirc.cache.steps
    for name in MeanField.ARRAYS:
        assert np.array_equal(np.array(getattr(again.cache.field, name)), np.array(getattr(nirc.cache.field, name)))


def test_reset_forgets(sphere):
    made = mi.load_dict(KEYS)
    made.use_cache(MeanCache())
    made.train(sphere, 2)
    state = made.cache.checkpoint()
    made.train(sphere, 2)
    made.cache.rollback(state)
    assert made.cache.steps == 2
    made.cache.field.reset()
    assert not np.array(made.cache.field.total).any()


@pytest.mark.parametrize("wrong", [OutgoingCache, dict])
def test_what_it_cannot_ask_is_refused(wrong):
    with pytest.raises(ValueError, match=f"takes an IncidentCache.*{wrong.__name__}"):
        mi.load_dict(KEYS).use_cache(wrong())


def test_what_is_missing_is_named():
    with pytest.raises(NotImplementedError, match="zeros"):
        ArrayField([0, 0, 0], [1, 1, 1])
