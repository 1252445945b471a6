"""The light tree: its shape, its bounds, and that no light is lost in it."""

import time

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW, sweep
from expectation import assert_same_mean, renders
from light_scenes import (
    MIXED,
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
from test_light_choice import assert_frequencies, draws, pmf_of_all, received
from test_vertex import lights, test_scene

from mi_neural.lights import tree
from mi_neural.lights.entries import DIRECTION, ENVIRONMENT, LOCAL
from mi_neural.lights.sampling import TreeLights
from mi_neural.lights.table import LightTable


def columns_of(centers, radius=0.01, axis=(0, 0, 1), cone=1.0, intensity=1.0, kind=LOCAL, form=1, plain=True) -> dict:
    n = len(centers)
    wide = lambda v, *shape: np.broadcast_to(np.asarray(v), (n, *shape)).copy()  # noqa: E731
    return {
        "emitter": np.arange(n), "center": np.asarray(centers, np.float32), "radius": wide(radius).astype(np.float32),
        "axis": wide(axis, 3).astype(np.float32), "cone": wide(cone).astype(np.float32), "plain": wide(plain),
        "intensity": wide(intensity).astype(np.float32), "kind": wide(kind), "form": wide(form),
    }  # fmt: skip


def ancestors(nodes, light: int) -> list[int]:
    """Nodes above a light, from its leaf to the root."""
    path = [int(nodes["leaf"][light])]
    while path[-1]:
        path.append(int(nodes["parent"][path[-1]]))
    return path


def members(nodes) -> list[np.ndarray]:
    """Lights of each node."""
    found = [[] for _ in nodes["left"]]
    for light in range(len(nodes["leaf"])):
        for node in ancestors(nodes, light):
            found[node].append(light)
    return [np.array(f) for f in found]


@pytest.fixture(scope="module")
def mixed():
    return mixed_lights()


# ---------------------------------------------------------------- shape


def assert_binary_tree(nodes, n: int) -> None:
    """2 n - 1 nodes; every light has a leaf of its own; children lie side by side and know their parent."""
    left, parent = nodes["left"], nodes["parent"]
    assert all(len(nodes[k]) == 2 * n - 1 for k in ("left", "parent", "light", "center", "intensity", "kind"))
    inner = np.flatnonzero(left)
    assert len(inner) == n - 1 and len(set(left[inner])) == n - 1 and (left[inner] % 2 == 1).all()
    assert (parent[left[inner]] == inner).all() and (parent[left[inner] + 1] == inner).all()
    leaves = np.flatnonzero(left == 0)
    np.testing.assert_array_equal(np.sort(nodes["light"][leaves]), np.arange(n))
    np.testing.assert_array_equal(nodes["leaf"][nodes["light"][leaves]], leaves)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 100])
def test_every_light_has_one_leaf(rng, n):
    assert_binary_tree(tree.build(columns_of(rng.normal(size=(n, 3)), intensity=rng.uniform(0, 2, n))), n)


@pytest.mark.parametrize("chunk", [1, 7])
def test_nodes_split_in_parts_give_the_same_tree(rng, chunk, monkeypatch):
    columns = columns_of(rng.normal(size=(200, 3)), intensity=rng.uniform(0, 2, 200))
    whole = tree.build(columns)
    monkeypatch.setattr(tree, "CHUNK", chunk)
    for name, values in tree.build(columns).items():
        np.testing.assert_array_equal(values, whole[name], err_msg=name)


def depth(nodes) -> int:
    return max(len(ancestors(nodes, light)) for light in range(len(nodes["leaf"])))


def test_no_tree_is_deeper_than_its_limit(rng):
    """Lights in one place are halved; lights each ten times as far as the last make the deepest tree there is."""
    one_place = tree.build(columns_of(np.ones((1000, 3))))
    assert_binary_tree(one_place, 1000)
    assert depth(one_place) == 11
    far = np.zeros((2000, 3))
    far[:, 0] = 1.04 ** np.arange(2000)
    nodes = tree.build(columns_of(far))
    assert_binary_tree(nodes, 2000)
    assert 30 < depth(nodes) <= tree.HALVES_FROM + 12


