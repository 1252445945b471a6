"""`mi-neural reproduce`: the list, unknown names, going on after an interruption, pages with both numbers."""

import html
import json
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK
from typer.testing import CliRunner

from mi_neural.bench import load
from mi_neural.caches.reliability import Reliability, ReliabilityGrid
from mi_neural.cli import app
from mi_neural.reproduce import changed, fsr, measures, registry, reliability, scene_files
from mi_neural.reproduce.changed import mean_reliabilities
from mi_neural.reproduce.entry import SOURCES, Entry, Outcome, Statement
from mi_neural.reproduce.work import Part, Work


def run(*words: str):
    return CliRunner().invoke(app, ["reproduce", *words])


def test_list_names_every_entry_with_its_source():
    shown = run()
    assert shown.exit_code == 0
    for name, entry in registry.ENTRIES.items():
        assert name.partition("/")[0] in SOURCES and entry.source
        (line,) = [line for line in shown.stdout.splitlines() if line.startswith(f"{name} ")]
        assert entry.figure in line and entry.scene in line and entry.shows in line


def test_unknown_name_is_one_line_with_close_ones(tmp_path):
    shown = run("reliability/figure4", "-o", str(tmp_path / "none"))
    assert shown.exit_code == 2
    assert "there is no entry 'reliability/figure4'" in shown.stderr and "reliability/fig4" in shown.stderr
    assert not (tmp_path / "none").exists()


def test_a_source_stands_for_all_its_entries():
    expected = [name for name in registry.ENTRIES if name.startswith("reliability/")]
    assert len(expected) > 1 and [e.name for e in registry.find("reliability")] == expected


def test_interrupted_entry_goes_on_without_measuring_again(tmp_path, monkeypatch):
    measured = []

    def first(bar) -> Part:
        measured.append("first")
        return Part({"error": np.float32(0.25)}, {"image": np.full((2, 3), 7.0)})

    def second(bar) -> Part:
        measured.append("second")
        if len(measured) == 2:
            raise KeyboardInterrupt
        return Part({"error": 0.5})

    def measure(work: Work) -> Outcome:
        group = work.group("fake", {"size": work.size})
        parts = [group.part("first", first), group.part("second", second)]
        assert parts[0].arrays["image"].sum() == 42.0
        text = ", ".join(str(p.numbers["error"]) for p in parts)
        return Outcome([Statement("error 0.3", "table 9", text, False, "-17 %", "another scene")], notes=["<a note>"])

    entry = Entry("fsr/fake", "Table 9", "Two parts.", "none", (1, 1), measure)
    monkeypatch.setattr(registry, "ENTRIES", {entry.name: entry})
    (tmp_path / "nvc/old").mkdir(parents=True)
    (tmp_path / "nvc/old/results.json").write_text("{}")  # of another version: does not matter
    stopped = run("fsr/fake", "-o", str(tmp_path))
    assert stopped.exit_code == 130 and "goes on from here" in stopped.stderr
    assert run("fsr/fake", "-o", str(tmp_path)).exit_code == 0
    assert measured == ["first", "second", "second"]
    page = (tmp_path / "fsr/fake/index.html").read_text()
    shown = ("error 0.3", "table 9", "0.25, 0.5", "differs, -17 %: another scene", "&lt;a note&gt;")
    assert all(text in page for text in shown)
    assert 'href="fsr/fake/index.html"' in (index := (tmp_path / "index.html").read_text()) and "1 differs" in index

    assert run("fsr/fake", "-o", str(tmp_path), "--size", "8x8").exit_code == 0
    assert measured[3:] == ["first", "second"], "another size is another measurement"


def test_damaged_part_is_measured_again(tmp_path):
    group = Work(tmp_path).group("fake", {})
    (group.folder / "part.json").write_text('{"error": 0.')
    for array in (1.0, 2.0):
        made = group.part("part", lambda bar, array=array: Part({"error": 1.0}, {"image": np.full(9, array)}))
        assert made.numbers == json.loads((group.folder / "part.json").read_text()) == {"error": 1.0}
        assert (made.arrays["image"] == array).all()
        arrays = group.folder / "part.npz"
        arrays.write_bytes(arrays.read_bytes()[:-30])


