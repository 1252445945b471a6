"""How cost grows, and where the time of a frame goes."""

import json
import time

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fake_cache import register
from load_study import load_study

from mi_neural.bench import budget, load, memory, split
from mi_neural.bench.specs import build_integrator, parse_integrator

scaling = load_study("scaling")


def points(costs: dict[float, float]) -> list[scaling.Point]:
    return [scaling.Point(x, str(x), y, None, None, None) for x, y in costs.items()]


def test_exponent_is_that_of_a_power_law():
    slope, error = scaling.exponent(points({x: 3e-3 * x**1.5 for x in (1, 10, 100, 1000)}), "image")
    assert slope == pytest.approx(1.5) and error < 1e-9
    noisy = {x: x * f for x, f in zip((1, 2, 4, 8, 16), (1.1, 0.9, 1.1, 0.9, 1.1), strict=True)}
    slope, error = scaling.exponent(points(noisy), "image")
    assert abs(slope - 1) < 2 * error < 0.2
    assert scaling.exponent(points({1: 1.0, 2: 2.0}), "image") is None
    assert scaling.exponent(points(noisy), "train") is None


def test_a_constant_part_counts_least_in_the_upper_half():
    fits = scaling.exponents(points({x: 100 + x for x in (1, 10, 100, 1e4, 1e5, 1e6)}))["image"]
    assert fits["all"][0] < 0.75 and fits["upper"][0] == pytest.approx(1, abs=0.01)


def test_what_is_varied_is_read():
    assert [s.size for s in scaling.settings("pixels", ("8x4", "16x8"), "s", None, 1)] == [(8, 4), (16, 8)]
    assert [s.spp for s in scaling.settings("samples", ("1", "4"), "s", None, 9)] == [1, 4]
    assert [s.keys for s in scaling.settings("records", ("7168",), "s", None, 1)] == [{"train_samples": 1024}]
    assert [s.keys for s in scaling.settings("network", ("16",), "s", None, 1)] == [{"width": 16}]
    assert [s.keys for s in scaling.settings("rr_depth", ("3",), "s", None, 1)] == [{"rr_depth": 3}]
    assert [s.threads for s in scaling.settings("cores", ("1", "2"), "s", None, 1)] == [1, 2]
    with pytest.raises(load.InputError, match="whole numbers from 1, got '0'"):
        scaling.settings("lights", ("0",), "s", None, 1)


def test_lit_floor_shines_alike_by_any_number_of_lights():
    path = mi.load_dict({"type": "path", "max_depth": 2})
    images = []
    for n in (1, 9):
        scene = scaling.lit_floor(n, (24, 16))
        assert len(scene.emitters()) == n
        images.append(np.array(mi.render(scene, integrator=path, spp=64)).mean())
    assert images[0] == pytest.approx(images[1], rel=0.25) and images[0] > 0  # the lights stand elsewhere


def test_command_writes_points_exponents_and_a_plot(tmp_path, capsys):
    register()
    common = ["cornell_box", "-i", "fake_cache:fraction=0", "--rounds", "2", "--frames", "2"]
    assert scaling.main([*common, "--over", "pixels=8x8,16x16,32x32", "-o", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "results.json").read_text())
    (line,) = found["points"].values()
    assert [p["x"] for p in line] == [64, 256, 1024] and all(p["image"] > 0 and p["train"] > 0 for p in line)
    assert line[0]["query"] == pytest.approx(1e-7) and "exponent of image in pixels" in capsys.readouterr().out
    assert found["exponents"]["fake_cache:fraction=0"]["query"]["all"][0] == pytest.approx(0)
    assert (tmp_path / "scaling.png").read_bytes()[:4] == b"\x89PNG"


