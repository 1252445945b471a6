"""The table of lights: its entries, and their points and densities."""

import time

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_mean
from light_scenes import (
    MIXED,
    at,
    glow,
    mixed_lights,
    picture,
    pixels,
    place,
    random_triangles,
    row,
    scene_of,
    triangles,
    uniforms,
)

from mi_neural.lights import table as table_module
from mi_neural.lights.clusters import make_groups
from mi_neural.lights.entries import (
    CYLINDER,
    DIRECTION,
    DISK,
    ENVIRONMENT,
    LOCAL,
    OTHER,
    PARALLELOGRAM,
    POINT,
    SPHERE,
    TRIANGLE,
)
from mi_neural.lights.sampling import PowerLights, TreeLights, UniformLights, VisibleLights
from mi_neural.lights.table import SHADOW_EPSILON, LightTable
from mi_neural.render import vertex

FLAT = (TRIANGLE, PARALLELOGRAM)


def flat(columns) -> np.ndarray:
    return np.isin(columns["form"], FLAT)


@pytest.fixture(scope="module")
def mixed():
    return mixed_lights()


# ---------------------------------------------------------------- entries of the table


def test_every_kind_of_emitter_has_its_entries(mixed):
    scene, table = mixed
    c = table.columns
    counts = {name: len(row(scene, table, name)) for name in [*MIXED, "sky"]}
    assert counts == {**dict.fromkeys([*MIXED, "sky"], 1), "box": 12}
    assert table.n_lights == 20 == len(c["emitter"])
    kinds = {name: set(c["kind"][row(scene, table, name)].tolist()) for name in counts}
    assert kinds.pop("sun") == {DIRECTION} and kinds.pop("sky") == {ENVIRONMENT}
    assert all(k == {LOCAL} for k in kinds.values())
    forms = {name: set(c["form"][row(scene, table, name)].tolist()) for name in counts}
    assert forms == {
        "ball": {SPHERE}, "plate": {DISK}, "tube": {CYLINDER}, "spark": {POINT}, "torch": {OTHER}, "sun": {OTHER},
        "window": {PARALLELOGRAM}, "box": {TRIANGLE}, "sky": {OTHER},
    }  # fmt: skip


def test_flat_entries_have_the_area_and_radiance_of_their_surface(mixed):
    scene, table = mixed
    c = table.columns
    (window,), box = row(scene, table, "window"), row(scene, table, "box")
    assert c["area"][window] == pytest.approx(3.0, rel=1e-5) and c["form"][window] == PARALLELOGRAM
    np.testing.assert_allclose(c["radiance"][window], [1, 2, 3], rtol=1e-5)
    np.testing.assert_allclose(c["center"][window], [0, -3, 2], atol=1e-5)
    assert c["radius"][window] == pytest.approx(np.hypot(1.5, 0.5), rel=1e-5)
    np.testing.assert_allclose(c["area"][box], 0.18, rtol=1e-5)
    assert (c["form"][box] == TRIANGLE).all() and c["plain"][box].all()
    np.testing.assert_allclose(c["intensity"][box], 5 * 0.18, rtol=1e-5)


@pytest.mark.parametrize("name, known", [
    ("ball", 2 * 4 * np.pi * 0.25), ("plate", 3 * np.pi), ("tube", 1.5 * 2 * np.pi * 0.25 * 2), ("spark", 4), ("sun",
        0.5),
    ("window", 6),
])  # fmt: skip
def test_intensity_is_radiance_times_area_or_what_the_light_was_given(mixed, name, known):
    scene, table = mixed
    (i,) = row(scene, table, name)
    assert table.columns["intensity"][i] == pytest.approx(known, rel=1e-4)


@pytest.mark.parametrize("name", ["ball", "plate", "tube", "box", "window"])
def test_bounding_spheres_contain_the_light(mixed, name):
    scene, table = mixed
    shape = next(s for s in scene.shapes() if s.id() == name)
    p = np.array(shape.sample_position(0.0, mi.Point2f(*np.random.default_rng(1).random((2, 4096), np.float32))).p).T
    c = table.columns
    rows = row(scene, table, name)
    distance = np.linalg.norm(p[:, None] - c["center"][rows], axis=-1) - c["radius"][rows]
    assert distance.min(axis=1).max() <= 1e-4
    size = float(np.linalg.norm(np.array(shape.bbox().extents())))
    assert c["radius"][rows].max() < size


