"""``neural_path``: what is measured is what there is, the decisions follow from it, and each choice is the integrator
that makes it alone.

The z-tests fail a correct integrator in one of 10,000 choices of seed; each prints what it could have seen.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW
from expectation import assert_mean, assert_same_mean, renders
from scipy import ndimage
from test_incident import load
from test_nrc import assert_like_path, constant_field
from test_vertex import lights, test_scene

from mi_neural import scenes
from mi_neural.bench.load import InputError
from mi_neural.bench.specs import IntegratorSpec, build_integrator, parse_integrator
from mi_neural.caches.accuracy import pairs_of
from mi_neural.caches.field import CacheFileError
from mi_neural.caches.outgoing import OutgoingTraining, training_paths
from mi_neural.caches.outgoing_field import OutgoingField, OutgoingShape
from mi_neural.estimators.spread import grown
from mi_neural.integrators.neural_path import LEAST_STEPS, denoised_threshold
from mi_neural.render.kernels import on_gpu

#: Caches that are trained in a second.
SMALL = {"train_samples": 512, "train_frames": 60, "train_steps": 0, **NETWORK}
BOX = ([0.0] * 3, [1.0] * 3)


def auto(**keys):
    return mi.load_dict({"type": "neural_path", **SMALL, **keys})


def render(scene, integrator, spp=16, seed=0, **kw) -> np.ndarray:
    image = np.array(integrator.render(scene, spp=spp, seed=seed, **kw), dtype=np.float64)
    assert np.isfinite(image).all()
    return image


@pytest.fixture(scope="module")
def sphere():
    return load("point_lit_sphere", 16)[0]


@pytest.fixture(scope="module")
def box():
    """Diffuse surfaces alone, so that `nirc` follows no sharp lobe."""
    return mi.load_file(str(scenes.path("cornell_box")), resx=16, resy=16)


@pytest.fixture(scope="module")
def trained(box):
    """An integrator trained in the box, extra channels on. Leave its keys and caches alone."""
    integrator = auto(channels="traced, cached, cache, depth, share")
    integrator.train(box, 60)
    return integrator


def force(integrator, noise=1.0, bias=1e9, mean_bias=0.0) -> None:
    """Let the grid of a trained integrator say the same everywhere."""
    grid = integrator.cache.queried.grid
    grid.mean_bias = mi.Float(mean_bias)
    grid.noise, grid.bias = (dr.full(mi.Float, v, grid.constants.n_entries) for v in (noise, bias))
    dr.make_opaque(grid)


def lay_records(integrator, density) -> None:
    """Let as many training records lie in the cells as ``density(k)`` says of the table's entries k."""
    field = integrator.cache.queried.field
    field.density = mi.Float(density(np.arange(dr.width(field.density))) * np.ones(dr.width(field.density)))
    dr.make_opaque(field)


# ---------------------------------------------------------------- training paths


def test_twins_start_together_and_their_records_are_right(sphere):
    """In the sphere every surface sends out 1, half of it direct: so does each record of either kind say, and each of
    the two estimates of a first vertex, if the cache at the end is right. Error rate 1e-4 each."""
    training, field = OutgoingTraining(n_paths=2**13), constant_field(2.0)
    traced = training_paths(sphere, sphere.sensors()[0], field, training, mi.UInt32(1), None, False, twins=True)
    dr.eval(traced)
    x = np.array(traced.outgoing.surface.position)[:, : 2**13]
    np.testing.assert_array_equal(x[:, ::2], x[:, 1::2])
    valid = np.array(traced.incident.valid)
    assert valid.sum() > 2**13
    assert_mean(np.array(traced.incident.target)[0][valid], 1, "incident records", relative=1e-4)
    p = pairs_of(traced, field, training.n_paths)
    ok = np.array(p.valid)
    print(f"{ok.sum()} pairs")
    assert ok.mean() > 0.99
    for estimate in p.traced:
        assert_mean(np.array(estimate)[0][ok], 1, "one more bounce", relative=1e-4)
    n, w = (np.array(v)[:, : 2**13] for v in (traced.outgoing.surface.normal, traced.incident.direction))
    tangent = w - (w * n).sum(axis=0) * n
    products = (tangent[:, ::2] * tangent[:, 1::2]).sum(axis=0)
    assert_mean(products, 0, "directions of the two, along the surface")
    np.testing.assert_allclose(np.array(p.cached)[0][ok], 1, rtol=1e-5)


# ---------------------------------------------------------------- each choice alone


