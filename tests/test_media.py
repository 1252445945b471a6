"""`plain_path` in participating media: the image of Mitsuba's `volpath`, or of `volpathmis` where colours differ.

What is refused there, and what a scene without media does not pay.
"""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW, sweep
from expectation import assert_same_mean, renders
from media_scenes import ball, clouds, cube, everywhere, fog, lamp, rgb, room, smoke

from mi_neural.emitters.common import LightSampler
from mi_neural.estimators.mis import mis_weight
from mi_neural.lights.sampling import Choice
from mi_neural.render import path as paths
from mi_neural.render import vertex

GLASS = {"type": "dielectric", "int_ior": 1.5}
#: Half of the light passes.
HALF_OPEN = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
#: Largest side of what the room's camera sees; extinctions are in its inverse.
SIZE = 3.0

#: (scene, the integrator that shows the right image).
SCENES = {
    "homogeneous": (lambda: room(box=cube(fog(2.0, 0.8, g=0.5))), "volpath"),
    "heterogeneous": (lambda: room(box=cube(smoke())), "volpath"),
    "beside each other": (lambda: room(a=cube(smoke()), b=ball(fog(3.0), radius=0.3, at=(0.9, -0.5, 0.2))),
                          "volpath"),
    "boundary of index 1": (lambda: room(box=cube(fog(), {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0})),
                            "volpath"),
    "in glass": (lambda: room(ball=ball(fog(2.0, 0.9), GLASS), sky={"type": "constant", "radiance": 0.3}), "volpath"),
    "in rough glass": (lambda: room(ball=ball(fog(2.0, 0.9), {"type": "roughdielectric", "alpha": 0.3})), "volpath"),
    "colours": (lambda: room(box=cube(fog((0.5, 2.0, 4.0), (0.9, 0.6, 0.8)))), "volpathmis"),
    "coloured smoke": (lambda: room(box=cube(smoke(albedo=(0.9, 0.6, 0.3)))), "volpath"),
    "camera inside": (lambda: everywhere(fog(0.4, 0.8)), "volpath"),
    "camera in colours": (lambda: everywhere(fog((0.1, 0.3, 0.6), 0.8, g=0.3)), "volpathmis"),
    "nested": (lambda: everywhere(fog(0.3), inner=ball(fog(3.0, 0.9), exterior={"type": "ref", "id": "air"})),
               "volpath"),
    "instances": (lambda: clouds(fog(3.0, 0.9)), "volpath"),
    "albedo 1": (lambda: room(box=cube(fog(3.0, 1.0))), "volpath"),
    "albedo 0": (lambda: room(box=cube(fog(2.0, 0.0))), "volpath"),
    "thin": (lambda: room(box=cube(fog(1e-4 / SIZE, 0.8))), "volpath"),
    "thick": (lambda: room(box=cube(fog(1e4 / SIZE, 0.8))), "volpath"),
    "half open shell": (lambda: room(box=cube(fog(2.0), HALF_OPEN)), "volpath"),
    "things in it": (lambda: everywhere(fog(0.4), block={"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3)},
                                        lamp=lamp((0, 0.5, 0), rgb(2.0, 3.0, 1.0), 0.1)), "volpath"),
    "sky": (lambda: room(box=cube(fog(2.0, 0.8, g=-0.3)), sky={"type": "constant", "radiance": rgb(0.2, 0.3, 0.5)},
                         sun={"type": "directional", "direction": [0.3, -1, -0.4], "irradiance": rgb(2.0, 1.5, 1.0)}),
            "volpath"),
    "points": (lambda: room(box=cube(fog(2.0)), a={"type": "point", "position": [0.8, 0.8, 0.5], "intensity": 0.4},
                            b={"type": "spot", "intensity": 3.0, "cutoff_angle": 30,
                               "to_world": mi.ScalarTransform4f().look_at([-1, 0.5, 0], [0, 0, 0], [0, 1, 0])}),
               "volpath"),
}  # fmt: skip
SAMPLERS = {
    "uniform": {"type": "uniform_lights"}, "power": {"type": "power_lights"}, "tree": {"type": "tree_lights"},
    "nvc": {"type": "nvc_lights", "train_frames": 8, "train_samples": 256},
    "clusters": {"type": "nvc_lights", "train_frames": 8, "train_samples": 256, "outputs": 2},
    "cells": {"type": "nvc_lights", "train_frames": 2, "train_samples": 256, "environment_cells": 4},
    "unlearned": {"type": "nvc_lights", "visibility": False},
}  # fmt: skip
CHOSEN = [("homogeneous", "uniform"), ("homogeneous", "power"), ("camera inside", "uniform"), ("camera inside", "nvc"),
          ("colours", "nvc"), ("things in it", "clusters"), ("sky", "cells"), ("heterogeneous", "nvc"),
          ("instances", "nvc"), ("half open shell", "nvc"),
          ("half open shell", "power"), ("points", "unlearned"), ("things in it", "tree"), ("points", "tree"),
          ("sky", "tree"), ("half open shell", "tree")]  # fmt: skip
VARIANTS = ("llvm_ad_mono", "llvm_ad_spectral")
IN_VARIANTS = [("colours", "nvc"), ("coloured smoke", None), ("camera in colours", "uniform")]
LIMITS = [{"max_depth": 1}, {"max_depth": 2}, {"max_depth": 3, "rr_depth": 1}, {"max_depth": -1, "rr_depth": 2},
          {"max_depth": 4, "hide_emitters": True}]  # fmt: skip
#: Of the default run: media, boundaries and ways of choosing lights of each kind.
DEFAULT = [("homogeneous", None), ("homogeneous", "power"), ("heterogeneous", "nvc"), ("colours", None),
           ("camera inside", "uniform"), ("nested", None), ("instances", None), ("half open shell", "tree"),
           ("sky", "cells")]  # fmt: skip
#: Comparisons of this file with a reference; together they fail by chance one choice of seeds in ten thousand.
N_TESTS = len(SCENES) + len(CHOSEN) + len(VARIANTS) * len(IN_VARIANTS) + len(LIMITS) + 8
DEPTH = {"max_depth": 8}


def compare(name: str, scene, reference: str, keys: dict, spp: int = 256, known=None, **depth) -> np.ndarray:
    """With images of the `reference`, or with those `known`, which are returned."""
    depth = depth or DEPTH
    if known is None:
        known = renders(scene, {"type": reference, **depth}, 16, spp, first_seed=500)
    ours = renders(scene, {"type": "plain_path", **depth, **keys}, 16, spp)
    assert_same_mean(ours, known, name, blocks=2, relative=1e-4, tests=N_TESTS)
    return known


@pytest.fixture(scope="module")
def seen():
    """Scenes and their references of the tests so far, by name."""
    return {}


# One scene after another, each by all samplers: its reference is rendered once
@pytest.mark.parametrize("name, sampler", sweep(
    [(name, sampler) for name in SCENES for sampler in (None, *(s for n, s in CHOSEN if n == name))], DEFAULT
))  # fmt: skip
def test_image_is_that_of_volpath(seen, name, sampler):
    make, reference = SCENES[name]
    if name not in seen:
        seen.clear()
        seen[name] = make(), None
    scene, known = seen[name]
    keys = {"light_sampler": SAMPLERS[sampler]} if sampler else {}
    seen[name] = scene, compare(f"{name}, {sampler}", scene, reference, keys, known=known)


@pytest.mark.parametrize("variant, name, sampler", sweep(
    [(variant, *case) for variant in VARIANTS for case in IN_VARIANTS],
    [("llvm_ad_mono", "coloured smoke", None), ("llvm_ad_spectral", "colours", "nvc")],
))  # fmt: skip
def test_image_in_mono_and_spectral_variants(variant, name, sampler):
    mi.set_variant(variant)
    make, reference = SCENES[name]
    keys = {"light_sampler": SAMPLERS[sampler]} if sampler else {}
    compare(f"{variant}, {name}, {sampler}", make(), reference, keys)


@pytest.fixture(scope="module")
def both_shells():
    """Fog in a shell of nothing on the left, in one of a mask on the right: in blocks of the image of their own."""
    return room(
        box=cube(fog(1.5, 0.9), size=0.4, at=(-0.45, 0, 0)), shell=cube(fog(1.5, 0.9), HALF_OPEN, 0.4, (0.45, 0, 0)),
        seen=lamp((0, 0.2, -0.8), rgb(1.0, 2.0, 3.0), 0.2), sky={"type": "constant", "radiance": 0.2})  # fmt: skip


@pytest.mark.parametrize("limits", sweep(LIMITS, (LIMITS[4],)))
def test_depths_roulette_and_hidden_emitters_are_those_of_volpath(both_shells, limits):
    compare(str(limits), both_shells, "volpath", {}, **limits)


@pytest.mark.parametrize("hide", [False, True])
def test_coverage_is_that_of_volpath(hide):
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    scene = room({"film": film}, back=ball(fog(3.0), at=(0.6, 0.2, 0)), box=cube(fog(2.0), HALF_OPEN, 0.3))
    keys = {"max_depth": 4, "hide_emitters": hide}

    def alpha(kind, first):
        images = renders(scene, {"type": kind, **keys}, 16, 64, first, channels=slice(3, 4))
        return np.repeat(images, 3, axis=-1)

    assert_same_mean(alpha("plain_path", 0), alpha("volpath", 500), "alpha", blocks=2, relative=1e-4, tests=N_TESTS)


@pytest.mark.parametrize("wrapper", [{"type": "moment"}, pytest.param({"type": "aov", "aovs": "d:depth"}, marks=SLOW)])
def test_wrappers_know_the_medium_of_the_camera(wrapper):
    make, reference = SCENES["camera inside"]
    scene = make()
    known = renders(scene, {"type": reference, **DEPTH}, 16, 64, first_seed=500)
    ours = renders(scene, {**wrapper, "inner": {"type": "plain_path", **DEPTH}}, 16, 64)
    assert_same_mean(ours, known, wrapper["type"], blocks=2, relative=1e-4, tests=N_TESTS)


def test_lamps_outside_of_fog_are_visible_from_within():
    """Boundaries of media are no walls to what `nvc_lights` learns."""
    scene = room(box=cube(fog(0.5)))
    integrator = mi.load_dict({"type": "plain_path", "light_sampler": {"type": "nvc_lights"}})
    mi.render(scene, integrator=integrator, spp=1)
    visible = [float(v[0]) for v in integrator.light_sampler.cache.field.query(mi.Point3f(-0.2, 0.1, 0.1))]
    print(visible)
    assert max(visible) > 0.8


# ---------------------------------------------------------------- changes from frame to frame

CHANGES = {
    "density": ("box.interior_medium.sigma_t.volume.data", lambda v: type(v)(0.3 * v.array, shape=v.shape)),
    "scale": ("box.interior_medium.scale", lambda v: 4 * v),
    "phase function": ("box.interior_medium.phase_function.g", lambda v: -0.8),
    "size of the boundary": ("box.vertex_positions", lambda v: 0.4 * v),
}


@pytest.mark.parametrize("name", sweep(CHANGES, ("density",)))
def test_image_follows_what_changes_in_a_medium(name):
    key, change = CHANGES[name]
    medium = smoke() if name == "density" else fog(2.0, 0.8, g=0.8)
    scene, integrator = room(box=cube(medium)), mi.load_dict({"type": "plain_path", **DEPTH})
    before = renders(scene, integrator, 2, 64)
    params = mi.traverse(scene)
    key = key if key in params else "box.interior_medium.sigma_t.data"
    params[key] = change(params[key])
    params.update()
    known = renders(scene, {"type": "volpath", **DEPTH}, 16, 256, first_seed=500)
    ours = renders(scene, integrator, 16, 256)
    assert_same_mean(ours, known, name, blocks=2, relative=1e-4, tests=N_TESTS)
    assert abs(before.mean() - known.mean()) > 0.01 * known.mean(), "the change is none"


def test_medium_that_moves_is_recorded_once():
    scene, integrator = room(box=cube(smoke())), mi.load_dict({"type": "plain_path", **DEPTH})
    params = mi.traverse(scene)
    start, recorded = mi.Float(params["box.vertex_positions"]), []
    for k in range(6):
        params["box.vertex_positions"] = start + 0.02 * k
        params.update()
        mi.render(scene, integrator=integrator, spp=1, seed=k)
        recorded.append([f.n_recordings for f in integrator.film_state.passes.recorded.values()])
    assert recorded[2] == recorded[-1] and max(recorded[-1]) <= 3


def test_camera_that_walks_into_the_medium():
    scene, integrator = everywhere(fog(0.4, 0.8)), mi.load_dict({"type": "plain_path", **DEPTH})
    place = mi.ScalarTransform4f().look_at([0, 0, 9], [0, -0.2, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    outside = mi.load_dict({"type": "perspective", "fov": 20, "to_world": place, "film": film})

    volpath, known = {"type": "volpath", **DEPTH}, {}
    for name, sensor in (("outside", outside), ("inside", scene.sensors()[0]), ("outside again", outside)):
        if sensor not in known:
            known[sensor] = renders(scene, volpath, 16, 64, 500, sensor)
        ours = renders(scene, integrator, 16, 64, 0, sensor)
        assert_same_mean(ours, known[sensor], name, blocks=1, relative=1e-4, tests=N_TESTS)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize("name", ["nirc_two_level", "nvc_direct", "restir_di"])
@pytest.mark.parametrize("where", ["in the scene", "around the camera", "around a camera of its own"])
def test_integrators_without_media_name_the_one_that_renders_them(name, where):
    scene, sensor = everywhere(fog()) if where == "around the camera" else room(box=cube(fog())), 0
    if where == "around a camera of its own":
        scene, sensor = room(), mi.load_dict({"type": "perspective", "medium": fog()})
    with pytest.raises(ValueError, match=name + r': .*participating medium.*use <integrator type="plain_path"/>') as e:
        mi.load_dict({"type": name}).render(scene, sensor, spp=1)
    assert "\n" not in str(e.value)
    assert all(kind in str(e.value) for kind in ('"neural_path"', '"nrc"', '"nirc"', '"volpath"'))


def test_medium_of_an_instance_is_refused_by_integrators_without_media():
    with pytest.raises(ValueError, match=r'instance borders a participating medium.*use <integrator type="plain_path"'):
        mi.load_dict({"type": "nirc_two_level"}).render(clouds(fog()), spp=1)


def gradient(scene, key: str, how: str) -> None:
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "plain_path", **DEPTH})
    dr.enable_grad(params[key])
    params.update()
    if how == "in place":
        integrator.render(scene, spp=1)
        return
    image = mi.render(scene, params, integrator=integrator, spp=1)
    dr.backward(dr.mean(image, axis=None)) if how == "backward" else dr.forward(params[key])


@pytest.mark.parametrize("how", ["backward", "forward", "in place"])
@pytest.mark.parametrize("key", ["floor.bsdf.reflectance.value", "box.interior_medium.albedo.value.value"])
def test_gradients_are_refused_and_prbvolpath_is_named(key, how):
    with pytest.raises(RuntimeError, match=r"plain_path: there are no gradients.*participating media.*'prbvolpath'"):
        gradient(room(box=cube(fog())), key, how)


def test_image_without_gradients_outside_of_mi_render():
    scene, integrator = room(box=cube(fog())), mi.load_dict({"type": "plain_path", **DEPTH})
    images = [np.array([image(k) for k in range(4)], np.float64) for image in (
        lambda k: integrator.render(scene, seed=k, spp=64),
        lambda k: mi.render(scene, integrator=integrator, seed=k, spp=64))]  # fmt: skip
    np.testing.assert_allclose(images[0].mean(), images[1].mean(), rtol=0.03)


def test_phase_function_of_microflakes_is_refused():
    flakes = {"type": "sggx", "S": {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 6), np.float32))}}
    scene, integrator = room(box=cube(fog() | {"phase": flakes})), mi.load_dict({"type": "plain_path"})
    for _ in range(2):  # the second time, too
        with pytest.raises(ValueError, match=r"plain_path: .*microflakes.*volpath"):
            integrator.render(scene, spp=1)


