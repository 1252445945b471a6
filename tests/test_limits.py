"""Limits met before anything is lost: large films and sample counts, several scenes, threads, interruptions."""

import gc
import importlib
import os
import signal
import threading
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK, SLOW
from expectation import assert_same_mean, renders
from hard_cases import Room, room

from mi_neural.integrators import checks
from mi_neural.render.frozen import undisturbed

SMALL = {"train_samples": 256, "train_frames": 8, "train_steps": 1, **NETWORK}
ALL = {
    "plain_path": {"type": "plain_path"},
    "nvc_direct": {"type": "nvc_direct"},
    "restir_di": {"type": "restir_di"},
    "nirc": {"type": "nirc", **SMALL},
    "nrc": {"type": "nrc", **SMALL},
}


def integrator_class(module: str, name: str):
    """A base class of integrators, of the variant that is set."""
    return getattr(importlib.import_module(f"mi_neural.integrators.{module}"), name)


@pytest.fixture(scope="module")
def scene():
    return room()()


def image(integrator, scene, **keys) -> np.ndarray:
    found = np.array(integrator.render(scene, **{"spp": 2, "seed": 1, **keys}), np.float64)
    assert np.isfinite(found).all()
    return found


@pytest.mark.parametrize("pass_samples", [None, 3])
def test_differentials_are_those_of_the_image_whatever_its_passes(scene, monkeypatch, pass_samples):
    """As narrow as the samples of a pixel lie, as in Mitsuba's own integrators."""
    integrator = mi.load_dict({"type": "nirc", "max_depth": 2})
    integrator.estimate = lambda scene, lights, field, sampler, ray, settings, active: (
        mi.Color3f(dr.norm(ray.d_x - ray.d)), mi.Bool(True), {})  # fmt: skip
    one = image(integrator, scene, spp=1)
    if pass_samples is not None:
        monkeypatch.setattr(type(integrator), "PASS_SAMPLES", pass_samples * one[..., 0].size)
    np.testing.assert_allclose(image(integrator, scene, spp=16), one / 4, rtol=0.05)


# ---------------------------------------------------------------- size


class _Huge:
    """A sensor with a film that nobody could hold."""

    def __init__(self, width, height):
        self.size = mi.ScalarVector2u(width, height)

    def film(self):
        return self

    def crop_size(self):
        return self.size


@pytest.mark.parametrize("size", [(2**31, 2), (2**16, 2**16), (2**20, 2**20)])
def test_film_beyond_the_entries_of_an_array_is_refused(size):
    with pytest.raises(ValueError, match=r"plain_path: a film of .* crop windows"):
        checks.check_film(_Huge(*size), "plain_path")


def test_film_beyond_the_memory_is_refused_before_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(checks, "_free_memory", lambda: 2**30)
    checks.check_film(_Huge(1920, 1080), "x", 400)
    with pytest.raises(ValueError, match=r"x: a film of 8192x8192 takes about 25.0 GiB .* 1.0 GiB are free"):
        checks.check_film(_Huge(8192, 8192), "x", 400)


def test_free_memory_is_known_here():
    assert checks._free_memory() is None or 2**24 < checks._free_memory() < 2**50


@pytest.mark.parametrize("name", ALL)
def test_every_integrator_refuses_a_film_that_does_not_fit(name, monkeypatch, scene):
    monkeypatch.setattr(checks, "_free_memory", lambda: 1000)
    with pytest.raises(ValueError, match=f"{name}: a film of 16x16 takes"):
        mi.load_dict(ALL[name]).render(scene, spp=1)


@pytest.mark.parametrize("name", ["plain_path", pytest.param("nvc_direct", marks=SLOW)])
def test_image_in_several_passes_has_the_mean_of_one(name, scene, monkeypatch):
    """As many samples as fit: 3 + 3 + 2 of 8. A false alarm in 10,000 choices of seed."""
    keys = {**ALL[name], "hide_emitters": True}  # the lights themselves are the most of the noise
    whole = renders(scene, keys, 16, 8)
    monkeypatch.setattr(integrator_class("lighting", "LightSamplingIntegrator"), "PASS_SAMPLES", 3 * 16 * 16)
    parts = renders(scene, keys, 16, 8, first_seed=100)
    assert_same_mean(parts, whole, name, blocks=1)
    a, b = (w.mean(axis=(1, 2, 3)).std(ddof=1) for w in (parts, whole))
    assert 0.3 < a / b < 3  # the passes are independent: as noisy as one


