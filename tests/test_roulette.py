"""Roulette by what lies ahead keeps the mean whatever is expected, and what is expected is learned by place."""

import importlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW, sweep
from two_level_bench import Bench, render, split_of

from mi_neural.caches import guide as guides
from mi_neural.caches.outlook import ENTRIES, Outlook
from mi_neural.estimators import roulette

KINDS = ("learned", "nonsense", "broken")
#: Divisions (n_cache, n_traced, probability, alpha, roulette, guide).
SPLITS = {"one": (0, 1, 1.0, 0.0, 0.5, 0.0), "four": (0, 4, 1.0, 0.0, 0.2, 0.0), "strong": (0, 1, 1.0, 0.0, 3.0, 0.0),
          "guided": (0, 1, 1.0, 0.0, 0.0, 0.5), "both": (0, 2, 1.0, 0.0, 0.5, 0.8),
          "with cache": (4, 2, 0.5, 1.0, 0.5, 0.3)}  # fmt: skip
KEYS = {"roulette": 0.5, "guide": 0.5}


@pytest.fixture(scope="module")
def bench():
    return Bench()


def tell(integrator, kind: str) -> None:
    """Give the outlook random or broken tables."""
    if kind == "learned":
        return
    outlook, rng = integrator.choice.outlook, np.random.default_rng(3)
    for name in ("ahead", "visible"):
        values = 10 ** rng.uniform(-3, 1, ENTRIES)
        if kind == "broken":
            bad = rng.random(ENTRIES) < 0.3
            values = np.where(bad, rng.choice([np.nan, np.inf, -np.inf, -1.0, 0.0], ENTRIES), values)
        setattr(outlook, name, mi.Float(values.astype(np.float32)))
    dr.make_opaque(outlook.ahead, outlook.visible)
    light = 10 ** rng.uniform(-3, 1, (guides.ENTRIES, guides.N_BINS))
    outlook.guide = guides.Guide(*outlook.box, light, np.full(guides.ENTRIES, guides.FEW))


def check(bench, name, kind, splits, cache="trained", **keys):
    integrator, _ = bench.integrator(name, **KEYS, **keys)
    integrator.choice.outlook = None
    integrator.bind(bench.scene(name), bench.scene(name).sensors()[0], train=False)
    tell(integrator, kind)
    bench.check(name, cache, splits, **KEYS, **keys)


# ---------------------------------------------------------------- the probability


def test_probability_is_one_where_nothing_is_to_be_left_out():
    expected = mi.Float([0.0, 1.0, np.inf, np.nan])
    assert np.array(roulette.survival(expected, 1, 0, 0.1)).tolist() == [1, 1, 1, 1]
    assert np.array(roulette.survival(expected, 2, 1, 0.1)).tolist() == pytest.approx([0.1, 0.5, 1, 1])


def test_weights_of_paths_are_bounded():
    weights = mi.Float([0.01, 0.5, 1.0, 5.0, 10.0, 100.0])
    q = roulette.least_of(weights)
    assert np.array(q).tolist() == pytest.approx([0.1, 0.1, 0.1, 0.5, 1, 1])
    assert (np.array(weights / q)[:5] <= 10 + 1e-4).all()


@pytest.mark.parametrize("level", [0.0, -1.0, np.nan, np.inf])
def test_probability_stays_in_its_limits_for_any_level(level):
    q = np.array(roulette.survival(mi.Float([0.0, 1e-6, 1.0, 1e6]), mi.Float(level), mi.Float(0.5), 0.1))
    assert (q >= 0.1 - 1e-6).all() and (q <= 1).all()


def test_strength_follows_the_noise():
    assert roulette.strength_of(4.0) == pytest.approx(2 * roulette.strength_of(1.0))
    assert roulette.strength_of(0.0) == roulette.strength_of(-1.0) == roulette.strength_of(np.inf) == 0


# ---------------------------------------------------------------- what is expected