def test_media_are_rendered_after_ctrl_c_while_lights_were_learned(monkeypatch):
    scene, keys = room(box=cube(fog())), {"type": "plain_path", "light_sampler": {"type": "uniform_lights"}}
    known = np.array(mi.load_dict(keys).render(scene, spp=4))
    integrator = mi.load_dict(keys)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(type(integrator.light_sampler), "train", interrupted)
        integrator.render(scene, spp=4)
    np.testing.assert_allclose(np.array(integrator.render(scene, spp=4)), known, rtol=1e-4, atol=1e-5)


def test_neural_depth_is_refused():
    keys = {"type": "plain_path", "neural_depth": 0, "light_sampler": SAMPLERS["nvc"]}
    with pytest.raises(ValueError, match="neural_depth works in scenes without participating media"):
        mi.load_dict(keys).render(room(box=cube(fog())), spp=1)


class FirstOfTwo:
    """A choice of lights as one would write it for surfaces."""

    DRJIT_STRUCT = {"table": object}  # noqa: RUF012

    def __init__(self, table):
        self.table = table

    def choose(self, si, n, transmits, u, sampler, hit, active):
        index = dr.select(u < 0.7, mi.UInt32(0), 1)
        return Choice(index, dr.rcp(self.pmf(si, n, transmits, index, active)),
                      *(self.pmf(si, n, transmits, i, active) for i in (index, hit)))  # fmt: skip

    def pmf(self, si, n, transmits, index, active):
        return dr.select(index == 0, mi.Float(0.7), 0.3)


