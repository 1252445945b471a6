"""Budgets, passes and rows, with Mitsuba's `path` and with a cache that is one number."""

import base64
import csv
import json
import time
from itertools import pairwise

import mitsuba as mi
import numpy as np
import pytest
from fake_cache import register
from test_denoise import has_denoiser

from mi_neural.bench import benchmark, budget, denoise, load, page, reference, repeats, report, suite
from mi_neural.bench.specs import parse_integrator
from mi_neural.image import denoise as oidn
from mi_neural.image import metrics, moments

SIZE = (16, 12)
#: Keys that results must hold, by the contract of the command line.
KEYS = (
    "scene integrator parameters size spp seconds_compile seconds_train seconds_render ns_per_sample ns_per_query "
    "records queries mean nonfinite relmse relmse_trimmed flip environment"
).split()


@pytest.fixture
def loaded() -> load.LoadedScene:
    register()
    return load.load_scene("cornell_box", SIZE)


@pytest.fixture
def path():
    return mi.load_dict({"type": "path", "max_depth": 4})


def fake(**keys):
    register()
    return mi.load_dict({"type": "fake_cache", "max_depth": 3, **keys})


#: What a sample a pixel takes by the `clock` below.
SAMPLE_SECONDS = 7e-3


@pytest.fixture
def clock(monkeypatch):
    """Time that passes by samples and sleep alone: budgets are met to the sample, however busy the machine is."""
    now, render_pass = [0.0], budget.render_pass

    def wait(seconds):
        now[0] += seconds

    def timed(scene, integrator, spp, *args):
        wait(SAMPLE_SECONDS * spp)
        return render_pass(scene, integrator, spp, *args)

    monkeypatch.setattr(budget, "clock", lambda: now[0])
    monkeypatch.setattr(budget, "render_pass", timed)
    monkeypatch.setattr("fake_cache.sleep", wait)

    def read():
        return now[0]

    read.wait = wait
    return read


# ---------------------------------------------------------------- passes


def test_accumulator_weighs_by_samples_and_leaves_out_nonfinite_pixels():
    film = moments.Accumulator()
    first, second = np.full((2, 2, 3), 1.0), np.full((2, 2, 3), 4.0)
    second[0, 0, 1], first[1, 1], second[1, 1] = np.nan, np.inf, np.inf
    film.add(first, 1)
    film.add(second, 2)
    assert film.mean()[0, 1] == pytest.approx(3.0)
    assert film.mean()[0, 0] == pytest.approx(1.0)  # the first pass alone
    assert film.mean()[1, 1] == pytest.approx(0.0)  # none was finite
    assert (film.nonfinite, film.spp) == (3, 3)


def test_seeds_of_passes_differ():
    seeds = {budget.pass_seed(s, t, k) for s in range(5) for t in range(4) for k in range(50)}
    assert len(seeds) == 5 * 4 * 50


def test_passes_are_chosen_to_end_in_time():
    sizes = [1, 4, 16]
    assert budget.choose_pass(sizes, {}, 1.0) == 1
    assert budget.choose_pass(sizes, {}, 0.0) is None
    assert budget.choose_pass(sizes, {1: 0.01}, 1.0) == 16
    assert budget.choose_pass(sizes, {1: 0.01, 16: 0.12}, 0.05) == 4
    assert budget.choose_pass(sizes, {1: 0.01}, 0.006) == 1  # more than half of it fits
    assert budget.choose_pass(sizes, {1: 0.01}, 0.004) is None
    assert budget.choose_pass(sizes, {1: 0.5}, 60.0) == 1  # no pass is longer than a second
    assert budget.choose_pass(sizes, {1: 5.0}, 60.0) == 1  # but for the smallest


def test_plan_of_passes_adds_up(loaded):
    for spp in (1, 3, 16, 100):
        assert sum(budget.plan_passes(loaded.scene, spp)) == spp
    assert max(budget.plan_passes(loaded.scene, 100_000)) * SIZE[0] * SIZE[1] <= budget.PASS_SAMPLES


