"""Compilation: frozen = plain = evaluated loops; a constant number of recordings, kernels and bytes; passes."""

import gc
import importlib
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK
from expectation import assert_same_mean
from test_incident import load

SMALL = {"type": "nirc", "train_samples": 512, "train_frames": 10, "train_steps": 0, **NETWORK}


def render(scene, integrator, spp=4, seed=1):
    return np.array(integrator.render(scene, spp=spp, seed=seed), dtype=np.float64)


@pytest.fixture(scope="module")
def sphere():
    return load("point_lit_sphere", 16)[0]


@pytest.fixture(scope="module")
def trained(sphere):
    integrator = mi.load_dict(SMALL)
    integrator.train(sphere, 40)
    return integrator


@pytest.fixture(scope="module")
def running(sphere):
    """An integrator in the middle of a sequence: every image is preceded by a training frame."""
    integrator = mi.load_dict({**SMALL, "train_steps": 1})
    integrator.train(sphere, 70)  # beyond the first snapshot of the weights
    for k in range(6):
        render(sphere, integrator, 2, k)
    return integrator


def recordings(integrator) -> list[int]:
    passes = integrator.film_state.passes.recorded.values()
    return [integrator.cache.recordings()["frame"], *(p.n_recordings for p in passes)]


def test_number_of_recordings_is_constant_over_frames(sphere, running):
    before = recordings(running)
    print(f"recordings of the training frame and of the passes: {before}")
    assert max(before) <= 3
    for k in range(10):
        render(sphere, running, 2, 100 + k)
    assert recordings(running) == before


def test_recordings_survive_a_reset(sphere, running):
    before = recordings(running)
    running.reset()
    for k in range(2):
        render(sphere, running, 2, k)
    after = recordings(running)
    assert sum(after) <= sum(before) + 2, (before, after)  # at most once more for each function


def test_no_kernel_is_compiled_and_no_byte_kept_over_forty_frames(sphere, running):
    def memory() -> int:
        gc.collect()
        dr.sync_thread()
        return int(Path("/proc/self/statm").read_text().split()[1]) * 4096  # resident

    memory()  # scenes of earlier tests go now: Dr.Jit records anew when their surfaces leave its registry
    counts = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):  # the flag is part of what is frozen
        for k in range(70):  # the first thirty, with the snapshot of the weights among them, settle
            if k == 30:
                start = memory()
            dr.kernel_history_clear()
            render(sphere, running, 2, 200 + k)
            history = [h for h in dr.kernel_history() if h["type"] == dr.KernelType.JIT]
            compiled = sum(not h["cache_hit"] for h in history)
            assert k < 30 or compiled == 0, f"frame {k}: {compiled} kernels compiled"
            counts.append(len(history))
        dr.kernel_history_clear()
    grown = memory() - start
    print(f"kernels per frame {min(counts[30:])}..{max(counts[30:])}, memory grown by {grown / 2**20:.1f} MiB")
    assert len(set(counts[30:])) <= 2  # with and without a snapshot of the weights
    assert grown < 24 * 2**20


def test_frozen_plain_and_evaluated_give_equal_images(sphere, trained):
    frozen = render(sphere, trained)
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        plain = render(sphere, trained)
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
            evaluated = render(sphere, trained)
    np.testing.assert_allclose(plain, frozen, rtol=1e-5)
    np.testing.assert_allclose(evaluated, frozen, rtol=1e-5)


def test_frozen_training_and_training_with_evaluated_loops_give_equal_caches(sphere):
    """Up to the order in which threads sum up gradients."""
    frozen, plain = (mi.load_dict({**SMALL, "train_frames": 3}) for _ in range(2))
    image = render(sphere, frozen)
    flags = dr.JitFlag.KernelFreezing, dr.JitFlag.SymbolicLoops
    with dr.scoped_set_flag(flags[0], False), dr.scoped_set_flag(flags[1], False):
        np.testing.assert_allclose(render(sphere, plain), image, rtol=0.01)


