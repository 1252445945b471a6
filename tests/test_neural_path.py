"""``neural_path``: what is measured is what there is, the decisions follow from it, and each of the three
choices is the integrator that makes it alone.

The z-tests fail a correct integrator in one of 10,000 choices of seed; each prints what it could have seen.
"""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_mean, assert_same_mean, renders
from scipy import ndimage
from test_incident import load
from test_nrc import assert_like_path, constant_field
from test_vertex import lights, test_scene

from mi_neural import scenes
from mi_neural.caches.accuracy import ERRORS, INCIDENT_COST, OUTGOING_COST, Accuracy, AccuracyShape, Pairs, mix
from mi_neural.caches.field import CacheFileError, Field, FieldShape
from mi_neural.caches.outgoing import OutgoingTraining, training_paths
from mi_neural.caches.pair import PairField, pairs_of

SLOW = pytest.mark.slow
#: Caches that are trained in a second.
SMALL = {"train_samples": 512, "train_frames": 60, "train_steps": 0}
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


def force(integrator, *, v=1.0, v_i=1.0, b_i=1e9, b_o=1e9, drift=1e30) -> None:
    """Let the grid of a trained integrator say the same everywhere."""
    accuracy = integrator.cache.field.accuracy
    for name, value in zip(ERRORS, (v, v_i, b_i, b_o, 0.0), strict=True):
        setattr(accuracy, name, dr.full(mi.Float, value, accuracy.shape.n_entries))
    accuracy.drift = dr.full(mi.Float, drift, accuracy.shape.n_regions)
    dr.make_opaque(accuracy)


# ---------------------------------------------------------------- what is measured


def pairs(rng, n, bias_o, bias_i, noise, level=1.0) -> Pairs:
    """Estimates of a radiance `level`, of relative standard deviation `noise`, half of it direct, by caches that are
    off by relative biases."""

    def noisy(mean, sigma):
        return mi.Color3f(mi.Float((level * (mean + sigma * rng.standard_normal(n))).astype(np.float32)))

    x = mi.Point3f(rng.random((3, n)).astype(np.float32))
    direct = tuple(noisy(0.5, 0.0) for _ in range(2))
    bounce = tuple(noisy(0.5, noise) for _ in range(2))
    incident = tuple(noisy(0.5 + bias_i, noise / 2) for _ in range(2))
    valid = mi.Bool(rng.random(n) < 0.9)
    normal = dr.zeros(mi.Vector3f, n) + mi.Vector3f(0, 0, 1)
    return Pairs(x, normal, mi.Color3f(dr.full(mi.Float, level * (1 + bias_o), n)), direct, bounce, incident, valid)


def observe(accuracy, p: Pairs, target=1.0, prediction=1.0, decay=1.0) -> None:
    n = dr.width(p.valid)
    colours = [mi.Color3f(dr.full(mi.Float, v, n)) for v in (target, prediction)]
    accuracy.observe(p, p.position, *colours, p.valid, dr.opaque(mi.Float, decay))


@pytest.mark.parametrize("level", [1e-4, 1.0, 1e4])
def test_biases_and_noise_are_found_in_the_noise(rng, level):
    """Biases of 0.3 and -0.2 under noise of 1, from 2 x 20 x 10^4 estimates; 4 standard errors."""
    accuracy = Accuracy(*BOX, AccuracyShape(resolution=1), scale=level)
    for _ in range(20):
        observe(accuracy, pairs(rng, 10_000, 0.3, -0.2, 1.0, level))
    square = 1.3**2 + 1e-2  # differences are relative to the prediction
    expected = {"noise_bounce": 1, "noise_incident": 0.25, "bias_incident": 0.04, "bias_outgoing": 0.09,
                "bias_product": -0.06}  # fmt: skip
    found = accuracy.summary()
    print(found, {k: v / square for k, v in expected.items()})
    for name, value in expected.items():
        assert found[name] == pytest.approx(value / square, abs=4 * 1.2 / math.sqrt(180_000)), name
    entry = accuracy._entry(mi.Point3f(0.5), mi.Vector3f(0, 0, 1))
    for name, value in expected.items():
        assert float(dr.gather(mi.Float, getattr(accuracy, name), entry)[0]) == pytest.approx(value / square, abs=0.012)


