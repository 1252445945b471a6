"""Groups of lights, bounds on what they give, and how one is chosen."""

import itertools
import math
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from expectation import ERROR_RATE
from light_scenes import (
    MIXED,
    CountingSampler,
    at,
    glow,
    mixed_lights,
    place,
    random_triangles,
    row,
    scene_of,
    shining_triangles,
    triangles,
    uniforms,
)
from scipy import stats

from mi_neural.caches import visibility
from mi_neural.light_noise import light_noise
from mi_neural.lights import sampling
from mi_neural.lights.clusters import Groups, kmeans, make_groups
from mi_neural.lights.entries import DIRECTION, ENVIRONMENT, LOCAL
from mi_neural.lights.importance import importance
from mi_neural.lights.sampling import PowerLights, TreeLights, UniformLights, VisibleLights
from mi_neural.lights.table import LightTable


@pytest.fixture(scope="module")
def mixed():
    return mixed_lights()


# ---------------------------------------------------------------- clusters


@pytest.fixture(scope="module")
def swarm(tmp_path_factory):
    """100 triangles in four classes of brightness, a point light, the sun and a sky."""
    rng = np.random.default_rng(5)
    lights = {"spark": MIXED["spark"], "sun": MIXED["sun"]}
    for k in range(4):
        path = tmp_path_factory.mktemp("swarm") / "m.ply"
        lights[f"m{k}"] = {**triangles(path, random_triangles(rng, 25, size=0.3)), "emitter": glow(10.0**k / 100)}
    scene = scene_of(lights, "constant")
    return scene, LightTable(scene)


def test_kmeans_is_a_partition_in_which_each_point_is_nearest_to_its_mean(rng):
    points, weights = rng.normal(size=(600, 3)), rng.uniform(0.1, 1, 600)
    label = kmeans(points, 8, weights, rounds=200)
    assert label.shape == (600,) and set(label) == set(range(8))
    means = np.stack([np.average(points[label == k], axis=0, weights=weights[label == k]) for k in range(8)])
    d = np.linalg.norm(points[:, None] - means, axis=-1)
    assert (d[np.arange(600), label] <= d.min(axis=1) + 1e-9).all()
    np.testing.assert_array_equal(label, kmeans(points, 8, weights, rounds=200))


def test_kmeans_of_few_or_equal_points(rng):
    np.testing.assert_array_equal(kmeans(rng.normal(size=(3, 3)), 8, np.ones(3)), [0, 1, 2])
    assert set(kmeans(np.ones((50, 3)), 8, np.ones(50))) == {0}
    two = np.repeat([[0.0, 0, 0], [1, 1, 1]], 20, axis=0)
    assert len(set(kmeans(two, 8, np.ones(40)))) == 2


@pytest.mark.parametrize("n_outputs", [4, 32, 150])
def test_clusters_are_a_partition_with_probabilities_that_sum_to_one(swarm, n_outputs):
    _, table = swarm
    g = make_groups(table, n_outputs, "kmeans")
    assert g.n_groups <= n_outputs and sum(np.array(g.count)) == table.n_lights
    np.testing.assert_array_equal(np.sort(np.array(g.member)), np.arange(table.n_lights))
    label, within = np.array(g.group_of), np.array(g.within, np.float64)
    np.testing.assert_allclose(np.bincount(label, within), 1, rtol=1e-5)
    assert (within > 0).all()
    for k in range(g.n_groups):
        first, count = np.array(g.start)[k], np.array(g.count)[k]
        members = np.array(g.member)[first : first + count]
        assert (label[members] == k).all()
        np.testing.assert_allclose(np.array(g.cumulative)[first : first + count], np.cumsum(within[members]), atol=1e-5)
    assert [g.kind[label[i]] for i in range(table.n_lights)] == table.columns["kind"].tolist()


