"""restir_di: the mean is that of `path`, whatever is reused; and what reuse is for."""

import importlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from expectation import assert_same_mean, renders
from test_vertex import lights, test_scene

test_scene.__test__ = False
RUNS = 24
#: A small network, trained little: the mean must not depend on it
NVC = {"type": "nvc_lights", "train_frames": 16, "train_samples": 512}
ALONE = {"history": 0.0, "spatial_samples": 0}


@pytest.fixture(autouse=True, scope="module")
def _registered():
    importlib.import_module("mi_neural.integrators.restir_di")


def lamp(x: float, z: float, radiance: float, y: float = 1.5) -> dict:
    to_world = mi.ScalarTransform4f().translate([x, y, z]).rotate([1, 0, 0], 90).scale(0.15)
    return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": radiance}}


def many_lights(size: int = 16, black: bool = False) -> mi.Scene:
    """Seven lights of all kinds, shadowed by the spheres and a wall."""
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([-0.6, 0.5, 1]).rotate([0, 1, 0], 90)}
    some = {f"lamp{k}": lamp(2 * np.cos(k), 2 * np.sin(k), 8.0 * k) for k in range(1, 4)}
    ball = {"type": "sphere", "center": [1.8, 0.3, 1.8], "radius": 0.2, "emitter": {"type": "area", "radiance": 9.0}}
    scene = test_scene({**lights("all"), **some, "ball": ball, "wall": wall}, size)
    if black:
        params = mi.traverse(scene)
        for name in params.keys():
            if name.endswith(("radiance.value", "intensity.value")):
                params[name] = 0.0 * params[name]
            elif name.endswith("sky.data"):
                params[name] = mi.TensorXf(np.zeros(params[name].shape, np.float32))
        params.update()
    return scene