def test_cells_tell_places_apart(rng):
    """A cache that is right on one side of the box and 0.3 too bright on the other."""
    accuracy = Accuracy(*BOX, AccuracyShape(resolution=2))
    for _ in range(20):
        p = pairs(rng, 4096, 0.0, 1.0, 0.2)
        p.outgoing = dr.select(p.position.x < 0.5, p.outgoing, 1.3 * p.outgoing)
        observe(accuracy, p)
    x = mi.Point3f([0.25, 0.75], 0.25, 0.25)
    share = np.array(accuracy.choose(x, mi.Vector3f(0, 0, 1) + dr.zeros(mi.Vector3f, 2), 1.0)[0])
    print(f"shares {share}")
    assert share[0] > 0.8 and share[1] == pytest.approx(0.04 / (0.04 + 0.09), abs=0.03)


def test_without_a_bias_only_what_is_not_known_counts(rng):
    """The bias found is its standard error, and falls as pairs come in; so the share rises."""
    shares = []
    for n in (256, 2**14, 2**20):
        accuracy = Accuracy(*BOX)
        observe(accuracy, pairs(rng, n, 0.0, 1.0, 1.0))
        shares.append(float(accuracy.choose(mi.Point3f(0.5), mi.Vector3f(0, 0, 1), 64.0)[0][0]))
    print(shares)
    assert 0 < shares[0] < shares[1] < shares[2] and shares[2] > 0.8


def test_where_nothing_was_measured_nothing_is_trusted():
    accuracy = Accuracy(*BOX)
    share, incident = accuracy.choose(mi.Point3f(0.5), mi.Vector3f(0, 0, 1), 1.0)
    assert share[0] == 0 and not incident[0] and accuracy.stops(mi.Point3f(0.5), 1.0)[0] < 1e-20


def test_mix_is_the_best_one():
    w = np.linspace(0, 1, 2001)
    for e, b, c in ((1, 0.5, 0), (0.2, 0.3, 0.1), (0.2, 0.3, 0.24), (0.1, 0.4, -0.1), (0.1, 0.12, 0.105)):
        error = w**2 * b + (1 - w) ** 2 * e + 2 * w * (1 - w) * c
        share, least = mix(mi.Float(e), mi.Float(b), mi.Float(c))
        assert float(least[0]) == pytest.approx(error.min(), rel=1e-5)
        assert float(share[0]) == pytest.approx(w[error.argmin()], abs=1e-3)
    assert [float(v[0]) for v in mix(mi.Float(0), mi.Float(0), mi.Float(0))] == [0, 0]


def test_choice_is_the_smaller_error_in_equal_time():
    accuracy = Accuracy(*BOX)
    for n in (1, 8, 1024):
        for v_i, b_i, c in ((0.1, 1e-3, 0.0), (0.9, 0.0, 0.0), (0.1, 0.5, 0.0), (0.1, 0.05, 0.05)):
            values = {"noise_bounce": 1, "noise_incident": v_i, "bias_incident": b_i, "bias_outgoing": 0.05,
                      "bias_product": c}  # fmt: skip
            for name, value in values.items():
                setattr(accuracy, name, dr.full(mi.Float, value, accuracy.shape.n_entries))
            share, incident = accuracy.choose(mi.Point3f(0.2), mi.Vector3f(1, 0, 0), float(n))
            options = {}  # (incident, mixed): (squared error in equal time, share)
            for kind, noise, bias, cost, cross in (
                (False, 1 / n, 0.0, 1.0, 0.0), (True, v_i / n, b_i, INCIDENT_COST, c),
            ):  # fmt: skip
                w = float(mix(mi.Float(noise + bias), mi.Float(0.05), mi.Float(cross))[0][0])
                slower = (cost + OUTGOING_COST - 1) * noise + bias
                options[kind, False] = cost * noise + bias, 0.0
                options[kind, True] = w**2 * 0.05 + (1 - w) ** 2 * slower + 2 * w * (1 - w) * cross, w
            (kind, _), (_, w) = min(options.items(), key=lambda o: o[1][0])
            assert bool(incident[0]) == kind
            assert float(share[0]) == pytest.approx(0 if w < 0.02 else 1 if w > 0.98 else w, rel=1e-4)