def test_same_seed_same_image(loaded, path):
    first, again = (budget.render_samples(loaded.scene, path, 5, seed=3) for _ in range(2))
    other = budget.render_samples(loaded.scene, path, 5, seed=4)
    assert np.allclose(first.rgb, again.rgb, rtol=1e-5)
    assert not np.allclose(first.rgb, other.rgb, rtol=1e-2)
    assert first.rgb.shape == (SIZE[1], SIZE[0], 3) and first.spp == 5


def test_mean_of_passes_is_the_mean_of_the_integrator(loaded, path, clock):
    passes = budget.render_seconds(loaded.scene, path, 200 * SAMPLE_SECONDS)
    whole = np.array(mi.render(loaded.scene, integrator=path, spp=512, seed=1))
    assert passes.spp == 200
    assert passes.rgb.mean() == pytest.approx(whole.mean(), rel=0.1)


def spread_of_images(loaded, integrator, film=None) -> float:
    """Variance of a pixel over eight images of 32 samples in passes of 2, mean of the pixels."""
    images = [
        budget.render_passes(loaded.scene, integrator, [2] * 16, 32, seed=seed, film=film and film()).rgb
        for seed in range(8)
    ]
    return np.var(images, axis=0, ddof=1).mean()


def test_passes_of_an_image_go_on_with_the_stratified_numbers(loaded):
    """With these seeds, 0.52 of the variance of independent passes, which images have whose spread is measured pass by
    pass, and 0.9 with eight independent groups. The integrator's next image is one by itself."""
    register()
    plain = mi.load_dict({"type": "plain_path", "max_depth": 2, "hide_emitters": True})
    before = np.array(mi.render(loaded.scene, integrator=plain, spp=4, seed=5))
    films = None, moments.Groups, moments.Moments
    together, groups, apart = (spread_of_images(loaded, plain, film) for film in films)
    print(f"variance of passes that go on over that of independent ones: {together / apart:.3f}, {groups / apart:.3f}")
    assert together < 0.75 * apart and together < groups < 0.95 * apart
    assert np.allclose(before, mi.render(loaded.scene, integrator=plain, spp=4, seed=5), rtol=1e-5)


def test_budget_is_met(loaded, path, clock):
    """To half of a sample, by passes of several sizes."""
    rendered = budget.render_seconds(loaded.scene, path, 0.4)
    assert abs(clock() - 0.4) <= SAMPLE_SECONDS / 2 and rendered.spp == round(0.4 / SAMPLE_SECONDS)
    assert rendered.seconds_render == pytest.approx(clock()) and rendered.seconds_train == 0.0


def test_watching_costs_no_time_of_the_budget(loaded, path, clock):
    seen = []

    def watch(rendered):
        seen.append(rendered)
        clock.wait(10.0)

    rendered = budget.render_seconds(loaded.scene, path, 0.4, watch=watch)
    assert rendered.spp == round(0.4 / SAMPLE_SECONDS) and seen[0].spp == 1
    assert all(2 * a.spp <= b.spp for a, b in pairwise(seen)) and seen[-1].spp > rendered.spp / 2
    assert all(s.seconds_render == pytest.approx(s.spp * SAMPLE_SECONDS) for s in seen)


def test_budget_is_met_by_the_clock_on_the_wall(loaded, path):
    budget.warm_up(loaded.scene, path, budget.pass_sizes(loaded.scene))
    start = time.perf_counter()
    rendered = budget.render_seconds(loaded.scene, path, 0.4)
    seconds = time.perf_counter() - start
    assert 0.3 < rendered.seconds_render <= seconds and 0.35 < seconds < 4  # others may use the machine


def test_training_is_part_of_the_budget(loaded, clock):
    integrator = fake(fraction=0.5)
    rendered = budget.render_seconds(loaded.scene, integrator, 0.4)
    assert rendered.seconds_train == pytest.approx(0.2)
    assert abs(rendered.seconds_train + rendered.seconds_render - 0.4) <= SAMPLE_SECONDS / 2
    assert rendered.statistics["records"] == 10
    assert (rendered.channels["frames"] == 10).all()

    integrator.reset()
    rendered = budget.render_seconds(loaded.scene, integrator, 0.1, pretrained=True)
    assert rendered.seconds_train == 0.0 and integrator.frames == 0


def test_a_tiny_budget_still_gives_an_image(loaded, path):
    assert budget.render_seconds(loaded.scene, path, 1e-6).spp == 1