def test_trusting_nothing_it_is_path():
    """Rough metal, plastic, glass, all kinds of lights; the cache is untrained."""
    scene = test_scene(lights("all"))
    integrator = auto(freeze_cache=True, spread_threshold=1e9)
    ours = renders(scene, integrator, 24, 32)
    path = renders(scene, {"type": "path"}, 24, 64, first_seed=1000)
    assert_same_mean(ours, path, "nothing trusted", relative=1e-5)


def copy_of(trained, box, tmp_path, **keys):
    trained.save_cache(tmp_path / "measured")
    integrator = auto(freeze_cache=True, **keys)
    integrator.load_cache(tmp_path / "measured", box)
    return integrator


def outgoing_alone(trained, box, **keys):
    """An `nrc` with the same outgoing cache."""
    integrator = mi.load_dict({"type": "nrc", "freeze_cache": True, **keys})
    integrator.render(box, spp=1)
    integrator.cache.adopt(trained.cache.field)
    return integrator


def test_cache_at_the_first_surface_is_nrc_with_threshold_zero(trained, box, tmp_path):
    integrator = copy_of(trained, box, tmp_path, channels="share, depth")
    force(integrator, bias=0.0)
    image = render(box, integrator, 4)
    known = render(box, outgoing_alone(trained, box, spread_threshold=0.0), 4)
    np.testing.assert_allclose(image[..., :3], known, rtol=1e-4, atol=1e-4 if on_gpu() else 1e-6)
    assert image[..., 4].max() == 1, "no path was traced"


def test_denoised_images_learn_from_more_paths_without_an_end():
    shares = [mi.load_dict({"type": "neural_path", **keys}).cache.training.unbounded_share
              for keys in ({}, {"denoised": True}, {"denoised": True, "unbounded_share": 0.1})]  # fmt: skip
    assert shares == [0.25, 0.5, 0.1]


@pytest.mark.parametrize("denoised", [pytest.param(False, marks=SLOW), True])
def test_cache_at_later_vertices_is_nrc(trained, box, tmp_path, denoised):
    integrator = copy_of(trained, box, tmp_path, denoised=denoised)
    force(integrator, mean_bias=0.6)
    lay_records(integrator, lambda k: 1.0)
    ours = renders(box, integrator, 24, 32)
    c = denoised_threshold(0.6, trained.cache.steps, 32) if denoised else grown(0.01, 32)
    assert (c > 5) == denoised
    known = renders(box, outgoing_alone(trained, box, spread_threshold=c), 24, 32, first_seed=1000)
    assert_same_mean(ours, known, f"nrc, c = {c}", relative=1e-5)


@pytest.mark.parametrize("plugin, keys", [
    ("nirc", {"light_samples": 2, "channels": "direct"}), ("nrc", {"blend": "ema", "reliability_kappa": 3.0}),
])  # fmt: skip
def test_older_name_still_works_and_says_the_new_one(plugin, keys, box, capfd):
    old = mi.load_dict({"type": plugin, **SMALL, "train_frames": 8, "termination": "auto", **keys})
    assert "type: neural_path" in "".join(capfd.readouterr())
    new = auto(train_frames=8, **({"channels": "traced"} if "channels" in keys else {}))
    assert type(old) is type(new) and str(old) == str(new) and old.channels == new.channels
    # Trained: equal but for the order of sums
    np.testing.assert_allclose(render(box, old, 4), render(box, new, 4), rtol=0.03, atol=1e-3)


# ---------------------------------------------------------------- all together


def test_trained_image_is_that_of_path(box):
    assert_like_path(box, auto(train_samples=1024, train_frames=150), 0.03, 0.2)


def test_known_answer_within_two_percent(sphere):
    image = render(sphere, auto(train_samples=1024), 16)
    print(f"mean {image.mean():.4f} (known 1)")
    assert abs(image.mean() - 1) < 0.02 and np.abs(image - 1).max() < 0.15


def test_mix_has_less_error_than_either_part():
    """The cache at the first surface alone, tracing alone, and the mix, at 64 samples."""
    box = mi.load_file(str(scenes.path("cornell_box")), resx=32, resy=32)
    trained = auto(train_samples=1024)
    trained.train(box, 200)
    path = np.array(mi.render(box, integrator=mi.load_dict({"type": "path"}), spp=1024), dtype=np.float64)
    parts = [outgoing_alone(trained, box, spread_threshold=c) for c in (0.0, grown(0.01, 64))]
    lamp = ndimage.maximum_filter(path.max(axis=-1), 3)[..., None] > 1  # its edges are as noisy whatever is traced
    weight = np.where(lamp, 0, 1 / (path.mean(axis=-1, keepdims=True) ** 2 + 1e-2))

    def error(integrator):
        images = np.stack([render(box, integrator, 64, k) for k in range(2)])
        return np.mean((images - path) ** 2 * weight)

    cache, traced, ours = error(parts[0]), error(parts[1]), error(trained)
    print(f"squared errors: cache {cache:.4f}, traced {traced:.4f}, neural_path {ours:.4f}")
    assert ours < min(cache, traced)