def test_later_vertices_stop_unless_the_mean_is_off(rng):
    right, wrong = Accuracy(*BOX), Accuracy(*BOX)
    for _ in range(10):
        p = pairs(rng, 4096, 0.0, 0.0, 1.0)
        target = mi.Color3f(mi.Float((1 + rng.standard_normal(4096)).astype(np.float32)))
        for accuracy, prediction in ((right, 1.0), (wrong, 2.0)):
            accuracy.observe(p, p.position, target, mi.Color3f(dr.full(mi.Float, prediction, 4096)), p.valid,
                             dr.opaque(mi.Float, 1.0))  # fmt: skip
    x = mi.Point3f(rng.random((3, 64)).astype(np.float32))
    for n in (1, 16):
        assert np.array(right.stops(x, float(n))).mean() > 0.9
    assert np.array(wrong.stops(x, 16.0)).mean() == pytest.approx(1 / (1 + 16 * 0.5), abs=0.03)
    assert np.array(right.stops(x, 1e9)).max() < 0.01, "with enough samples, paths go on"


def test_numbers_that_are_not_finite_count_nothing(rng):
    accuracy = Accuracy(*BOX)
    p = pairs(rng, 256, 0.1, 0.1, 0.1)
    p.valid = dr.full(mi.Bool, True, 256)
    nan = mi.Color3f(dr.select(dr.arange(mi.UInt32, 256) < 10, math.nan, 0.5))
    p.bounce = nan, p.bounce[1]
    observe(accuracy, p)
    assert all(math.isfinite(v) for v in accuracy.summary().values())
    assert all(np.isfinite(v).all() for v in accuracy.snapshot().values())


def test_snapshot_and_reset(rng):
    accuracy, other = Accuracy(*BOX), Accuracy(*BOX)
    empty = accuracy.snapshot()
    observe(accuracy, pairs(rng, 4096, 0.2, 0.1, 1.0))
    other.restore(accuracy.snapshot())
    np.testing.assert_array_equal(np.array(other.bias_outgoing), np.array(accuracy.bias_outgoing))
    np.testing.assert_array_equal(np.array(other.drift), np.array(accuracy.drift))
    accuracy.reset()
    assert all(np.array_equal(v, empty[k]) for k, v in accuracy.snapshot().items())


@pytest.mark.parametrize("key, value", [("resolution", 0), ("region", 0), ("n_entries", 100), ("n_regions", 3)])
def test_impossible_grid_is_refused_by_name(key, value):
    with pytest.raises(ValueError, match=f"{key} is {value}"):
        AccuracyShape(**{key: value})


# ---------------------------------------------------------------- training paths


def test_twins_start_together_and_their_records_are_right(sphere):
    """In the sphere every surface sends out 1, half of it direct: so does each record of either cache say, and each of
    the two estimates of a first vertex, if the cache at the end is right. Error rate 1e-4 each."""
    training = OutgoingTraining(n_paths=2**13)
    field = constant_field(2.0)
    incident = Field([-2] * 3, [2] * 3, FieldShape(n_levels=1, hashmap_size=64, width=4, n_hidden=1))

    def first(si, bsdf, active, sampler):
        return dr.select(active, mi.Color3f(0.5), 0), sampler

    traced = training_paths(
        sphere, sphere.sensors()[0], field, training, mi.UInt32(1), None, False, twins=True, first=first
    )
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
    for k in range(2):
        assert_mean(np.array(p.direct[k] + p.bounce[k])[0][ok], 1, "one more bounce", relative=1e-4)
    n, w = (np.array(v)[:, : 2**13] for v in (traced.outgoing.surface.normal, traced.incident.direction))
    tangent = w - (w * n).sum(axis=0) * n
    products = (tangent[:, ::2] * tangent[:, 1::2]).sum(axis=0)
    assert_mean(products, 0, "directions of the two, along the surface")
    np.testing.assert_allclose(np.array(p.outgoing)[0][ok], 1, rtol=1e-5)
    assert incident.steps == 0


