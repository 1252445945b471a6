"""What users do with ``path``, with each integrator of this package: sensors, wrappers, coverage, loops, threads.

Mitsuba's `path` is the reference. Comparisons of means allow for four standard errors and, where a cache ends paths,
for 8 % of bias: a false alarm in about 10,000 choices of seed.
"""

import contextlib
import gc
import io
import itertools
import math
import re
import resource
import threading

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW, sweep

from mi_neural.render.film import Area, put_in_reach

T = mi.ScalarTransform4f
SMALL = {"train_frames": 32, "train_samples": 512, **NETWORK}
INTEGRATORS = {
    "plain_path": {"type": "plain_path"},
    "nirc": {"type": "nirc", **SMALL},
    "nrc": {"type": "nrc", **SMALL},
    "neural_path": {"type": "neural_path", **SMALL},
    "nirc_two_level": {"type": "nirc_two_level", **SMALL},
}
UNBIASED = ("plain_path", "nirc_two_level")
CACHED = tuple(n for n in INTEGRATORS if n != "plain_path")
ALL = pytest.mark.parametrize("name", INTEGRATORS)
#: For tests of what all integrators inherit: one without a cache and one with.
TWO = pytest.mark.parametrize("name", sweep(INTEGRATORS, ("plain_path", "nrc")))


def grey(value):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def wall(at, axis=(0, 1, 0), angle=0.0, size=1.0, **keys):
    return {"type": "rectangle", "to_world": T().translate(list(at)).rotate(list(axis), angle).scale(size), **keys}


def film(width=12, height=12, **keys):
    return {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}, **keys}


def camera(origin=(0, 0, 3.2), target=(0, 0, 0), kind="perspective", **keys):
    keys = {"film": film(), **keys} | ({} if kind == "orthographic" else {"fov": 45})
    return {"type": kind, "to_world": T().look_at(list(origin), list(target), [0, 1, 0]), **keys}


def room(**changes):
    """An open box with a cube in it and a lamp under its ceiling; an entry that is None is left out."""
    parts = {
        "type": "scene", "sensor": camera(), "back": wall((0, 0, -1), bsdf=grey(0.6)),
        "floor": wall((0, -1, 0), (1, 0, 0), -90, bsdf=grey(0.6)),
        "ceiling": wall((0, 1, 0), (1, 0, 0), 90, bsdf=grey(0.6)),
        "left": wall((-1, 0, 0), (0, 1, 0), 90, bsdf=grey(0.6)),
        "right": wall((1, 0, 0), (0, 1, 0), -90, bsdf=grey(0.3)),
        "block": {"type": "cube", "to_world": T().translate([0.3, -0.7, 0.1]).scale(0.3), "bsdf": grey(0.6)},
        "lamp": wall((0, 0.98, 0), (1, 0, 0), 90, 0.3, bsdf=grey(0.0), emitter={"type": "area", "radiance": 5.0}),
        **changes,
    }  # fmt: skip
    return mi.load_dict({k: v for k, v in parts.items() if v is not None})


def images(scene, keys, sensor=0, spp=64, n=4, first=0):
    integrator = mi.load_dict(keys) if isinstance(keys, dict) else keys
    return np.array([
        np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=first + k)) for k in range(n)
    ], np.float64)  # fmt: skip


def agree(name, ours, path, channels=slice(0, 3)):
    """The mean of images by `name` against that of images by ``path``."""
    assert ours.shape == path.shape and np.isfinite(ours).all()
    a, b = (x[..., channels].mean(axis=(1, 2, 3)) for x in (ours, path))
    error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / len(a) ** 0.5
    allowed = max(4 * error, (0.005 if name in UNBIASED else 0.08) * abs(b.mean()), 1e-6)
    print(f"{name}: {a.mean():.5f}, path {b.mean():.5f}, allowed {allowed:.5f}")
    assert abs(a.mean() - b.mean()) <= allowed


# ---------------------------------------------------------------- sensors


@TWO
def test_sensor_that_is_not_in_the_scene(name):
    scene, integrator = room(sensor=None), mi.load_dict(INTEGRATORS[name])
    for x in (-1.0, 1.0):
        view = mi.load_dict(camera((x, 0.2, 3.0)))
        agree(name, images(scene, integrator, view), images(scene, {"type": "path"}, view, first=100))


@pytest.mark.parametrize("kind, keys", [("thinlens", {"aperture_radius": 0.05, "focus_distance": 3.0}),
                                        ("orthographic", {})])  # fmt: skip
