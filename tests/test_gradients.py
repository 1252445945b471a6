"""Gradients of images through the cached integrators: against analysis, finite differences, and Mitsuba's ``prb``.

Biased gradients may be off by 5 % of the gradient's norm beyond what noise explains.
"""

import importlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, sweep
from gradient_scenes import (
    BY_CACHE,
    CACHED,
    SMALL,
    T,
    agree,
    assert_is_difference,
    black_wall,
    gradients_of,
    reference,
    room,
    spread_of,
    tracked,
    train,
)

from mi_neural import scenes


@pytest.mark.parametrize("rr_depth", [1, 100])
def test_derivative_by_the_albedo_is_known_also_where_roulette_ends_paths(rr_depth):
    """In a sphere of albedo a around a point light the image is E a / (1 - a): its derivative over it 1 / (a (1 - a)),
    4 for 1/2. While the probability of roulette was differentiated, too, it was 2 where paths may end from the first
    bounce on."""
    scene = mi.load_file(str(scenes.path("point_lit_sphere")), resx=8, resy=8)
    params = mi.traverse(scene)
    (key,) = (k for k in params.keys() if k.endswith("reflectance.value"))
    albedo = params[key]
    dr.enable_grad(albedo)
    params.update()
    integrator = mi.load_dict({"type": "plain_path", "max_depth": 24, "rr_depth": rr_depth})
    image = mi.render(scene, params, integrator=integrator, spp=512)
    dr.backward(dr.sum(image, axis=None))
    found = float(np.sum(np.array(dr.grad(albedo)))) / float(np.sum(np.array(image)))
    print(f"derivative over the image {found:.3f} (known 4)")
    assert found == pytest.approx(4, rel=0.03)


# ---------------------------------------------------------------- what is known


@pytest.mark.parametrize("name, keys", [*((name, {}) for name in CACHED), ("nirc_two_level", {"gradient": "cache"})])
def test_gradients_of_the_point_lit_sphere(name, keys):
    """Albedo ρ, intensity I: L = I/π ρ/(1 - ρ) everywhere, so dL/dρ = 4 and dL/dI = 1/π at 1/2 and π."""
    scene = mi.load_file(str(scenes.path("point_lit_sphere")), resx=8, resy=8)
    params, (wall_key, light_key) = tracked(scene)
    integrator = mi.load_dict({"type": name, "train_frames": 48, "train_samples": 512, **NETWORK, **keys})
    image = mi.render(scene, params, integrator=integrator, spp=64, seed=1)
    steps = integrator.cache.steps
    dr.backward(dr.mean(image, axis=None))
    albedo, intensity = np.array(dr.grad(params[wall_key])), np.array(dr.grad(params[light_key]))
    print(name, albedo.ravel(), intensity.ravel())
    np.testing.assert_allclose(albedo.ravel(), 4 / 3, rtol=0.02)
    np.testing.assert_allclose(intensity.ravel(), 1 / (3 * np.pi), rtol=0.02)
    assert integrator.cache.steps == steps, "the adjoint trains nothing"
    mi.render(scene, params, integrator=integrator, spp=1)
    assert integrator.cache.steps == steps + 1, "the next image does"


@pytest.mark.parametrize("keys", sweep([{}, {"light_sampler": {"type": "uniform_lights"}}], [{}]))
def test_gradients_of_a_surface_that_is_all_black(keys):
    """Direct light and light from the cache, against a finite difference."""
    scene, params, key = black_wall()
    found = gradients_of(scene, params, [key], train(scene, "nrc", **keys), 512, 1)
    assert_is_difference(scene, params, key, found, 24, 0.1)


@pytest.mark.parametrize("records", [True, False])
def test_environment_has_gradients_whatever_the_passes(monkeypatch, records):
    """The camera sees it directly, and by reflection; in three passes, and with functions that cannot be recorded."""
    sky = mi.Bitmap(np.random.default_rng(2).uniform(0, 1, (4, 8, 3)).astype(np.float32))
    scene = room(width=8, sky={"type": "envmap", "bitmap": sky},
                 eye={"type": "perspective", "fov": 70, "to_world": T().look_at([0, 0, 3.2], [0, 0, 0], [0, 1, 0]),
                      "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"},
                               "pixel_format": "rgb"}})  # fmt: skip
    params, keys = mi.traverse(scene), ["sky.data"]
    integrator = train(scene, "nrc")
    integrator.records = records
    theirs = spread_of(scene, params, keys, mi.load_dict({"type": "prb", "max_depth": 24}), 1024)
    for name, size in (("one pass", 2**22), ("three passes", 64 * 64)):
        monkeypatch.setattr(importlib.import_module("mi_neural.integrators.gradients"), "PASS_SAMPLES", size)
        agree(name, spread_of(scene, params, keys, integrator, 192), theirs)