def test_outlook_of_a_sphere_is_its_radiance_everywhere(bench):
    """Point-lit sphere of albedo 1/2: the surface sends out 1, and all light samples arrive."""
    scene = bench.scene("point_lit_sphere")
    outlook = Outlook.learn(scene, scene.sensors()[0], None, 1)
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), mi.warp.square_to_uniform_sphere(mi.PCG32(256).next_float32() * mi.Vector2f(1)))
    si = scene.ray_intersect(ray)
    ahead, visible = (np.array(f(si, mi.Bool(True))) for f in (outlook.ahead_at, outlook.visible_at))
    print("radiance", ahead.mean(), ahead.std(), "visible", visible.min())
    assert float(outlook.mean[0]) == pytest.approx(1, abs=0.02)
    assert ahead.mean() == pytest.approx(1, abs=0.03) and ahead.std() < 0.25
    assert visible.min() > 0.9


def test_light_samples_in_the_shade_are_known(bench):
    """In the Cornell box the ceiling sees no front of the lamp, and some of the floor is in the shadow of the boxes."""
    scene = bench.scene("cornell_box")
    outlook = Outlook.learn(scene, scene.sensors()[0], None, 1, n_paths=2**14)
    visible = np.array(outlook.visible)
    assert ((visible > 0) & (visible <= 1)).all() and visible.min() < 0.3 and (visible > 0.8).any()


def test_outlook_of_darkness_is_nothing():
    ball, light = {"type": "sphere", "center": [0, 0, 5]}, {"type": "constant", "radiance": 0.0}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "ball": ball, "light": light})
    outlook = Outlook.learn(scene, scene.sensors()[0], None, 0, n_paths=256)
    assert np.isfinite(np.array(outlook.ahead)).all() and float(outlook.mean[0]) == 0


# ---------------------------------------------------------------- directions


@pytest.fixture(scope="module")
def guide():
    """A guide of random tables, one entry without light."""
    light = 10 ** np.random.default_rng(1).uniform(-2, 1, (guides.ENTRIES, guides.N_BINS))
    light[7] = 0
    return guides.Guide([0.0] * 3, [1.0] * 3, light, np.full(guides.ENTRIES, guides.FEW))


def test_bins_are_those_that_their_directions_came_from():
    index = dr.arange(mi.UInt32, guides.N_BINS)
    for u in ((0.01, 0.01), (0.5, 0.5), (0.99, 0.99)):
        d = guides.direction_in(index, mi.Point2f(*u))
        assert np.allclose(np.array(dr.norm(d)), 1, atol=1e-5)
        assert np.array_equal(np.array(guides.bin_of(d)), np.array(index))


@pytest.mark.parametrize("cell", [3, 7])
def test_directions_have_the_density_that_is_said(guide, cell):
    """E[1/p] over half the sphere is its solid angle, and each bin is met as often as its share."""
    n = 2**20
    rng = mi.PCG32(n)
    d = guide.sample(mi.UInt32(cell), rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32()), True)
    p = np.array(guide.pdf(mi.UInt32(cell), d, True))
    met = np.bincount(np.array(guides.bin_of(d)), minlength=guides.N_BINS)
    shares = np.array(guide.shares).reshape(-1, guides.N_BINS)[cell].astype(np.float64)
    assert shares.sum() == pytest.approx(1, abs=1e-5)
    assert ((met - n * shares) ** 2 / (n * shares)).sum() < 400  # chi2 with 287 degrees of freedom: p = 1e-5
    assert (np.where(np.array(d.y) > 0, 1 / p, 0)).mean() == pytest.approx(2 * np.pi, rel=0.02)


def test_guide_of_a_room_looks_at_its_light(bench):
    """On the floor of the Cornell box, the table has more than the cosine's share in directions that go up."""
    scene = bench.scene("cornell_box")
    outlook = Outlook.learn(scene, scene.sensors()[0], None, 1, n_paths=2**14)
    outlook.learn_guide(scene, scene.sensors()[0], None, 1, n_paths=2**16, times=1)
    known = np.array(outlook.guide.known) > 0
    shares = np.array(outlook.guide.shares).reshape(-1, guides.N_BINS)
    assert known.sum() > 20 and np.allclose(shares.sum(axis=1), 1, atol=1e-4)
    assert shares[known].max() > 5 / guides.N_BINS