@pytest.mark.parametrize("name", ["plain_path", "nrc"])
def test_sensors_that_cannot_be_recorded_render_from_recorded_functions(name, kind, keys):
    scene, integrator = room(sensor=camera(kind=kind, **keys)), mi.load_dict(INTEGRATORS[name])
    agree(name, images(scene, integrator), images(scene, {"type": "path"}, first=100))
    recorded = [f.n_recordings for f in integrator.film_state.passes.recorded.values()]
    images(scene, integrator, first=50)
    assert [f.n_recordings for f in integrator.film_state.passes.recorded.values()] == recorded and max(recorded) <= 3


@pytest.mark.parametrize("name", ["plain_path", "nirc"])
def test_irradiance_meter(name):
    def meter(x, count):  # equal sensors would be merged into one by Mitsuba 3.9.1
        sensor = {"type": "irradiancemeter", "film": film(1, 1),
                  "sampler": {"type": "independent", "sample_count": count}}  # fmt: skip
        return wall((x, -0.99, 0.5), (1, 0, 0), -90, 0.1, bsdf=grey(0.0), sensor=sensor)

    scene = room(sensor=None, a=meter(-0.5, 4), b=meter(0.5, 5))
    if name != "plain_path":  # whose plan looks at two lamps
        second = wall((0.5, 0.9, 0), (1, 0, 0), 90, 0.1, emitter={"type": "area"})
        made = mi.load_dict(INTEGRATORS[name]).make_plan(room(sensor=None, a=meter(-0.5, 4), second=second))
        assert "chosen uniformly" in made.decisions["light_sampler"].because
    for k in range(2):
        agree(name, images(scene, INTEGRATORS[name], k, 4096), images(scene, {"type": "path"}, k, 4096, first=100))


@pytest.mark.parametrize("name", ["plain_path", pytest.param("nirc", marks=SLOW)])
def test_batch(name):
    view = {k: v for k, v in camera().items() if k != "film"}
    scene = room(sensor={"type": "batch", "a": view, "b": {**view, "fov": 20}, "film": film(24, 12)})
    agree(name, images(scene, INTEGRATORS[name]), images(scene, {"type": "path"}, first=100))


@pytest.mark.parametrize("keys", [{"type": "plain_path", "max_depth": 2}, {"type": "restir_di"}])
def test_batch_sensor_that_was_asked_for_rays_before(keys):
    """It keeps numbers of the last rays, and the process ended where a recording freed them."""
    view = {k: v for k, v in camera().items() if k != "film"}
    scene = room(sensor={"type": "batch", "a": view, "b": {**view, "fov": 20}, "film": film(16, 8)})
    places = mi.Point2f(np.float32([0.2, 0.7]), np.float32([0.3, 0.4]))
    dr.eval(scene.sensors()[0].sample_ray_differential(0.0, 0.5, places, mi.Point2f(0.5)))
    path = images(scene, {"type": "path", "max_depth": 2}, spp=256, n=1).mean()
    assert abs(images(scene, keys, spp=32, n=1).mean() / path - 1) < 0.1


def test_one_recording_serves_many_views():
    scene, integrator = room(sensor=None), mi.load_dict(INTEGRATORS["plain_path"])
    for k in range(6):
        view = mi.load_dict(camera((0.2 * k, 0, 3.0), fov=40 + k) if k % 2 else camera((0.2 * k, 0, 3.0)))
        path = images(scene, {"type": "path"}, view, 256, 1)
        assert abs(images(scene, integrator, view, 256, 1).mean() / path.mean() - 1) < 0.06
    passes = integrator.film_state.passes.recorded
    assert len(passes) == 1 and max(f.n_recordings for f in passes.values()) <= 3


def test_crop_window_that_moves_is_no_new_recording():
    scene, integrator = room(), mi.load_dict(INTEGRATORS["plain_path"])
    whole = images(scene, integrator, spp=256, n=1)[0]
    for x in (0, 4, 8):
        view = mi.load_dict(camera(film=film(crop_width=4, crop_height=12, crop_offset_x=x, crop_offset_y=0)))
        part = images(scene, integrator, view, 256, 1)[0]
        assert abs(part.mean() / whole[:, x : x + 4].mean() - 1) < 0.1
    assert len(integrator.film_state.passes.recorded) == 2