def test_lights_without_extent_have_their_place_and_radius_0(mixed):
    scene, table = mixed
    c = table.columns
    for name, known in (
        ("spark", [0.5, 0.5, 2.5]),
        ("torch", [1, -3, 3]),
        ("sun", -np.array([0.3, -0.2, -1]) / np.sqrt(1.13)),
    ):
        (i,) = row(scene, table, name)
        np.testing.assert_allclose(c["center"][i], known, atol=1e-5)
        assert c["radius"][i] == 0


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("scale", [[1, 2, 1], [-1, 2, 1], [1, 1, -1]])
@pytest.mark.parametrize("shape", ["rectangle", "cube"])
def test_normals_point_to_where_the_light_goes(shape, scale, flip):
    to_world = at(1, 2, 3).rotate([1, 2, 3], 70).scale(scale)
    light = {"type": shape, "to_world": to_world, "flip_normals": flip, "emitter": glow()}
    scene = mi.load_dict({"type": "scene", "light": light})
    c = LightTable(scene).columns
    middle = c["corner"] + (c["edge1"] + c["edge2"]) * np.where(c["form"] == TRIANGLE, 1 / 3, 0.5)[:, None]
    for side, known in ((1, 1.0), (-1, 0.0)):
        n = side * c["normal"]
        ray = mi.Ray3f(mi.Point3f(*(middle + 0.01 * n).T), mi.Vector3f(*-n.T))
        si = scene.ray_intersect(ray)
        assert np.array(si.is_valid()).all()
        np.testing.assert_allclose(np.array(si.emitter(scene).eval(si))[0], known)


@pytest.mark.parametrize("flip", [False, True])
def test_mirrored_rectangle_is_one_light_with_a_cone(flip):
    to_world = mi.ScalarTransform4f().scale([-1, 2, 1])
    light = {"type": "rectangle", "to_world": to_world, "flip_normals": flip, "emitter": glow()}
    table = LightTable(mi.load_dict({"type": "scene", "light": light}))
    assert table.n_lights == 1 and table.columns["cone"][0] == 1


def test_two_rectangles_of_unlike_halves_stay_two_lights(tmp_path, rng):
    """A quadrilateral that is no parallelogram, and one whose halves differ in radiance."""
    kite = [[[0, 0, 0], [1, 0, 0], [2, 2, 0]], [[0, 0, 0], [2, 2, 0], [0, 1, 0]]]
    square = [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]]
    two = [[1, 1, 1], [2, 2, 2]]
    for corners, attribute, known in ((kite, None, 2), (square, None, 1), (square, ("face_glow", two), 2)):
        mesh = triangles(tmp_path / "m.ply", corners, attribute)
        mesh["emitter"] = glow({"type": "mesh_attribute", "name": "face_glow"} if attribute else 1.0)
        assert LightTable(mi.load_dict({"type": "scene", "m": mesh})).n_lights == known


def test_halves_of_a_rectangle_that_shine_to_opposite_sides_are_two_lights(tmp_path):
    """As one light, either half would be sampled where the other one is seen from behind."""
    halves = [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [0, 1, 0], [1, 1, 0]]]
    mesh = {**triangles(tmp_path / "m.ply", halves), "emitter": glow()}
    table = LightTable(mi.load_dict({"type": "scene", "m": mesh}))
    np.testing.assert_array_equal(table.columns["normal"], [[0, 0, 1], [0, 0, -1]])


def test_radiance_of_a_picture_is_its_mean_and_not_plain():
    light = {"type": "rectangle", "emitter": glow(picture(pixels()))}
    c = LightTable(mi.load_dict({"type": "scene", "light": light})).columns
    assert len(c["plain"]) == 2 and not c["plain"].any()
    np.testing.assert_allclose(c["radiance"].mean(axis=0), pixels().mean(axis=(0, 1)), rtol=0.3)


def test_picture_whose_bright_spot_no_probe_met_is_not_plain():
    """Next-event estimation would use the probes' mean, and lose the spot."""
    spot = np.full((64, 64, 3), 0.5, np.float32)
    spot[10, 10] = 1e4
    light = {"type": "rectangle", "emitter": glow(picture(spot))}
    assert not LightTable(mi.load_dict({"type": "scene", "light": light})).columns["plain"].any()