def test_the_first_split_is_between_two_crowds(rng):
    centers = rng.normal(size=(300, 3)) * 0.1
    centers[::3] += [0, 20, 0]
    nodes = tree.build(columns_of(centers))
    found = [set(m) for m in members(nodes)[1:3]]
    assert set(range(0, 300, 3)) in found


def test_lights_that_face_two_ways_are_split_by_their_place_along_that_axis():
    """Two rows of lamps a little apart, back to back, three times as long: areas alone would cut the rows in two."""
    x = np.tile(np.linspace(0, 3, 40), 2)
    facing = np.repeat([1.0, -1.0], 40)
    centers = np.stack([x, np.tile(np.linspace(0, 1, 40), 2), 0.9 * facing], axis=1)
    nodes = tree.build(columns_of(centers, axis=np.stack([0 * x, 0 * x, facing], axis=1)))
    assert set(range(40)) in [set(m) for m in members(nodes)[1:3]]
    even = tree.build(columns_of(centers, cone=-1.0))
    assert set(range(40)) not in [set(m) for m in members(even)[1:3]]


def test_cone_measure_is_that_of_a_hemisphere_and_of_the_sphere():
    """One normal lights ∫ cos = π of its hemisphere; normals in all directions light the sphere."""
    np.testing.assert_allclose(tree._cone_measure(np.array([1.0, -1.0])), [np.pi, 4 * np.pi], rtol=1e-6)


def test_near_lights_far_lights_and_the_environment_are_apart(mixed):
    table = mixed[1]
    nodes = tree.build(table.columns)
    assert_binary_tree(nodes, table.n_lights)
    kind = table.columns["kind"]
    for node, lights_of in enumerate(members(nodes)):
        if node:
            kinds = set(kind[lights_of].tolist())
            assert kinds in ({LOCAL}, {DIRECTION}, {ENVIRONMENT}, {DIRECTION, ENVIRONMENT})
            assert nodes["kind"][node] == max(kinds)


# ---------------------------------------------------------------- bounds


def test_nodes_bound_their_lights(mixed, rng, tmp_path):
    mesh = triangles(tmp_path / "m.ply", random_triangles(rng, 200))
    for table in (mixed[1], LightTable(scene_of({"m": {**mesh, "emitter": glow()}, "sun": MIXED["sun"]}))):
        c, nodes = table.columns, tree.build(table.columns)
        power = tree.powers(c)
        for node, inside in enumerate(members(nodes)):
            if nodes["kind"][node] == LOCAL and node:
                reach = np.linalg.norm(c["center"][inside] - nodes["center"][node], axis=1) + c["radius"][inside]
                assert reach.max() <= nodes["radius"][node] * (1 + 1e-6)
                angle = np.arccos(np.clip(c["axis"][inside] @ nodes["axis"][node], -1, 1))
                angle += np.arccos(np.clip(c["cone"][inside], -1, 1))
                assert min(angle.max(), np.pi) <= np.arccos(np.clip(nodes["cone"][node], -1, 1)) + 2e-3
            assert nodes["intensity"][node] == pytest.approx(power[inside].sum(), rel=1e-9)


