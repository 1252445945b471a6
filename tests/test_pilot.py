"""The division of a camera sample is measured where it is not given; path tracing is taken where nothing is better."""

import importlib
import math

import mitsuba as mi
import pytest
from cheap import SLOW, sweep
from two_level_bench import SMALL, Bench, fill, render


@pytest.fixture(scope="module")
def bench():
    return Bench()


@pytest.fixture(scope="module")
def box(bench):
    return bench.scene("cornell_box")


@pytest.fixture(autouse=True)
def pilot_at_once(monkeypatch):
    """The pilot looks before the first image, however small."""
    monkeypatch.setattr(importlib.import_module("mi_neural.integrators.pilot"), "WORTH", 0)


def test_small_images_are_path_traced_and_measured_when_asked(box, monkeypatch, short_pilot):
    monkeypatch.setattr(importlib.import_module("mi_neural.integrators.pilot"), "WORTH", 3 * 256)
    integrator = mi.load_dict({**SMALL, "train_frames": 4, "train_steps": 0})
    for k in range(2):
        render(box, integrator, 1, k)
    assert "pilot" not in integrator.statistics() and integrator.statistics()["split"] == "path tracing, 1 path"
    render(box, integrator, 1, 2)  # enough samples by now
    assert integrator.statistics()["pilot"]
    integrator.reset()
    integrator.train_first(box)
    assert "pilot" not in integrator.statistics()
    assert integrator.measure(box)["pilot"]


@pytest.fixture
def short_pilot(monkeypatch):
    monkeypatch.setattr(importlib.import_module("mi_neural.integrators.pilot"), "PILOT_SAMPLES", 2**13)


@pytest.fixture
def clockwork(monkeypatch, short_pilot):
    """The pilot's measured seconds, made a model of the work, so that choices do not hang on the machine's mood: a
    path costs `costs[0]` for direct light and `costs[1]` beyond, a query `costs[2]`."""
    pilot = importlib.import_module("mi_neural.integrators.pilot")
    plain, costs = pilot.Pilot.run, [0.3, 0.7, 0.1]

    def run(self, split, passes=pilot.PILOT_PASSES, first_seed=0):
        images, _ = plain(self, split, passes, first_seed)
        each = split.n_traced * (costs[0] + split.probability * costs[1])
        each += costs[2] * split.n_cache if split.alpha != 0 else 0
        return images, [1e-6 * each * self.samples] * passes

    monkeypatch.setattr(pilot.Pilot, "run", run)
    return costs


@pytest.mark.parametrize("given", sweep(
    [{}, {"alpha": 1.0, "cache_samples": 2}, {"ris": True}, {"cache_samples": 3, "residual_samples": 3},
     {"alpha": "cell"}, {"residual_probability": 0.3}],
    [{"alpha": 1.0, "cache_samples": 2}],
))  # fmt: skip
def test_chosen_division_stays_within_the_keys_given(box, short_pilot, given):
    integrator = mi.load_dict({**SMALL, "train_frames": 12, **given})
    image = render(box, integrator, 4)
    assert image.mean() > 0.05
    split, table = integrator.split, integrator.statistics()["pilot"]
    print(given, "->", split)
    for t in table:
        for key in ("variance", "seconds", "cost", "efficiency"):
            assert math.isfinite(t[key]) and t[key] > 0, f"{key} of {t}"
        assert t["cost"] == pytest.approx(t["variance"] * t["seconds"])
        assert t["n_cache"] == (0 if t["alpha"] == 0 else given.get("cache_samples", t["n_cache"]))
        assert t["n_traced"] == given.get("residual_samples", 1 if "ris" in given else t["n_traced"])
        assert t["probability"] == pytest.approx(given.get("residual_probability", t["probability"]))
        assert t["alpha"] == {"cell": -1.0}.get(given.get("alpha"), given.get("alpha", t["alpha"]))
        assert t["probability"] == 1 or t["alpha"] != 0 or "residual_probability" in given
    assert {k: getattr(split, k) for k in ("n_cache", "n_traced", "probability", "alpha")} in [
        {k: t[k] for k in ("n_cache", "n_traced", "probability", "alpha")} for t in table
    ]
    assert integrator.statistics()["seconds_pilot"] > 0 and str(split) == integrator.statistics()["split"]


@pytest.mark.parametrize("given, says", [
    ({"cache_samples": 0}, "path tracing, 1 path"), ({"alpha": 0.0, "residual_samples": 2}, "path tracing, 2 paths"),
])  # fmt: skip
def test_where_no_cache_can_be_asked_nothing_is_measured(box, given, says):
    integrator = mi.load_dict({**SMALL, **given})
    render(box, integrator, 1)
    s = integrator.statistics()
    assert s["split"] == says and "pilot" not in s and s["seconds_pilot"] == 0 and s["steps"] == 0


def test_path_tracing_is_chosen_where_the_cache_is_nonsense(box, bench, clockwork):
    learned = bench.integrator("cornell_box")[1]
    integrator = mi.load_dict({**SMALL, "residual_probability": 1.0, "freeze_cache": True})
    integrator.train_first(box)  # a field, untrained
    fill(integrator, "nonsense", learned)
    integrator.cache.statistics.pop("alpha", None)
    integrator.choice.reset()
    render(box, integrator, 1)
    print(integrator.statistics()["split"], "mean alpha", integrator.statistics()["alpha"])
    assert integrator.split.alpha == 0 and integrator.split.n_cache == 0
    assert integrator.statistics()["split"].startswith("path tracing")


@SLOW
def test_cache_is_chosen_where_queries_are_cheap_and_paths_dear(bench, clockwork):
    """Among 32 lamps, chosen uniformly, direct light makes most of the noise: many samples of it are worth more than
    the paths that the cache stands in for. `roulette` is given, because the clock would not charge for it."""
    clockwork[:] = [0.02, 1.0, 0.001]
    lamps = bench.scene("lamp_bays")
    integrator = mi.load_dict({**SMALL, "light_sampler": {"type": "uniform_lights"}, "roulette": 0.0})
    render(lamps, integrator, 1)
    print(integrator.statistics()["split"], [round(t["efficiency"], 2) for t in integrator.choice.table])
    assert integrator.split.alpha == -1 and integrator.split.n_cache >= 2


def test_division_is_measured_again_once_the_cache_is_twice_as_old(box, monkeypatch):
    integrator = mi.load_dict({**SMALL, "train_frames": 8, "train_steps": 4})
    calls = []
    monkeypatch.setattr(integrator.choice, "_compare", lambda pilot: calls.append(integrator.cache.steps))
    for k in range(8):  # 8, 12, ..., 36
        render(box, integrator, 1, k)
    assert calls == [8, 16, 32]