def test_radiance_of_mesh_attributes_is_that_of_each_face_and_the_mean_of_each_vertex(tmp_path, rng):
    corners = random_triangles(rng, 6)
    for kind, values in (("face", rng.uniform(1, 2, (6, 3))), ("vertex", rng.uniform(1, 2, (18, 3)))):
        mesh = triangles(tmp_path / "m.ply", corners, (f"{kind}_glow", values))
        mesh["emitter"] = glow({"type": "mesh_attribute", "name": f"{kind}_glow"})
        c = LightTable(mi.load_dict({"type": "scene", "m": mesh})).columns
        known = values if kind == "face" else values.reshape(6, 3, 3).mean(axis=1)
        np.testing.assert_allclose(c["radiance"], known, rtol=1e-4 if kind == "face" else 0.15)
        assert c["plain"].all() == (kind == "face")


def test_mesh_attribute_light_beside_lights_of_other_kinds(tmp_path, rng):
    mesh = triangles(tmp_path / "m.ply", random_triangles(rng, 3), ("face_glow", np.ones((3, 3))))
    mesh["emitter"] = glow({"type": "mesh_attribute", "name": "face_glow"})
    table = LightTable(scene_of({"m": mesh, "spark": MIXED["spark"], "ball": MIXED["ball"]}))
    assert table.n_lights == 5 and (table.columns["intensity"] > 0).all()


def test_spot_light_whose_picture_is_mostly_black_keeps_an_intensity():
    """Of intensity 0 it would never be chosen, and nothing else finds a light without extent."""
    spot = np.zeros((64, 64, 3), np.float32)
    spot[20, 40] = 1000
    torch = {**MIXED["torch"], "texture": picture(spot)}
    assert (LightTable(scene_of({"torch": torch, "spark": MIXED["spark"]})).columns["intensity"] > 0).all()


def test_narrow_beams_alone_keep_an_intensity():
    """None of the directions that are looked along lies within them; with intensity 0 they were never chosen."""
    beam = {"type": "spot", "intensity": 1.0, "cutoff_angle": 0.2}
    aim = [mi.ScalarTransform4f().look_at([x, 0, 3], [x + 0.3, 0.2, 0], [0, 1, 0]) for x in (-1, 1)]
    table = LightTable(scene_of({f"beam_{k}": {**beam, "to_world": to_world} for k, to_world in enumerate(aim)}))
    assert (table.columns["intensity"] > 0).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", ["no area", "black", "NaN", "coincident", "huge"])
def test_odd_lights_give_finite_columns(tmp_path, rng, case):
    corners = random_triangles(rng, 8)
    emission, extra = glow(), {}
    if case == "no area":
        corners[2:4, 1] = corners[2:4, 0]
        corners[5] = corners[5, 0]
    elif case == "coincident":
        corners[:] = corners[0]
        extra = {"a": MIXED["spark"], "b": MIXED["spark"]}
    else:
        value = {"black": 0.0, "NaN": float("nan"), "huge": 1e30}[case]
        emission = glow(value)
        extra = {"ball": {**MIXED["ball"], "emitter": glow(value)}, "spark": {**MIXED["spark"], "intensity": value}}
    mesh = triangles(tmp_path / "m.ply", corners)
    table = LightTable(scene_of({"m": {**mesh, "emitter": emission}, **extra}))
    c = table.columns
    assert all(np.isfinite(v).all() for v in c.values())
    if case == "no area":
        assert (c["area"][[2, 3, 5]] == 0).all() and (c["intensity"][[2, 3, 5]] == 0).all()
    if case in ("black", "NaN"):
        assert (c["intensity"] == 0).all()
    groups = make_groups(table, 4, "kmeans")
    for sampler in (UniformLights(table), PowerLights(table), TreeLights(table), VisibleLights(table, groups)):
        n = 256
        seen_from = place([0, 0, 0.5], n), mi.Vector3f(0, 0, 1), mi.Bool(False)
        choice = sampler.choose(*seen_from, uniforms(n).next_1d(), uniforms(n, 1), mi.UInt32(0), mi.Bool(True))
        pmf_hit = choice.of_hit(sampler, *seen_from, mi.UInt32(0), mi.Bool(True))
        assert (np.array(choice.index) < table.n_lights).all()
        for value in (choice.weight, choice.pmf, pmf_hit):
            assert np.isfinite(np.array(value)).all() and (np.array(value) >= 0).all()


