"""Several scenes and repeats in one comparison: which scenes, what the repeats say, going on after an interruption."""

import json
import math
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from fake_cache import register
from scipy import stats
from typer.testing import CliRunner

from mi_neural import scenes
from mi_neural.bench import benchmark, collection, curves, judging, kept, load, reference, repeats, report, suite
from mi_neural.bench.specs import parse_integrator
from mi_neural.cli import app
from mi_neural.image import exr, metrics

SCENE = """<scene version="3.0.0">
    <default name="level" value="1"/>
    <integrator type="path"/>
    <sensor type="perspective"> <film type="hdrfilm"> <integer name="width" value="{width}"/>
        <integer name="height" value="{height}"/> <rfilter type="box"/> </film> </sensor>
    <shape type="sphere"> <point name="center" x="0" y="0" z="4"/> </shape>
    <emitter type="constant"> <rgb name="radiance" value="$level"/> </emitter>
</scene>"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> Path:
    """A folder of two scenes, one of them with a reference beside it, and the current one."""
    register()
    monkeypatch.chdir(tmp_path)
    for name, (width, height) in {"scenes/ball/scene.xml": (12, 8), "scenes/moon.xml": (8, 8)}.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(SCENE.format(width=width, height=height))
    return tmp_path


def compare(*arguments: object, code: int = 0, of: tuple[str, ...] = ("--scenes", "scenes")) -> str:
    common = ["compare", *of, "--reference-cache", "references", "-o", "out"]
    result = CliRunner().invoke(app, [*common, *map(str, arguments)])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def results() -> dict:
    return json.loads(Path("out/results.json").read_text())


# ---------------------------------------------------------------- which scenes


def test_scenes_of_a_folder_are_found_without_what_they_include(folder):
    Path("scenes/ball/parts.xml").write_text('<scene version="3.0.0"/>')
    Path("scenes/ball/scene.xml").write_text('<scene version="3.0.0"> <include filename="parts.xml"/> </scene>')
    Path("scenes/notes.xml").write_text("<notes/>")
    found = collection.scenes_in(Path("scenes"))
    assert [str(f.relative_to(folder / "scenes")) for f in found] == ["ball/scene.xml", "moon.xml"]


def test_scenes_are_taken_once_and_named_apart(folder):
    moon = folder / "scenes/moon.xml"
    assert collection.choose([str(moon), "lit_cube"], Path("scenes"))[0] == moon
    assert len(collection.choose([str(moon), "lit_cube"], Path("scenes"))) == 3
    files = [Path("a/scene.xml"), Path("b/a.xml"), Path("c/d.xml")]
    assert collection.titles(files) == ["a_1", "a_2", "d"]
    files = [Path("a/room.xml"), Path("b/room.xml"), Path("room_1.xml")]
    assert collection.titles(files) == ["room_2", "room_3", "room_1"]
    files += [Path("Room.xml"), Path("a/room_1/scene.xml")]
    assert len({title.casefold() for title in collection.titles(files)}) == len(files)


# ---------------------------------------------------------------- what repeats say


@pytest.mark.parametrize("n", [2, 3, 10, 21, 22, 60])
def test_intervals_are_students(n, rng):
    values = rng.standard_normal(n)
    expected = stats.t.ppf(0.975, n - 1) * values.std(ddof=1) / math.sqrt(n)
    assert repeats.half_width(values) == pytest.approx(expected, rel=2e-4)
    assert repeats.half_width(values[:1]) is None


def test_intervals_cover_as_often_as_they_say(rng):
    """95 % of 2000 intervals, to 4 standard deviations of a binomial: one failure in 16,000."""
    held = sum(abs(x.mean()) <= repeats.half_width(x) for x in rng.standard_normal((2000, 4)))
    assert abs(held - 1900) < 4 * math.sqrt(2000 * 0.95 * 0.05)


def row(**values) -> benchmark.Row:
    facts = {
        "scene": "s", "integrator": "path", "label": "path", "parameters": {}, "size": [4, 4], "seed": 0,
        "mode": "one-shot", "frames": 1, "denoised": False, "spp": 1, "seconds_compile": 0.0, "seconds_train": 0.0,
        "seconds_render": 1.0, "seconds_denoise": 0.0, "seconds_total": 1.0, "ns_per_sample": 1.0,
        "ns_per_query": None, "records": None, "queries": None, "mean": 1.0, "nonfinite": 0, "budget_seconds": 1.0,
    }  # fmt: skip
    return benchmark.Row(**(facts | values))


def test_rows_that_differ_by_their_repeat_alone_are_one_line():
    rows = [row(repeat=k, relmse_trimmed=x) for k, x in enumerate((0.1, 0.2, 0.3))]
    rows += [row(denoised=True, relmse_trimmed=0.01), row(mode="curve", relmse_trimmed=1.0), row(scene="t")]
    groups = repeats.group(rows)
    assert [len(g.rows) for g in groups] == [3, 1, 1]
    assert groups[0].mean("relmse_trimmed") == pytest.approx(0.2)
    head, first, *_ = report.table(groups)
    half = 4.3027 * 0.1 / math.sqrt(3)
    assert first[head.index("relMSE trimmed")] == f"0.2 ± {half:.2g}" and "mode" not in head
    assert groups[1].half_width("relmse_trimmed") is None


def test_bias_and_variance_of_a_group_are_told_apart(rng):
    known = reference.Reference(np.ones((40, 40, 3), np.float32), None, {}, None)
    images = {k: 1.2 + 0.5 * rng.standard_normal((40, 40, 3)) for k in range(5)}
    (group,) = repeats.group(row(repeat=k) for k in images)
    repeats.tell_apart(group, lambda row: images[row.repeat], known)
    expected = 0.04 / 1.01
    assert abs(group.squared_bias - expected) < 4 * group.squared_bias_error < 0.4 * expected
    assert group.variance == pytest.approx(0.25 / 1.01, rel=0.05)
    whole = np.mean([metrics.relmse(i, known.rgb) for i in images.values()])
    assert group.squared_bias + group.variance == pytest.approx(whole, rel=0.02)  # but for the trimming
    without_noise = group.squared_bias_error
    noisy = reference.Reference(known.rgb, np.full((40, 40, 3), 0.5, np.float32), {}, None)
    repeats.tell_apart(group, lambda row: images[row.repeat], noisy)
    of_reference = math.sqrt(2) * 0.5 / 1.01 / math.sqrt(4800)
    assert group.squared_bias_error == pytest.approx(math.hypot(without_noise, of_reference), rel=0.05)
    (single,) = repeats.group([row()])
    repeats.tell_apart(single, lambda row: images[0], known)
    assert single.squared_bias is single.variance is None


def test_factor_is_a_geometric_mean_over_scenes():
    scenes = []
    for name, first, second in (("a", 1.0, 0.5), ("b", 8.0, 1.0)):
        rows = [row(scene=name, relmse_trimmed=first, flip=0.1), row(scene=name, label="nirc", relmse_trimmed=second)]
        scenes.append(report.SceneResult(name, (4, 4), rows, repeats.group(rows), None))
    ((title, cells),) = report.summary(report.Report("", {}, scenes))
    assert title == "one-shot 1 s" and cells[0] == ["integrator", "a", "b", "factor"]
    assert [line[-1] for line in cells[1:]] == ["1", "4"]
    assert cells[1][1] == "1 / 0.1"
    scenes[0].groups.pop()  # as if interrupted
    ((_, cells),) = report.summary(report.Report("", {}, scenes))
    assert cells[2] == ["nirc", "", "1 / ", ""]


def test_curves_are_means_over_repeats_at_each_budget_and_sample_count():
    rows = [row(repeat=k, seconds_total=1.0 + 0.1 * k, relmse_trimmed=0.1 + 0.2 * k) for k in range(2)]
    assert curves.line(rows, "seconds_total", "relmse_trimmed") == [pytest.approx((1.05, 0.2, 0.1, 0.3))]
    rows = [row(mode="curve", spp=n, relmse_trimmed=1 / n) for n in (4, 1, 2)]
    assert [p[:2] for p in curves.line(rows, "spp", "relmse_trimmed")] == [(1, 1), (2, 0.5), (4, 0.25)]
    assert curves.svg(rows, ("steady",)) is None and "<svg" in curves.svg(rows, ("curve",))


def test_another_seed_learns_by_other_numbers():
    def loss(integrator) -> float:
        return integrator.train(sphere, 3)["loss"]

    small = {"type": "nirc", "train_samples": 512}
    sphere = mi.load_file(str(scenes.path("point_lit_sphere")), resx=16, resy=16)
    integrator = mi.load_dict({**small, "light_sampler": {"type": "nvc_lights"}})
    first = loss(integrator)
    integrator.reseed(7)
    assert integrator.cache.steps == 0 and integrator.light_sampler.cache.seed == 7
    other = loss(integrator)
    integrator.reseed(0)
    assert loss(integrator) == pytest.approx(first, rel=1e-3) != pytest.approx(other, rel=1e-2)
    assert loss(mi.load_dict({**small, "seed": 7})) == pytest.approx(other, rel=1e-3), "as if it had been given by key"


# ---------------------------------------------------------------- the command

MOON = ("scenes/moon.xml",)
QUICK = ("-i", "path:max_depth=2", "-i", "fake_cache:fraction=0.2,max_depth=2", "--seconds", "0.03", "--reference-spp",
         "64", "--repeats", "3")  # fmt: skip


def test_scenes_and_repeats_end_in_one_report():
    said = compare(*QUICK, "-D", "level=2", "--size", "10x6,6x6")
    assert "one-shot 0.03 s" in said and "confidence interval" in said
    found = results()
    assert [(s["scene"], s["size"]) for s in found["scenes"]] == [("ball", [10, 6]), ("moon", [6, 6])]
    assert all(s["reference"]["standard_error"] >= 0 for s in found["scenes"])
    rows = [r for r in found["rows"] if r["mode"] == "one-shot"]
    assert len(rows) == 2 * 2 * 3 and len({(r["scene"], r["image"]) for r in rows}) == len(rows)
    assert {r["seed"] for r in rows} == {k * benchmark.SEED_STEP for k in range(3)}
    for r in rows:
        image = exr.read(Path("out") / r["scene"] / r["image"])
        assert image.metadata["repeat"] == r["repeat"] and r["mean"] == pytest.approx(image.rgb.mean(), rel=1e-4)
    groups = [g for g in found["groups"] if g["mode"] == "one-shot"]
    assert len(groups) == 4 and all(g["repeats"] == 3 for g in groups)
    of_cache = [g for g in groups if g["label"].startswith("fake")]
    assert all(g["spp_half_width"] is not None and g["flip"] > 0 for g in of_cache)
    # 9 % too bright; how many samples fit into the time, and with them the interval, is the machine's affair
    assert all(g["squared_bias_error"] > 0 for g in of_cache)
    assert np.mean([g["squared_bias"] for g in of_cache]) == pytest.approx(0.09**2, rel=0.8)
    page = Path("out/report.html").read_text()
    assert all(text in page for text in ('href="#summary"', 'href="#scene-1"', 'id="viewer-1"', "standard error"))
    assert not list(Path("out").rglob("rows.jsonl")) and len(list(Path("references").glob("*.exr"))) == 2


def test_repeats_are_independent_and_train_by_their_own_seeds(monkeypatch):
    seeds = []
    loaded = load.load_scene("scenes/moon.xml", (6, 6))
    (case,) = benchmark.make_cases(loaded, [parse_integrator("fake_cache")])
    case.integrator.reseed = lambda seed: (seeds.append(seed), case.integrator.reset())
    assert isinstance(case.integrator, mi.Integrator)
    found = []
    benchmark.Bench(loaded, None, None, {}, found.append).run([case], benchmark.Plan([0.01], repeats=3, seed=5))
    assert seeds == [5 + benchmark.SEED_STEP, 5 + 2 * benchmark.SEED_STEP]
    images = [p.rgb for p in found]
    assert len(images) == 3 and not any(np.allclose(images[0], i) for i in images[1:])


def test_reference_beside_a_scene_is_used_unless_another_is_asked_for():
    exr.write("scenes/moon_reference_6x6.exr", np.full((6, 6, 3), 7.0))
    quick = ("-i", "path:max_depth=2", "--seconds", "0.01", "--size", "6x6")
    compare(*quick)
    paths = {s["scene"]: s["reference"]["path"] for s in results()["scenes"]}
    assert paths["moon"].endswith("moon_reference_6x6.exr") and paths["ball"].startswith("references")
    compare(*quick, "--reference-spp", 32)
    assert all(s["reference"]["path"].startswith("references") for s in results()["scenes"])


def test_what_cannot_be_rendered_is_left_out_and_the_others_go_on():
    Path("scenes/broken.xml").write_text('<scene version="3.0.0"> <shape type="nonsense"/> </scene>')
    said = compare(*QUICK[:2], "-i", "fake_cache:fail=true", "--seconds", "0.01", "--reference-spp", 16)
    found = results()
    assert [s["scene"] for s in found["scenes"]] == ["ball", "moon"] and "broken is left out" in said
    assert {r["label"] for r in found["rows"]} == {"path:max_depth=2"}
    assert sum("fake_cache:fail=true on" in note for note in found["notes"]) == 2


def test_interrupted_comparison_of_scenes_goes_on(monkeypatch):
    measure, n = suite.benchmark.Bench.one_shot, [0]

    def stop(self, *arguments):
        n[0] += 1
        if n[0] == 8:  # the second repeat of the first integrator on the second scene
            raise KeyboardInterrupt
        measure(self, *arguments)

    monkeypatch.setattr(suite.benchmark.Bench, "one_shot", stop)
    assert "goes on from here" in compare(*QUICK, code=130)
    before = results()
    rows = [(r["scene"], r["label"], r["repeat"], r["seconds_total"]) for r in before["rows"]
            if r["mode"] == "one-shot"]  # fmt: skip
    assert len(rows) == 7 and "Interrupted" in Path("out/report.html").read_text()
    said = compare(*QUICK)
    assert "rows are there already" in said and n[0] == 8 + 5
    after = [(r["scene"], r["label"], r["repeat"], r["seconds_total"]) for r in results()["rows"]
             if r["mode"] == "one-shot"]  # fmt: skip
    assert after[:7] == rows and len(after) == 12
    curve = [(r["scene"], r["label"], r["repeat"], r["spp"]) for r in results()["rows"] if r["mode"] == "curve"]
    assert len(set(curve)) == len(curve) and {c[:3] for c in curve} == {r[:3] for r in after}
    assert not list(Path("out").rglob("rows.jsonl"))


def test_recalled_row_costs_one_map(monkeypatch, tmp_path, rng):
    """Its errors are on disk, and no map is shown against the denoised reference."""
    made = row(image="path.exr")
    image, known = rng.random((6, 8, 3)).astype(np.float32), rng.random((3, 4, 3)).astype(np.float32)
    exr.write(tmp_path / "path.exr", image)
    there = kept.Kept(tmp_path, {})
    there.add(made)
    pair = reference.Reference(known, None, {}, None, known)
    expected = judging.judge(SimpleNamespace(), [exr.read(tmp_path / "path.exr").rgb], pair)
    n, flip = [], metrics.flip
    monkeypatch.setattr(metrics, "flip", lambda *args: n.append(1) or flip(*args))
    monkeypatch.setattr(metrics, "relmse", None)
    key = (made.label, made.mode, made.budget_seconds, made.denoised, made.repeat)
    (found,) = there.pictures([key], pair, None)
    assert len(n) == 1 and found.row is made and np.array_equal(found.rgb, exr.read(tmp_path / "path.exr").rgb)
    assert np.array_equal(found.flip_map, expected)
    (found,) = there.pictures([key], None, None)
    assert len(n) == 1 and found.flip_map is None


# ---------------------------------------------------------------- images made elsewhere


def test_images_made_elsewhere_stand_beside_ours():
    exr.write("moon_reference.exr", np.full((6, 6, 3), 2.0))
    exr.write("flat.exr", np.full((12, 12, 3), 1.0))  # twice the film's size: averaged
    said = compare("--reference", "moon_reference.exr", *QUICK[:4], "--seconds", "0.03", "--size", "6x6",
                   "--image", "Other=flat.exr,seconds=0.03,spp=9", "--image", "Other=flat.exr,seconds=0.03",
                   "--image", "Cleaned=flat.exr,seconds=4,denoised=true", of=MOON)  # fmt: skip
    assert "Other" in said and "Cleaned + denoiser" in said
    found = results()
    rows = {(r["label"], r["repeat"]): r for r in found["rows"] if r["mode"] == "one-shot"}
    other = rows["Other", 0]
    assert other["relmse"] == pytest.approx(1.0 / 4.04, rel=1e-4), "(1 - 2)² / (2² + 1 % of the mean's square)"
    assert other["budget_seconds"] == other["seconds_total"] == 0.03 and other["spp"] == 9
    assert other["ns_per_sample"] == pytest.approx(0.03e9 / (9 * 36)) and rows["Other", 1]["spp"] is None
    assert rows["Cleaned", 0]["denoised"] and rows["Cleaned", 0]["budget_seconds"] == 4
    assert exr.read(Path("out") / other["image"]).rgb.shape == (6, 6, 3)
    labels = [g["label"] for g in found["groups"]]
    assert labels[-2:] == ["Other", "Cleaned"] and labels[0] == "path:max_depth=2", "factors are against ours"
    page = Path("out/report.html").read_text()
    assert "Other, one-shot 0.03 s" in page and "Cleaned + denoiser, one-shot 4 s" in page
    assert "Other" in Path("out/table.md").read_text() and "Other" in Path("out/curves_one-shot.svg").read_text()


def test_images_made_elsewhere_say_which_of_several_scenes_they_show():
    exr.write("flat.exr", np.full((8, 8, 3), 1.0))
    quick = ("-i", "path:max_depth=2", "--seconds", "0.01", "--reference-spp", "16", "--image")
    compare(*quick, "Other=flat.exr,seconds=1,scene=moon")
    assert [r["scene"] for r in results()["rows"] if r["label"] == "Other"] == ["moon"]
    for typed, expected in (
        ("Other=flat.exr,seconds=1", "add scene=NAME, one of ball, moon"),
        ("Other=flat.exr,seconds=1,scene=sun", "no scene 'sun' here; there is ball, moon"),
        ("Other=flat.exr", "--image takes NAME=FILE.exr,seconds=T"),
        ("flat.exr,seconds=1", "--image takes NAME=FILE.exr,seconds=T"),
        ("Other=flat.exr,seconds=1,sampels=3", "--image takes NAME=FILE.exr,seconds=T"),
        ("Other=flat.exr,seconds=-1", "seconds must be a number greater than 0"),
        ("Other=flat.exr,seconds=1,denoised=yes", "denoised is true or false, got 'yes'"),
        ("Other=none.exr,seconds=1", "no such image: none.exr"),
    ):
        assert expected in compare(*quick, typed, code=2).replace("\n", " ")


def test_integrators_and_images_whose_files_would_have_one_name_are_refused():
    """They were one row with an interval of confidence of width 0."""
    exr.write("flat.exr", np.full((8, 8, 3), 1.0))
    more = {"-i": "path:max_depth=2", "--image": "path_max_depth-2=flat.exr,seconds=1"}
    for option, typed in more.items():
        said = compare("-i", "path:max_depth=2", "--seconds", "0.01", option, typed, of=MOON, code=2)
        assert "would share the files path_max_depth-2" in said.replace("\n", " ")


def test_image_made_elsewhere_of_another_size_is_refused():
    exr.write("wide.exr", np.full((5, 9, 3), 1.0))
    Path("other.exr").write_text("no image")
    quick = ("-i", "path:max_depth=2", "--seconds", "0.01", "--reference-spp", "16", "--image")
    said = compare(*quick, "Other=wide.exr,seconds=1", code=2, of=MOON)
    assert "wide.exr is 9x5, the film 8x8: add --size 9x5" in said and "reference" not in said, "before any work"
    said = compare(*quick, "Other=other.exr,seconds=1", code=2, of=MOON)
    assert "not a readable EXR image" in said and "reference" not in said