@pytest.mark.parametrize("keys", [{"type": "plain_path", "max_depth": 2}, {"type": "restir_di"}])
def test_samples_in_the_border_that_reach_no_pixel(keys):
    """Mitsuba wrote beside the image for them, and the process ended."""
    lanczos = {"rfilter": {"type": "lanczos"}, "sample_border": True}
    view = camera(film=film(8, 4, **lanczos))
    assert np.isfinite(images(room(sensor=view), keys, spp=16, n=4)).all()
    area = Area.of(mi.load_dict(view))
    places = mi.Point2f([-2.9, -2.4, 10.6, 4.0], [1.0, 1.0, 1.0, 6.6])
    assert (area.border, area.radius) == (3, 3.0) and list(area.reaches(places)) == [False, True, False, False]
    place, (one,) = put_in_reach(area, places, [mi.Float(1)])
    assert list(one) == [0, 1, 0, 0] and np.array(place)[:, 0].tolist() == [0.5, 0.5]


# ---------------------------------------------------------------- coverage and what is hidden


#: Side by side, each in a third of the picture: a mask in front of nothing, a boundary that is none, and glass.
THIRDS = {
    "mask": {"type": "rectangle", "to_world": T().translate([-2.65, 0, 0.9]).scale(0.6),
             "bsdf": {"type": "mask", "opacity": 0.4, "bsdf": grey(0.5)}},
    "null": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "null"}},
    "glass": {"type": "sphere", "center": [2.65, 0, 0], "radius": 0.5, "bsdf": {"type": "dielectric"}},
}  # fmt: skip
WIDE = {
    "back": None, "left": None, "right": None, "block": None,
    "floor": wall((1.3, -1, 0), (1, 0, 0), -90, 2.5, bsdf=grey(0.6)),
    "ceiling": wall((1.3, 1, 0), (1, 0, 0), 90, 2.5, bsdf=grey(0.6)),
    "lamp": wall((0, 0.98, 0), (1, 0, 0), 90, bsdf=grey(0.0), emitter={"type": "area", "radiance": 2.0}),
}  # fmt: skip
#: What is in the scene, and the parts of the picture that are looked at one by one.
COVERAGE = {
    "thirds": ({**WIDE, **THIRDS}, 3),
    "black sky": ({"sky": {"type": "constant", "radiance": 0.0}, "back": None}, 1),
    "sky": ({"sky": {"type": "constant", "radiance": 0.3}, "back": None}, 1),
}


@pytest.fixture(scope="module")
def of_path():
    """`of_path(what, scene, ...)`: images by ``path``, rendered once."""
    found = {}

    def rendered(what, scene, **keys):
        if what not in found:
            found[what] = images(scene, {"type": "path", **keys}, spp=64, first=100)
        return found[what]

    return rendered


@pytest.mark.parametrize("name, case, hide", sweep(
    itertools.product(INTEGRATORS, COVERAGE, (False, True)),
    [*itertools.product(["plain_path"], COVERAGE, (False, True)), ("nirc", "thirds", True), ("nrc", "thirds", True)],
))  # fmt: skip
def test_coverage_is_that_of_path(name, case, hide, of_path):
    parts, n = COVERAGE[case]
    scene = room(sensor=camera(film=film(12 * n, pixel_format="rgba"), fov_axis="y"), **parts)
    ours = images(scene, {**INTEGRATORS[name], "hide_emitters": hide}, spp=64)
    path = of_path((case, hide), scene, hide_emitters=hide)
    for a, b in zip(np.split(ours, n, axis=2), np.split(path, n, axis=2), strict=True):
        agree(name, a, b)
        a, b = a[..., 3].mean(axis=0), b[..., 3].mean(axis=0)
        # 256 samples of a share of at most 1/4 of variance each: 4.9 standard errors of the difference
        assert np.abs(a - b).max() < 0.22 and abs(a.mean() - b.mean()) < 0.02


@pytest.mark.parametrize("name", sweep(CACHED, ("nirc", "nrc")))
def test_mirror_behind_a_hidden_lamp(name):
    mirror = wall((0, 0, -0.95), size=0.6, bsdf={"type": "twosided", "bsdf": {"type": "conductor"}})
    ball = {"type": "sphere", "center": [0, 0, 0.4], "radius": 0.2, "emitter": {"type": "area", "radiance": 3.0}}
    scene = room(mirror=mirror, ball=ball)
    path, ours = (images(scene, {**keys, "hide_emitters": True}, spp=256, n=2)[:, 4:8, 4:8].mean() for keys in
                  ({"type": "path"}, INTEGRATORS[name]))  # fmt: skip
    print(f"behind the lamp {ours / path - 1:+.1%}")
    assert abs(ours / path - 1) < 0.1


