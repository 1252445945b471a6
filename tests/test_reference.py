"""References: rendered, continued, found, averaged, refused; what an error against one of them is."""

import os
from types import SimpleNamespace

import numpy as np
import pytest
from test_denoise import has_denoiser

from mi_neural.bench import benchmark, denoise, judging, load, reference, terminal
from mi_neural.bench.specs import parse_integrator
from mi_neural.image import exr, metrics

SIZE = (16, 12)


@pytest.fixture
def loaded() -> load.LoadedScene:
    return load.load_scene("cornell_box", SIZE)


def test_reference_of_a_scene_with_media_is_that_of_volpath(loaded, tmp_path):
    from dataclasses import replace

    from media_scenes import cube, fog, room

    foggy = replace(loaded, scene=room(box=cube(fog())))
    assert reference.reference_path(foggy, tmp_path) != reference.reference_path(loaded, tmp_path)
    assert reference.render_reference(foggy, 1, tmp_path).metadata["integrator"] == "volpath"


def test_reference_is_kept_continued_and_found_again(loaded, tmp_path):
    size = reference.pass_spp(loaded.scene)
    first = reference.render_reference(loaded, 4 * size, tmp_path)
    more = reference.render_reference(loaded, 8 * size, tmp_path)
    again = reference.render_reference(loaded, 2 * size, tmp_path)
    assert first.path == more.path and np.array_equal(again.rgb, more.rgb)
    assert [int(r.metadata["spp"]) for r in (first, more, again)] == [4 * size, 8 * size, 8 * size]

    # As if it had been rendered at once
    (whole := tmp_path / "whole").mkdir()
    at_once = reference.render_reference(loaded, 8 * size, whole)
    assert np.allclose(at_once.rgb, more.rgb, rtol=1e-3, atol=1e-5)
    assert np.allclose(at_once.variance, more.variance, rtol=1e-2, atol=1e-7)
    assert 0.0 < more.noise_floor() < first.noise_floor()


def test_variance_of_a_reference_is_that_of_its_mean(tmp_path):
    loaded = load.load_scene("cornell_box", SIZE, integrator_keys={"max_depth": 2})  # direct light: no fireflies
    found = reference.render_reference(loaded, 8 * reference.pass_spp(loaded.scene), tmp_path)
    (tmp_path / "other").mkdir()
    other = reference.render_reference(loaded, 8 * reference.pass_spp(loaded.scene), tmp_path / "other", seed=1)
    squared, variance = (found.rgb - other.rgb) ** 2, found.variance + other.variance
    # 7 degrees of freedom each: E chi^2_1 / (chi^2_14 / 14) = 14 / 12
    lit = variance > 0.0
    assert (squared[lit] / variance[lit]).mean() == pytest.approx(14 / 12, rel=0.25)


def test_pixel_that_is_no_number_in_a_pass_of_a_reference_is_left_out_of_that_pass(rng):
    passes = list(rng.uniform(1, 2, (5, 1, 2, 3)))
    known = np.mean(passes[1:], axis=0), np.var(passes[1:], axis=0, ddof=1) / 4
    moments = reference._Moments()
    for k, image in enumerate(passes):
        moments.add(np.where((k == 0) & (np.arange(2) == 0)[:, None], np.nan, image))
    np.testing.assert_allclose(moments.mean[:, :1], known[0][:, :1])
    np.testing.assert_allclose(moments.variance()[:, :1], known[1][:, :1])
    np.testing.assert_allclose(moments.mean[:, 1], np.mean(passes, axis=0)[:, 1])
    np.testing.assert_allclose(moments.variance()[:, 1], (np.var(passes, axis=0, ddof=1) / 5)[:, 1])


def test_interrupted_reference_keeps_its_passes(loaded, tmp_path):
    size = reference.pass_spp(loaded.scene)

    def stop(done, total):
        if done == 3 * size:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reference.render_reference(loaded, 8 * size, tmp_path, stop)
    kept = reference.load_reference(reference.reference_path(loaded, tmp_path))
    assert int(kept.metadata["spp"]) == 3 * size


def test_reference_beside_a_scene_is_found(tmp_path):
    for name in ("reference_8x4.exr", "sun_reference_8x4.exr"):
        exr.write(tmp_path / name, np.ones((4, 8, 3)))
    assert reference.beside(tmp_path / "scene.xml", (8, 4)) == tmp_path / "reference_8x4.exr"
    assert reference.beside(tmp_path / "sun.xml", (8, 4)) == tmp_path / "sun_reference_8x4.exr"
    assert reference.beside(tmp_path / "moon.xml", (8, 4)) is reference.beside(tmp_path / "sun.xml", (4, 8)) is None


def test_reference_of_another_scale_is_found_beside_a_scene(tmp_path):
    for name in ("reference_16x8.exr", "reference_4x2.exr", "reference_32x16.exr", "reference_8x5.exr"):
        exr.write(tmp_path / name, np.ones((2, 4, 3)))
    scene = tmp_path / "scene.xml"
    assert reference.beside(scene, (8, 4)) is None
    assert reference.beside(scene, (8, 4), scaled=True).name == "reference_16x8.exr"
    assert reference.beside(scene, (64, 32), scaled=True).name == "reference_32x16.exr"
    assert reference.beside(scene, (6, 3), scaled=True) is None