def test_threads_are_put_back(capsys):
    before = dr.thread_count()
    arguments = ["cornell_box", "-i", "path:max_depth=2", "--over", "cores=1", "--size", "8x8", "--rounds", "1"]
    assert scaling.main(arguments) == 0 and dr.thread_count() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--over", "zork"), "give values, as in --over zork=1,2,4"),
        (("--over", "pixels=8"), "WIDTHxHEIGHT"),
        (("--over", "zork=1", "--size", "8x8"), "path has no key 'zork'"),
    ],
)
def test_what_cannot_be_varied_is_refused(arguments, message, capsys):
    assert scaling.main(["cornell_box", "-i", "path", *arguments]) == 2
    assert message in capsys.readouterr().err


# ---------------------------------------------------------------- split of a frame


def test_kernels_are_timed_apart_from_python():
    x = dr.arange(mi.Float, 2**22)
    dr.eval(x)

    def work():
        time.sleep(0.2)
        dr.eval(dr.sin(dr.exp(dr.sqrt(x))))

    work()
    wall, busy = split.kernels(work)
    assert 0 < busy < wall - 0.19
    assert split.kernels(lambda: time.sleep(0.01))[1] == 0.0


def test_parts_of_a_frame_add_up():
    register()
    loaded = load.load_scene("cornell_box", (16, 12))
    for text in ("path", "fake_cache"):
        spec = parse_integrator(text)
        integrator, keys = build_integrator(spec, loaded.carried)
        found = split.measure(loaded.scene, integrator, 1, frames=3)
        parts = [found.train, found.query or 0.0, found.trace, found.film, found.python]
        assert all(p >= 0 for p in parts) and sum(parts) == pytest.approx(found.total, rel=0.05)
        assert found.trace > 0 and found.film > 0 and found.query is None
        assert split.ablated_query(loaded.scene, spec, keys, integrator) is None


def test_training_step_and_queries_are_found(monkeypatch):
    """By an integrator that sleeps where it trains and says how many queries it makes."""
    register()
    loaded = load.load_scene("cornell_box", (16, 12))
    integrator, _ = build_integrator(parse_integrator("fake_cache"), loaded.carried)
    render, facts = budget.render_pass, {"seconds_train": 0.0, "queries": 0, "ns_per_query": 1.0}

    def learning(*args):
        time.sleep(0.05)
        facts["seconds_train"] += 0.05
        facts["queries"] += 1000
        return render(*args)

    monkeypatch.setattr(budget, "render_pass", learning)
    monkeypatch.setattr(budget, "statistics", lambda _: dict(facts))
    found = split.measure(loaded.scene, integrator, 1, frames=3)
    assert found.query == pytest.approx(1e-6) and found.train == 0.0  # sleeping runs no kernels: it is Python's
    assert found.python > 0.04 and found.total > 0.05


def test_training_that_is_queued_counts_as_training():
    """Most of a small image's time: a step of 2048 paths against 192 samples."""
    loaded = load.load_scene("cornell_box", (16, 12))
    integrator, _ = build_integrator(parse_integrator("nrc"), loaded.carried)
    integrator.train(loaded.scene, 16)
    found = split.measure(loaded.scene, integrator, 1, frames=3)
    alone = np.median([split.kernels(lambda: integrator.train(loaded.scene, 1))[1] for _ in range(5)])  # as `found` is
    print(f"training {1e3 * found.train:.2f} ms, tracing {1e3 * found.trace:.2f}; a step alone {1e3 * alone:.2f}")
    assert found.train > found.trace and found.train > 0.3 * alone


# ---------------------------------------------------------------- memory


def test_peak_is_counted_anew():
    if not memory.start():
        pytest.skip("this system cannot reset a process's high-water mark")
    before = memory.peak_mib()
    held = np.ones(2**24)  # 128 MiB
    assert memory.peak_mib() > before + 100
    del held
    memory.start()
    assert memory.peak_mib() < before + 64


def test_system_that_does_not_count_it(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "_PROCESS", tmp_path / "none")
    assert memory.start() is False and memory.peak_mib() is None