def test_as_many_outputs_as_lights_give_each_its_own_group(swarm):
    _, table = swarm
    for n in (table.n_lights, table.n_lights + 5):
        g = make_groups(table, n, "kmeans")
        assert g.single and g.n_groups == table.n_lights
        np.testing.assert_array_equal(np.array(g.within), 1)
        for name in ("center", "axis", "radius", "cone", "intensity"):
            known = table.columns[name].T
            np.testing.assert_allclose(np.array(getattr(g, name)), known, rtol=1e-5, atol=1e-6, err_msg=name)
        index, p = g.sample_light(mi.UInt32(3), mi.Float(0.5), mi.Bool(True))
        assert np.array(index)[0] == 3 and np.array(p)[0] == 1


def test_sampled_lights_have_the_frequencies_of_within(swarm):
    """χ², for each of six groups."""
    _, table = swarm
    g = make_groups(table, 6, "kmeans")
    n = 2**16
    label, within = np.array(g.group_of), np.array(g.within, np.float64)
    for k in range(g.n_groups):
        index, p = g.sample_light(mi.UInt32(k), uniforms(n, k).next_1d(), mi.Bool(True))
        index, p = np.array(index) * np.ones(n, int), np.array(p)
        assert (label[index] == k).all()
        np.testing.assert_allclose(p, within[index], rtol=1e-6)
        assert_frequencies(np.bincount(index, minlength=table.n_lights), within * (label == k), f"group {k}")


def assert_frequencies(found, pmf, what="") -> None:
    """χ² test of counts against probabilities; cells of fewer than 10 expected counts are pooled."""
    pmf, n = np.asarray(pmf, np.float64), found.sum()
    assert (found[pmf == 0] == 0).all()
    many = pmf * n >= 10
    found, expected = np.append(found[many], found[~many].sum()), n * np.append(pmf[many], pmf[~many].sum())
    found, expected = found[expected > 0], expected[expected > 0]
    chi2 = ((found - expected) ** 2 / expected).sum()
    bound = stats.chi2.isf(ERROR_RATE, max(len(found) - 1, 1)) if len(found) > 1 else 1e-6
    print(f"{what}: χ² {chi2:.1f}, bound {bound:.1f}, {len(found)} cells")
    assert chi2 <= bound


@pytest.mark.parametrize("u", [0.0, 0.5, 1 - 2**-24])
def test_extreme_numbers_choose_a_member(swarm, u):
    _, table = swarm
    g = make_groups(table, 5, "kmeans")
    for k in range(g.n_groups):
        index, p = g.sample_light(mi.UInt32(k), mi.Float(u), mi.Bool(True))
        assert np.array(g.group_of)[np.array(index)[0]] == k and np.array(p)[0] > 0


def test_group_bounds_contain_their_members(swarm):
    _, table = swarm
    c = table.columns
    g = make_groups(table, 10, "kmeans")
    label = np.array(g.group_of)
    center, axis = np.array(g.center).T, np.array(g.axis).T
    local = c["kind"] == LOCAL
    reach = np.linalg.norm(c["center"] - center[label], axis=1) + c["radius"] - np.array(g.radius)[label]
    assert reach[local].max() <= 1e-4
    angle = np.arccos(np.clip((axis[label] * c["axis"]).sum(axis=1), -1, 1)) + np.arccos(np.clip(c["cone"], -1, 1))
    cone = np.arccos(np.clip(np.array(g.cone)[label], -1, 1))
    assert (angle <= cone + 1e-3)[local & (np.array(g.cone)[label] > -1)].all()
    total = np.bincount(label, c["intensity"].astype(float))
    np.testing.assert_allclose(np.array(g.intensity), total, rtol=1e-4)


def test_lights_by_emitter_and_what_auto_chooses(swarm, mixed):
    _, table = swarm
    g = make_groups(table, 32, "emitter")
    assert g.n_groups == 7 and len(set(zip(np.array(g.group_of), table.columns["emitter"], strict=False))) == 7
    assert make_groups(table, 32, "auto").n_groups == 7
    assert make_groups(mixed[1], 12, "auto").n_groups == 9
    assert make_groups(table, 6, "auto").n_groups <= 6


