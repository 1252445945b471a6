"""`studies/frame_profile.py`: parts add up, rates are those of what was computed, the first image is there before the
last; and previews while a cache trains."""

import mitsuba as mi
import numpy as np
import pytest
from load_study import load_study

from mi_neural.bench import budget, load

profile = load_study("frame_profile")

SMALL = {"type": "nirc", "levels": 2, "hashmap_size": 256, "width": 8, "train_samples": 128, "train_vertices": 4}


@pytest.fixture(scope="module")
def found():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(profile, "BATCH", 2**10)
        patch.setattr(profile, "SQUARE", 64)
        patch.setattr(profile, "FRAMES", 3)
        scene = load.load_scene("cornell_box", (16, 16), {}).scene
        return profile.profile(scene, mi.load_dict({**SMALL, "max_depth": 6}), spp=1, frames=2)


def test_parts_of_a_frame_and_of_training_add_up(found):
    frame, training = dict(found["frame"]), dict(found["training"])
    total = frame.pop("total")
    assert sum(v for k, v in frame.items() if k != "spp" and v is not None) == pytest.approx(total, rel=0.01)
    parts = [training[k] for k in ("records", "network", "products", "optimiser")]
    assert all(p > 0 for p in parts)
    assert training["n_records"] == 128 * 3
    assert 0 < training["n_valid"] <= training["n_records"]
    assert 0 < training["us_per_record_step"] < training["us_per_record"]


def test_shares_are_of_the_peak(found):
    network = found["network"]
    inputs, width = 2 * 2 + 16, 8
    macs = inputs * width + width * width + width * 3
    assert network["gflops"] == pytest.approx(2 * macs / network["ns"])
    peak = max(network["blas_square_gflops"], network["blas_same_shape_gflops"])
    assert network["share_of_peak"] == pytest.approx(network["gflops"] / peak)


def test_table_shows_every_part(found):
    shown = {name.strip() for name, _ in profile.table(found)}
    assert {"frame", "train", "trace", "film", "python", "query", "MLP alone", "training frame", "a record"} <= shown


def test_flops_are_counted_from_the_time_of_a_product():
    start = budget.clock()
    rate = profile.blas_flops(128, 64, 32)
    spent = budget.clock() - start
    assert rate > 2 * 128 * 64 * 32 / spent  # one of its eight products took less than all of them


def test_preview_in_the_middle_of_training_changes_nothing():
    scene = load.load_scene("cornell_box", (16, 16), {}).scene
    images, previews = [], []
    for asks in (False, True):
        integrator = mi.load_dict({**SMALL, "max_depth": 6, "train_frames": 6})

        def look(done, total, integrator=integrator):
            previews.append(budget.preview(scene, integrator))

        integrator.train_first(scene, progress=look if asks else None)
        images.append(budget.render_samples(scene, integrator, 2).rgb)
        assert integrator.statistics()["steps"] == 6 + 1 and integrator.statistics()["images"] == 1
    assert len(previews) == 6 and all(p.spp == 1 and p.interrupted and p.rgb.mean() > 0 for p in previews)
    np.testing.assert_allclose(images[1], images[0], rtol=1e-3, atol=1e-4)


def test_integrators_that_learn_nothing_have_no_preview():
    assert budget.preview(None, mi.load_dict({"type": "path"})) is None


@pytest.mark.slow
def test_first_image_is_on_disk_before_training_ends():
    times = profile.first_image("cornell_box", "nirc", ["--size", "64x64"])
    for name in ("cold", "warm"):
        assert 0 < times[name]["first"] < times[name]["done"]
    assert times["warm"]["compile"] < times["cold"]["compile"]
