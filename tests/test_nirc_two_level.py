"""``nirc_two_level`` is unbiased for any cache: trained, untrained, nonsense or broken, the mean is that of `path`.

The z-tests compare at least 64 independent images each with as many of Mitsuba's `path`, as a whole and in 16 blocks,
corrected for the number of all of them: one correct integrator in 10,000 fails any. Each prints the smallest bias that
it could have seen. The four numbers that divide a camera sample are variables, so one kernel serves all divisions.
"""

import importlib
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from expectation import assert_same_mean, renders
from two_level_bench import (
    CACHES,
    GIVEN,
    N_RENDERS,
    N_TESTS,
    SLOW,
    SMALL,
    SPP,
    Bench,
    channels_of,
    chosen,
    fill,
    render,
    split_of,
    two_level,
)

from mi_neural.caches.field import CacheFileError, Field
from mi_neural.estimators import two_level as transport


@pytest.fixture(scope="module")
def bench():
    return Bench()


@pytest.fixture(scope="module")
def sphere(bench):
    return bench.scene("point_lit_sphere")


@pytest.fixture(scope="module")
def box(bench):
    return bench.scene("cornell_box")


@pytest.fixture(scope="module")
def trained(bench):
    """An integrator trained in the box. Its division and cache are whatever the last test made them."""
    integrator, learned = bench.integrator("cornell_box")
    fill(integrator, "trained", learned)
    integrator.choice.split = split_of((4, 1, 1.0, -1.0))
    return integrator


# ---------------------------------------------------------------- the mean is that of path


@pytest.mark.parametrize("kind", sweep(CACHES, ("trained",)))
def test_mean_is_that_of_path_for_any_cache(bench, kind):
    """Of the whole image to better than 1 %."""
    bench.check("cornell_box", kind, chosen("paper", "cell"), visible=0.01, spp=3 * SPP)


@pytest.mark.parametrize("kind", [pytest.param(k, marks=() if k == "trained" else SLOW) for k in CACHES])
def test_mean_is_that_of_path_for_any_division(bench, kind):
    bench.check("cornell_box", kind, chosen("quarter", "several"))


@pytest.mark.parametrize("kind", sweep(CACHES, ("nonsense",)))
def test_mean_in_the_sphere_is_that_of_path(bench, kind):
    bench.check("point_lit_sphere", kind, chosen("paper", "quarter"))


@pytest.mark.parametrize("kind", [pytest.param("trained", marks=SLOW), "nonsense"])
@pytest.mark.parametrize("keys, depth", [({"ris": True}, -1), ({"every_vertex": True}, 4)], ids=["ris", "every_vertex"])
def test_mean_is_that_of_path_by_every_setting(bench, keys, depth, kind):
    splits = {"paper": (8, 1, 1.0, 1.0), "cell": (4, 1 if "ris" in keys else 2, 0.5, -1.0)}
    bench.check("cornell_box", kind, splits, depth, **keys)


@SLOW
@pytest.mark.parametrize("kind", CACHES)
def test_depth_limit_is_that_of_path(bench, kind):
    bench.check("point_lit_sphere", kind, chosen("paper", "quarter"), depth=3, every_vertex=True)


@SLOW
@pytest.mark.parametrize("kind", CACHES)
def test_mean_in_a_glossy_hall_with_lights_chosen_by_their_visibility(bench, kind):
    """Mirror, gloss, glass, sky, sun and lamps; sharp lobes are traced."""
    bench.check("glossy_hall", kind, chosen("paper", "quarter"), light_sampler={"type": "nvc_lights"})


@SLOW
@pytest.mark.parametrize("kind", CACHES)
@pytest.mark.parametrize("keys", [{}, {"ris": True}, {"every_vertex": True}, {"every_vertex": True, "ris": True}],
                         ids=["plain", "ris", "every_vertex", "both"])  # fmt: skip
@pytest.mark.parametrize("name", ["lit_cube", "cornell_box", "glossy_hall", "lamp_bays"])
def test_mean_in_more_scenes_by_every_setting(bench, name, keys, kind):
    bench.check(name, kind, chosen("paper", "quarter"), **keys)


@SLOW
@pytest.mark.parametrize("kind", ["trained", "untrained", "nonsense"])
@pytest.mark.parametrize("name", ["cornell-box", "veach-bidir", "staircase2"])
def test_mean_in_well_known_scenes(bench, shared_scenes, name, kind):
    if name not in bench.scenes:
        bench.scenes[name] = mi.load_file(str(shared_scenes / name / "scene.xml"), resx=48, resy=27)
    bench.check(name, kind, chosen("paper", "quarter"))