@pytest.mark.parametrize("name", UNBIASED)
def test_roulette_begins_where_it_does_in_path(name):
    """With roulette from the first bounce on: the mean, and the spread between images, are those of ``path``."""
    scene = room()
    ours = images(scene, {**INTEGRATORS[name], "rr_depth": 1}, n=12, spp=16)
    path = images(scene, {"type": "path", "rr_depth": 1}, n=12, spp=16, first=100)
    agree(name, ours, path)


# ---------------------------------------------------------------- wrappers


@pytest.mark.parametrize("name", [pytest.param("nirc", marks=SLOW), "nrc"])
def test_wrappers_train_for_the_sensor_that_renders(name):
    """Two rooms, the first sensor in the other one: a cache trained there knows nothing of this one."""
    def rooms(x, tint, n):
        parts = {f"{k}{n}": wall((x + p[0], *p[1:]), a, d, bsdf=grey(0.6)) for k, p, a, d in (
            ("back", (0, 0, -1), (0, 1, 0), 0), ("front", (0, 0, 1), (0, 1, 0), 180),
            ("floor", (0, -1, 0), (1, 0, 0), -90), ("ceiling", (0, 1, 0), (1, 0, 0), 90),
            ("left", (-1, 0, 0), (0, 1, 0), 90), ("right", (1, 0, 0), (0, 1, 0), -90))}  # fmt: skip
        lamp = {"type": "area", "radiance": {"type": "rgb", "value": tint}}
        parts[f"lamp{n}"] = wall((x, 0.98, 0), (1, 0, 0), 90, 0.3, bsdf=grey(0.0), emitter=lamp)
        return parts | {f"view{n}": camera((x, 0, 0.9), (x, 0, -1), film=film())}

    scene = mi.load_dict({"type": "scene", **rooms(0.0, [5, 1, 1], 0), **rooms(8.0, [1, 1, 8], 1)})
    wrapped = {"type": "aov", "aovs": "d:depth", "image": INTEGRATORS[name]}
    path = images(scene, {"type": "path"}, 1, 256, 2)
    ours = images(scene, wrapped, 1, 64, 2)[..., :3]
    print(f"{ours.mean() / path.mean() - 1:+.2%}")
    assert abs(ours.mean() / path.mean() - 1) < 0.06
    view = mi.load_dict(camera((8, 0, 0.9), (8, 0, -1)))
    loose = images(scene, {"type": "moment", "inner": INTEGRATORS[name]}, view, spp=4, n=2)
    assert np.isfinite(loose).all()


# ---------------------------------------------------------------- loops, threads, the user's own recordings


@TWO
def test_function_of_the_users_own_may_be_frozen_around_a_trained_integrator(name):
    scene = room()
    integrator = mi.load_dict({**INTEGRATORS[name], **({} if name == "plain_path" else {"train_steps": 0})})
    frame = dr.freeze(lambda scene, integrator, seed: mi.render(scene, integrator=integrator, spp=16, seed=seed))
    if name != "plain_path":
        with pytest.raises(Exception) as e:
            frame(scene, integrator, mi.UInt32(0))
        cause = e.value
        while cause.__cause__ is not None:
            cause = cause.__cause__
        assert "integrator.train(scene, 300)" in str(cause)
        integrator.train(scene, 32)
    plain = images(scene, integrator, spp=64)
    frozen = np.array([np.array(frame(scene, integrator, mi.UInt32(k))) for k in range(16)])
    assert abs(frozen.mean() / plain.mean() - 1) < 0.03