def test_gradients_of_what_is_black():
    """A colour of 0 has a derivative, where ``prb`` finds none: against finite differences."""
    scene = room()
    params, keys = tracked(scene, ("lamp.emitter.radiance.value", "left.bsdf.reflectance.value"))
    params[keys[0]], params[keys[1]] = mi.Color3f(5, 0, 5), mi.Color3f(0.5, 0, 0.5)
    for k in keys:
        dr.enable_grad(params[k])
    params.update()
    integrator = train(scene, "nrc")
    mean = mi.TensorXf(np.full((12, 12, 3), 1 / 432, np.float32))
    found = gradients_of(scene, params, keys, integrator, 256, 1, mean)[[1, 4]]
    path, step, images = mi.load_dict({"type": "path", "max_depth": 24}), 0.05, {}
    with dr.suspend_grad():
        for which, at in ((None, None), (0, mi.Color3f(5, step, 5)), (1, mi.Color3f(0.5, step, 0.5))):
            known = None if which is None else dr.detach(params[keys[which]])
            if which is not None:
                params[keys[which]] = at
                params.update()
            images[which] = float(np.mean(np.array(mi.render(scene, integrator=path, spp=1024, seed=3))))
            if which is not None:
                params[keys[which]] = known
                params.update()
    expected = [(images[k] - images[None]) / step for k in (0, 1)]
    print(found, expected)
    np.testing.assert_allclose(found, expected, rtol=0.08)


# ---------------------------------------------------------------- biased: within 5 % of prb's


@pytest.mark.parametrize("name, kind", sweep([
    (name, kind) for kind in ("diffuse", "glossy", "mirror", "mask", "sky") for name in BY_CACHE
], [("nirc", "diffuse"), ("neural_path", "diffuse")]))  # fmt: skip
def test_gradients_by_the_cache_are_those_of_prb(name, kind):
    scene, params, keys, theirs = reference(kind)
    ours = spread_of(scene, params, keys, train(scene, name), 128)
    agree(f"{name}, {kind}", ours, theirs)


def test_direct_light_at_the_end_is_traced_where_the_cache_lacks_it():
    scene, params, keys, theirs = reference("diffuse")
    integrator = train(scene, "nrc", cache_content="indirect")
    agree("nrc, indirect", spread_of(scene, params, keys, integrator, 128), theirs)


# ---------------------------------------------------------------- as Mitsuba's own


@pytest.fixture
def warnings():
    """What Mitsuba logs as a warning."""
    found, known = [], mi.logger().appender(0)

    class Catcher(mi.Appender):
        def append(self, level, text):
            if level >= mi.LogLevel.Warn:
                found.append(text)

        def log_progress(self, *_):
            pass

    logger = mi.logger()
    logger.clear_appenders()
    logger.add_appender(Catcher())
    yield found
    logger.clear_appenders()
    logger.add_appender(known)


@pytest.mark.parametrize("name, key, lights", sweep([
    ("nirc", "floor.bsdf.reflectance.data", {}), ("nrc", "floor.bsdf.reflectance.data", {}), ("nrc", "sky.data", {}),
    ("nrc", "sky.data", {"light_sampler": {"type": "power_lights"}}),
    ("nirc", "floor.bsdf.reflectance.data", {"gradient": "traced"}),
], [("nirc", "floor.bsdf.reflectance.data", {}), ("nirc", "floor.bsdf.reflectance.data", {"gradient": "traced"}),
    ("nrc", "sky.data", {"light_sampler": {"type": "power_lights"}})]))  # fmt: skip
