"""The environment as texels: the map of the sphere to the square, what texels hold, what they give as lights."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from light_scenes import MIXED, scene_of
from scipy import stats

from mi_neural.lights import sky
from mi_neural.lights.clusters import make_groups
from mi_neural.lights.entries import DIRECTION
from mi_neural.lights.importance import importance
from mi_neural.lights.sampling import VisibleLights
from mi_neural.lights.table import LightTable


def directions(n, seed=0):
    d = np.random.default_rng(seed).normal(size=(3, n))
    return mi.Vector3f((d / np.linalg.norm(d, axis=0)).astype(np.float32))


def under(pixels=None, **keys):
    """A scene of a floor under an environment."""
    if pixels is not None:
        keys = {"type": "envmap", "bitmap": mi.Bitmap(np.asarray(pixels, np.float32)), **keys}
    camera = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1]),
              "film": {"type": "hdrfilm", "width": 8, "height": 8}}  # fmt: skip
    return mi.load_dict({"type": "scene", "floor": {"type": "rectangle"}, "sky": keys, "camera": camera})


def pixels(height=32, seed=0):
    return np.random.default_rng(seed).uniform(0, 2, (height, 2 * height, 3)).astype(np.float32)


# ---------------------------------------------------------------- the map


def test_map_is_its_own_inverse():
    d = directions(100_000)
    assert float(dr.max(dr.norm(sky.to_direction(sky.to_square(d)) - d))[0]) < 2e-5
    p = mi.Point2f(np.random.default_rng(1).random((2, 100_000)).astype(np.float32))
    back = sky.to_square(sky.to_direction(p))
    seam = dr.minimum(p.x, dr.minimum(1 - p.x, dr.minimum(p.y, 1 - p.y))) < 1e-3  # two edges are one place
    assert float(dr.max(dr.select(seam, 0, dr.norm(back - p)))[0]) < 1e-4


@pytest.mark.parametrize("d", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (-0.6, 0, 0.8), (0.6, 0.8, 0)])
def test_poles_and_axes_are_mapped(d):
    p = sky.to_square(mi.Vector3f(*map(float, d)))
    assert 0 <= p.x[0] <= 1 and 0 <= p.y[0] <= 1
    np.testing.assert_allclose(np.array(sky.to_direction(p)).ravel(), d, atol=1e-6)


def test_map_keeps_areas():
    """chi2 over 16 x 16 cells; a map that keeps areas fails in one of 10,000 choices of seed."""
    counts = np.histogram2d(*np.array(sky.to_square(directions(400_000, 5))), 16, [[0, 1], [0, 1]])[0]
    assert stats.chisquare(counts.ravel()).pvalue > 1e-4


# ---------------------------------------------------------------- texels


@pytest.mark.parametrize("height, size", [(4, 32), (64, 64), (100, 128), (1024, 512)])
def test_texels_are_as_fine_as_the_bitmap(height, size):
    assert sky.Sky(under(np.ones((height, 2 * height, 3))), 0).size == size


def test_points_of_a_texel_are_in_it_and_near_its_centre():
    s = sky.Sky(under(pixels()), 0)
    rng = np.random.default_rng(0)
    texel = mi.UInt32(rng.integers(s.size**2, size=50_000).astype(np.uint32))
    d = s.at(texel, mi.Point2f(rng.uniform(0.01, 0.99, (2, 50_000)).astype(np.float32)))
    np.testing.assert_array_equal(np.array(s.texel_of(d)), np.array(texel))
    cos = np.array(dr.dot(d, dr.gather(mi.Vector3f, mi.Vector3f(s.direction.T.astype(np.float32)), texel)))
    assert np.arccos(np.clip(cos, -1, 1)).max() * s.size < sky.REACH


def test_irradiance_is_the_integral_of_radiance():
    for scene, error in ((under(type="constant", radiance=2.0), 1e-5), (under(pixels()), 0.02)):
        s = sky.Sky(scene, 0)
        d = directions(200_000)
        mean = np.array(mi.luminance(s.radiance(scene.emitters()[0], d))).mean()
        assert s.irradiance.sum() == pytest.approx(4 * np.pi * mean, rel=error)


def test_a_sun_of_one_pixel_is_found():
    sun = np.full((256, 512, 3), 0.01, np.float32)
    sun[60, 100] = 1e5
    s = sky.Sky(under(sun), 0)
    top = np.sort(s.irradiance)[::-1]
    assert top[:12].sum() > 0.95 * top.sum() and (s.irradiance > 0).all()


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_dark_and_broken_bitmaps_give_finite_texels(value):
    image = np.full((8, 16, 3), value, np.float32)
    scene = under(image)
    s = sky.Sky(scene, 0)
    assert np.isfinite(s.irradiance).all() and (s.irradiance >= 0).all()
    sampler = {"type": "nvc_lights", "environment_cells": 8, "train_frames": 1, "train_samples": 64}
    integrator = mi.load_dict({"type": "plain_path", "max_depth": 2, "light_sampler": sampler})
    if value == 0:
        assert (np.array(integrator.render(scene, spp=1)) == 0).all()
    else:
        with pytest.raises(ValueError, match="'sky' has values that are not finite"):
            integrator.render(scene, spp=1)


# ---------------------------------------------------------------- texels as lights


@pytest.mark.parametrize("lights", [{}, MIXED], ids=["alone", "among others"])
def test_table_puts_texels_last_and_finds_what_a_ray_met(lights):
    scene = scene_of(lights, "envmap")
    table, whole = LightTable(scene, texels=True), LightTable(scene)
    assert whole.sky is None and table.n_lights == whole.n_lights - 1 + table.sky.size**2
    c = table.columns
    assert (c["kind"][table.sky.first :] == DIRECTION).all()
    for name in ("emitter", "intensity", "center"):
        np.testing.assert_array_equal(c[name][: table.sky.first], whole.columns[name][whole.columns["kind"] != 2])
    d = directions(2000, 3)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 60), d))
    index, emits = table.index_of(scene, si)
    beyond = ~np.array(si.is_valid())
    assert np.array(emits)[beyond].all() and beyond.sum() > 900
    np.testing.assert_array_equal(np.array(index)[beyond], (table.sky.first + np.array(table.sky.texel_of(d)))[beyond])


def test_density_of_a_texel_is_one_over_its_solid_angle_on_both_ways():
    scene = scene_of(MIXED, "envmap")
    table = LightTable(scene, texels=True)
    rng = np.random.default_rng(0)
    n = 5000
    index = mi.UInt32(rng.integers(table.sky.first, table.n_lights, n).astype(np.uint32))
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    ds, weight, pdf = table.sample(scene, si, index, mi.Point2f(rng.random((2, n)).astype(np.float32)), mi.Bool(True))
    np.testing.assert_allclose(np.array(pdf), table.sky.size**2 / (4 * np.pi), rtol=1e-5)
    far = scene.ray_intersect(mi.Ray3f(mi.Point3f(0, 0, 100), mi.Vector3f(ds.d)), ds.d.z > 0)
    at = mi.DirectionSample3f(scene, far, si)
    np.testing.assert_allclose(np.array(table.pdf(scene, si, index, far, at, mi.Bool(True))), np.array(pdf), rtol=1e-5)
    Le = scene.environment().eval(far, ds.d.z > 0)
    up = np.array(ds.d.z) > 0.01
    np.testing.assert_allclose(np.array(weight * pdf).T[up], np.array(Le).T[up], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("two_sided", [False, True])
def test_importance_of_cells_bounds_that_of_their_texels(two_sided):
    table = LightTable(under(pixels()), texels=True)
    groups = make_groups(table, 32, n_cells=16)
    assert groups.n_groups == 16 and all(groups.cell) and set(groups.kind) == {DIRECTION}
    sampler = VisibleLights(table, groups)
    n = directions(64, 9)
    cells = np.stack([np.array(w) for w in sampler.weights(mi.Point3f(0), n, mi.Bool(two_sided))])
    cos = np.array(n).T @ table.sky.direction.T
    cos = np.abs(cos) if two_sided else np.maximum(cos, 0)
    for k in range(16):
        mine = groups.host["label"] == k
        given = (cos[:, mine] * table.sky.irradiance[mine]).sum(axis=1)
        assert (cells[k] >= 0.999 * given).all()
        assert ((cells[k] > 0) | (given < 1e-6)).all()


def test_one_texel_is_bounded_over_all_its_points():
    table = LightTable(under(pixels(16)), texels=True)
    rng = np.random.default_rng(2)
    n = directions(20_000, 4)
    index = mi.UInt32(rng.integers(table.n_lights, size=20_000).astype(np.uint32))

    class One:
        kind = DIRECTION
        center, cone, intensity = (dr.gather(type(a), a, index) for a in (table.center, table.cone, table.intensity))

    bound = np.array(importance(One, mi.Point3f(0), n, mi.Bool(False)) / One.intensity)
    d = table.sky.at(index, mi.Point2f(rng.random((2, 20_000)).astype(np.float32)))
    assert (bound >= np.array(dr.maximum(dr.dot(d, n), 0)) - 1e-6).all()


@pytest.mark.parametrize("lights", [{}, MIXED], ids=["alone", "among others"])
def test_choice_and_density_integrate_to_all_light(lights):
    """E[L(ω) [ω above] w / p] = ∫ L dω over the sky, within 4.5 standard errors: wrong in one of 10^5 choices."""
    scene = scene_of(lights, "envmap")
    table = LightTable(scene, texels=True)
    sampler = VisibleLights(table, make_groups(table, 32, n_cells=8))
    n = 200_000
    rng = np.random.default_rng(7)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    u = lambda: mi.Float(rng.random(n).astype(np.float32))  # noqa: E731
    choice = sampler.choose(si, mi.Vector3f(0, 0, 1), mi.Bool(False), u(), _Sampler(n), mi.UInt32(0),
                            mi.Bool(True))  # fmt: skip
    ds, weight, _ = table.sample(scene, si, choice.index, mi.Point2f(u(), u()), mi.Bool(True))
    is_sky = np.array(choice.index) >= table.sky.first
    up = np.array(ds.d.z) > 0
    found = np.where(is_sky & up, np.array(mi.luminance(weight) * choice.weight * ds.d.z), 0)
    d = directions(400_000, 11)
    known = np.array(mi.luminance(table.sky.radiance(scene.environment(), d)) * dr.maximum(d.z, 0)) * 4 * np.pi
    error = np.hypot(found.std() / n**0.5, known.std() / 400_000**0.5)
    assert abs(found.mean() - known.mean()) < 4.5 * error


class _Sampler:
    def __init__(self, n):
        self.rng = mi.PCG32(n, 5)

    def next_1d(self):
        return self.rng.next_float32()