@pytest.mark.parametrize("scale, two_sided", sweep(
    [(scale, two_sided) for scale in (1e-4, 1, 1e5) for two_sided in (False, True)],
    [(1e-4, False), (1, True), (1e5, False)],
))  # fmt: skip
def test_no_light_that_reaches_a_point_has_probability_zero(tmp_path, rng, scale, two_sided):
    """Every tenth point lies on a light: in the bounds of many nodes, and in the plane of a triangle."""
    corners, table = shining_triangles(tmp_path, rng, scale)
    n, lights_ = 400, TreeLights(table)
    x = (rng.normal(size=(n, 3)) * rng.choice([0.5, 2, 20], (n, 1)) * scale).astype(np.float32)
    x[::10] = corners[rng.integers(0, 64, n // 10)].mean(axis=1)
    normal = rng.normal(size=(n, 3))
    normal = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.nan_to_num(received(corners, table.columns["normal"], x, normal, two_sided), nan=0) > 0
    si, N = place(x, n), mi.Vector3f(*normal.T)
    pmf = np.stack([np.array(lights_.pmf(si, N, mi.Bool(two_sided), mi.UInt32(k), mi.Bool(True))) for k in range(64)])
    print(f"{known.mean():.2f} of the pairs see each other; probabilities sum to {pmf.sum(axis=0).mean():.3f}")
    assert np.isfinite(pmf).all() and (pmf >= 0).all() and (pmf.sum(axis=0) <= 1 + 1e-5).all()
    assert known.sum() > 1000 and (pmf[known] > 0).all()


def test_light_behind_the_surface_and_light_that_looks_away_have_probability_zero():
    """Two panels: one shines down on the floor from above, one is below it, and one above shines up."""
    down, up = at(0, 0, 2).rotate([1, 0, 0], 180), at(1, 0, 2)
    panels = {"down": down, "below": at(0, 0, -2), "up": up}
    scene = scene_of({k: {"type": "rectangle", "to_world": v.scale(0.3), "emitter": glow()} for k, v in panels.items()})
    table = LightTable(scene)
    lights_ = TreeLights(table)
    (first,), (below,), (away,) = (row(scene, table, k) for k in panels)

    def pmf(two_sided):
        si = place([0, 0, 0], 3)
        index = mi.UInt32([int(first), int(below), int(away)])
        return np.array(lights_.pmf(si, mi.Vector3f(0, 0, 1), mi.Bool(two_sided), index, mi.Bool(True)))

    np.testing.assert_array_equal(pmf(False) > 0, [True, False, False])
    np.testing.assert_array_equal(pmf(True) > 0, [True, True, False])


def test_the_nearest_light_is_chosen_often():
    """Of a hundred lamps on a grid, seen from a fifth of its spacing: one time in five in the mean, and no light
    less than five times as often as if chosen uniformly. It is not always the most frequent: the nodes above it are
    wide."""
    table = LightTable(hall(100))
    lights_ = TreeLights(table)
    facing_down = np.flatnonzero(table.columns["axis"][:, 2] < 0)
    below = (table.columns["center"] - [0, 0, 0.08]).tolist()
    pmf = np.array([pmf_of_all(lights_, below[k], [0, 0, 1])[k] for k in facing_down])
    print(pmf.mean(), pmf.min(), len(pmf))
    assert pmf.mean() > 0.18 and pmf.min() > 0.05


# ---------------------------------------------------------------- many lights, one light, dark lights


@pytest.fixture(scope="module")
def ten_thousand():
    """Point lights in a table made by hand; a light in a thousand is a hundred times as bright."""
    rng = np.random.default_rng(11)
    scene = scene_of({"a": {"type": "point", "position": [0, 0, 1]}, "b": {"type": "point", "position": [1, 0, 1]}})
    table, n = LightTable(scene), 10_000
    columns = {k: np.repeat(v[:1], n, axis=0) for k, v in table.columns.items()}
    columns["center"] = rng.uniform(-5, 5, (n, 3)).astype(np.float32)
    columns["intensity"] = np.where(np.arange(n) % 1000 == 0, 100, 1).astype(np.float32)
    table.assign(columns)
    return table


def test_ten_thousand_lights_are_built_fast_and_have_probabilities_that_sum_to_one(ten_thousand):
    """They shine everywhere and the surface is two-sided, so there is no dead end."""
    t0 = time.perf_counter()
    lights_ = TreeLights(ten_thousand)
    seconds = time.perf_counter() - t0
    n = ten_thousand.n_lights
    print(f"tree of {n} lights: {seconds:.2f} s, depth {depth(tree.build(ten_thousand.columns))}")
    for p in ([0.0, 0, 0], [4.9, 4.9, 4.9], [300.0, 0, 0]):
        pmf = np.array(lights_.pmf(place(p, n), mi.Vector3f(0, 0, 1), mi.Bool(True), dr.arange(mi.UInt32, n),
                                   mi.Bool(True)), np.float64)  # fmt: skip
        assert (pmf > 0).all() and pmf.sum() == pytest.approx(1, rel=1e-4)
    assert seconds < 3  # 0.2 s measured; a loop in Python over the nodes takes ten times as long


def test_ten_thousand_lights_are_chosen_as_often_as_their_probability_says(ten_thousand):
    """Rare ones are pooled: of 2^18 draws most lights have fewer than ten."""
    lights_, n, p = TreeLights(ten_thousand), ten_thousand.n_lights, [0.5, 0.2, 0.1]
    rng = uniforms(2**18, 3)
    u = rng.next_1d()
    choice = lights_.choose(place(p, 2**18), mi.Vector3f(0, 0, 1), mi.Bool(True), u, rng, mi.UInt32(0), mi.Bool(True))
    index, pmf = np.array(choice.index), np.array(choice.pmf, np.float64)
    known = np.array(lights_.pmf(place(p, n), mi.Vector3f(0, 0, 1), mi.Bool(True), dr.arange(mi.UInt32, n),
                                 mi.Bool(True)), np.float64)  # fmt: skip
    np.testing.assert_allclose(pmf, known[index], rtol=1e-3)
    counts = np.bincount(index, minlength=n)
    assert_frequencies(counts, known, "all")
    # Blocks of a hundred lights, near and far: the bits of one number would not do for those that come last
    assert_frequencies(counts.reshape(100, 100).sum(axis=1), known.reshape(100, 100).sum(axis=1), "hundreds")
    order = np.argsort(known)
    assert_frequencies(counts[order].reshape(200, 50).sum(axis=1), known[order].reshape(200, 50).sum(axis=1), "ranks")


def test_one_light_is_chosen_always():
    """Built for it nevertheless with plan="everything"."""
    scene = test_scene(lights("point"), 8)
    sampler = mi.load_dict({"type": "tree_lights", "plan": "everything"})
    lights_ = sampler.lights(scene, scene.sensors()[0])
    index, weight, pmf, pmf_hit = draws(lights_, [0.0, 0.0, 0.0], [0, 0, 1], 64)
    assert (index == 0).all() and (weight == 1).all() and (pmf == 1).all() and (pmf_hit == 1).all()


def test_dark_lights_are_left_out_and_uncertain_ones_are_not():
    """What looked dark in a few samples of a picture may have a bright part."""
    dark = columns_of(np.eye(3), intensity=[0, 2, 4])
    np.testing.assert_allclose(tree.powers(dark), [0, 0.5, 1])
    guessed = {**dark, "plain": np.array([False, True, True])}
    np.testing.assert_allclose(tree.powers(guessed), [0.05, 0.5, 1])
    unsampled = {**dark, "form": np.array([8, 1, 1])}
    np.testing.assert_allclose(tree.powers(unsampled), [0, 0.5, 1])
    assert (tree.powers(columns_of(np.eye(3), intensity=0)) == 0).all()
    assert np.isfinite(tree.powers(columns_of(np.eye(3), intensity=[np.nan, np.inf, 1]))).all()


# ---------------------------------------------------------------- in integrators


def hall(n: int) -> mi.Scene:
    """A floor under `n` small lamps on a grid, a third of them turned away."""
    side = int(np.ceil(n**0.5))
    lamps = {}
    for k in range(n):
        p = (np.array([k % side, k // side]) / side - 0.5) * 4
        turn = 0 if k % 3 == 0 else 180
        lamps[f"l{k}"] = {"type": "rectangle", "to_world": at(*p, 1.0).rotate([1, 0, 0], turn).scale(0.02),
                          "emitter": glow(50.0)}  # fmt: skip
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([0, -4, 3], [0, 0, 0], [0, 0, 1])
    return mi.load_dict({
        "type": "scene", **lamps, "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)},
        "camera": {"type": "perspective", "to_world": view, "film": film},
    })  # fmt: skip


def error(scene, sampler: str, known) -> float:
    keys = {"type": "plain_path", "max_depth": 2, "hide_emitters": True, "light_sampler": {"type": sampler}}
    return float(((renders(scene, keys, 8, 8) - known) ** 2).mean())


def test_near_lights_are_found_with_a_fraction_of_the_noise():
    scene = hall(100)
    keys = {"type": "plain_path", "max_depth": 2, "hide_emitters": True}
    known = renders(scene, {**keys, "light_sampler": {"type": "tree_lights"}}, 16, 64, first_seed=100)
    path = renders(scene, {**keys, "type": "path"}, 16, 512, first_seed=200)
    assert_same_mean(known, path, "tree_lights", relative=1e-5)
    by = {k: error(scene, k, known.mean(axis=0)) for k in ("uniform_lights", "power_lights", "tree_lights")}
    print({k: f"{v:.3g}" for k, v in by.items()})
    assert by["tree_lights"] < 0.2 * min(by["uniform_lights"], by["power_lights"])


@pytest.mark.parametrize("key, value", [
    ("b.position", lambda: mi.Point3f(3, 2, 1)), ("b.intensity.value", lambda: mi.Color3f(90.0)),
])  # fmt: skip
def test_tree_follows_lights_that_change(key, value):
    scene = scene_of({"a": MIXED["window"], "b": MIXED["spark"], "c": MIXED["plate"]})
    sampler = mi.load_dict({"type": "tree_lights"})
    before = pmf_of_all(sampler.lights(scene, None), [0.0, 0.0, 0.1], [0, 0, 1])
    params = mi.traverse(scene)
    params[key] = value()
    params.update()
    after = pmf_of_all(sampler.lights(scene, None), [0.0, 0.0, 0.1], [0, 0, 1])
    np.testing.assert_allclose(after, pmf_of_all(TreeLights(LightTable(scene)), [0.0, 0.0, 0.1], [0, 0, 1]), rtol=1e-6)
    assert np.abs(after - before).max() > 0.05


def test_image_of_lights_that_move_is_not_recorded_anew():
    """The tree of as many lights has as many nodes, whatever its shape."""
    scene = hall(12)
    integrator = mi.load_dict({"type": "plain_path", "max_depth": 2, "light_sampler": {"type": "tree_lights"}})
    params = mi.traverse(scene)
    counts, means = [], []
    for k in range(6):
        for j in range(12):
            place_ = mi.Transform4f().translate([0.1 * j * k, 0, 1 - 0.05 * k])
            params[f"l{j}.to_world"] = place_.rotate([1, 0, 0], 180).scale(0.05)
        params.update()
        with dr.suspend_grad():
            means.append(np.array(integrator.render(scene, spp=64, seed=k)).mean())
        counts.append([f.n_recordings for f in integrator.film_state.passes.recorded.values()])
    print(counts, means)
    assert counts[-1] == counts[2] and len(set(np.round(means, 6))) == 6


@pytest.mark.parametrize("keys", [
    pytest.param({"type": "nirc_two_level", "max_depth": 4, "train_samples": 256, "train_frames": 16, "train_steps": 0,
                  **NETWORK}, marks=SLOW),
    {"type": "nvc_direct", "max_depth": 2},
    pytest.param({"type": "restir_di", "candidates": "nvc", "history": 0}, marks=SLOW),
], ids=lambda keys: keys["type"])  # fmt: skip
def test_image_with_it_nested_is_that_of_path(keys):
    scene = test_scene(lights("all"), 12)
    keys = {**keys, "light_sampler": {"type": "tree_lights"}}
    known = renders(scene, {"type": "path", "max_depth": keys.get("max_depth", 2)}, 16, 256, first_seed=1000)
    assert_same_mean(renders(scene, keys, 16, 64), known, keys["type"], relative=1e-5)


@pytest.mark.parametrize("keys, says", [
    ({"plan": "some"}, "tree_lights: plan is 'some'; give one of"), ({"bins": 4}, "bins"),
])  # fmt: skip
def test_keys_that_it_has_not_are_refused(keys, says):
    with pytest.raises((ValueError, RuntimeError), match=says):
        mi.load_dict({"type": "tree_lights", **keys})