# ---------------------------------------------------------------- the mean is that of path


@pytest.mark.parametrize("kind, split", sweep(
    [(kind, split) for kind in KINDS for split in SPLITS],
    [("learned", "both"), ("broken", "with cache"), ("nonsense", "guided")],
))  # fmt: skip
def test_mean_is_that_of_path_whatever_is_expected(bench, kind, split):
    check(bench, "cornell_box", kind, {split: SPLITS[split]})


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_mean_in_the_sphere_is_that_of_path(bench, kind):
    check(bench, "point_lit_sphere", kind, SPLITS)


@SLOW
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("keys", [{}, {"ris": True}, {"every_vertex": True}, {"light_sampler": {"type": "nvc_lights"}}],
                         ids=["plain", "ris", "every_vertex", "lights"])  # fmt: skip
@pytest.mark.parametrize("name", ["lit_cube", "glossy_hall", "lamp_bays"])
def test_mean_in_more_scenes_by_every_setting(bench, name, keys, kind):
    names = ("one", "strong", "both", "with cache") if "ris" not in keys else ("one", "strong", "guided")
    check(bench, name, kind, {n: SPLITS[n] for n in names}, **keys)


@SLOW
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["cornell-box", "veach-bidir", "staircase2", "veach-ajar"])
def test_mean_in_well_known_scenes(bench, shared_scenes, name, kind):
    if name not in bench.scenes:
        bench.scenes[name] = mi.load_file(str(shared_scenes / name / "scene.xml"), resx=48, resy=27)
    check(bench, name, kind, SPLITS)


# ---------------------------------------------------------------- the keys


def test_without_strength_it_is_path_tracing(bench):
    """Bit for bit the same, whatever the outlook and the guide."""
    scene = bench.scene("cornell_box")
    integrator, _ = bench.integrator("cornell_box", **KEYS)
    integrator.choice.split = split_of((0, 1, 1.0, 0.0, 0.0, 0.0))
    image = render(scene, integrator)
    tell(integrator, "nonsense")
    assert np.array_equal(image, render(scene, integrator))


def test_strength_is_measured_with_the_division(bench, monkeypatch):
    pilot = importlib.import_module("mi_neural.integrators.pilot")
    monkeypatch.setattr(pilot, "PILOT_SAMPLES", 2**12)
    scene = bench.scene("cornell_box")
    integrator = mi.load_dict({"type": "nirc_two_level", "alpha": 0.0, "cache_samples": 0, "roulette": 0.5})
    render(scene, integrator, 1)
    assert integrator.statistics()["split"] == "path tracing, 1 path, roulette 0.5"
    integrator = mi.load_dict({"type": "nirc_two_level", "train_samples": 512, "train_frames": 2, "train_steps": 0,
                               **NETWORK})  # fmt: skip
    render(scene, integrator, 1)
    strengths = {t["roulette"] for t in integrator.measure(scene)["pilot"]}
    assert 0 in strengths and len(strengths) == 4
    assert {t["guide"] for t in integrator.statistics()["pilot"]} == {0.0, 0.5}
    assert (integrator.choice.outlook.guide is None) == (integrator.split.guide == 0)
    integrator.reset()
    assert integrator.choice.outlook is None


@pytest.mark.parametrize("key, value", [("roulette", -0.1), ("roulette", np.nan), ("roulette", np.inf),
                                        ("guide", -0.1), ("guide", 1.0), ("guide", np.nan)])  # fmt: skip
def test_impossible_key_is_refused_by_name(key, value):
    with pytest.raises((ValueError, RuntimeError), match=f"nirc_two_level: {key} is"):
        mi.load_dict({"type": "nirc_two_level", key: value})


def test_equal_seeds_give_equal_images(bench):
    scene = bench.scene("cornell_box")
    images = [render(scene, mi.load_dict({"type": "nirc_two_level", "cache_samples": 0, **NETWORK, **KEYS}), seed=3)
              for _ in range(2)]  # fmt: skip
    assert np.array_equal(*images)
