"""What users' scripts do with each integrator of this package: loops over scenes, threads, functions that they freeze
themselves, gradients that are asked for, and bad input, which is refused in one line."""

import contextlib
import gc
import io
import math
import re
import resource
import threading

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import SLOW
from test_drop_in import ALL, INTEGRATORS, TWO, camera, images, room

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