def test_forward_and_backward_are_transposes(name, key, lights):
    """<δ, J v> = <Jᵀ δ, v> with the same samples; a Gaussian filter, a crop window, channels."""
    film = {"type": "hdrfilm", "width": 16, "height": 12, "crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 8,
            "crop_height": 7, "rfilter": {"type": "gaussian"}, "pixel_format": "rgba",
            "sample_border": True}  # fmt: skip
    eye = {"type": "perspective", "fov": 70, "to_world": T().look_at([0, 0, 3.2], [0, 0, 0], [0, 1, 0]), "film": film}
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.random.default_rng(2).uniform(0, 1, (4, 8, 3)).astype(np.float32))}
    scene = room(eye=eye, sky=sky)
    params = mi.traverse(scene)
    integrator = train(scene, name, channels="depth", train_frames=8, **lights)
    known, t = mi.TensorXf(params[key]), mi.Float(0)
    v = np.random.default_rng(3).normal(size=known.shape).astype(np.float32)
    dr.enable_grad(t)
    params[key] = known + mi.TensorXf(v) * t
    params.update()
    dr.forward(t, dr.ADFlag.ClearEdges)
    image = np.array(integrator.render_forward(scene, params, 0, 5, 16), np.float64)
    assert image.shape == (7, 8, 5) and (image[..., 3:] == 0).all()
    δ = np.random.default_rng(4).normal(size=image.shape).astype(np.float32)
    δ[..., 3:] = 0
    params[key] = known
    dr.enable_grad(params[key])
    params.update()
    back = gradients_of(scene, params, [key], integrator, 16, 5, mi.TensorXf(δ))
    left, right = np.sum(image * δ), np.sum(back * v.ravel())
    print(left, right)
    assert left == pytest.approx(right, rel=2e-3, abs=1e-3 * np.linalg.norm(back) * np.linalg.norm(v))


def test_seeds_and_samples_are_those_of_the_gradient():
    scene = room(width=6)
    params, keys = tracked(scene)
    integrator = train(scene, "nrc", train_steps=0, train_frames=8)

    def by(**numbers):
        for k in keys:
            dr.set_grad(params[k], 0)
        dr.backward(dr.sum(mi.render(scene, params, integrator=integrator, spp=2, **numbers), axis=None))
        return np.concatenate([np.array(dr.grad(params[k])).ravel() for k in keys])

    first = by(seed=1, seed_grad=7, spp_grad=4)
    again, other, more = by(seed=2, seed_grad=7, spp_grad=4), by(seed=1, seed_grad=8, spp_grad=4), by(seed=1)
    np.testing.assert_allclose(first, again, rtol=1e-3, atol=1e-4 * np.abs(first).max())
    for different in (other, more):
        assert np.abs(first - different).max() > 1e-2 * np.abs(first).max()


def test_passes_of_one_gradient_add_up(monkeypatch):
    scene = room(width=6)
    params, keys = tracked(scene)
    integrator = train(scene, "nrc", train_frames=8)
    whole = gradients_of(scene, params, keys, integrator, 8, 3)
    monkeypatch.setattr(importlib.import_module("mi_neural.integrators.gradients"), "PASS_SAMPLES", 36 * 2)
    parts = gradients_of(scene, params, keys, integrator, 8, 3)
    np.testing.assert_allclose(whole, parts, rtol=0.3, atol=0.1 * np.abs(whole).max())
    assert not np.array_equal(whole, parts)


@pytest.mark.parametrize("name", ["nirc", "nirc_two_level"])
def test_gradients_are_recorded_once(name):
    """Other values, seeds and loss images replay one recording; what it gives is what is traced without."""
    scene = room(width=6)
    params, keys = tracked(scene)
    integrator = train(scene, name, train_frames=8)
    first = gradients_of(scene, params, keys, integrator, 4, 1)
    gradients_of(scene, params, keys, integrator, 4, 2)
    function = next(f for k, f in integrator.film_state.passes.recorded.items() if k[0] == "adjoint")
    known = function.n_recordings
    params[keys[0]] = dr.detach(params[keys[0]]) * 0.9
    dr.enable_grad(params[keys[0]])
    params.update()
    for seed in range(3):
        mi.render(scene, params, integrator=integrator, spp=1, seed=seed)
        replayed = gradients_of(scene, params, keys, integrator, 4, seed)
    assert function.n_recordings <= known + 1

    def disturbed(*_):
        raise RuntimeError("another thread freed memory while a function was recorded")

    recorded = integrator.film_state.passes.recorded
    recorded |= {k: disturbed for k in recorded if k[0] == "adjoint"}
    with pytest.raises(RuntimeError, match=rf"^{name}: another thread .*; set them to zero and compute them again"):
        gradients_of(scene, params, keys, integrator, 4, 2)
    np.testing.assert_allclose(replayed, gradients_of(scene, params, keys, integrator, 4, 2), rtol=1e-3, atol=1e-5)
    integrator.records = False
    np.testing.assert_allclose(replayed, gradients_of(scene, params, keys, integrator, 4, 2), rtol=1e-3, atol=1e-5)
    assert not np.array_equal(first, replayed)