def diffuse_scene(size: int = 16) -> mi.Scene:
    """A floor and a matte sphere under many lamps."""
    look_at = mi.ScalarTransform4f().look_at([0, 3, 4], [0, 0.3, 0], [0, 1, 0])
    return mi.load_dict({
        "type": "scene", **{f"lamp{k}": lamp(2.5 * np.cos(k), 2.5 * np.sin(k), 10.0) for k in range(12)},
        "sensor": {"type": "perspective", "fov": 50, "to_world": look_at,
                   "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(4)},
        "ball": {"type": "sphere", "center": [0, 0.7, 0], "radius": 0.7},
    })  # fmt: skip


def integrator(**keys):
    return mi.load_dict({"type": "restir_di", **keys})


def last_frames(scene, it, runs: int = RUNS, frames: int = 3, first_seed: int = 0, between=None) -> np.ndarray:
    """The last of `frames` frames, of independent runs; `between(k)` is called before frame k."""
    images = []
    for run in range(runs):
        it.state.reset()  # what a light sampler learned may stay
        for k in range(frames):
            if between is not None:
                between(k)
            image = mi.render(scene, integrator=it, spp=1, seed=first_seed + run)
        images.append(np.array(image))
    return np.stack(images).astype(np.float64)[..., :3]


def path(scene, **keys) -> np.ndarray:
    return renders(scene, {"type": "path", "max_depth": 2, **keys}, 24, 32, first_seed=1000)


@pytest.fixture(scope="module")
def many_lights_path() -> np.ndarray:
    return path(many_lights())


@pytest.mark.parametrize("keys", [
    {}, pytest.param({"candidates": "nvc"}, marks=pytest.mark.slow),
    pytest.param({"candidates": "nvc", "nvc_where": "disoccluded"}, marks=pytest.mark.slow),
    pytest.param({**ALONE, "initial_candidates": 1}, marks=pytest.mark.slow),
    {"candidates": "nvc", "candidate_shadow_ray": False},
    pytest.param({"candidate_shadow_ray": False}, marks=pytest.mark.slow),
    pytest.param({"candidates": "nvc", "preset": "paper", "nvc_where": "disoccluded"}, marks=pytest.mark.slow),
], ids=["light", "nvc", "disoccluded", "alone", "nvc without a ray", "light without a ray", "preset"])  # fmt: skip
def test_mean_is_that_of_path(keys, many_lights_path):
    scene = many_lights()
    if "candidates" in keys:
        keys = {**keys, "light_sampler": NVC}
    assert_same_mean(last_frames(scene, integrator(**keys)), many_lights_path, str(keys), relative=1e-5)


@pytest.mark.parametrize(
    "name", ["area", *(pytest.param(n, marks=pytest.mark.slow) for n in ("point", "constant", "envmap"))]
)
def test_mean_with_a_single_light_is_that_of_path(name):
    scene = test_scene(lights(name))
    keys = {"light_sampler": NVC} if name == "constant" else {}
    assert_same_mean(last_frames(scene, integrator(**keys)), path(scene), name, relative=1e-5)


@pytest.mark.slow
def test_hidden_emitters_are_those_of_path():
    scene = many_lights()
    ours = last_frames(scene, integrator(hide_emitters=True))
    assert_same_mean(ours, path(scene, hide_emitters=True), "hidden", relative=1e-5)


def test_moving_camera_does_not_change_the_mean():
    scene = many_lights()
    params = mi.traverse(scene)

    def move(k):
        look_at = mi.ScalarTransform4f().look_at([0.4 * k - 0.8, 3, 5], [0, 0.5, 0], [0, 1, 0])
        params["sensor.to_world"] = mi.Transform4f(look_at)
        params.update()

    ours = last_frames(scene, integrator(), between=move)
    assert_same_mean(ours, path(scene), "camera moves", relative=1e-5)


def test_lights_that_change_do_not_change_the_mean():
    """One is switched on and another off, right before the frame that is looked at."""
    scene = many_lights()
    params = mi.traverse(scene)

    def change(k):
        params["lamp1.emitter.radiance.value"] = mi.Color3f(40.0 if k == 2 else 0.0)
        params["lamp2.emitter.radiance.value"] = mi.Color3f(0.0 if k == 2 else 40.0)
        params.update()

    ours = last_frames(scene, integrator(), between=change)
    assert_same_mean(ours, path(scene), "lights change", relative=1e-5)


def test_reuse_lowers_the_noise():
    """Of single frames, at half of the pixels or more: over frames, over pixels, and both together."""
    scene = diffuse_scene(32)
    keys = [ALONE, {"spatial_samples": 0}, {"history": 0.0, "spatial_radius": 4.0}, {"spatial_radius": 4.0}]
    noise = [np.median(last_frames(scene, integrator(**k), 8, 6).var(axis=0)) for k in keys]
    alone, frames, pixels, both = noise
    print(f"variance alone {alone:.3g}, over frames {frames:.3g}, over pixels {pixels:.3g}, both {both:.3g}")
    assert frames < 0.5 * alone and pixels < 0.8 * alone and both < 0.5 * alone


def test_nvc_only_where_nothing_is_known_is_nvc_there():
    """In the first frame, which knows nothing, both choices are the same, sample by sample; later, in the mean."""
    scene, images = diffuse_scene(16), {}
    for where in ("everywhere", "disoccluded"):
        it = integrator(candidates="nvc", nvc_where=where, light_sampler={**NVC, "freeze": True})
        images[where] = last_frames(scene, it, 2, 1)
        images[where + " later"] = last_frames(scene, it, 16, 4)
    np.testing.assert_allclose(images["disoccluded"], images["everywhere"], rtol=1e-3, atol=1e-4)
    assert_same_mean(images["disoccluded later"], images["everywhere later"], "disoccluded", relative=1e-5)


def test_edges_know_what_the_pixel_beside_saw():
    """Samples of a pixel at an edge lie now on this side of it, now on that."""
    scene, it = diffuse_scene(32), integrator(spatial_samples=0)
    for k in range(8):
        mi.render(scene, integrator=it, spp=1, seed=k)
    M, usable = np.array(it.state.past.kept.M), np.array(it.state.past.usable)
    new = (M[usable] <= 1).mean()
    print(f"{100 * new:.2f} % of the pixels know nothing")
    assert new < 0.01


@pytest.mark.slow
def test_biased_combination_is_darker():
    scene = many_lights()
    biased, unbiased = (last_frames(scene, integrator(combination=c), 8) for c in ("biased", "unbiased"))
    assert np.isfinite(biased).all()
    assert 0.5 * unbiased.mean() < biased.mean() < unbiased.mean()


@pytest.mark.parametrize("move, kept", [(0.0, 0.85), (0.1, 0.5), (100.0, 0.0)])
def test_history_follows_the_camera(move, kept):
    """`kept` of the pixels at least know all frames, those at edges aside."""
    scene, it = diffuse_scene(32), integrator(spatial_samples=0)
    params = mi.traverse(scene)
    for k in range(8):
        origin = [move * k, 3, 4]
        params["sensor.to_world"] = mi.Transform4f(
            mi.ScalarTransform4f().look_at(origin, [move * k, 0.3, 0], [0, 1, 0])
        )
        params.update()
        mi.render(scene, integrator=it, spp=1, seed=k)
    M, usable = np.array(it.state.past.kept.M), np.array(it.state.past.usable)
    found = (M[usable] >= 7).mean() if usable.any() else 0
    assert kept <= found <= (1 if kept else 0)


def test_point_is_found_where_the_camera_saw_it():
    """The matrix of the camera before leads a surface to its own pixel, shifted and cropped films included."""
    module = importlib.import_module("mi_neural.integrators.restir_past")
    sensor = mi.load_dict({
        "type": "perspective", "fov": 40, "principal_point_offset_x": 0.2, "near_clip": 0.3,
        "to_world": mi.ScalarTransform4f().look_at([1, 2, 3], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 40, "height": 30, "crop_offset_x": 5, "crop_width": 20},
    })  # fmt: skip
    (to_film, eye), pinhole = module.camera_of(sensor)
    assert pinhole
    pos = mi.Point2f([0.1, 0.5, 0.9], [0.7, 0.2, 0.4])
    ray, _ = sensor.sample_ray(0, 0.5, pos, mi.Point2f(0.5))
    film = to_film @ mi.Vector3f(ray(mi.Float(1, 5, 30)) - eye)
    np.testing.assert_allclose(np.array([film.x / film.z, film.y / film.z]), np.array(pos), atol=1e-4)
    assert (np.array(film.z) > 0).all()
    assert not module.camera_of(mi.load_dict({"type": "orthographic"}))[1]


def film_of_another_kind() -> dict:
    return {"type": "hdrfilm", "width": 12, "height": 8, "pixel_format": "rgba", "sample_border": True,
            "rfilter": {"type": "gaussian"}}  # fmt: skip


@pytest.mark.slow
def test_filters_borders_and_alpha_are_those_of_path():
    scene = many_lights()
    look_at = mi.ScalarTransform4f().look_at([0, 3, 5], [0, 0.5, 0], [0, 1, 0])
    sensor = mi.load_dict({"type": "perspective", "fov": 60, "to_world": look_at, "film": film_of_another_kind()})
    it, plain, ours, other = integrator(), mi.load_dict({"type": "path", "max_depth": 2}), [], []
    for k in range(24):
        it.reset()
        ours.append(np.array(mi.render(scene, sensor=sensor, integrator=it, spp=2, seed=k)))
        other.append(np.array(mi.render(scene, sensor=sensor, integrator=plain, spp=32, seed=100 + k)))
    ours, other = np.stack(ours), np.stack(other)
    assert ours.shape == (24, 8, 12, 4)
    assert_same_mean(ours[..., :3], other[..., :3], "gaussian", blocks=2, relative=1e-5)
    np.testing.assert_allclose(ours[..., 3].mean(), other[..., 3].mean(), atol=0.02)


def test_cameras_whose_motion_is_not_known_render_too():
    sensor = mi.load_dict({"type": "orthographic", "film": film_of_another_kind(),
                           "to_world": mi.ScalarTransform4f().look_at([0, 3, 5], [0, 0.5, 0], [0, 1, 0]).scale(3)})
    it = integrator()
    image = np.array(mi.render(many_lights(), sensor=sensor, integrator=it, spp=3))
    assert np.isfinite(image).all() and image[..., :3].max() > 0
    assert np.array(it.state.past.kept.M).max() > 2


def test_samples_of_one_call_are_frames():
    scene, it = diffuse_scene(8), integrator()
    four = np.array(mi.render(scene, integrator=it, spp=4, seed=3))
    assert it.state.frame == 4
    it.reset()
    each = [np.array(mi.render(scene, integrator=it, spp=1, seed=3)) for _ in range(4)]
    assert it.state.frame == 4
    np.testing.assert_allclose(four, np.mean(each, axis=0), rtol=1e-4, atol=1e-5)


def test_reset_forgets():
    scene, it = diffuse_scene(8), integrator()
    first, second = (np.array(mi.render(scene, integrator=it, spp=1)) for _ in range(2))
    assert not np.allclose(first, second)
    it.reset()
    np.testing.assert_allclose(np.array(mi.render(scene, integrator=it, spp=1)), first, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_another_scene_starts_anew():
    it = integrator()
    for k in range(2):
        mi.render(diffuse_scene(8), integrator=it, spp=1, seed=k)
        assert it.state.frame == 1
    scene = many_lights(8)
    image = mi.render(scene, integrator=it, spp=1, seed=3)
    np.testing.assert_allclose(np.array(image), np.array(mi.render(scene, integrator=integrator(), spp=1, seed=3)),
                               rtol=1e-4, atol=1e-5)  # fmt: skip


def test_frames_are_recorded_once():
    """But for the first three, and after a reset too."""
    scene, it = diffuse_scene(8), integrator()
    for k in range(9):
        if k == 6:
            it.state.reset()
        mi.render(scene, integrator=it, spp=1, seed=k)
    (frame,) = it.state.frames.values()
    assert frame.n_recordings <= 3


@pytest.mark.parametrize("flag", [dr.JitFlag.SymbolicCalls, dr.JitFlag.SymbolicLoops], ids=lambda flag: flag.name)
def test_frames_that_cannot_be_recorded_are_rendered_as_they_are(flag):
    """A user who looks for a fault switches symbolic calls or loops off."""
    scene = diffuse_scene(8)
    recorded = np.array(mi.render(scene, integrator=integrator(), spp=2, seed=3))
    with dr.scoped_set_flag(flag, False):
        plain = np.array(mi.render(scene, integrator=integrator(), spp=2, seed=3))
    np.testing.assert_allclose(plain, recorded, rtol=1e-3, atol=1e-5)


def test_function_of_the_users_own_that_is_frozen_says_why_not():
    scene, it = diffuse_scene(8), integrator()
    frame = dr.freeze(lambda scene, it, seed: mi.render(scene, integrator=it, spp=1, seed=seed))
    with pytest.raises(Exception) as e:
        frame(scene, it, mi.UInt32(0))
    cause = e.value
    while cause.__cause__ is not None:
        cause = cause.__cause__
    assert "restir_di: inside a function frozen by dr.freeze" in str(cause) and "plain_path" in str(cause)
    assert np.isfinite(np.array(mi.render(scene, integrator=it, spp=1))).all()  # nothing is broken by it


@pytest.mark.parametrize("keys", [{"combination": "biased"}, {"light_sampler": NVC}], ids=["light", "nvc"])
def test_lights_that_are_off_give_black(keys):
    scene, it = many_lights(8, black=True), integrator(**keys)
    for k in range(3):
        assert (np.array(mi.render(scene, integrator=it, spp=1, seed=k)) == 0).all()
    kept = it.state.past.kept
    dr.eval(kept)
    assert all(np.isfinite(np.array(v)).all() for v in (kept.w_sum, kept.W, kept.M, kept.target))


@pytest.mark.slow
def test_bright_and_dim_lights_stay_finite():
    scene = diffuse_scene(8)
    params = mi.traverse(scene)
    for k, radiance in enumerate([1e-12, 1e12, 1e-6, 1e6]):
        params[f"lamp{k}.emitter.radiance.value"] = mi.Color3f(radiance)
    params.update()
    it = integrator()
    for k in range(4):
        assert np.isfinite(np.array(mi.render(scene, integrator=it, spp=1, seed=k))).all()


def test_table_of_a_single_light_is_made_at_first_and_after_an_edit(monkeypatch):
    """Made for each frame it took three quarters of the time of a small image. Twice, as the first evaluates values."""
    module, made = importlib.import_module("mi_neural.integrators.restir_di"), []
    monkeypatch.setattr(module, "LightTable", lambda scene, make=module.LightTable: made.append(1) or make(scene))
    scene, restir = test_scene(lights("area"), 4), integrator()
    before = np.array(restir.render(scene, spp=8)).mean()
    assert 1 <= len(made) <= 2
    made.clear()
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("radiance.value"))
    params[key] = 3 * params[key]
    params.update()
    restir.reset()
    after = np.array(restir.render(scene, spp=8)).mean()
    assert 1 <= len(made) <= 2 and after == pytest.approx(3 * before, rel=1e-4)


@pytest.mark.parametrize("key, value, says", [
    ("initial_candidates", 0, "initial_candidates is 0; it must be at least 1"),
    ("history", -1.0, "history is -1.0; give 0"),
    ("spatial_samples", -1, "spatial_samples is -1; give 0"),
    ("spatial_radius", 0.0, "spatial_radius is 0.0; give -1"),
    ("normal_threshold", 1.5, "normal_threshold is 1.5; it is a cosine"),
    ("depth_threshold", 0.0, "depth_threshold is 0.0; it must be greater than 0"),
    ("combination", "fair", "combination is 'fair'; give one of: unbiased, biased"),
    ("candidates", "all", "candidates is 'all'; give one of: light, nvc"),
    ("nvc_where", "here", "nvc_where is 'here'; give one of: everywhere, disoccluded"),
    ("max_depth", 1, "max_depth is 1; it renders direct light: give 2"),
])  # fmt: skip
def test_bad_keys_are_refused(key, value, says):
    with pytest.raises(Exception, match=f"restir_di: {says}"):
        integrator(**{key: value})


@pytest.mark.parametrize("depth", [-1, 2, 64])
def test_integrator_of_a_scene_made_for_path_is_replaced_by_its_name(depth, capfd):
    """Public scenes set `max_depth`. What another one than 2 leaves out is said."""
    text = (f'<integrator version="3.0.0" type="restir_di"><integer name="max_depth" value="{depth}"/>'
            '<integer name="rr_depth" value="8"/></integrator>')  # fmt: skip
    assert mi.load_string(text).max_depth == 2
    said = f"restir_di renders light reflected once (max_depth 2, not {depth})"
    assert (said in "".join(capfd.readouterr())) == (depth != 2)


def test_light_sampler_that_would_not_be_asked_is_refused():
    with pytest.raises(Exception, match="set candidates to 'nvc' or leave the light_sampler out"):
        integrator(candidates="light", light_sampler=NVC)


def test_it_cannot_be_nested():
    with pytest.raises(RuntimeError, match="whole frames"):
        integrator().sample(None, None, None)