@pytest.mark.parametrize("agrees, word", [(True, "agrees"), (False, "differs: why"), (None, "not comparable: why")])
def test_reason_is_shown_where_numbers_differ(agrees, word):
    assert Statement("a", "b", "c", agrees, "", "why").verdict == word


def test_quick_counterpart_shows_both_numbers(tmp_path, monkeypatch):
    tiny = reliability.Settings((16, 16), frames=23, pretrain=2, spp=1, reference_spp=16, cache_samples=1,
                                methods=("High-LR", "EMA", "blend"))  # fmt: skip
    monkeypatch.setattr(reliability, "QUICK", tiny)
    for method in tiny.methods:
        monkeypatch.setitem(changed.METHODS, method, changed.METHODS[method] | NETWORK)
    for name in ("fig1", "hidden", "fig4"):
        shown = run(f"reliability/{name}", "--quick", "-o", str(tmp_path))
        assert shown.exit_code == 0, shown.stderr
        folder = tmp_path / "reliability" / name
        found = json.loads((folder / "results.json").read_text())
        page = (folder / "index.html").read_text()
        for s in found["statements"]:
            assert all(html.escape(s[key]) in page for key in ("paper", "where", "ours", "verdict"))
    assert "training" not in shown.stderr, "the second figure takes the first one's frames"
    assert len(list((tmp_path / "measured").glob("states-*"))) == 1, "both settings have the same references"
    found = json.loads((tmp_path / "reliability/fig4/results.json").read_text())
    flip = {line[0]: [float(v) for v in line[1:4]] for line in found["tables"]["Means over the frames"][1:]}
    assert all(before < after for before, after, _ in flip.values()), "a moved lamp makes every cache wrong"