def test_first_pass_is_the_whole_image_where_it_fits(scene):
    """Splitting changes no image that was rendered in one go."""
    integrator = mi.load_dict(ALL["plain_path"])
    mine = image(integrator, scene, spp=4, seed=7)
    integrator.records = False
    np.testing.assert_allclose(mine, image(integrator, scene, spp=4, seed=7), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["plain_path", "nirc"])
def test_impossible_sample_counts_are_refused(name, scene):
    for spp in (-1, 1.5):
        with pytest.raises(ValueError, match=f"{name}: spp is {spp}; give a whole number"):
            mi.load_dict(ALL[name]).render(scene, spp=spp)


# ---------------------------------------------------------------- several at once


def test_scenes_and_integrators_alive_at_once_do_not_disturb_one_another():
    """Two integrators and two scenes by turns: the images are those of each alone."""
    bright, dark = room(radiance=(50.0, 20.0))(), room(radiance=(0.5, 0.2))()
    keys = {**ALL["nirc"], "train_steps": 0}
    alone = [image(mi.load_dict(keys), s, spp=8).mean() for s in (bright, dark)]
    one, two, plain = mi.load_dict(keys), mi.load_dict(keys), mi.load_dict(ALL["plain_path"])
    for _ in range(2):
        found = [image(one, bright, spp=8).mean(), image(two, dark, spp=8).mean()]
        image(plain, bright), image(plain, dark)
        np.testing.assert_allclose(found, alone, rtol=0.02)


def test_image_from_a_thread_is_that_of_the_main_thread(scene):
    integrator, found = mi.load_dict(ALL["plain_path"]), []
    here = image(integrator, scene, spp=4)
    thread = threading.Thread(target=lambda: found.append(image(integrator, scene, spp=4)))
    thread.start()
    thread.join(120)
    np.testing.assert_allclose(found[0], here, rtol=1e-4, atol=1e-6)


def test_training_from_a_thread_works(scene):
    integrator, found = mi.load_dict(ALL["nirc"]), []

    def work():
        try:
            found.append(image(integrator, scene))
        except BaseException as error:
            found.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(120)
    assert isinstance(found[0], np.ndarray), found
    assert integrator.cache.steps == 8 and image(integrator, scene).mean() > 0


# ---------------------------------------------------------------- interrupted callers


@contextmanager
def interrupted_at(module, name: str, call: int):
    """Ctrl-C is pressed in call number `call` of `module.name`."""
    original, count = getattr(module, name), [0]

    def wrapped(*args, **kwargs):
        count[0] += 1
        if count[0] == call:
            signal.raise_signal(signal.SIGINT)
        return original(*args, **kwargs)

    setattr(module, name, wrapped)
    try:
        yield count
    finally:
        setattr(module, name, original)


PLACES = {
    "records traced": ("mi_neural.caches.incident", "trace_records"),
    "records learned": ("mi_neural.caches.incident", "learn"),
    "image traced": ("mi_neural.render.path", "bounce"),
}


@pytest.mark.parametrize("place, call", [*((p, 1) for p in PLACES), ("records traced", 2), ("image traced", 2)])
def test_integrator_goes_on_after_ctrl_c_while_it_was_recorded(place, call, scene):
    """A notebook in which a cell is interrupted and run again."""
    module, name = PLACES[place]
    known = image(mi.load_dict(ALL["nirc"]), scene, spp=16).mean()
    integrator = mi.load_dict(ALL["nirc"])
    with interrupted_at(importlib.import_module(module), name, call) as count, pytest.raises(KeyboardInterrupt):
        image(integrator, scene)
    found = image(integrator, scene, spp=16)
    print(f"{place}, call {call}: {found.mean():.4f}, undisturbed {known:.4f}, {integrator.cache.steps} steps")
    assert count[0] >= call and found.mean() == pytest.approx(known, rel=0.1)


@pytest.mark.parametrize("first", [pytest.param(True, marks=SLOW), False])
def test_integrator_goes_on_after_ctrl_c_while_it_planned(first):
    """In its first scene, or in another after that."""
    lamps, other = room()(), room(extra={"spark": None})()
    known, integrator = mi.load_dict(ALL["nirc"]), mi.load_dict(ALL["nirc"])
    expected = image(known, lamps)
    if not first:
        image(integrator, other)
    with (interrupted_at(importlib.import_module("mi_neural.integrators.planning"), "light_noise", 1),
          pytest.raises(KeyboardInterrupt)):  # fmt: skip
        image(integrator, lamps)
    found = image(integrator, lamps)
    assert integrator.state.plan.to_json() == known.state.plan.to_json() and integrator.cache.steps == 8
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("frames", [8, -1])
def test_first_training_goes_on_after_ctrl_c(scene, monkeypatch, frames):
    monkeypatch.setattr(importlib.import_module("mi_neural.integrators.common"), "SETTLE_FRAMES", (8, 8))
    integrator = mi.load_dict({**ALL["nirc"], "train_frames": frames})

    def stop(done, _):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        integrator.train_first(scene, progress=stop)
    assert integrator.cache.steps == 3
    image(integrator, scene)
    assert integrator.cache.steps == 8
    image(integrator, scene)
    assert integrator.cache.steps == 9