def test_cache_that_answers_with_infinities_costs_variance_alone(bench, sphere, monkeypatch):
    """By direction: infinite, not a number, negative, and one that is right."""
    plain = Field.query

    def query(self, features, w, averaged=True):
        value = plain(self, features, w, averaged)
        for k, bad in ((0, math.nan), (1, -3.0)):
            value[k] = dr.select(w.z > 0.5, bad, value[k])
        value.z = dr.select(w.z > 0.999, math.inf, value.z)
        return value

    monkeypatch.setattr(Field, "query", query)
    monkeypatch.setattr(transport, "ANSWER_MAX", 100.0)  # for a test that sees something
    integrator = two_level(alpha=1.0, residual_probability=0.5, freeze_cache=True)
    ours = renders(sphere, integrator, N_RENDERS, SPP)
    assert np.isfinite(ours).all() and integrator.statistics()["nonfinite"] == 0
    assert_same_mean(ours, bench.reference("point_lit_sphere"), "infinite answers", relative=1e-5, tests=N_TESTS)
    assert ours.std() > 2 * bench.reference("point_lit_sphere").std(), "the answers must have been asked for"


# ---------------------------------------------------------------- limit cases


@pytest.mark.parametrize("keys", [{}, {"ris": True}, pytest.param({"every_vertex": True}, marks=SLOW)], ids=str)
def test_without_cache_samples_it_is_path_tracing(bench, box, keys):
    """At path tracing's cost: nothing is trained, nothing asked. By RIS, too, which has one candidate then."""
    integrator = mi.load_dict({**SMALL, "cache_samples": 0, "residual_samples": 1, **keys})
    ours = renders(box, integrator, N_RENDERS, SPP, first_seed=3)
    seen = assert_same_mean(ours, bench.reference("cornell_box"), f"Nc = 0 {keys}", relative=1e-5, tests=N_TESTS)
    assert seen < 0.01
    s = integrator.statistics()
    assert s["queries"] == 0 and s["steps"] == 0 and integrator.cache.field is None
    assert s["split"] == "path tracing, 1 path"


@pytest.mark.parametrize("kind", ["trained", "nonsense"])
def test_where_its_terms_cancel_alpha_changes_nothing(bench, box, kind):
    """Nc = Nr = q = 1: the images of all α are one."""
    integrator, learned = bench.integrator("cornell_box")
    fill(integrator, kind, learned)
    images = []
    for alpha in (0.0, 1.0, 0.5, -1.0):
        integrator.choice.split = split_of((1, 1, 1.0, alpha))
        images.append(render(box, integrator, 8, 3))
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], rtol=1e-5, atol=1e-6)


def test_good_cache_lowers_the_variance_and_a_bad_one_raises_it(bench, sphere):
    """Where three paths of four are left out: the cache stands in for them."""
    integrator, learned = bench.integrator("point_lit_sphere")

    def variance(kind, alpha):
        fill(integrator, kind, learned)
        integrator.choice.split = split_of((4, 1, 0.25, alpha))
        return renders(sphere, integrator, 64, 1, first_seed=50).var(axis=0, ddof=1).mean()

    plain, helped, harmed = variance("trained", 0.0), variance("trained", 1.0), variance("nonsense", 1.0)
    print(f"variance {plain:.2e} without, {helped:.2e} with the cache, {harmed:.2e} with nonsense")
    assert helped < 0.8 * plain < plain < harmed


# ---------------------------------------------------------------- channels

ALL = "direct, cache, residual, alpha, variance_cache, variance_residual, variance_indirect"


@pytest.fixture(scope="module")
def shown(bench, box):
    """An integrator with all channels, and the box's trained cache."""
    integrator = two_level(channels=ALL)
    integrator.train(box, 60)
    return integrator


def test_names_of_the_channels(shown):
    rgb = [f"{n}.{c}" for n in ("direct", "cache", "residual") for c in "RGB"]
    rest = [f"variance_{n}.{c}" for n in ("cache", "residual", "indirect") for c in "RGB"]
    assert shown.aov_names() == [*rgb, "alpha", *rest]
    assert two_level(channels="alpha,residual").aov_names() == ["alpha", *rgb[6:]]