class FirstOfTwoInMedia(FirstOfTwo):
    def choose(self, si, n, transmits, u, sampler, hit, active, around=None):
        return super().choose(si, n, transmits, u, sampler, hit, active)

    def pmf(self, si, n, transmits, index, active, around=None):
        return super().pmf(si, n, transmits, index, active)


def own_sampler(kind):
    class Own(LightSampler):
        def make(self, scene, table):
            return kind(table)

    mi.register_emitter("own_lights", lambda props: Own(props))
    return {"type": "plain_path", **DEPTH, "light_sampler": {"type": "own_lights"}}


@pytest.mark.parametrize("kind", [FirstOfTwo, FirstOfTwoInMedia])
def test_light_sampler_of_ones_own_on_surfaces(kind):
    known = renders(room(), {"type": "path", **DEPTH}, 16, 64, first_seed=500)
    ours = renders(room(), own_sampler(kind), 16, 64)
    assert_same_mean(ours, known, kind.__name__, blocks=2, relative=1e-4, tests=N_TESTS)


def test_light_sampler_of_ones_own_in_media():
    scene = room(box=cube(fog(2.0)))
    with pytest.raises(ValueError, match=r"FirstOfTwo\.choose has no argument 'around'.*add around=None"):
        mi.load_dict(own_sampler(FirstOfTwo)).render(scene, spp=1)
    known = renders(scene, {"type": "volpath", **DEPTH}, 16, 64, first_seed=500)
    ours = renders(scene, own_sampler(FirstOfTwoInMedia), 16, 64)
    assert_same_mean(ours, known, "own", blocks=2, relative=1e-4, tests=N_TESTS)