@pytest.mark.parametrize("name", ["nirc", "nvc_direct"])
def test_ctrl_c_while_it_is_prepared_leaves_no_trace(name, scene):
    """Something was trained by then."""
    integrator = mi.load_dict(ALL[name])
    with (interrupted_at(importlib.import_module("mi_neural.render.film"), "_pass_of", 1),
          pytest.raises(KeyboardInterrupt)):  # fmt: skip
        integrator.prepare(scene)
    facts = integrator.statistics()
    assert facts.get("steps", 0) == 0 and facts.get("visibility_steps", 0) == 0 and facts["seconds_train"] < 1


def test_ctrl_c_waits_for_the_end_of_what_is_recorded_and_is_not_lost():
    reached = False
    with pytest.raises(KeyboardInterrupt), undisturbed():
        signal.raise_signal(signal.SIGINT)
        reached = True
    assert reached and signal.getsignal(signal.SIGINT) is signal.default_int_handler and gc.isenabled()
    with pytest.raises(ValueError, match="first"), undisturbed():
        signal.raise_signal(signal.SIGINT)
        raise ValueError("first")  # what went wrong inside counts more
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no timers here")
def test_integrators_go_on_after_ctrl_c_at_any_moment(scene):
    """A timer interrupts at 12 moments, in training, recording and rendering; then all is as if it had not."""
    integrators = {name: mi.load_dict(ALL[name]) for name in ("plain_path", "nirc", "nrc")}
    known = {name: image(it, scene, spp=16).mean() for name, it in integrators.items()}

    def interrupt(*_):
        signal.raise_signal(signal.SIGINT)

    before, hits = signal.signal(signal.SIGALRM, interrupt), 0
    try:
        for k in range(12):
            integrator = integrators[("plain_path", "nirc", "nrc")[k % 3]]
            if k < 6:
                integrator.reset()
            signal.setitimer(signal.ITIMER_REAL, 0.003 + 0.007 * k)
            try:
                for seed in range(200):
                    integrator.render(scene, spp=2, seed=seed)
            except KeyboardInterrupt:
                hits += 1
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        signal.signal(signal.SIGALRM, before)
    print(f"{hits} of 12 interrupted")
    assert hits >= 10
    for name, integrator in integrators.items():
        assert image(integrator, scene, spp=16).mean() == pytest.approx(known[name], rel=0.15), name


# ---------------------------------------------------------------- memory


def resident() -> int:
    """Bytes of main memory that this process holds."""
    gc.collect()
    dr.sync_thread()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc here")
@pytest.mark.parametrize("name", ["nirc", "nrc", "plain_path"])
def test_memory_stays_flat_over_a_thousand_frames(name):
    """Within 1 % from frame 100 on; 10,000 frames by `MI_NEURAL_FRAMES=10000`."""
    frames = int(os.environ.get("MI_NEURAL_FRAMES", 1000))
    keys = dict(ALL[name])
    if name == "plain_path":
        keys["light_sampler"] = {"type": "nvc_lights"}
    scene, integrator = Room(film={"width": 8, "height": 8}).load(), mi.load_dict(keys)
    start = None
    for k in range(frames):
        if k == 100:
            start = resident()
        integrator.render(scene, spp=1, seed=k)
    grown = resident() / start - 1
    image_of_the_end = image(integrator, scene, spp=256)
    recordings = getattr(getattr(integrator, "cache", None), "recordings", dict)()
    print(f"{name}: {start / 2**20:.1f} MiB after 100 frames, {grown:+.2%} after {frames}; mean "
          f"{image_of_the_end.mean():.4f}; recordings {recordings}")  # fmt: skip
    assert grown < 0.01


def test_passes_are_those_of_the_integrator_with_a_cache():
    assert integrator_class("common", "CacheIntegrator").PASS_SAMPLES < integrator_class(
        "lighting", "LightSamplingIntegrator"
    ).PASS_SAMPLES < checks.MOST_ENTRIES