def test_share_falls_as_samples_grow_and_channels_say_so(trained, box):
    shares, depths = [], []
    for spp in (1, 16, 256):
        image = render(box, trained, spp)
        colour, traced, cached, _, depth, share = np.split(image, (3, 6, 9, 12, 13), axis=-1)
        np.testing.assert_allclose(traced + cached, colour, rtol=1e-4, atol=1e-5)
        shares.append(share.mean())
        depths.append(depth.mean())
    print(f"shares {shares}, depths {depths}")
    assert shares[0] > shares[1] > shares[2] and depths[0] < depths[2]


@pytest.mark.parametrize("channels", ["share, depth", "share, depth, cache"])
def test_denoised_images_do_not_show_the_cache_at_the_first_surface(trained, box, tmp_path, channels):
    """Also where the cache is seen in a channel; and paths are traced further before they end."""
    found = {}
    for denoised in (False, True):
        integrator = copy_of(trained, box, tmp_path, denoised=denoised, channels=channels)
        force(integrator, bias=1.0, mean_bias=4.0)
        image = render(box, integrator, 4)
        found[denoised] = image[..., 3:5].mean(axis=(0, 1))
        assert image[..., 5:].max(initial=1) > 0
    assert auto(denoised=True).settings(512) == (512, 0.01, 1) and auto().settings(512) == (512, 2.0, 1)
    print(f"(share, depth): {found[False]}, denoised {found[True]}")
    assert found[True][0] == 0 < found[False][0] and found[True][1] > found[False][1]
    assert integrator.queries_per_sample < copy_of(trained, box, tmp_path).queries_per_sample


def test_young_cache_is_traced_past_in_denoised_images(box):
    """After eight steps paths run on nearly as far as without a cache, after 200 they end in it."""
    integrator, depths = auto(denoised=True, channels="depth"), {}
    for steps in (8, 200):
        integrator.train(box, steps - integrator.cache.steps)
        assert integrator.settings(64)[2] == steps
        depths[steps] = render(box, integrator, 64)[..., 3].mean()
    far = render(box, auto(spread_threshold=math.inf, channels="depth", freeze_cache=True), 64)[..., 3].mean()
    print(f"depth {depths}, traced {far}")
    assert depths[8] > 0.9 * far and depths[200] < 0.7 * far


def test_denoised_images_trace_past_places_with_few_training_records(trained, box, tmp_path):
    """Where a thousandth of the usual number lies, paths hardly end; without a denoiser that changes nothing."""
    depths = {}
    for denoised in (False, True):
        integrator = copy_of(trained, box, tmp_path, denoised=denoised, channels="depth")
        force(integrator, mean_bias=0.02)
        for name, density in (("even", lambda k: 1.0), ("none", lambda k: 0.0),
                              ("few", lambda k: np.where(k % 16, 1e-3, 1.0))):  # fmt: skip
            lay_records(integrator, density)
            depths[denoised, name] = render(box, integrator, 16)[..., 3].mean()
    print(depths)
    assert depths[False, "even"] == depths[False, "none"] == depths[False, "few"]
    assert depths[True, "even"] == depths[True, "none"]  # of a cache file that does not say
    assert depths[True, "few"] > 1.5 * depths[True, "even"]


def test_typical_density_is_that_near_records():
    field = OutgoingField(*BOX, OutgoingShape(n_levels=2, hashmap_size=64, width=16))
    assert field.typical_density()[0] == 0
    points = np.repeat([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]], [30, 10], axis=0)
    field.count(mi.Point3f(points.T.astype(np.float32)), mi.Bool(True), mi.Float(0))
    assert field.density_at(mi.Point3f(0.1))[0] == 30
    assert field.typical_density()[0] == pytest.approx((30 * 30 + 10 * 10) / 40)


# ---------------------------------------------------------------- state


def test_saved_caches_give_the_same_image(trained, box, sphere, tmp_path):
    image = render(box, trained, 4, 3)[..., :3]
    other = copy_of(trained, box, tmp_path)
    np.testing.assert_array_equal(render(box, other, 4, 3), image)
    with pytest.raises(CacheFileError, match="another scene"):
        auto().load_cache(tmp_path / "measured", sphere)
    with pytest.raises(CacheFileError, match="no incident radiance alone"):
        mi.load_dict({"type": "nirc"}).load_cache(tmp_path / "measured")