@pytest.mark.parametrize("numbers", [(4, 1, 1.0, 1.0), (4, 1, 0.25, -1.0), (6, 3, 0.5, 0.5), (0, 2, 1.0, 0.0)])
def test_channels_sum_to_the_image(box, shown, numbers):
    shown.choice.split = split_of(numbers)
    image = channels_of(shown, render(box, shown, 32, 4))
    total = image["direct"] + image["cache"] + image["residual"]
    np.testing.assert_allclose(total, image[""], rtol=1e-4, atol=1e-5)
    alpha = image["alpha"]
    assert (alpha >= 0).all() and (alpha <= 1).all()
    if numbers[3] >= 0:  # less in pixels some samples of which see the lamp's back or nothing
        assert np.median(alpha) == pytest.approx(numbers[3]) and alpha.max() <= numbers[3] + 1e-6
    if numbers[3] == 0:
        assert (image["cache"] == 0).all()


def test_variances_are_those_of_independent_images(box, shown):
    """Sample variance within images of 64 samples, and variance over 256 images of one: equal up to the gain of
    stratification, a 64th, and five standard errors (of a twelfth of the film each: error rate below 1e-4)."""
    shown.choice.split = split_of((4, 1, 0.5, 1.0))
    within = [channels_of(shown, render(box, shown, 64, 900 + k)) for k in range(12)]
    single = [channels_of(shown, render(box, shown, 1, k)) for k in range(256)]
    for name in ("cache", "residual", "indirect"):
        part = [c["cache"] + c["residual"] if name == "indirect" else c[name] for c in single]
        over = np.var(part, axis=0, ddof=1).mean(axis=-1).ravel()
        stated = np.mean([c[f"variance_{name}"] for c in within], axis=0).mean(axis=-1).ravel()
        # Heavy tails: compare what nearly all pixels say, and the film's mean loosely
        ratio, error = stated.mean() / over.mean(), 5 * over.std() / over.mean() * math.sqrt(2 / over.size / 4)
        print(f"variance_{name}: {stated.mean():.4g} within, {over.mean():.4g} over images, ratio {ratio:.3f}")
        assert ratio == pytest.approx(1, abs=0.02 + error)
        assert np.median(stated / np.maximum(over, 1e-12)) == pytest.approx(1, abs=0.15)
    once = channels_of(shown, render(box, shown, 1, 5))
    assert all((once[f"variance_{n}"] == 0).all() for n in ("cache", "residual", "indirect")), "one sample has none"


def test_variance_channels_do_not_change_the_image(box, shown):
    shown.choice.split = split_of((4, 1, 0.5, 1.0))
    plain = two_level()
    plain.share_cache(shown)
    plain.choice.split = shown.choice.split
    np.testing.assert_allclose(render(box, shown, 8, 9)[..., :3], render(box, plain, 8, 9), rtol=1e-4, atol=1e-6)


@SLOW
def test_wrapped_in_aov_it_shows_the_same_light(box, bench):
    inner = {**SMALL, **GIVEN, "channels": "residual,alpha"}
    wrapped = mi.load_dict({"type": "aov", "aovs": "d:depth", "inner": inner})
    image = np.array(mi.render(box, integrator=wrapped, spp=64), dtype=np.float64)
    names = wrapped.aov_names()
    assert [n for n in names if n.startswith("inner.")][-4:] == [*(f"inner.residual.{c}" for c in "RGB"), "inner.alpha"]
    assert np.isfinite(image).all()
    assert image[..., :3].mean() == pytest.approx(bench.reference("cornell_box").mean(), rel=0.05)


# ---------------------------------------------------------------- refused


@pytest.mark.parametrize("keys, says", [
    ({"residual_probability": 0.0}, "residual_probability is 0.*\\(0, 1\\]"),
    ({"residual_probability": 1.5}, "residual_probability is 1.5.*\\(0, 1\\]"),
    ({"residual_probability": -0.5}, "residual_probability is -0.5"),
    ({"residual_probability": math.nan}, "residual_probability is nan"),
    ({"alpha": 2.0}, "alpha is 2.*'cell' or a number in \\[0, 1\\]"),
    ({"alpha": -0.1}, "alpha is -0.1"), ({"alpha": math.nan}, "alpha is nan"), ({"alpha": "x"}, "alpha is 'x'.*'cell'"),
    ({"alpha": 1.0, "cache_samples": 0}, "alpha is 1.*cache_samples is 0"),
    ({"alpha": "cell", "cache_samples": 0}, "alpha is cell.*cache_samples is 0"),
    ({"cache_samples": -1}, "cache_samples is -1"), ({"residual_samples": 0}, "residual_samples is 0.*at least 1"),
    ({"mode": "best"}, "mode is 'best'.*unbiased, progressive"),
    ({"blend": "reliability"}, "it has no key 'blend'; nirc and nrc have it"),
    ({"reliability": "evidence"}, "it has no key 'reliability'; nirc and nrc have it"),
    ({"ris": True, "residual_samples": 2}, "ris chooses one direction.*residual_samples"),
    ({"channels": "cache,depht"}, "unknown channel 'depht'.*variance_indirect"), ({"max_depth": -2}, "max_depth is -2"),
])  # fmt: skip
def test_impossible_key_is_refused_by_name(keys, says):
    with pytest.raises((ValueError, RuntimeError), match=f"nirc_two_level: {says}"):
        mi.load_dict({"type": "nirc_two_level", **keys})


