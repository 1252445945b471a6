"""studies/media.py: its scenes, and how it judges images."""

import mitsuba as mi
import numpy as np
import pytest
from load_study import load_study


@pytest.fixture(scope="module")
def media():
    return load_study("media")


def test_scenes_are_lit_and_have_media(media, monkeypatch):
    monkeypatch.setattr(media, "SIZE", (16, 9))
    for name, case in media.CASES.items():
        scene = mi.load_dict({"type": "scene", **case.make()})
        integrator = mi.load_dict({"type": "plain_path"})
        image = np.array(mi.render(scene, integrator=integrator, spp=4, seed=1))
        assert image.shape == (9, 16, 3) and 0.05 < image.mean() < 2, name
        assert integrator.media is not None, name


def test_noise_of_references_does_not_count(media):
    """An image that is 10 % too bright has an error of 0.01/1.01, however noisy the references are. The bound is five
    standard errors of the mean."""
    rng, judge = np.random.default_rng(0), object.__new__(media.Judge)
    judge.references = 1 + rng.normal(0, 0.5, (2, 180, 320, 3))
    judge.scale = np.full((180, 320, 3), 1.01)
    error, deviation = judge.error(np.full((180, 320, 3), 1.1))
    assert deviation < 1e-3
    assert abs(error - 0.01 / 1.01) < 5 * deviation