def test_cache_is_that_of_nrc_and_back(trained, box, tmp_path):
    """A file of either serves both; what was not measured is not trusted at the first surface."""
    trained.save_cache(tmp_path / "measured")
    plain = mi.load_dict({"type": "nrc", "freeze_cache": True, "spread_threshold": 0.0, **NETWORK})
    plain.load_cache(tmp_path / "measured", box)
    known = render(box, outgoing_alone(trained, box, spread_threshold=0.0), 4)
    np.testing.assert_array_equal(render(box, plain, 4), known)
    plain.save_cache(tmp_path / "plain")
    integrator = auto(freeze_cache=True, channels="share")
    integrator.load_cache(tmp_path / "plain", box)
    assert render(box, integrator, 4)[..., 3].max() == 0


def test_frozen_functions_are_not_recorded_again_and_preparing_changes_nothing(box):
    integrator = auto(train_frames=4, train_steps=1, train_samples=256)
    for k in range(4):
        render(box, integrator, 2, k)
    functions = [integrator.cache.recorded("frame"), *integrator.film_state.passes.recorded.values()]
    recorded = [f.n_recordings for f in functions]
    for k in range(6):
        render(box, integrator, 2, 10 + k)
    now = [f.n_recordings for f in functions]
    print(f"recordings {now}")
    assert now == recorded and max(now) <= 3
    before = integrator.cache.field.snapshot() | integrator.cache.queried.grid.arrays()
    integrator.prepare(box, spp=2)
    after = integrator.cache.field.snapshot() | integrator.cache.queried.grid.arrays()
    assert all(np.array_equal(v, after[k]) for k, v in before.items())
    s = integrator.statistics()
    assert s["noise_of_pairs"] > 0 and s["steps"] == 13


# ---------------------------------------------------------------- refused


@pytest.mark.parametrize("keys, message", [
    ({"denoised": 1}, "denoised is 1; give true or false"),
    ({"spread_threshold": -1.0}, "spread_threshold is -1"),
    ({"blend": "fast"}, "neural_path: it has no key 'blend'; nirc and nrc have it"),
    ({"train_samples": 1}, "train_samples is 1"),
    ({"reliability_decay": 0.8}, "neural_path: it has no key 'reliability_decay'; nirc and nrc have it"),
])  # fmt: skip
def test_impossible_combination_is_refused(keys, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        auto(**keys)


def test_keys_of_other_integrators_are_left_out_where_they_may_be():
    """As `--set` gives them: to each integrator that has them."""
    optional = {"blend": "fast", "reliability": "evidence", "width": 16}
    assert build_integrator(IntegratorSpec("neural_path"), optional=optional)[1] == {"width": 16}
    assert build_integrator(IntegratorSpec("nrc"), optional=optional)[1] == optional
    with pytest.raises(InputError, match="neural_path: it has no key 'blend'; nirc and nrc have it"):
        build_integrator(parse_integrator("neural_path:blend=fast"))


@pytest.mark.parametrize("plugin", ["nirc", "nrc"])
def test_unknown_termination_is_refused(plugin):
    with pytest.raises((ValueError, RuntimeError), match="termination"):
        mi.load_dict({"type": plugin, "termination": "sometimes"})


def test_a_cache_with_no_time_to_learn_stays_out_of_the_image(box, monkeypatch):
    """Where the seconds for training are too few for LEAST_STEPS, the image is traced; the cache goes on learning."""
    integrator = auto(channels="cached, share", denoised=True)
    integrator.train(box, 0)
    facts = integrator.train_seconds(box, 1e-6)
    assert facts["cache_left_out"] and integrator.cache.steps < LEAST_STEPS
    image = render(box, integrator)
    assert np.abs(image[..., 3:]).max() == 0 and image[..., :3].mean() > 0
    integrator.train(box, LEAST_STEPS - integrator.cache.steps)
    assert "cache_left_out" not in integrator.statistics()
    integrator.denoised = False
    assert render(box, integrator)[..., 3:6].max() > 0
    integrator.reset()
    integrator.train(box, 3)  # who asks for three steps gets an image of three
    assert render(box, integrator)[..., 3:6].max() > 0


def test_a_training_by_time_is_prolonged_for_the_least_steps(box, monkeypatch):
    integrator = auto()
    integrator.prepare(box, spp=1)
    seconds = []
    monkeypatch.setattr(type(integrator), "seconds_of_step", lambda self, *_: seconds[0])
    seconds.append(0.01)
    integrator.train_seconds(box, 0.2)  # 24 steps of 0.01 s are 1.2 times the time
    assert integrator.cache.steps >= LEAST_STEPS
    integrator.reset()
    seconds[0] = 0.1
    facts = integrator.train_seconds(box, 0.2)
    assert facts["cache_left_out"] and integrator.cache.steps < LEAST_STEPS