# ---------------------------------------------------------------- one cache for two integrators


def nirc(**keys):
    return mi.load_dict({"type": "nirc", **{k: v for k, v in SMALL.items() if k != "type"}, **keys})


def test_cache_is_shared_with_a_nirc_and_back(box):
    """What one trains the other knows, and an unbiased one of the same cache hands it on."""
    biased = nirc()
    biased.train(box, 40)
    unbiased = two_level()
    unbiased.share_cache(biased)
    assert unbiased.cache.field is biased.cache.field and unbiased.cache.steps == 40
    image = render(box, unbiased, 16)
    assert unbiased.cache.steps == 40, "what is shared is trained"
    assert unbiased.statistics()["alpha"] > 0.05, "α of a cache that was trained elsewhere is gathered first"
    before = biased.cache.field.snapshot()
    unbiased.train(box, 5)
    after = biased.cache.field.snapshot()
    assert any((before[k] != after[k]).any() for k in before)
    assert render(box, biased, 16).mean() == pytest.approx(image.mean(), rel=0.1)
    third = two_level()
    third.share_cache(unbiased)
    assert third.cache.field is biased.cache.field


def test_cache_is_shared_by_an_integrator_that_had_one_of_its_own(box):
    """What was known of the old one, α and the division, is forgotten with it."""
    own, biased = two_level(), nirc(seed=3)
    own.train(box, 20)
    biased.train(box, 60)
    render(box, own, 1)
    own.share_cache(biased)
    render(box, own, 1)
    assert own.cache.steps == 60
    assert float(own.cache.queried.mean_sigma()[0]) > 0.05, "α is that of the cache which is in use"


def test_cache_of_no_one_or_of_other_sizes_is_not_shared(box):
    with pytest.raises(ValueError, match=r"nirc_two_level: share_cache.*trained cache.*train\(\) first"):
        two_level().share_cache(nirc())
    with pytest.raises(ValueError, match=r"share_cache.*trained cache"):
        two_level().share_cache(mi.load_dict({"type": "path"}))
    wide = nirc(width=24)
    wide.train(box, 1)
    with pytest.raises(ValueError, match="same sizes"):
        two_level().share_cache(wide)


def test_cache_files_of_either_are_read_by_both(box, tmp_path):
    biased, unbiased = nirc(), two_level()
    biased.train(box, 40)
    biased.save_cache(tmp_path / "biased")
    unbiased.load_cache(tmp_path / "biased", box)
    assert unbiased.cache.steps == 40
    render(box, unbiased, 4)
    assert unbiased.cache.steps == 40 and unbiased.statistics()["alpha"] > 0.05
    unbiased.train(box, 3)
    unbiased.save_cache(tmp_path / "unbiased")
    again = nirc()
    again.load_cache(tmp_path / "unbiased", box)
    assert again.cache.steps == 43
    found, known = again.cache.field.snapshot(), unbiased.cache.field.snapshot()
    assert all((found[k] == known[k]).all() for k in known)
    with pytest.raises(CacheFileError, match="same sizes"):
        two_level(width=8).load_cache(tmp_path / "unbiased")


# ---------------------------------------------------------------- state, films, passes


def test_equal_seeds_give_equal_images(box, trained):
    a, b, c = (render(box, trained, 4, seed) for seed in (5, 5, 6))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_reset_forgets_what_was_learned(box):
    integrator = two_level(train_frames=5)
    render(box, integrator, 1)
    assert integrator.cache.steps == 5 and integrator.statistics()["queries"] == 4 * 16 * 16
    integrator.reset()
    s = integrator.statistics()
    assert integrator.cache.steps == 0 and s["queries"] == 0 and "alpha" not in s
    render(box, integrator, 1)
    assert integrator.cache.steps == 5