def test_tens_of_thousands_of_lights_are_built_fast(tmp_path, rng):
    mesh = triangles(tmp_path / "m.ply", random_triangles(rng, 30_000))
    scene = scene_of({"m": {**mesh, "emitter": glow()}})
    t0 = time.perf_counter()
    table = LightTable(scene)
    t1 = time.perf_counter()
    groups = make_groups(table, 32, "kmeans")
    print(f"table {t1 - t0:.2f} s, clusters {time.perf_counter() - t1:.2f} s")
    assert table.n_lights == 30_000 and groups.n_groups == 32
    assert all(np.isfinite(v).all() for v in table.columns.values())
    assert time.perf_counter() - t0 < 8  # 0.7 s measured; a loop in Python over the lights takes a minute


def test_thousands_of_lamps_are_known_without_a_call_into_each(rng):
    """A call through pointers is compiled for each emitter of the scene: 0.3 s at 3,000. A few others are called one by
    one."""
    lamps = {}
    for k in range(1000):
        x, y, z = rng.uniform(-1, 1, 3)
        lamps |= {
            f"ball{k}": {"type": "sphere", "center": [x, y, z + 2], "radius": 0.01, "emitter": glow(1.0 + k)},
            f"spark{k}": {"type": "point", "position": [x, y, z + 3], "intensity": 1.0 + k},
            f"plate{k}": {"type": "disk", "to_world": at(x, y, z + 4).scale(0.01), "emitter": glow(1.0 + k)},
        }
    scene = scene_of({**lamps, "sun": MIXED["sun"], "torch": MIXED["torch"]}, "constant")
    t0 = time.perf_counter()
    table = LightTable(scene)
    print(f"table {time.perf_counter() - t0:.2f} s")
    assert table.forms == {SPHERE, POINT, DISK, OTHER} and len(table.others) == 3 and table.all_plain
    assert time.perf_counter() - t0 < 8  # 0.3 s measured
    n = 3000
    si = place(rng.uniform([-2, -2, 0.2], [2, 2, 1.5], (n, 3)), n)
    u = mi.Point2f(*rng.random((2, n), np.float32))
    index = mi.UInt32(rng.integers(table.n_lights, size=n).astype(np.uint32))
    ds, weight, _ = table.sample(scene, si, index, u, mi.Bool(True))
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), mi.UInt32(table.columns["emitter"][np.array(index)]))
    known, known_weight = emitter.sample_direction(si, u)
    np.testing.assert_allclose(np.array(ds.d), np.array(known.d), atol=1e-5)
    np.testing.assert_allclose(np.array(weight), np.array(known_weight), rtol=2e-2)  # 1 - cos of a small cone


def test_more_lights_than_the_table_holds_are_refused(monkeypatch, tmp_path, rng):
    monkeypatch.setattr(table_module, "MAX_LIGHTS", 10)
    mesh = triangles(tmp_path / "m.ply", random_triangles(rng, 11))
    with pytest.raises(ValueError, match=r"11 emissive triangles.*leave the light_sampler out"):
        LightTable(scene_of({"m": {**mesh, "emitter": glow()}}))


# ---------------------------------------------------------------- index, sample, pdf


def test_index_of_a_ray_is_the_light_it_met(mixed, rng):
    scene, table = mixed
    n = 20_000
    ray = mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.warp.square_to_uniform_sphere(mi.Point2f(*rng.random((2, n), np.float32))))
    si = scene.ray_intersect(ray)
    index, emits = (np.array(v) for v in table.index_of(scene, si))
    Le = np.array(si.emitter(scene).eval(si)).max(axis=0)
    assert (emits | (Le == 0)).all() and 0.1 < emits.mean() < 0.9
    c = table.columns
    number = {v: k for k, v in enumerate(np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())))}
    met = np.array(dr.reinterpret_array(mi.UInt32, si.emitter(scene)))
    assert (c["emitter"][index[emits]] == [number[m] for m in met[emits]]).all()
    assert set(index[emits]) >= {*row(scene, table, "ball"), *row(scene, table, "window"), *row(scene, table, "sky")}
    # Flat ones: the point lies in the entry
    p = np.array(si.p).T
    on = emits & flat(c)[index]
    k = index[on]
    basis = np.stack([c["edge1"][k], c["edge2"][k], c["normal"][k]], -1)
    u, v, off = np.linalg.solve(basis.astype(float), (p[on] - c["corner"][k])[..., None])[..., 0].T
    assert (np.abs(off) < 1e-4).all() and (u > -1e-4).all() and (v > -1e-4).all()
    assert (np.where(c["form"][k] == TRIANGLE, u + v, np.maximum(u, v)) < 1 + 1e-4).all()
    assert len(set(k)) > 4


