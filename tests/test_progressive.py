"""``mode="progressive"``: the biased image first, which tends to the unbiased one."""

import math

import mitsuba as mi
import numpy as np
import pytest
from expectation import renders
from two_level_bench import SLOW, Bench, channels_of, render, two_level


@pytest.fixture(scope="module")
def bench():
    return Bench()


@pytest.fixture(scope="module")
def box(bench):
    return bench.scene("cornell_box")


@pytest.fixture(scope="module")
def sphere(bench):
    return bench.scene("point_lit_sphere")


@pytest.fixture(scope="module")
def poor(bench, box):
    """A `progressive` integrator whose cache is untrained, far from right, and one of the unbiased samples alone."""
    pair = two_level(mode="progressive", freeze_cache=True), two_level(freeze_cache=True)
    for integrator in pair:
        render(box, integrator, 2)
    return pair


def block_error(image, known) -> float:
    """Root mean square of the relative errors of 64 blocks."""
    def blocks(i):
        return i.reshape(8, 2, 8, 2, 3).mean(axis=(1, 3, 4))

    return float(np.sqrt(np.mean((blocks(image) / blocks(known) - 1) ** 2)))


def test_progressive_tends_to_the_unbiased_image(bench, box, poor):
    """Although its cache is wrong it comes as near to `path` as the unbiased half of its samples, but for what the
    correction holds back, which is of the size of the noise."""
    progressive, unbiased = poor
    known = bench.reference("cornell_box").mean(axis=0)
    errors = {}
    for spp in (16, 128, 1024):
        errors[spp] = [np.mean([block_error(render(box, i, n, 40 + k), known) for k in range(4)])
                       for i, n in ((progressive, spp), (unbiased, spp // 2))]  # fmt: skip
        print(f"{spp} samples: error of 64 blocks {errors[spp][0]:.4f}; of the unbiased half {errors[spp][1]:.4f}")
    assert errors[1024][0] < 0.6 * errors[128][0] < 0.36 * errors[16][0]
    for spp in (128, 1024):
        assert errors[spp][0] < 1.5 * errors[spp][1]


@SLOW
def test_mean_of_progressive_is_that_of_path_with_many_samples(bench, box, poor):
    """By a z-test; what the correction leaves of a bias may be a standard deviation of one image's noise."""
    ours = renders(box, poor[0], 16, 256, first_seed=70)
    known = bench.reference("cornell_box")
    noise = ours.mean(axis=(1, 2, 3)).std(ddof=1) / known.mean()
    off = ours.mean() / known.mean() - 1
    error = math.hypot(noise / 4, known.mean(axis=(1, 2, 3)).std(ddof=1) / 8 / known.mean())
    print(f"off by {off:+.2e}, noise of one image {noise:.1e}")
    assert abs(off) < noise + 4 * error


def test_every_channel_is_there_in_an_image_of_one_sample(box):
    integrator = two_level(mode="progressive", channels=",".join(mi.load_dict({"type": "nirc_two_level"}).CHANNELS),
                           train_frames=2)  # fmt: skip
    for spp in (1, 16):
        image = np.array(integrator.render(box, spp=spp))
        assert image.shape[2] == 3 + len(integrator.aov_names()) and np.isfinite(image).all()
    assert integrator.statistics()["queries"] > 0


def test_one_sample_gives_an_image(box, poor):
    for spp in (1, 2, 3):
        image = render(box, poor[0], spp)
        mixed = poor[0].mixed
        assert image.mean() > 0 and mixed.n_biased + mixed.n_unbiased == spp and mixed.n_biased >= 1


@SLOW
def test_recordings_of_another_scene_are_not_kept(box, sphere):
    integrator = two_level(mode="progressive", train_frames=2)
    for scene in (box, sphere, box):
        render(scene, integrator, 4)
        assert len(integrator.mixed.nirc.film_state.passes.recorded) == 1 and integrator.mixed.n_biased == 4
        assert integrator.cache.steps == 2


def test_calls_of_one_image_are_one_image(bench, box, poor):
    """Between plan_samples(n) and plan_samples(None) each call shows all samples so far; then a new image begins."""
    integrator, known = poor[0], bench.reference("cornell_box").mean(axis=0)
    assert integrator.cumulative and not poor[1].cumulative
    integrator.plan_samples(256)
    errors = []
    for k in range(16):
        errors.append(block_error(render(box, integrator, 16, 300 + k), known))
        assert integrator.mixed.n_biased + integrator.mixed.n_unbiased == 16 * (k + 1)
    integrator.plan_samples(None)
    assert integrator.mixed.n_biased == 0
    whole = np.mean([block_error(render(box, integrator, 256, 400 + k), known) for k in range(4)])
    print(f"error after 16 samples {errors[0]:.4f}, after 256 in calls {errors[-1]:.4f}, in one call {whole:.4f}")
    assert errors[-1] < 0.6 * errors[0] and errors[-1] < 2 * whole
    render(box, integrator, 4)
    assert integrator.mixed.n_biased + integrator.mixed.n_unbiased == 4


@SLOW
def test_progressive_shows_the_channels_of_its_unbiased_part(box):
    integrator = two_level(mode="progressive", channels="cache,residual,alpha,variance_indirect", train_frames=20)
    image = channels_of(integrator, render(box, integrator, 32))
    assert (image["variance_indirect"] >= 0).all() and image["variance_indirect"].mean() > 0
    assert image["alpha"].min() >= 0 and image["alpha"].max() <= 1 and image["cache"].mean() > 0