def test_changed_seed_is_not_baked_into_the_recording(sphere, trained):
    images = [render(sphere, trained, seed=k) for k in range(3)]
    assert not np.array_equal(images[0], images[1]) and not np.array_equal(images[1], images[2])
    with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, False):
        np.testing.assert_allclose(render(sphere, trained, seed=2), images[2], rtol=1e-5)


@pytest.fixture
def small_passes(monkeypatch):
    def set_to(n):
        monkeypatch.setattr(importlib.import_module("mi_neural.integrators.common").CacheIntegrator, "PASS_SAMPLES", n)

    return set_to


@pytest.mark.parametrize("n", [16 * 16 * 2, 16 * 4, 5])
def test_several_passes_are_one(sphere, trained, small_passes, n):
    """Some samples of all pixels, some rows of one sample, one row at a time: same points, same mean."""
    whole = np.stack([render(sphere, trained, 3, k) for k in range(8)])
    small_passes(n)
    parts = np.stack([render(sphere, trained, 3, k) for k in range(8)])
    assert np.array_equal(parts[0], render(sphere, trained, 3, 0)), "the same seed gives the same image"
    assert np.isfinite(parts).all() and parts.shape == whole.shape
    assert_same_mean(parts, whole, f"passes of {n}", relative=1e-5)
    np.testing.assert_allclose(parts, whole, rtol=0.5)  # no pixel is missing, none counted twice


def test_variants_can_be_switched_back_and_forth(sphere, trained, variant):
    before = render(sphere, trained)
    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match="scalar variants have no"):
        mi.load_dict({"type": "nirc"})
    mi.set_variant(variant)
    assert np.array_equal(render(sphere, trained), before)
    other = mi.load_dict({**SMALL, "train_frames": 2})
    assert np.isfinite(render(sphere, other)).all()
    trained.train(sphere, 1)  # no copy of its code from another variant
    assert np.isfinite(render(sphere, trained)).all()


def test_old_scenes_collected_while_a_pass_is_recorded_do_no_harm(run_python):
    """Destroying a scene cannot be recorded; Python's collector must not do it in the middle of a recording."""
    code = """if True:
        import gc
        import mi_neural, mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        from mi_neural import scenes
        from mi_neural.render import path
        direct_light = path.direct_light
        def collect_first(*args, **kw):  # the collector may run at any time, unless it is switched off
            if gc.isenabled():
                gc.collect()
            return direct_light(*args, **kw)
        def load():
            return mi.load_file(str(scenes.path("point_lit_sphere")), resx=4, resy=4)
        scene, old = load(), [load()]
        integrator = mi.load_dict({"type": "nirc", "train_samples": 64, "train_frames": 1, "light_samples": 1})
        gc.set_threshold(10**6)
        old.append(old)  # a cycle: only the collector frees it
        del old
        path.direct_light = collect_first
        integrator.render(scene, spp=1)
        assert gc.isenabled()
        print("done")
    """
    assert run_python(code, quick=True).stdout.splitlines()[-1] == "done"


GARBAGE = """
import gc, drjit as dr, mi_neural, mitsuba as mi, numpy as np
mi.set_variant(VARIANT)
from mi_neural import scenes
scene = mi.load_file(str(scenes.path("point_lit_sphere")), resx=8, resy=8)
integrator = mi.load_dict({"type": "nirc", "train_samples": 256, "train_frames": 2, "train_steps": 1, "levels": 2,
                          "hashmap_size": 256, "width": 8})

class Loop:
    pass

def litter():
    for _ in range(20):
        loop = Loop()
        loop.me, loop.array = loop, mi.Float(np.ones(64, np.float32))

def collect(phase, info):
    if phase == "stop":
        litter()

gc.callbacks.append(collect)
gc.set_threshold(1)
litter()
mi.render(scene, integrator=integrator, spp=2)
assert integrator.measure_query(2**10) > 0
"""


def test_garbage_is_not_collected_while_something_is_recorded(run_python, variant):
    """What wraps memory of NumPy, freed by a collection while Dr.Jit records, ends the process. In one of its own."""
    run_python(GARBAGE.replace("VARIANT", repr(variant)), quick=True)