# ---------------------------------------------------------------- each choice alone


def test_trusting_nothing_it_is_path():
    """Rough metal, plastic, glass, all kinds of lights; the caches are untrained."""
    scene = test_scene(lights("all"))
    integrator = auto(freeze_cache=True)
    ours = renders(scene, integrator, 24, 32)
    path = renders(scene, {"type": "path"}, 24, 64, first_seed=1000)
    assert_same_mean(ours, path, "nothing trusted", relative=1e-5)


def copy_of(trained, box, tmp_path, **keys):
    trained.save_cache(tmp_path / "pair")
    integrator = auto(freeze_cache=True, **keys)
    integrator.load_cache(tmp_path / "pair", box)
    return integrator


def outgoing_alone(trained, box, **keys):
    """An `nrc` with the same outgoing cache."""
    integrator = mi.load_dict({"type": "nrc", "freeze_cache": True, **keys})
    integrator.render(box, spp=1)
    integrator.cache.adopt(trained.cache.field.outgoing)
    return integrator


def test_outgoing_cache_at_the_first_vertex_is_nrc_with_threshold_zero(trained, box, tmp_path):
    integrator = copy_of(trained, box, tmp_path, channels="share, depth")
    force(integrator, b_o=0.0)
    image = render(box, integrator, 4)
    known = render(box, outgoing_alone(trained, box, spread_threshold=0.0), 4)
    np.testing.assert_allclose(image[..., :3], known, rtol=1e-4, atol=1e-6)
    assert image[..., 4].max() == 1, "no path was traced"


def test_outgoing_cache_at_later_vertices_is_nrc(trained, box, tmp_path):
    integrator = copy_of(trained, box, tmp_path)
    force(integrator, drift=0.0)
    ours = renders(box, integrator, 24, 32)
    known = renders(box, outgoing_alone(trained, box), 24, 32, first_seed=1000)
    assert_same_mean(ours, known, "nrc", relative=1e-5)


def test_incident_cache_at_the_first_vertex_is_nirc(trained, box, tmp_path):
    integrator = copy_of(trained, box, tmp_path)
    force(integrator, v_i=0.0, b_i=0.0)
    ours = renders(box, integrator, 24, 32)
    alone = mi.load_dict({"type": "nirc", "freeze_cache": True, "termination": "primary"})
    alone.render(box, spp=1)
    alone.cache.adopt(trained.cache.field.incident)
    assert_same_mean(ours, renders(box, alone, 24, 32, first_seed=1000), "nirc", relative=1e-5)


@pytest.mark.parametrize("plugin, keys", [("nirc", {"light_samples": 2, "channels": "direct"}), ("nrc", {})])
def test_older_name_still_works_and_says_the_new_one(plugin, keys, box, capfd):
    old = mi.load_dict({"type": plugin, **SMALL, "termination": "auto", **keys})
    assert "type: neural_path" in "".join(capfd.readouterr())
    new = auto(**({"channels": "traced"} if keys else {}))
    # Trained: equal but for the order of sums
    np.testing.assert_allclose(render(box, old, 4), render(box, new, 4), rtol=0.03, atol=1e-3)


# ---------------------------------------------------------------- all together


def test_trained_image_is_that_of_path(box):
    assert_like_path(box, auto(train_samples=1024, train_frames=150), 0.03, 0.2)


def test_known_answer_within_two_percent(sphere):
    image = render(sphere, auto(train_samples=1024), 16)
    print(f"mean {image.mean():.4f} (known 1)")
    assert abs(image.mean() - 1) < 0.02 and np.abs(image - 1).max() < 0.15