def test_impossible_groups_are_refused(swarm):
    _, table = swarm
    with pytest.raises(ValueError, match=r"7 emitters, more than the 5 outputs.*raise outputs"):
        make_groups(table, 5, "emitter")
    with pytest.raises(ValueError, match=r"2 lights are at infinity.*2 outputs; raise outputs"):
        make_groups(table, 2, "kmeans")


def test_dark_groups_share_their_probability_equally(swarm):
    _, table = swarm
    g = Groups(table, np.arange(table.n_lights) % 3, np.zeros(table.n_lights))
    np.testing.assert_allclose(np.array(g.within), 1 / np.array(g.count)[np.array(g.group_of)], rtol=1e-5)


def test_probabilities_of_very_many_lights_are_those_they_are_chosen_with(tmp_path, rng):
    """In single precision a running sum of 1e5 terms is good to a hundredth of a term: pmf must be what is left of
    it.
    """
    mesh = triangles(tmp_path / "m.ply", random_triangles(rng, 50_000))
    table = LightTable(mi.load_dict({"type": "scene", "m": {**mesh, "emitter": glow()}}))
    g = Groups(table, np.zeros(table.n_lights, int))
    steps = np.diff(np.array(g.cumulative, np.float64), prepend=0)
    within = np.array(g.within, np.float64)[np.array(g.member)]
    print(f"largest relative error of a probability {np.abs(within / steps - 1).max():.1e}")
    np.testing.assert_allclose(within, steps, rtol=1e-3)


# ---------------------------------------------------------------- bounds


class One:
    """Columns of one light for each receiver."""

    def __init__(self, columns, index, kind=LOCAL, n=1):
        def take(v, t):
            return (
                    t(*(np.repeat(np.array(v)[:, [index]], n, axis=1)))
                    if np.ndim(v) > 1
                    else t(
                        np.repeat(np.array(v)[index], n)
                    )
                )
        self.kind = kind
        self.center, self.axis = take(columns.center, mi.Vector3f), take(columns.axis, mi.Vector3f)
        self.radius, self.cone = take(columns.radius, mi.Float), take(columns.cone, mi.Float)
        self.intensity = take(columns.intensity, mi.Float)


def received(corners, normals, x, n, two_sided=False, steps=12) -> np.ndarray:
    """Largest cos_i cos_l / d² over points of each triangle, brute force: (lights, receivers)."""
    a, b = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1))
    a, b = (v[a + b <= steps] / steps for v in (a, b))
    w = np.stack([1 - a - b, a, b], -1)
    points = np.einsum("kc,lcx->lkx", w, corners.astype(float))
    d = points[:, :, None] - x[None, None]
    d2 = (d**2).sum(axis=-1)
    d = d / np.sqrt(d2)[..., None]
    cos_i, cos_l = (d * n).sum(axis=-1), -(d * normals[:, None, None]).sum(axis=-1)
    cos_i = np.abs(cos_i) if two_sided else cos_i
    eps = 1e-4
    return (np.where((cos_i > eps) & (cos_l > eps), cos_i * cos_l, 0) / d2).max(axis=1)