def test_warm_up_uses_what_leaves_no_trace(loaded):
    integrator = fake()
    budget.warm_up(loaded.scene, integrator, [1, 4])
    assert (integrator.n_prepared, integrator.n_renders, integrator.frames) == (2, 0, 0)


def test_interrupted_rendering_keeps_the_image_so_far(loaded):
    rendered = budget.render_seconds(loaded.scene, fake(interrupt_render=3, fraction=0.0), 60.0)
    assert rendered.interrupted and rendered.spp > 0 and rendered.rgb.mean() > 0.0
    with pytest.raises(KeyboardInterrupt, match="before the first samples"):
        budget.render_samples(loaded.scene, fake(interrupt_render=1), 4)


def test_interrupted_training_still_renders_a_pass(loaded):
    rendered = budget.render_seconds(loaded.scene, fake(interrupt_train=True), 60.0)
    assert rendered.interrupted and rendered.spp == 1


def test_nonfinite_pixels_are_counted(loaded):
    rendered = budget.render_samples(loaded.scene, fake(nan=True), 1)
    assert rendered.nonfinite == SIZE[0] * SIZE[1] and (rendered.rgb == 0.0).all()


# ---------------------------------------------------------------- rows and reports


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A comparison of `path` with the fake cache: (pictures, reference)."""
    register()
    loaded = load.load_scene("cornell_box", SIZE)
    ref = reference.render_reference(loaded, 64, tmp_path_factory.mktemp("reference"))
    specs = [parse_integrator(text) for text in ("path", "fake_cache:fraction=0.25")]
    cases = benchmark.make_cases(loaded, specs, {"max_depth": 4})
    guides = denoise.render_guides(loaded.scene)[0] if has_denoiser() else None
    pictures = []
    bench = benchmark.Bench(loaded, ref, guides, {"cores": 1}, pictures.append)
    bench.run(cases, benchmark.Plan([0.05, 0.1], 3, [0.05]))
    return pictures, ref


def test_integrators_are_told_that_their_images_will_be_denoised(loaded):
    specs = [parse_integrator(s) for s in ("path", "neural_path", "neural_path:denoised=false")]
    known = [benchmark.make_cases(loaded, specs, denoise=d) for d in (False, True)]
    assert [[getattr(c.integrator, "denoised", None) for c in cases] for cases in known] == [
        [None, False, False], [None, True, False],
    ]  # fmt: skip
    assert known[1][1].spec.label == "neural_path"


def test_rows_hold_what_the_contract_names(measured):
    pictures, _ = measured
    rows = [p.row for p in pictures]
    for row in rows:
        entry = json.loads(json.dumps(row.to_json(), allow_nan=False))
        assert set(KEYS) <= entry.keys()
        assert entry["parameters"]["max_depth"] == 4
        assert row.mode in benchmark.WITHOUT_PICTURE or (row.relmse > 0.0 and row.flip > 0.0)
        assert row.environment == {"cores": 1}
        assert row.seconds_total == row.seconds_train + row.seconds_render + row.seconds_denoise
    variants = 2 if has_denoiser() else 1
    pictured = [row for row in rows if row.mode not in benchmark.WITHOUT_PICTURE]
    modes = [row.mode for row in pictured if row.label == "path"]
    assert modes == ["one-shot"] * 2 * variants + ["sample"] * variants + ["steady"] * variants

    cached = [row for row in pictured if row.integrator == "fake_cache"]
    assert 0.25 * 0.05 <= cached[0].seconds_train < 0.1
    steady = next(row for row in cached if row.mode == "steady")
    assert steady.pretrain_frames == 3 and steady.frames == benchmark.STEADY_FRAMES and steady.seconds_train == 0.0
    assert steady.flicker > 0.0 and cached[0].flicker is None
    assert steady.records == 3, "one-shot runs before it must leave nothing in the cache"


def test_curve_is_that_of_the_longest_run_and_ends_with_it(measured):
    rows = [p.row for p in measured[0] if p.row.label == "path" and not p.row.denoised]
    curve = [row for row in rows if row.mode == "curve"]
    (final,) = (row for row in rows if row.mode == "one-shot" and row.budget_seconds == 0.1)
    assert {row.budget_seconds for row in curve} == {0.1}
    assert all(b.spp >= 2 * a.spp and b.seconds_total > a.seconds_total for a, b in pairwise(curve))
    assert curve[0].spp == 1 and curve[-1].spp <= final.spp < 2 * curve[-1].spp
    assert curve[0].relmse_trimmed > curve[-1].relmse_trimmed and curve[-1].seconds_total <= final.seconds_total


def test_time_of_a_frame_is_split_and_memory_counted(measured):
    rows = [p.row for p in measured[0]]
    split = [row for row in rows if row.mode == "split"]
    assert [row.integrator for row in split] == ["path", "fake_cache"] and split[0].split["trace"] > 0
    assert all(row.split is None for row in rows if row.mode != "split")
    if rows[0].peak_mib is not None:
        assert all(50 < row.peak_mib < 20_000 for row in rows)


def test_ns_per_sample_is_time_over_samples(measured):
    row = next(p.row for p in measured[0] if p.row.mode == "one-shot")
    assert row.ns_per_sample == pytest.approx(1e9 * row.seconds_render / (SIZE[0] * SIZE[1] * row.spp))


def test_report_is_one_file_that_loads_nothing(measured, tmp_path):
    pictures, ref = measured
    rows = [p.row for p in pictures]
    entries = [page.reference_entry(ref, 0.0), *(page.entry(p, 0.0) for p in pictures if p.rgb is not None)]
    scene = report.SceneResult("a<b", SIZE, rows, repeats.group(rows), ref.to_json(), ["a & b"], entries)
    suite.write(report.Report("mi-neural compare", {"cores": 1}, [scene], ["c & d"]), tmp_path)
    text = (tmp_path / "report.html").read_text()
    assert text.count("data:image/png;base64,") == 2 * len(entries) - 1
    assert all(part in text for part in ("a&lt;b", "a &amp; b", "c &amp; d", "class Viewer", ".viewer {"))
    assert text.count("<svg") - 1 == 3 == len(list(tmp_path.glob("curves_*.svg"))), "one more opens the scene"
    for outside in ('src="http', "url(http", "<link", "@import", "fetch("):
        assert outside not in text
    results = json.loads((tmp_path / "results.json").read_text())
    assert len(results["rows"]) == len(rows) and results["scenes"][0]["reference"]["variance_subtracted"] is True
    lines = (tmp_path / "results.csv").read_text().splitlines()
    assert len(lines) == len(rows) + 1 and len({len(row) for row in csv.reader(lines)}) == 1
    first, second = (tmp_path / "table.md").read_text().split("\n\n")
    assert len(first.splitlines()) == len(scene.groups) - 2 + 2  # two lines are in the second table: splits of frames
    assert len({line.count("|") for line in first.splitlines()}) == 1 and "python" in second


def test_pictures_of_pages_are_webp(measured):
    picture = next(p for p in measured[0] if p.rgb is not None)
    exact, small = page.entry(picture, 0.0), page.entry(picture, 0.0, 10**5)
    assert exact["image"].startswith("data:image/png") and small["image"].startswith("data:image/webp")
    found = base64.b64decode(small["error"].partition(",")[2])
    assert found[:4] == b"RIFF" and found[8:12] == b"WEBP" and len(found) <= 10**5


def test_denoiser_lowers_the_error(path, tmp_path):
    if not has_denoiser():
        pytest.skip("mitsuba-oidn is not installed")
    loaded = load.load_scene("cornell_box", (64, 64), integrator_keys={"max_depth": 4})
    ref = reference.render_reference(loaded, 64, tmp_path)
    noisy = budget.render_samples(loaded.scene, path, 2).rgb
    clean, seconds = denoise.denoise(noisy, denoise.render_guides(loaded.scene)[0])
    assert seconds > 0.0 and clean.shape == noisy.shape
    assert metrics.relmse_trimmed(clean, ref.rgb) < metrics.relmse_trimmed(noisy, ref.rgb)


def test_missing_denoiser_says_what_to_type(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba_oidn", None)
    with pytest.raises(load.InputError, match=r"pip install 'mi_neural\[denoise\]'"):
        denoise.require()
    image = np.ones((2, 2, 3), np.float32)
    with pytest.raises(ImportError, match=r"pip install 'mi_neural\[denoise\]'"):
        oidn.denoise(image, image, image)