def test_mirror_lobes_are_not_left_to_the_incident_cache():
    """Its directions are those of smooth lobes alone: on plastic, here as much mirror as dark paint, paths go on."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    plastic = {"type": "plastic", "int_ior": 1.8, "diffuse_reflectance": 0.1}
    scene = mi.load_dict({
        "type": "scene", "lamp": {"type": "point", "position": [0, 0, 0.5], "intensity": 3.0},
        "room": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": plastic}},
        "sensor": {"type": "perspective", "fov": 60, "to_world": T().look_at([0, 0, -0.9], [0, 0, 1], [0, 1, 0]),
                   "film": film},
    })  # fmt: skip
    integrator = auto(freeze_cache=True)
    render(scene, integrator, 1)
    force(integrator, v_i=0.0, b_i=0.0)
    assert_same_mean(renders(scene, integrator, 16, 32), renders(scene, {"type": "path"}, 16, 64, first_seed=1000),
                     "plastic", blocks=2, relative=1e-5)  # fmt: skip


def test_mix_has_less_error_than_either_part():
    """The cache at the first vertex alone, tracing alone, and the mix, at 64 samples: 0.0021, 0.0025, 0.0020."""
    box = mi.load_file(str(scenes.path("cornell_box")), resx=48, resy=48)
    trained = auto(train_samples=1024)
    trained.train(box, 200)
    path = np.array(mi.render(box, integrator=mi.load_dict({"type": "path"}), spp=1024), dtype=np.float64)
    keys = {"spread_threshold": 0.0}, {}
    parts = [outgoing_alone(trained, box, **k) for k in keys]
    lamp = ndimage.maximum_filter(path.max(axis=-1), 3)[..., None] > 1  # its edges are as noisy whatever is traced
    weight = np.where(lamp, 0, 1 / (path.mean(axis=-1, keepdims=True) ** 2 + 1e-2))

    def error(integrator):
        images = np.stack([render(box, integrator, 64, k) for k in range(2)])
        return np.mean((images - path) ** 2 * weight)

    cache, traced, ours = error(parts[0]), error(parts[1]), error(trained)
    print(f"squared errors: cache {cache:.4f}, traced {traced:.4f}, auto {ours:.4f}")
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


# ---------------------------------------------------------------- state


def test_saved_caches_give_the_same_image(trained, box, sphere, tmp_path):
    image = render(box, trained, 4, 3)[..., :3]
    other = copy_of(trained, box, tmp_path)
    np.testing.assert_array_equal(render(box, other, 4, 3), image)
    with pytest.raises(CacheFileError, match="another scene"):
        auto().load_cache(tmp_path / "pair", sphere)
    with pytest.raises(CacheFileError, match="holds no outgoing radiance"):
        mi.load_dict({"type": "nrc"}).load_cache(tmp_path / "pair")
    with pytest.raises(CacheFileError, match="no incident radiance alone"):
        mi.load_dict({"type": "nirc"}).load_cache(tmp_path / "pair")
    trained.cache.field.outgoing.save(tmp_path / "one")
    with pytest.raises(CacheFileError, match="does not hold both"):
        auto().load_cache(tmp_path / "one")
    assert PairField.load(tmp_path / "pair")[0].steps == 60


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
    before = integrator.cache.field.snapshot()
    integrator.prepare(box, spp=2)
    after = integrator.cache.field.snapshot()
    assert all(np.array_equal(v, after[k]) for k, v in before.items())
    s = integrator.statistics()
    assert s["noise_bounce"] > 0 and s["steps"] == 13


# ---------------------------------------------------------------- refused


@pytest.mark.parametrize("keys, message", [
    ({"cache_samples": 0}, "cache_samples is 0"),
    ({"cache_samples": 1.5}, "cache_samples is 1.5; give a whole number"),
    ({"blend": "fast"}, "blend is 'fast'"),
    ({"train_samples": 1}, "train_samples is 1"),
    ({"blend": "reliability"}, "blend is 'reliability'"),
])  # fmt: skip
def test_impossible_combination_is_refused(keys, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        auto(**keys)


@pytest.mark.parametrize("plugin", ["nirc", "nrc"])
def test_unknown_termination_is_refused(plugin):
    with pytest.raises((ValueError, RuntimeError), match="termination"):
        mi.load_dict({"type": plugin, "termination": "sometimes"})