def test_preparing_leaves_no_trace(box):
    integrator = two_level(train_frames=8)
    integrator.prepare(box, spp=2)
    assert integrator.cache.steps == 0 and integrator.state.images == 0 and integrator.statistics()["records"] == 0
    render(box, integrator, 2)
    assert integrator.cache.steps == 8

    def state():
        moments = integrator.cache.queried.snapshot()
        arrays = {k: np.array(v if not isinstance(v, (list, dict)) else 0) for k, v in moments.items()}
        facts = {k: v for k, v in integrator.statistics().items() if k not in ("ns_per_query", "seconds_pilot")}
        return integrator.cache.field.snapshot() | arrays, facts

    before, facts = state()
    assert facts["alpha"] > 0
    integrator.prepare(box, spp=2)
    after, again = state()
    assert facts == again
    assert before.keys() == after.keys() and all(np.array_equal(before[k], after[k]) for k in before)


@pytest.mark.parametrize("width, height", [(7, 5), pytest.param(1, 1, marks=SLOW)])
def test_image_does_not_depend_on_how_it_is_cut_into_passes(bench, sphere, monkeypatch, width, height):
    """Films whose pixels are no multiple of a packet, in one pass, in one per sample, in rows: one image, of mean 1."""
    to_world = mi.ScalarTransform4f().look_at([0.3, 0.2, 0.4], [-0.5, -0.2, -0.6], [0, 1, 0])
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "fov": 70, "to_world": to_world, "film": film})
    common = importlib.import_module("mi_neural.integrators.common")
    integrator, learned = bench.integrator("point_lit_sphere")
    fill(integrator, "trained", learned)
    integrator.choice.split = split_of((4, 1, 0.5, 1.0))
    whole = np.stack([render(sphere, integrator, 32, k, sensor=sensor) for k in range(64)])
    means = whole.mean(axis=(1, 2, 3))
    assert abs(means.mean() - 1) < 5 * means.std(ddof=1) / 8 + 1e-5
    pixels = whole.mean(axis=-1)
    error = pixels.std(axis=0, ddof=1) / 8
    assert (np.abs(pixels.mean(axis=0) - 1) < 5 * error + 1e-4).all(), "every pixel has its share of the samples"
    for size in (width * height, 3):
        monkeypatch.setattr(common.CacheIntegrator, "PASS_SAMPLES", size)
        for k in range(2):
            np.testing.assert_allclose(render(sphere, integrator, 32, k, sensor=sensor), whole[k], rtol=1e-4)


FILMS = {
    "crop": {"crop_offset_x": 3, "crop_offset_y": 5, "crop_width": 9, "crop_height": 6},
    "gaussian": {"rfilter": {"type": "gaussian"}},
    "border": {"rfilter": {"type": "gaussian"}, "sample_border": True},
    "rgba": {"pixel_format": "rgba"},
}
FILMS["all"] = {**FILMS["crop"], **FILMS["border"], **FILMS["rgba"]}


@pytest.mark.parametrize("mode", [pytest.param("unbiased", marks=SLOW), "progressive"])
@pytest.mark.parametrize("name", [n if n == "all" else pytest.param(n, marks=SLOW) for n in FILMS])
def test_film_shows_what_it_shows_with_path(sphere, name, mode):
    """Every pixel is 1, and stands where the film's window says."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, **FILMS[name]}
    to_world = mi.ScalarTransform4f().look_at([0.3, 0.2, 0.4], [-0.5, -0.2, -0.6], [0, 1, 0])
    sensor = mi.load_dict({"type": "perspective", "fov": 70, "to_world": to_world, "film": film})
    image = render(sphere, two_level(mode=mode, channels="variance_indirect"), 64, sensor=sensor)
    expected = np.array(mi.render(sphere, sensor=sensor, integrator=mi.load_dict({"type": "path"}), spp=1))
    n = expected.shape[2]
    assert image.shape == (*expected.shape[:2], n + 3)
    # A cache of few frames may be wrong by two percent on so few pixels
    assert image[..., :3].mean() == pytest.approx(1, rel=0.02 if mode == "unbiased" else 0.04)
    assert np.abs(image[..., :3] - 1).max() < 0.4
    if n == 4:
        np.testing.assert_allclose(image[..., 3], 1, rtol=1e-5)