@pytest.mark.parametrize("integrators", [("plain_path",), pytest.param(("nirc",), marks=SLOW)])
def test_light_sampler_inside_a_function_of_the_users_own_says_why_not(run_python, integrators):
    """A replay would choose among the lights of the first call; in a process of its own, as it ended the process."""
    samplers = ("uniform_lights", "power_lights", "tree_lights", "nvc_lights")
    code = f"""
import mi_neural, mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
lamps = {{name: {{"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([x, 0, 2]).rotate([1, 0, 0], 180),
                 "emitter": {{"type": "area"}}}} for name, x in (("a", -2), ("b", 2))}}
film = {{"type": "hdrfilm", "width": 8, "height": 8}}
scene = mi.load_dict({{"type": "scene", "floor": {{"type": "rectangle"}}, **lamps,
                      "sensor": {{"type": "perspective", "film": film,
                                 "to_world": mi.ScalarTransform4f().look_at([0, -3, 2], [0, 0, 0], [0, 0, 1])}}}})
small = {{"train_frames": 1, "train_samples": 64}}
for sampler in {samplers}:
    for integrator in {integrators}:
        keys = {{**small, "levels": 2, "width": 8, "train_steps": 0}} if integrator == "nirc" else {{}}
        nested = {{"type": sampler, **(small if sampler == "nvc_lights" else {{}})}}
        it = mi.load_dict({{"type": integrator, "light_sampler": nested, **keys}})
        print(sampler, integrator, end=": ", flush=True)
        mi.render(scene, integrator=it, spp=1)
        frame = dr.freeze(lambda scene, it, seed: mi.render(scene, integrator=it, spp=1, seed=seed))
        try:
            frame(scene, it, mi.UInt32(0))
            print("rendered", flush=True)
        except Exception as e:
            while e.__cause__ is not None:
                e = e.__cause__
            print(" ".join(str(e).split()), flush=True)
"""
    out = run_python(code, quick=True).stdout
    said = dict(line.split(": ", 1) for line in out.splitlines())
    assert list(said) == [f"{s} {i}" for s in samplers for i in integrators], out
    wrong = {k: v for k, v in said.items()
             if f"{k.split()[0]}: inside a function frozen by dr.freeze" not in v or "plain_path" not in v}  # fmt: skip
    assert not wrong


def test_nothing_is_collected_inside_of_a_recording_of_the_users_own(run_python):
    """Memory of an earlier image that is freed there ends the process. Here a collection is due at every allocation."""
    code = """
import mi_neural, mitsuba as mi, drjit as dr, gc, traceback
mi.set_variant("llvm_ad_rgb")
from mi_neural import scenes
scene = mi.load_file(str(scenes.path("cornell_box")), resx=8, resy=8)
it = mi.load_dict({"type": "plain_path"})
mi.render(scene, integrator=it, spp=1)
frame = dr.freeze(lambda scene, it, seed: mi.render(scene, integrator=it, spp=1, seed=seed))
inside, outside = 0, 0

def collects(phase, info):
    global inside, outside
    if phase == "start" and dr.flag(dr.JitFlag.FreezingScope):
        within = any(f.name == "render" and "mitsuba" in f.filename for f in traceback.extract_stack())
        inside, outside = inside + within, outside + (not within)

gc.collect()
gc.callbacks.append(collects)
gc.set_threshold(1)
frame(scene, it, mi.UInt32(0))
gc.set_threshold(700)
print(f"{inside} inside, {outside} outside")
"""
    out = run_python(code, quick=True).stdout
    assert re.fullmatch(r"0 inside, [1-9]\d* outside\n", out), out


@pytest.mark.parametrize("n", [60, pytest.param(200, marks=SLOW)])
def test_scenes_loaded_in_a_loop_leave_nothing_behind(n):
    """Scenes, sensors and integrators; memory after the first 40 is that at the end, to 3 %."""
    sizes = []
    for k in range(n):
        scene, view = room(sensor=None), mi.load_dict(camera())
        keys = {"train_frames": 1, "train_samples": 64, "levels": 2} if k % 4 == 0 else None
        integrator = mi.load_dict({"type": "nrc", **keys} if keys else {"type": "plain_path"})
        mi.render(scene, integrator=integrator, sensor=view, spp=1, seed=k)
        del scene, view, integrator
        if k % 20 == 19:
            gc.collect()
            with open("/proc/self/statm", encoding="ascii") as file:
                sizes.append(int(file.read().split()[1]) * resource.getpagesize() / 2**20)
    print(f"resident MiB {[round(s) for s in sizes]}")
    assert sizes[-1] < 1.03 * sizes[1]


def test_two_threads_render_at_once():
    found, scenes = [], [room() for _ in range(2)]

    def work(scene):
        try:
            found.append(images(scene, INTEGRATORS["nirc"], spp=4, n=1))
        except BaseException as e:  # handed on to the main thread
            found.append(e)

    threads = [threading.Thread(target=work, args=(scene,)) for scene in scenes]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    for f in found:
        if isinstance(f, BaseException):
            raise f
    assert np.isfinite(found).all()