def test_nothing_is_met_where_the_ray_is_off_or_what_it_meets_is_dark(mixed):
    scene, table = mixed
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(0, 0, -1)))
    assert not np.array(table.index_of(scene, si)[1]).any()
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 0.5), mi.Vector3f(0, 0, 1)))
    assert np.array(table.index_of(scene, si)[1]).all()
    assert not np.array(table.index_of(scene, si, mi.Bool(False))[1]).any()


@pytest.mark.parametrize("sky", ["constant", "envmap"])
def test_density_of_a_point_is_that_of_sampling_it(sky, rng):
    scene = scene_of(MIXED, sky)
    table = LightTable(scene)
    n = 4000
    si = place(rng.uniform([-2, -2, 0.2], [2, 2, 1.5], (n, 3)), n)
    index = mi.UInt32(rng.integers(table.n_lights, size=n).astype(np.uint32))
    ds, weight, pdf = table.sample(scene, si, index, mi.Point2f(*rng.random((2, n), np.float32)), mi.Bool(True))
    si_light = scene.ray_intersect(mi.Ray3f(si.p, ds.d))
    hit, emits = table.index_of(scene, si_light)
    near = dr.norm(si_light.p - ds.p) < 1e-3  # not the back of a tube
    same = emits & (hit == index) & (pdf > 0) & (near | ~si_light.is_valid())
    same &= ~si_light.is_valid() | (dr.abs(dr.dot(si_light.n, ds.d)) > 0.05)  # there a cylinder's normal is too inexact
    again = table.pdf(
        scene, si, hit, si_light, mi.DirectionSample3f(scene, si_light, vertex.reference_point(si.p, si.n)), same
    )
    same, pdf, again, index = (np.array(v) for v in (same, pdf, again, index))
    delta = np.array(ds.delta) & np.ones(n, bool)
    c = table.columns
    assert set(index[same]) >= set(np.flatnonzero((c["intensity"] > 0) & ~flat(c))) - set(index[delta])
    assert same.sum() > 500
    off = np.abs(again[same] / pdf[same] - 1)
    assert off[flat(c)[index[same]]].max() < 2e-2
    assert np.median(off) < 1e-5 and (off > 2e-2).mean() < 2e-3  # grazing hits of spheres and cylinders are inexact
    Le = np.array(si_light.emitter(scene).eval(si_light, mi.Bool(same)))
    np.testing.assert_allclose((np.array(weight) * pdf)[:, same], Le[:, same], rtol=1e-2)