@pytest.mark.parametrize("make, lights, triangles", [
    (lambda folder: scene_files.foliage(folder, 50), 2, 2 + 100),  # two of the floor
    (lambda folder: scene_files.foliage(folder, 0), 2, 2),
    (lambda folder: scene_files.hall_of_lamps(folder, 80, 2), 8, 2 + 2 * 12 + 160),  # and of twelve partitions
], ids=["foliage", "ball", "hall"])  # fmt: skip
def test_scenes_that_entries_make_are_as_they_say(make, lights, triangles, tmp_path):
    file = make(tmp_path)
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert make(tmp_path) == file and made == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    scene = load.load_scene(str(file), (16, 9)).scene
    assert len(scene.emitters()) == lights
    assert sum(s.primitive_count() for s in scene.shapes() if s.is_mesh()) == triangles
    image = np.array(mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": 3}), spp=16))
    assert np.isfinite(image).all() and image.mean() > 0


# ---------------------------------------------------------------- measures


def test_mean_reliability_tells_a_predictor_that_follows_the_targets_from_one_that_does_not(rng):
    grid = ReliabilityGrid([0, 0, 0], [1, 1, 1], Reliability(measure="correlation", resolution=1))
    n = 4096
    for _ in range(3):
        y, other = (mi.Color3f(rng.uniform(0, 1, (3, n)).astype("f4")) for _ in range(2))
        place, normal = mi.Point3f(rng.uniform(0.1, 0.9, (3, n)).astype("f4")), mi.Normal3f(0, 0, 1)
        grid.update(place, normal, mi.Bool([True] * n), y, y, other)
    found = mean_reliabilities(SimpleNamespace(cache=SimpleNamespace(queried=SimpleNamespace(grid=grid))))
    # Var y is 1/12, so that ε = 0.001 leaves 0.988; the other correlation has a standard deviation of 1/sqrt(3 n)
    assert found["reliability_trained"] == pytest.approx(1 / (1 + 12e-3), abs=0.005)
    assert abs(found["reliability_averaged"]) < 0.05
    assert mean_reliabilities(SimpleNamespace(cache=SimpleNamespace(queried=None))) == {}


def test_chromaticity_error_sees_colour_and_not_brightness(rng):
    reference = rng.uniform(0.5, 1.0, (4, 5, 3))
    assert measures.chromaticity_error(3.0 * reference, reference) == pytest.approx(0.0, abs=1e-12)
    white, red = np.ones((2, 2, 3)), np.array([1.0, 0.0, 0.0]) * np.ones((2, 2, 3))
    assert measures.chromaticity_error(red, white) == pytest.approx(4 / 3)
    dark = np.vstack([white, 1e-6 * white])
    assert measures.chromaticity_error(np.vstack([white, red]), dark) == 0.0, "what is black is left out"


def test_relative_variance_is_that_of_one_sample(rng):
    images = list(2.0 + 0.5 * rng.standard_normal((400, 8, 8, 3)))  # of 4 samples each
    # 4 Var / mean², with relMSE's 0.01; without the largest of 192 values, which lowers it by 0.1 %
    assert measures.relative_variance(images, 4) == pytest.approx(4 * 0.25 / 4 / 1.01, rel=0.03)


def test_renderer_of_ones_own_learns_the_light_and_notices_a_change(tmp_path):
    settings = fsr.Settings((16, 16), before=24, after=1, truth=128)
    part = fsr.run(Work(tmp_path).group("fsr", settings), settings, 0.01, 0.0, 1.0)
    error = part.numbers["error"]
    assert np.mean(error[20:24]) < 0.25 * np.mean(error[:3]), "the cache learns"
    assert error[24] > 2.0 * np.mean(error[20:24]), "the lamp has moved"
    assert part.arrays["image_0"].shape == (16, 16, 3) and part.numbers["flicker"][0] is None


def test_interrupted_part_goes_on_inside_of_it(tmp_path, monkeypatch):
    """Frames that were rendered are not rendered again, and the result is that without an interruption."""
    settings = fsr.Settings((8, 8), before=6, after=2, truth=64)
    whole = fsr.run(Work(tmp_path / "whole").group("fsr", settings), settings, 0.01, 0.9, 1.0)

    def stop_after(n: int):
        def progress(text):
            def bar(done, total):
                if text.startswith("rate") and done == n:
                    raise KeyboardInterrupt

            return bar

        return progress

    frames, frame = [], fsr.Renderer.frame
    monkeypatch.setattr(fsr.Renderer, "frame", lambda self, seed, *a: (frames.append(seed), frame(self, seed, *a))[1])
    for n in (3, 7):
        with pytest.raises(KeyboardInterrupt):
            fsr.run(Work(tmp_path / "cut", progress=stop_after(n)).group("fsr", settings), settings, 0.01, 0.9, 1.0)
    group = Work(tmp_path / "cut").group("fsr", settings)
    part = fsr.run(group, settings, 0.01, 0.9, 1.0)
    assert frames == list(range(1, 9))
    for name in ("error", "flicker"):
        assert part.numbers[name][1:] == pytest.approx(whole.numbers[name][1:], rel=1e-3), name
    assert part.arrays.keys() == whole.arrays.keys() and len(part.numbers["error"]) == 8
    assert not list(group.folder.glob("*unfinished*"))


def test_damaged_rest_of_an_interrupted_part_is_measured_again(tmp_path):
    unfinished = Work(tmp_path).group("some", {"size": (1, 1)}).unfinished("part")
    assert unfinished.read() is None
    unfinished.keep(lambda: Part({"error": [1.0, None]}, {"image": np.ones(3)}))
    assert not unfinished.path.exists(), "kept too soon"
    unfinished.keep(lambda: Part({"error": [1.0, None]}, {"image": np.ones(3)}), now=True)
    assert unfinished.read().numbers == {"error": [1.0, None]} and unfinished.read().arrays["image"].sum() == 3
    unfinished.path.write_bytes(unfinished.path.read_bytes()[:50])
    assert unfinished.read() is None


def test_quick_entries_are_said_to_take_less_than_two_minutes():
    assert all(0 < quick < 120 and quick < full for quick, full in (e.seconds for e in registry.ENTRIES.values()))