def test_shapes_have_the_gradient_of_prb_and_are_named_once(warnings):
    scene = room(width=6)
    params, keys = tracked(scene, ("block.vertex_positions", "left.bsdf.reflectance.value"))
    integrator = train(scene, "nrc", train_frames=8)
    a = gradients_of(scene, params, keys, integrator, 16, 3)
    gradients_of(scene, params, keys, integrator, 16, 4)
    b = gradients_of(scene, params, keys, mi.load_dict({"type": "prb", "max_depth": -1}), 16, 3)
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * np.abs(b).max())
    said = [w for w in warnings if "gradients come from prb" in w]
    assert len(said) == 1 and "block.vertex_positions" in said[0]


def test_prb_that_leaves_the_light_sampler_out_is_named_once(warnings):
    scene = room(width=6)
    params, keys = tracked(scene)
    keys_of = {"train_frames": 8, "light_sampler": {"type": "power_lights"}}
    for gradient in ("cache", "prb"):
        nested = train(scene, "nrc", gradient=gradient, **keys_of)
        for seed in range(2):
            gradients_of(scene, params, keys, nested, 1, seed)
        named = [w for w in warnings if "by prb choose lights as Mitsuba does, without power_lights" in w]
        assert len(named) == (gradient == "prb")


def test_channels_without_gradient_are_named_once(warnings):
    scene = room(width=6)
    params, keys = tracked(scene)
    for gradient in ("cache", "prb"):
        integrator = train(scene, "nrc", train_frames=8, channels="depth", gradient=gradient)
        for _ in range(2):
            image = mi.render(scene, params, integrator=integrator, spp=1)
            dr.backward(dr.mean(image, axis=None))
            assert np.isfinite(np.array(dr.grad(params[keys[0]]))).all()
    assert len([w for w in warnings if "depth have no gradient" in w]) == 2


def test_unknown_way_of_differentiating_is_refused():
    with pytest.raises(Exception, match="give one of: cache, traced, prb"):
        mi.load_dict({"type": "nirc", "gradient": "both"})


# ---------------------------------------------------------------- inverse rendering


@pytest.mark.slow
@pytest.mark.parametrize("name", BY_CACHE)
def test_colours_texture_and_lamp_are_found_from_an_image(name):
    scene = room(width=16)
    target = mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 24}), spp=2048)
    params = mi.traverse(scene)
    keys = ["left.bsdf.reflectance.value", "right.bsdf.reflectance.value", "floor.bsdf.reflectance.data",
            "lamp.emitter.radiance.value"]  # fmt: skip
    true = {k: np.array(params[k]) for k in keys}
    optimizer = mi.ad.Adam(lr=0.05)
    for k in keys:
        optimizer[k] = dr.full(type(params[k]), 0.5, dr.width(params[k])) if k != keys[2] else params[k] * 0 + 0.5
    optimizer[keys[3]] = mi.Color3f(3)
    optimizer.set_learning_rate({keys[3]: 0.2})
    params.update(optimizer)
    integrator = mi.load_dict({"type": name, **SMALL})
    for step in range(120):
        image = mi.render(scene, params, integrator=integrator, spp=8, seed=step)
        dr.backward(dr.mean(dr.square(image - target) / (dr.square(target) + 0.1), axis=None))
        optimizer.step()
        for k in keys[:3]:
            optimizer[k] = dr.clip(optimizer[k], 0, 1)
        params.update(optimizer)
    for k, tolerance in zip(keys, (0.05, 0.05, 0.1, 0.5), strict=True):
        error = np.abs(np.array(params[k]) - true[k]).mean()
        print(k, error)
        assert error < tolerance