def form_factor(corners, p, n) -> float:
    """∫ cos⁺ dω of a polygon above the horizon (Lambert 1760)."""
    v = corners - p
    v = v / np.linalg.norm(v, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(v, np.roll(v, -1, axis=0), strict=True):
        gamma = np.cross(a, b)
        total += np.arccos(np.clip(a @ b, -1, 1)) * (gamma @ n) / np.linalg.norm(gamma)
    return abs(total) / 2


@pytest.mark.parametrize("shape", ["rectangle", "triangle", "attribute"])
def test_mean_of_samples_is_the_irradiance_of_a_polygon(tmp_path, shape):
    """E[radiance cos / density] over points of the light; of three triangles for the mesh."""
    quad = np.array([[-1, -1, 2], [-1, 1, 2], [1, 1, 2.5], [1, -1, 2.5]])
    corners = quad[[[0, 1, 2], [0, 2, 3]]] if shape == "rectangle" else quad[[[0, 1, 2]]]
    radiance = np.array([1.0, 2.0, 4.0])
    attribute = ("face_glow", [radiance]) if shape == "attribute" else None
    emission = (
        {"type": "mesh_attribute", "name": "face_glow"} if attribute else {"type": "rgb", "value": radiance.tolist()}
    )
    mesh = triangles(tmp_path / "m.ply", corners, attribute)
    scene = mi.load_dict({"type": "scene", "m": {**mesh, "emitter": glow(emission)}})
    table = LightTable(scene)
    assert table.n_lights == 1
    n, p = 2**14, np.array([0.3, -0.2, 0.0])
    normal = np.sign(table.columns["normal"][0, 2])
    assert normal == -1, "the light does not face the receiver"
    sampler = uniforms(n)
    ds, weight, _ = table.sample(scene, place(p, n), mi.UInt32(0), sampler.next_2d(), mi.Bool(True))
    for channel in range(3):
        known = radiance[channel] * form_factor(quad if shape == "rectangle" else quad[:3], p, np.array([0, 0, 1.0]))
        assert_mean(np.array(weight[channel] * ds.d.z), known, f"{shape}, channel {channel}", relative=1e-5)


def test_mean_of_samples_of_a_spotted_picture_is_its_irradiance():
    """One texel of 4096 carries most of the light."""
    spot = np.full((16, 16, 3), 0.5, np.float32)
    spot[3, 3] = 1e3
    light = {"type": "rectangle", "to_world": at(0, 0, 20).rotate([1, 0, 0], 180), "emitter": glow(picture(spot))}
    scene = mi.load_dict({"type": "scene", "light": light})
    table = LightTable(scene)
    n = 2**14
    total = 0
    for k in range(table.n_lights):
        ds, weight, _ = table.sample(scene, place([0, 0, 0], n), mi.UInt32(k), uniforms(n, k).next_2d(), mi.Bool(True))
        total += np.array(weight.x * ds.d.z)
    assert_mean(total, spot.mean() * 4 / 400, "spotted", relative=5e-3)  # cosines and distances differ by 0.5 %


def test_lights_that_are_not_flat_are_sampled_as_their_emitter_does(mixed, rng):
    """Where Mitsuba gives a weight; on the back of a disk or cylinder its density is positive as well."""
    scene, table = mixed
    n = 64
    si = place(rng.uniform([-2, -2, 0.2], [2, 2, 1.5], (n, 3)), n)
    u = mi.Point2f(*rng.random((2, n), np.float32))
    for i in np.flatnonzero(~flat(table.columns)):
        emitter = scene.emitters()[table.columns["emitter"][i]]
        known, known_weight = emitter.sample_direction(si, u)
        ds, weight, pdf = table.sample(scene, si, mi.UInt32(int(i)), u, mi.Bool(True))
        np.testing.assert_allclose(np.array(ds.d), np.array(known.d) * np.ones((3, n)), rtol=1e-5, atol=1e-6)
        known_weight = np.array(known_weight) * np.ones((3, n))
        np.testing.assert_allclose(np.array(weight), known_weight, rtol=1e-4, atol=1e-7)
        lit = known_weight.max(axis=0) > 0
        np.testing.assert_allclose(np.array(pdf)[lit], (np.array(known.pdf) * np.ones(n))[lit], rtol=1e-4)


def test_shadow_rays_end_on_flat_lights_and_at_the_place_of_others(mixed, rng):
    scene, table = mixed
    c = table.columns
    n = 2000
    index = rng.integers(table.n_lights, size=n)
    origin = mi.Point3f(0.1, 0.2, 0.3) + dr.zeros(mi.Point3f, n)
    ray, some = table.shadow_ray(scene, origin, mi.UInt32(index.astype(np.uint32)),
                                 mi.Point2f(*rng.random((2, n), np.float32)), mi.Bool(True))  # fmt: skip
    assert dr.all(some)
    np.testing.assert_allclose(np.linalg.norm(np.array(ray.d), axis=0), 1, rtol=1e-4)
    target = np.array(ray(ray.maxt / (1 - SHADOW_EPSILON))).T
    on_plane = flat(c)[index]
    off = ((target - c["corner"][index]) * c["normal"][index]).sum(axis=1)
    assert (np.abs(off[on_plane]) < 1e-3).all()
    near = c["kind"][index] == LOCAL
    assert (np.linalg.norm(target - c["center"][index], axis=1)[near] <= c["radius"][index][near] + 1e-3).all()