def test_larger_reference_is_averaged_with_its_noise(tmp_path):
    values = np.random.default_rng(1).random((4, 6, 3))
    variance = np.random.default_rng(2).random((4, 6, 3))
    exr.write(tmp_path / "r.exr", values, exr.layer_channels("variance", variance))
    found = reference.load_reference(tmp_path / "r.exr", (3, 2), scaled=True)
    assert found.rgb[1, 2] == pytest.approx(values[2:4, 4:6].mean(axis=(0, 1)), rel=1e-3)
    assert found.variance[1, 2] == pytest.approx(variance[2:4, 4:6].sum(axis=(0, 1)) / 16, rel=1e-3)
    assert reference.scale_note(found, (3, 2)) == "Each pixel of the reference is a mean of 2x2 in r.exr."
    with pytest.raises(load.InputError, match=r"6x4.*3x2.*box filter"):
        reference.load_reference(tmp_path / "r.exr", (3, 2))


def test_errors_against_a_smaller_reference_are_those_of_block_means():
    rng = np.random.default_rng(3)
    small = rng.random((4, 6, 3))
    noise = rng.normal(0.0, 0.3, (8, 12, 3))
    noise -= np.repeat(np.repeat(metrics.block_means(noise, (4, 6)), 2, axis=0), 2, axis=1)
    image = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1) + noise  # right on average over every 2x2
    row = SimpleNamespace()
    known = reference.Reference(small.astype(np.float32), None, {}, None)
    flip_map = judging.judge(row, [image], known)
    assert row.relmse < 1e-9 and row.flip < 1e-3 and flip_map.shape == (4, 6)
    with pytest.raises(ValueError, match="no whole blocks"):
        judging.judge(row, [image[:, :11]], known)


def test_noise_of_the_reference_is_no_part_of_flip_against_the_denoised_one():
    if not has_denoiser():
        pytest.skip("Open Image Denoise is not installed")
    image = np.full((24, 32, 3), 0.5, np.float32)
    noise = np.random.default_rng(4).normal(0.0, 0.1, image.shape).astype(np.float32)
    guides = denoise.Guides(image, np.zeros_like(image), clean=True)
    known = reference.Reference(image + noise, None, {}, None)
    row = SimpleNamespace()
    judging.judge(row, [image], known)
    assert row.flip > 0.1 and not hasattr(row, "flip_clean")
    judging.judge(row, [image], denoise.cleaned(known, guides))
    assert row.flip > 0.1 and row.flip_clean < 0.5 * row.flip
    smaller = reference.Reference(known.rgb[::2, ::2], None, {}, None)
    assert denoise.cleaned(smaller, guides).clean is None


def test_references_have_a_place_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert reference.cache_folder() == tmp_path / "mi_neural" / "references"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    if os.name != "nt":
        assert reference.cache_folder() == tmp_path / "home" / ".cache" / "mi_neural" / "references"


def test_standard_error_of_a_reference_is_relative():
    known = reference.Reference(np.full((4, 4, 3), 2.0), np.full((4, 4, 3), 0.04), {}, None)
    assert known.standard_error() == pytest.approx(0.1, rel=0.01)  # 0.2 of 2
    assert reference.Reference(known.rgb, None, {}, None).standard_error() is None


def test_unusable_references_are_refused(tmp_path):
    file = tmp_path / "r.exr"
    with pytest.raises(load.InputError, match="no reference"):
        reference.load_reference(file)
    exr.write(file, np.ones((4, 6, 3)))
    assert reference.load_reference(file, (6, 4)).variance is None
    with pytest.raises(load.InputError, match=r"6x4.*8x4.*--size 6x4"):
        reference.load_reference(file, (8, 4))
    exr.write(file, np.full((4, 6, 3), np.nan))
    with pytest.raises(load.InputError, match="24 non-finite"):
        reference.load_reference(file)


def test_another_depth_is_noticed():
    def with_depth(depth):
        return reference.Reference(np.ones((1, 1, 3)), None, {"max_depth": depth}, None)

    assert "max_depth=64" in reference.depth_warning(with_depth("64"), 12)
    assert reference.depth_warning(with_depth("12"), 12) is None
    assert reference.depth_warning(with_depth("-1"), 4294967295) is None
    assert reference.depth_warning(reference.Reference(np.ones((1, 1, 3)), None, {}, None), 12) is None
    assert "-D max_depth=2" in reference.depth_warning(with_depth("64"), 64, direct_only=True)
    assert reference.depth_warning(with_depth("2"), 2, direct_only=True) is None


@pytest.mark.parametrize("name", ["nvc_direct", "restir_di"])
def test_reference_that_holds_more_than_direct_light_is_noticed(name):
    loaded = load.load_scene("cornell_box", (8, 6), {"max_depth": "64"})
    (case,) = benchmark.make_cases(loaded, [parse_integrator(name)])
    made = reference.Reference(np.ones((6, 8, 3)), None, {"max_depth": "64"}, None)
    (note,) = terminal.depth_notes(made, loaded, [case])
    assert note.startswith(f"{name}: it renders light reflected once")
    (case,) = benchmark.make_cases(loaded, [parse_integrator("path")])
    assert not terminal.depth_notes(made, loaded, [case])