def test_same_seed_gives_the_same_image_in_another_process(run_python):
    code = """if True:
        import mi_neural, mitsuba as mi, numpy as np
        mi.set_variant("llvm_ad_rgb")
        from mi_neural import scenes
        scene = mi.load_file(str(scenes.path("cornell_box")), resx=8, resy=8)
        for keys in ({"type": "nrc"}, {"type": "nirc"}, {"type": "nirc_two_level", "cache_samples": 4}):
            integrator = mi.load_dict({**keys, "levels": 4, "width": 16, "train_frames": 4, "train_samples": 128})
            print(*np.array(mi.render(scene, integrator=integrator, spp=4, seed=3)).ravel())
    """
    with contextlib.redirect_stdout(io.StringIO()) as here:
        exec(code)
    a, b = (np.array(text.split(), float) for text in (here.getvalue(), run_python(code, quick=True).stdout))
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_scene_that_cannot_be_recorded_is_rendered_unrecorded():
    rng = np.random.default_rng(0)
    ellipsoids = {
        "type": "ellipsoidsmesh", "centers": mi.TensorXf(rng.uniform(-0.5, 0.5, (8, 3)).astype(np.float32)),
        "scales": mi.TensorXf(np.full((8, 3), 0.2, np.float32)),
        "quaternions": mi.TensorXf(np.tile(np.float32([0, 0, 0, 1]), (8, 1))),
    }  # fmt: skip
    scene = room(block=ellipsoids)
    path = images(scene, {"type": "path"}, spp=256, n=2).mean()
    for name in ("plain_path", "nrc"):
        integrator = mi.load_dict({**INTEGRATORS[name], **({} if name == "plain_path" else {"train_frames": 8})})
        assert abs(images(scene, integrator, spp=64, n=1).mean() / path - 1) < 0.1
        assert integrator.statistics()["recorded"] is False


@pytest.mark.parametrize("name", ["nvc_direct", "restir_di"])
def test_gradients_are_refused_in_one_line(name):
    scene = room()
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("reflectance.value"))
    dr.enable_grad(params[key])
    params.update()
    integrator = mi.load_dict(INTEGRATORS.get(name, {"type": name}))
    with pytest.raises(Exception) as e:
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1)))
    cause = e.value
    while cause.__cause__ is not None:
        cause = cause.__cause__
    assert "it has no gradients" in str(cause)


@pytest.mark.parametrize("keys", [
    {"type": "nirc", "cache_samples": 1.5}, {"type": "nrc", "train_frames": 2.5},
    {"type": "plain_path", "max_depth": 3.2}, {"type": "nirc", "levels": 1.5},
    {"type": "plain_path", "max_depth": math.inf}, {"type": "nirc", "rr_depth": math.nan},
])  # fmt: skip
def test_numbers_that_must_be_whole_are_refused_otherwise(keys):
    with pytest.raises((ValueError, RuntimeError), match="give a whole number"):
        mi.load_dict(keys)


@pytest.mark.parametrize("keys", [{"residual_probability": "half"}, {"roulette": True}, {"guide": "on"},
                                  {"alpha": True}])  # fmt: skip
def test_keys_without_a_default_are_refused_by_name_too(keys):
    with pytest.raises((ValueError, RuntimeError), match=rf"nirc_two_level: {next(iter(keys))} is .*; give .*number"):
        mi.load_dict({"type": "nirc_two_level", **keys})


@ALL
def test_what_is_no_sensor_or_no_sample_count_is_refused_in_one_line(name):
    scene, integrator = room(), mi.load_dict(INTEGRATORS[name])
    with pytest.raises(ValueError, match=f"{name}: sensor is 'x'; give its number"):
        integrator.render(scene, sensor="x", spp=1)
    for spp in ("8", 1.5, -1):
        with pytest.raises(ValueError, match=f"{name}: spp is {spp!r}; give a whole number"):
            integrator.render(scene, spp=spp)


def test_last_line_of_an_error_inside_render_is_ours(run_python):
    code = """if True:
        import mi_neural, mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        mi_neural.register()  # a second time: nothing is wrapped twice
        scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}, "ball": {"type": "sphere"}})
        mi.render(scene, integrator=mi.load_dict({"type": "nirc"}), spp=1)
    """
    done = run_python(code, ok=False)
    assert done.returncode != 0
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("nirc: the scene has no emitter"), last
    assert done.stderr.count("nirc: the scene has no emitter") == 2  # where it was raised, and last