# ---------------------------------------------------------------- scenes without media


def direct_light_of_surfaces(scene, lights, path, bsdf, found, numbers, sampler, alone=None):
    """`paths.direct_light` as it is where there are surfaces alone."""
    si, active, delta = path.si, path.active, found.delta
    ref = vertex.reference_point(si.p, si.n)
    ds_hit, emits = mi.DirectionSample3f(scene, found.si, ref), found.followed
    if lights is not None:
        hit, emits = lights.table.index_of(scene, found.si, found.followed)
    smooth = active & vertex.has_smooth(bsdf)
    if lights is None:
        ds, light = scene.sample_emitter_direction(si, numbers.point, True, smooth)
        pdf_light, sampled = ds.pdf, smooth & (ds.pdf > 0)
    else:
        n, transmits = vertex.receiver(si, bsdf)
        choice = lights.choose(si, n, transmits, numbers.light, sampler, hit, active)
        sampler = choice.advanced(sampler)
        ds, light, pdf = lights.table.sample(scene, si, choice.index, numbers.point, smooth & (choice.weight > 0))
        light *= choice.weight
        pdf_light, sampled = choice.pmf * pdf, smooth & (pdf > 0)
    f, pdf_bsdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), sampled)
    if lights is not None:
        sampled &= dr.max(f * light) > 0
        sampled &= ~scene.ray_test(si.spawn_ray_to(ds.p), sampled)
    in_full = mi.Bool(ds.delta)
    if alone is not None:
        in_full |= alone(pdf_bsdf)
    w_light = dr.select(in_full, 1, mis_weight(pdf_light, pdf_bsdf))
    L_nee = vertex.finite(f * light * w_light, sampled)
    if lights is None:
        pdf_hit = scene.pdf_emitter_direction(ref, ds_hit, emits & ~delta)
    else:
        pdf_hit = choice.pmf_hit * lights.table.pdf(scene, si, hit, found.si, ds_hit, emits & ~delta)
    w_bsdf = dr.select(delta, 1, mis_weight(found.bs.pdf, pdf_hit))
    Le = dr.select(emits, found.si.emitter(scene, emits).eval(found.si, emits) * w_bsdf, 0)
    return L_nee, Le, sampler