@pytest.mark.parametrize("scale, two_sided", sweep(
    [(scale, two_sided) for scale in (1e-4, 1, 1e5) for two_sided in (False, True)],
    [(1e-4, True), (1, False), (1e5, True)],
))  # fmt: skip
def test_importance_is_positive_wherever_a_point_of_the_light_can_be_seen(tmp_path, rng, scale, two_sided):
    """Random triangles, near and far receivers, groups of 1 and of several; and no more than 4 times too small."""
    corners, table = shining_triangles(tmp_path, rng, scale)
    c = table.columns
    n = 400
    x = (rng.normal(size=(n, 3)) * rng.choice([0.5, 2, 20], (n, 1)) * scale).astype(np.float32)
    normal = rng.normal(size=(n, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    known = received(corners, c["normal"], x, normal, two_sided) * c["intensity"][:, None]
    X, N = mi.Point3f(*x.T), mi.Vector3f(*normal.T)
    found = np.stack([np.array(importance(One(table, k, n=n), X, N, mi.Bool(two_sided))) for k in range(64)])
    assert np.isfinite(found).all() and (found > 0)[known > 0].all()
    assert (found == 0).any(), "a bound that excludes nothing"
    for g in (make_groups(table, 12, "kmeans"), Groups(table, np.arange(64) // 2)):
        label = np.array(g.group_of)
        found = np.stack([np.array(importance(One(g, k, n=n), X, N, mi.Bool(two_sided))) for k in range(g.n_groups)])
        best = np.zeros_like(found)
        np.maximum.at(best, label, known)
        assert np.isfinite(found).all() and (found > 0)[best > 0].all()


def test_importance_is_zero_behind_the_receiver_and_behind_the_light():
    light = {"type": "rectangle", "to_world": at(0, 0, 3).rotate([1, 0, 0], 180), "emitter": glow()}
    table = LightTable(mi.load_dict({"type": "scene", "light": light}))
    up, down = mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, -1)
    one_sided, two_sided = mi.Bool(False), mi.Bool(True)
    value = lambda z, n, s: importance(One(table, 0), mi.Point3f(0, 0, z), n, s)[0]  # noqa: E731
    assert value(0.0, up, one_sided) > 0 and value(0.0, down, one_sided) == 0 and value(0.0, down, two_sided) > 0
    assert value(6.0, down, one_sided) == 0 and value(6.0, up, two_sided) == 0
    assert value(0.0, up, one_sided) == pytest.approx(4 / 9, rel=0.01)


def test_importance_of_the_sun_is_its_cosine_and_of_the_sky_constant(mixed):
    scene, table = mixed
    (sun,), (sky,) = row(scene, table, "sun"), row(scene, table, "sky")
    n = mi.Vector3f(0, 0, 1)
    x = mi.Point3f(0, 0, 0)
    assert importance(One(table, sun, DIRECTION), x, n, mi.Bool(False))[0] == pytest.approx(
        0.5 / np.sqrt(1.13), rel=1e-4
    )
    assert importance(One(table, sun, DIRECTION), x, -n, mi.Bool(False))[0] == 0
    assert importance(One(table, sun, DIRECTION), x, -n, mi.Bool(True))[0] == pytest.approx(
        0.5 / np.sqrt(1.13), rel=1e-4
    )
    values = {importance(One(table, sky, ENVIRONMENT), x, v, mi.Bool(False))[0] for v in (n, -n)}
    assert len(values) == 1 and values.pop() > 0


def test_importance_of_mixed_kinds_in_one_array_is_that_of_each_kind(mixed):
    _, table = mixed
    x, n = mi.Point3f(0.1, 0.2, 0.3), mi.Vector3f(0, 0.6, 0.8)

    class All:
        pass

    light = All()
    for name in ("kind", "center", "radius", "axis", "cone", "intensity"):
        setattr(light, name, getattr(table, name))
    together = np.array(importance(light, x, n, mi.Bool(False)))
    apart = [
        importance(One(table, k, int(kind)), x, n, mi.Bool(False))[0] for k, kind in enumerate(table.columns["kind"])
    ]
    np.testing.assert_allclose(together, apart, rtol=1e-5)


# ---------------------------------------------------------------- choosing


class Predicted:
    """Stands for a network: random visibilities, some 0, of each group."""

    def __init__(self, n, values=None):
        self.values = np.random.default_rng(n).choice([0, 0.01, 0.5, 1], n) if values is None else values

    def query(self, x):
        return [mi.Float(float(v)) for v in self.values]


def samplers_of(table) -> dict:
    few = make_groups(table, 6, "kmeans")
    samplers = {
        "uniform": UniformLights(table), "power": PowerLights(table), "tree": TreeLights(table),
        "clusters": VisibleLights(table, few),
        "one candidate": VisibleLights(table, few, Predicted(few.n_groups), candidates=1),
    }  # fmt: skip
    if table.n_lights <= 32:
        single = make_groups(table, 32)
        samplers["unshadowed"] = VisibleLights(table, single)
        samplers["predicted"] = VisibleLights(table, single, Predicted(table.n_lights))
    return samplers


ALL = [
    *[("mixed", name) for name in ("uniform", "power", "tree", "unshadowed", "predicted", "clusters", "one candidate")],
    *[("swarm", name) for name in ("uniform", "power", "tree", "clusters", "one candidate")],
]
#: Of the default run.
SOME = [*(("mixed", name) for name in ("uniform", "power", "tree", "predicted")), ("swarm", "tree"),
        ("swarm", "clusters")]  # fmt: skip
PLACES = [([0.2, 0.1, 0.3], [0, 0, 1]), ([-1.5, 1, 2], [0.6, 0, -0.8]), ([0, 0, 3], [0, 0, 1])]


@pytest.fixture(scope="module")
def choosers(swarm, mixed):
    return {"swarm": samplers_of(swarm[1]), "mixed": samplers_of(mixed[1])}


def pmf_of_all(sampler, p, n) -> np.ndarray:
    count = sampler.table.n_lights
    pmf = sampler.pmf(place(p, count), mi.Vector3f(*n), mi.Bool(False), dr.arange(mi.UInt32, count), mi.Bool(True))
    return np.array(pmf, np.float64) * np.ones(count)


def draws(sampler, p, n, count=2**17, seed=0, hit=0):
    rng = uniforms(count, seed)
    u = rng.next_1d()
    seen_from = (place(p, count), mi.Vector3f(*n), mi.Bool(False))
    choice = sampler.choose(*seen_from, u, rng, mi.UInt32(hit), mi.Bool(True))
    pmf_hit = choice.of_hit(sampler, *seen_from, mi.UInt32(hit), mi.Bool(True))
    return [np.array(v) * np.ones(count) for v in (choice.index, choice.weight, choice.pmf, pmf_hit)]


@pytest.mark.parametrize("where, name", ALL)
def test_probabilities_of_all_lights_sum_to_one(choosers, where, name):
    """Of a tree with those of its dead ends: nodes that might reach the point, of whose lights none does."""
    for k, (p, n) in enumerate(PLACES):
        pmf = pmf_of_all(choosers[where][name], p, n)
        nothing = (draws(choosers[where][name], p, n, 2**16, seed=k)[1] == 0).mean() if name == "tree" else 0
        bound = stats.norm.isf(ERROR_RATE / 12) * np.sqrt(nothing / 2**16)
        assert (pmf >= 0).all() and pmf.sum() + nothing == pytest.approx(1, rel=1e-4, abs=bound + 1e-6)


@pytest.mark.parametrize("where, name", ALL)
def test_probability_of_the_light_met_is_its_probability(choosers, where, name):
    sampler = choosers[where][name]
    p, n = PLACES[1]
    pmf = pmf_of_all(sampler, p, n)
    hits = np.arange(sampler.table.n_lights)
    _, _, _, found = draws(sampler, p, n, len(hits), hit=hits.astype(np.uint32))
    np.testing.assert_allclose(found, pmf, rtol=1e-4)
    index, weight, chosen, _ = draws(sampler, p, n, 512)
    some = weight > 0
    assert some.sum() > 100
    np.testing.assert_allclose(chosen[some], pmf[index.astype(int)][some], rtol=1e-4)


@pytest.mark.parametrize("where, name", sweep([w for w in ALL if w[1] not in ("clusters", "one candidate")], SOME[:-1]))
def test_lights_are_chosen_as_often_as_their_probability_says(choosers, where, name):
    sampler = choosers[where][name]
    for k, (p, n) in enumerate(PLACES):
        index, weight, pmf, _ = draws(sampler, p, n, seed=k)
        known, some = pmf_of_all(sampler, p, n), weight > 0
        assert name == "tree" or some.all()
        np.testing.assert_allclose((weight * pmf)[some], 1, rtol=1e-5)
        counts = np.bincount(index[some].astype(int), minlength=sampler.table.n_lights)
        counts, known = np.append(counts, (~some).sum()), np.append(known, max(1 - known.sum(), 0))
        assert (known[-1] < 1e-4) == (counts[-1] == 0)
        known[-1] *= counts[-1] > 0  # what rounding leaves
        assert_frequencies(counts, known, f"{where}, {name}, place {k}")


@pytest.mark.parametrize("where, name", sweep(ALL, SOME))
def test_every_light_that_may_contribute_weighs_one_in_the_mean(choosers, where, name):
    """E[1{light} weight] = 1; z-test, Šidák's correction over the lights. Rarely chosen ones are taken together."""
    sampler = choosers[where][name]
    c, count = sampler.table.columns, 2**18
    p, n = PLACES[0]
    index, weight, _, _ = draws(sampler, p, n, count, seed=3)
    index = index.astype(int)
    can = np.array([
        importance(One(sampler.table, k, int(c["kind"][k])), mi.Point3f(*p), mi.Vector3f(*n), mi.Bool(False))[0] > 0
        for k in range(len(c["kind"]))
    ])  # fmt: skip
    assert can.sum() > 5
    n_hit = np.bincount(index, minlength=len(can))
    mean, square = (np.bincount(index, weight**e, minlength=len(can)) / count for e in (1, 2))
    often = can & (n_hit >= 200)
    bound = stats.norm.isf((1 - (1 - ERROR_RATE) ** (1 / (often.sum() + 1))) / 2) * 1.1
    z = (mean - 1)[often] / np.sqrt((square - mean**2)[often] / count)
    print(f"{where}, {name}: {often.sum()} of {can.sum()} lights; largest z {np.abs(z).max():.2f}, bound {bound:.2f}")
    assert often.sum() > 5 and np.abs(z).max() < bound
    rare = can & ~often
    if n_hit[rare].sum() >= 200:
        per_draw = np.where(rare[index], weight, 0)
        assert abs(per_draw.mean() - rare.sum()) < bound * per_draw.std() / np.sqrt(count)
    if name not in ("uniform", "power"):
        assert (weight[~can[index]] == 0).all()


def test_single_prediction_of_one_light_chooses_it_nearly_always(mixed):
    _, table = mixed
    values = np.zeros(table.n_lights)
    values[4] = 1
    groups = make_groups(table, table.n_lights)
    for p, n in PLACES[:1]:
        with_network = pmf_of_all(VisibleLights(table, groups, Predicted(20, values)), p, n)
        without = pmf_of_all(VisibleLights(table, groups), p, n)
        can = without > 0
        assert (
            can[4] and with_network[4] / without[4] > 5 * np.delete(with_network / np.maximum(without, 1e-30), 4).max()
        )
        assert (with_network[can] > 0).all()


@pytest.mark.parametrize("value", [float("nan"), -1.0])
def test_predictions_that_are_no_number_leave_every_light_possible(mixed, value):
    _, table = mixed
    groups = make_groups(table, table.n_lights)
    values = np.full(table.n_lights, 0.5)
    values[[0, 7]] = value
    p, n = PLACES[0]
    pmf = pmf_of_all(VisibleLights(table, groups, Predicted(20, values)), p, n)
    can = pmf_of_all(VisibleLights(table, groups), p, n) > 0
    assert np.isfinite(pmf).all() and (pmf[can] > 0).all() and pmf.sum() == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize("intensity, size, position, n_outputs", sweep(
    itertools.product([(1e-30, 1e-30), (1e30, 1e30), (1e-30, 1e30)], [1e-6, 1.0, 1e4], [0.0, 1e5], [32, 4]),
    [((1e-30, 1e-30), 1e-6, 1e5, 4), ((1e30, 1e30), 1e4, 1e5, 4),
     *itertools.product([(1e-30, 1e30)], [1e-6, 1.0, 1e4], [0.0, 1e5], [32])],
))  # fmt: skip
def test_extreme_lights_give_finite_probabilities(tmp_path, rng, intensity, size, position, n_outputs):
    """Receivers far away, near, and on a light."""
    offset = np.array([position, 0, 0])
    lights = {}
    for k in range(8):
        corners = random_triangles(rng, 1, center=offset, spread=size, size=size)
        lights[f"m{k}"] = {**triangles(tmp_path / f"{k}.ply", corners), "emitter": glow(intensity[k % 2])}
    table = LightTable(mi.load_dict({"type": "scene", **lights}))
    assert all(np.isfinite(v).all() for v in table.columns.values())
    samplers = [PowerLights(table), TreeLights(table), VisibleLights(table, make_groups(table, n_outputs, "kmeans"))]
    for sampler in samplers:
        up = np.array([0.0, 0.0, 1.0])
        for p in (offset, offset + up, offset + 1e5 * up, table.columns["center"][3].astype(float)):
            index, weight, pmf, pmf_hit = draws(sampler, p, [0, 0, 1], 64, hit=3)
            for value in (weight, pmf, pmf_hit):
                assert np.isfinite(value).all() and (value >= 0).all()
            assert (pmf <= 1.0001).all() and (index < 8).all()


def test_all_choices_are_defined_where_no_light_contributes(mixed):
    """Below the floor, looking down, without sun and sky."""
    scene = scene_of({k: v for k, v in MIXED.items() if k != "sun"})
    table = LightTable(scene)
    for name, sampler in samplers_of(table).items():
        _, weight, pmf, pmf_hit = draws(sampler, [0, 0, -50], [0, 0, -1], 128)
        assert all(np.isfinite(v).all() for v in (weight, pmf, pmf_hit))
        if name not in ("uniform", "power"):
            assert (weight == 0).all() and (pmf == 0).all() and (pmf_hit == 0).all()


# ---------------------------------------------------------------- random numbers


@pytest.fixture
def counted(monkeypatch):
    monkeypatch.setattr(CountingSampler, "uses", [])
    monkeypatch.setattr(CountingSampler, "points", [])
    return CountingSampler


@pytest.mark.parametrize("symbolic", [True, False])
@pytest.mark.parametrize("name", ["uniform", "power", "tree", "clusters", "one candidate"])
def test_no_number_is_used_twice_by_choices_one_after_another(choosers, counted, name, symbolic):
    """By itself, in a loop, and in a loop within a loop that some lanes leave out, as in `restir_di`."""
    sampler, n = choosers["swarm"][name], 16
    si = place(PLACES[0][0], n)

    def candidate(i, total, numbers):
        u = numbers.next_1d()
        choice = sampler.choose(si, si.n, mi.Bool(False), u, numbers, mi.UInt32(0), mi.Bool(True))
        numbers = choice.sampler
        return i + 1, total + choice.weight * numbers.next_1d(), numbers

    def candidates(numbers, active):
        _, total, numbers = dr.while_loop((mi.UInt32(0), dr.zeros(mi.Float, n), numbers),
                                          lambda i, *_: active & (i < 2), candidate)  # fmt: skip
        return total, numbers

    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, symbolic):
        _, total, numbers = candidate(mi.UInt32(0), mi.Float(0), counted.make(dr.arange(mi.UInt32, n)))
        more, numbers = candidates(numbers, mi.Bool(True))
        _, rest, numbers = dr.while_loop(
            (dr.arange(mi.UInt32, n) % 2 == 0, dr.zeros(mi.Float, n), numbers), lambda new, *_: new,
            lambda new, _, numbers: (mi.Bool(False), *candidates(numbers, new)),
        )  # fmt: skip
        total = total + more + rest + numbers.next_1d()
        dr.eval(total, numbers)
    drawn = np.array(numbers.drawn)
    assert counted.most_uses() == 1 and np.array(counted.uses[0]).sum() == drawn.sum()
    if name in ("uniform", "power", "tree"):  # the others draw as many as the group's candidates
        several, one = (16, 10) if name == "tree" else (11, 7)  # a tree draws one more for each of 5 or 3 choices
        np.testing.assert_array_equal(drawn, np.where(np.arange(n) % 2 == 0, several, one))
    else:
        assert (drawn >= np.where(np.arange(n) % 2 == 0, 16, 10)).all()  # one number a candidate, at least


@pytest.mark.parametrize("n", [2**24, 2**24 - 3, 10_000_000, 2**13])
def test_each_of_millions_of_lights_is_chosen_alike(n):
    """By one random number, of 23 bits, every other one of 2^24 lights was never chosen. The lights between two such
    numbers are drawn as often as they should be: chi-square, which fails in less than one of 10,000 seeds."""
    k, draws = 2**22 + 12345, 2**14
    sampler = UniformLights(SimpleNamespace(n_lights=n))
    choice = sampler.choose(None, None, None, mi.Float(k / 2**23), uniforms(draws), mi.UInt32(0), mi.Bool(True))
    index = np.array(choice.index) + np.zeros(draws, int)
    low, high = k * n / 2**23, (k + 1) * n / 2**23
    lights = np.arange(int(low), math.ceil(high))
    share = np.minimum(lights + 1, high) - np.maximum(lights, low)
    assert np.isin(index, lights).all() and int(float(choice.weight[0])) == n
    found = np.bincount(index - lights[0], minlength=len(lights))
    expected = draws * share / share.sum()
    assert stats.chi2.sf(((found - expected) ** 2 / expected).sum(), max(len(lights) - 1, 1)) > 1e-4


@pytest.mark.parametrize("kind", ["power", "clusters"])
def test_random_numbers_of_large_groups_have_further_bits(kind, swarm, monkeypatch):
    table = swarm[1]
    sampler = PowerLights(table) if kind == "power" else VisibleLights(table, make_groups(table, 6, "kmeans"))
    seen = []

    def sample_light(group, u, active):
        seen.append(np.array(u))
        return mi.UInt32(0), mi.Float(1)

    monkeypatch.setattr(sampler.groups, "sample_light", sample_light)
    sampler.resamples = False
    for few in (2**12, 16):
        monkeypatch.setattr(sampling, "FEW_LIGHTS", few)
        at_point = place(PLACES[0][0], 256), mi.Vector3f(0, 0, 1), mi.Bool(False)
        sampler.choose(*at_point, mi.Float(0.3), uniforms(256), mi.UInt32(0), mi.Bool(True))
    (coarse, fine) = (np.unique(u + np.zeros(256, np.float32)) for u in seen)
    assert len(coarse) == 1 and len(fine) > 2 and np.ptp(fine) < 1e-5 and (fine >= coarse[0]).all()


def test_the_sampler_that_was_given_is_advanced_too(swarm):
    """Callers that keep theirs and not the one that comes back draw new numbers as well."""
    sampler = VisibleLights(swarm[1], make_groups(swarm[1], 6, "kmeans"), candidates=4)
    used = uniforms(16)
    u = used.next_1d()
    sampler.choose(place(PLACES[0][0], 16), mi.Vector3f(0, 0, 1), mi.Bool(False), u, used, mi.UInt32(0), mi.Bool(True))
    after, fresh = np.array(used.next_1d()), uniforms(16)
    drawn = np.stack([np.array(fresh.next_1d()) for _ in range(9)])
    assert not (drawn == after).all(axis=1).any()


def test_no_number_is_used_twice_where_lights_are_looked_at(mixed, counted, monkeypatch):
    """By the plan, and for training points and shadow rays of a visibility cache."""
    scene, table = mixed
    camera = mi.load_dict({"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, -6, 3], [0, 0, 0],
                                                                                            [0, 0, 1])})  # fmt: skip
    monkeypatch.setattr("mi_neural.light_noise.PathSampler", counted)
    assert np.isfinite(light_noise(scene, camera, n_points=64).uniform)
    assert len(counted.uses) == 2 and counted.most_uses() == 1

    monkeypatch.setattr(visibility, "PathSampler", counted)
    monkeypatch.setattr(visibility, "_numbers", counted.make)
    cache = visibility.VisibilityCache(visibility.VisibilityTraining(n_points=32))
    cache.train(scene, camera, table, make_groups(table, 6), frames=2)
    assert len(counted.uses) == 2 + 1 + 2 * 2 and counted.most_uses() == 1