def kernels(scene, keys: dict) -> set[str]:
    """The code of all kernels of two images, but for their names and how their arguments happen to be aligned."""
    integrator, codes = mi.load_dict(keys), set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for k in range(2):
            dr.eval(mi.render(scene, integrator=integrator, spp=1, seed=k))
            dr.sync_thread()
        for kernel in dr.kernel_history():
            if kernel["type"] == dr.KernelType.JIT:
                codes.add(re.sub(r"drjit_[0-9a-f]{32}|align \d+", "", kernel["ir"].getvalue()))
    return codes


@pytest.mark.parametrize("sampler", ["none", "power", "nvc", pytest.param("nrc", marks=SLOW), "neural_path", "nirc"])
def test_scene_without_media_compiles_to_kernels_of_surfaces_alone(sampler, monkeypatch):
    scene, keys = room(), {"type": "plain_path", **DEPTH}
    if sampler in ("nrc", "neural_path", "nirc"):
        keys = {"type": sampler, "train_frames": 2, "train_samples": 256, **NETWORK, **DEPTH}
    elif sampler != "none":
        keys["light_sampler"] = SAMPLERS[sampler]
    kernels(scene, keys)  # its first recording has the scene's own parts evaluated
    now = kernels(scene, keys)
    with monkeypatch.context() as patch:
        patch.setattr(paths, "direct_light", direct_light_of_surfaces)
        alone = kernels(scene, keys)
    print(f"{sampler}: {len(now)} kernels, {sum(map(len, now))} bytes")
    assert now == alone and len(now) > 1
    assert len(kernels(room(box=cube(fog())), keys) & now) < len(now), "those of media are others"
