"""docs/results.py: numbers of a comparison into a table."""

import json
import shlex
import sys
from itertools import pairwise

import mitsuba as mi
import pytest
from load_study import load_study

from mi_neural import scenes
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.scenes import public


@pytest.fixture(scope="module")
def results(docs_script):
    return docs_script("results")


@pytest.fixture
def table(results):
    """A table of two scenes and two integrators."""
    text = """{"title": "", "commit": "a", "date": "2026-01-01", "machine": "m", "mitsuba": "3", "paths": ["docs"],
        "command": "x", "columns": ["scene", "`path`", "`old`"], "formats": {"2": "{} / {}"},
        "extract": {"values": {"relmse_trimmed": "3g", "flip": ".3f"}, "mode": "one-shot", "denoised": true,
            "rows": [{"scene": "a", "budget_seconds": 2}, {"scene": "b", "budget_seconds": 2}],
            "columns": [null, {"label": "path"}, {"label": "new", "title": "`new`"}]},
        "rows": [["a", [9, 9], ""], {"cells": ["b", [9, 9], ""], "commit": "older"}]}"""
    number = results.Number
    return json.loads(text, parse_float=number, parse_int=number)


def group(scene, label, error, denoised=True, seconds=2.0):
    return {"scene": scene, "label": label, "mode": "one-shot", "budget_seconds": seconds, "denoised": denoised,
            "relmse_trimmed": error, "flip": 0.1}  # fmt: skip


GROUPS = [group("a", "path", 0.12345), group("a", "new", 2e-5), group("b", "path", 1.0), group("b", "new", None)]
ENVIRONMENT = {"mitsuba": "3.9.1", "cores": 2, "cpu": "EPYC"}


def test_numbers_of_a_comparison_fill_the_table(results, table):
    others = [group("a", "path", 7.0, denoised=False), group("a", "path", 8.0, seconds=10.0)]
    results.fill(table, {"groups": [*others, *GROUPS], "environment": ENVIRONMENT}, "abc1234", None)
    assert table["rows"] == [["a", ["0.123", "0.100"], ["2e-05", "0.100"]], ["b", ["1", "0.100"], ""]]
    assert table["columns"] == ["scene", "`path`", "`new`"]
    assert (table["commit"], table["mitsuba"], table["machine"]) == ("abc1234", "3.9.1", "2 cores (EPYC)")
    assert table["date"] > "2026-01-01"


def test_numbers_have_the_digits_that_were_asked_for(results):
    asked = ((0.08999, ".3f", "0.090"), (1234.0, "3g", "1230"), (2e-5, "2g", "2e-05"), (4.5, "2g", "4.5"))
    assert [results._digits(value, digits) for value, digits, _ in asked] == [text for _, _, text in asked]


def test_a_missing_integrator_is_named(results, table):
    with pytest.raises(results.ResultsError, match="0 groups of the comparison have scene a, label new"):
        results.fill(table, {"groups": [GROUPS[0], GROUPS[2]], "environment": ENVIRONMENT}, "abc1234", None)


def test_what_cannot_be_run_says_why(results, table, tmp_path, monkeypatch):
    monkeypatch.setenv("MI_NEURAL_SCENES", str(tmp_path))
    assert results.not_run(table) == ""
    named = {**table, "command": "mi-neural compare veach-ajar sponza-gray/sun sponza-gray/lights32 -o $OUT"}
    assert "type mi-neural scenes get veach-ajar sponza-gray" in results.not_run(named)
    for name in ("veach-ajar/scene", "sponza-gray/sun", "sponza-gray/lights32"):
        file = tmp_path / f"{name}.xml"
        file.parent.mkdir(exist_ok=True)
        file.touch()
    assert results.not_run(named) == ""
    assert "not kept" in results.not_run({**table, "command": None})
    assert "by hand" in results.not_run({k: v for k, v in table.items() if k != "extract"})


def test_extraction_of_every_table_fits_its_rows_and_columns(results):
    found = [results.tables.read(file.stem) for file in results.tables.RESULTS.glob("*.json")]
    found = [table for table in found if "extract" in table]
    assert len(found) >= 5
    for table in found:
        if "fields" in table["extract"]:
            assert len(table["extract"]["fields"]) == len(table["columns"])
            continue
        assert len(table["extract"]["rows"]) == len(table["rows"])
        assert len(table["extract"]["columns"]) == len(table["columns"])
        keys = ("scene", "label", "integrator", "mode", "budget_seconds", "denoised", "threshold", "asked", "width",
                "spp", "frames", "seconds", "why", "setting", "method", "kernels", "values", "as", "title",
                "each")  # fmt: skip
        for part in (*table["extract"]["rows"], *table["extract"]["columns"]):
            assert not set(part or {}) - set(keys)


def test_commands_of_every_table_name_what_exists(results):
    """Scripts, scenes and integrators with their keys; so a run does not fail after hours at the last of them."""
    mi.set_variant("llvm_ad_rgb")
    known, built = {*scenes.names(), *public.names()}, set()
    for file in results.tables.RESULTS.glob("*.json"):
        table = results.tables.read(file.stem)
        extract = table.get("extract", {})
        for words in map(shlex.split, extract.get("commands", [table["command"]] if extract else [])):
            assert words[0] in ("python", "mi-neural"), file.name
            assert words[0] == "mi-neural" or (results.ROOT / words[1]).is_file(), file.name
            built |= {after for word, after in pairwise(words) if word == "-i"}
            named = [word.removesuffix(".xml") for word in words[2:] if "sponza" in word or "veach" in word]
            assert not {word for word in named if not word.startswith("$OUT")} - known, file.name
    assert len(built) > 20
    for text in sorted(built):
        build_integrator(parse_integrator(text))


def test_a_table_of_a_gpu_waits_for_one(results, table, monkeypatch):
    asked = {**table, "extract": {**table["extract"], "needs": "gpu"}}
    monkeypatch.setattr(results, "has_gpu", lambda: True)
    assert results.not_run(asked) == ""
    monkeypatch.setattr(results, "has_gpu", lambda: False)
    assert "NVIDIA GPU" in results.not_run(asked) and results.not_run(table) == ""


def test_a_row_that_is_not_measured_keeps_its_source(results, table):
    table["extract"]["rows"][1] = None
    results.fill(table, {"groups": GROUPS, "environment": ENVIRONMENT}, "abc1234", None)
    kept = table["rows"][1]
    assert kept["cells"] == ["b", ["9", "9"], ""]
    assert (kept["commit"], kept["date"], kept["machine"]) == ("older", "2026-01-01", "m") and "command" not in kept
    assert table["rows"][0] == ["a", ["0.123", "0.100"], ["2e-05", "0.100"]]


def test_cells_are_written_as_the_column_says(results):
    """Texts among the values as they are; a machine that names itself is in the caption."""
    wanted = {"scene": "a", "values": {"ms": ".0f", "split": "3g"}, "as": "{} ({})"}
    found = results.cell(wanted, [{"scene": "a", "ms": 12.7, "split": "4 paths"}])
    assert found == {"values": ["13", "4 paths"], "as": "{} ({})"}
    table = {**of(results, "gpu"), "extract": {"rows": [None] * 7, "columns": [None] * 7}}
    results.fill(table, {"groups": [], "environment": {**ENVIRONMENT, "machine": "one GPU"}}, "abc1234", None)
    assert table["machine"] == "one GPU"


def test_a_command_runs_once_and_is_read(results, table, tmp_path, monkeypatch):
    """The command here writes a report of its own; it fails the second time."""
    code = "import json, pathlib, sys; f = pathlib.Path(sys.argv[1]) / 'results.json'; f.open('x').write('{\"a\": 1}')"
    (tmp_path / "write.py").write_text(code, encoding="utf-8")
    monkeypatch.setattr(results, "OUT", tmp_path / "out")
    monkeypatch.setattr(results, "version", lambda paths: "abc1234")
    asked = {**table, "command": f"{sys.executable} {tmp_path / 'write.py'} $OUT"}
    assert results.run(asked) == {"a": 1} == results.run(asked)
    next((tmp_path / "out").glob("*/done")).unlink()
    with pytest.raises(results.ResultsError, match="status 1; type the same again"):
        results.run(asked)


# ---------------------------------------------------------------- other programs


def of(results, name: str) -> dict:
    """The table of that name; its rows lose their numbers, so that all that is there afterwards was read."""
    found = results.tables.read(name)
    found["rows"] = [[row["cells"][0], *[""] * (len(row["cells"]) - 1)] for row in results.tables.rows(found)]
    return found


def test_gradients_of_the_study_are_read(results, tmp_path):
    """As `studies/gradients.py` writes them, a file a scene; the last scene has no parameters of lamps."""
    for k, scene in enumerate(("cornell-box", "veach-ajar", "living-room")):
        lines = [{"integrator": name, "seconds": 0.1, "bias": 0.01 * n,
                  "efficiency": {"colours": 1.0 + n, "others": 2.0 + k, **({"emitters": 1.44} if k < 2 else {})}}
                 for n, name in enumerate(("prb", "nirc", "nrc", "nirc_two_level"))]  # fmt: skip
        text = json.dumps({"scene": scene, "spp": 8, "lines": lines, "rows": [], "environment": ENVIRONMENT})
        (tmp_path / f"{scene}.json").write_text(text, encoding="utf-8")
    table = of(results, "gradients")
    results.fill(table, results.collected(tmp_path, "*.json", "lines"), "abc1234", None)
    first = ["2.0", "3.0", "4.0"]
    assert table["rows"][1][1:] == [first, ["3.0"] * 3, ["1.4"] * 3, ["0.010", "0.020", "0.030"]]
    assert table["rows"][2][1:] == [first, ["4.0"] * 3, "", ["0.010", "0.020", "0.030"]]


def test_memory_of_gradients_of_the_study_is_read(results, tmp_path):
    """As `studies/gradients.py --memory` writes it, a file a scene."""
    table = of(results, "gradients_memory")
    for k, scene in enumerate(("cornell-box", "living-room")):
        lines = [{"integrator": name, "image": 1.0, "first": 2.0, "gradient": 10.0 * k + n + 0.2}
                 for n, name in enumerate(("prb", "nirc", "nrc", "nirc_two_level"))]  # fmt: skip
        text = json.dumps({"scene": scene, "lines": lines, "environment": ENVIRONMENT})
        (tmp_path / f"{scene}.json").write_text(text, encoding="utf-8")
    results.fill(table, results.collected(tmp_path, "*.json", "lines"), "abc1234", None)
    assert [row[1:] for row in table["rows"]] == [["0", "1", "2", "3"], ["10", "11", "12", "13"]]


def test_figures_of_a_gpu_are_read(results, tmp_path):
    """As `studies/gpu_figures.py` writes them: `path` has no cache, and nothing that its mean is compared with."""
    table = of(results, "gpu")
    rows = [{**row, "first": 0.5604, "frame": 10.04, "sample": 132.7,
             **({} if row["integrator"] == "path" else {"mean": -0.04, "step": 5.43, "query": 0.067})}
            for row in table["extract"]["rows"]]  # fmt: skip
    text = json.dumps({"machine": "one NVIDIA H200", "rows": rows, "environment": ENVIRONMENT})
    (tmp_path / "figures.json").write_text(text, encoding="utf-8")
    results.fill(table, results.collected(tmp_path, "figures.json", "rows"), "abc1234", None)
    assert table["rows"][0][1:] == ["0.56", "10", "133", "", "", ""]
    assert table["rows"][2][1:] == ["0.56", "10", "133", "5.43", "0.07", "-0.04"]


def test_path_lengths_of_the_study_are_read(results, tmp_path):
    """As `studies/path_lengths.py` writes them, a folder a scene; without rays of `nirc` there is no factor."""
    study = load_study("path_lengths")
    for scene in ("sun", "staircase2", "veach-ajar", "cornell-box"):
        points = [study.Point("nrc", 0.0, 0.0, 0.1), study.Point("nrc", 1e-3, 1.0, 0.001),
                  *(study.Point("nirc", c, 100 * c, 0.01) for c in (0.0, 1e-3, 1e-2))]  # fmt: skip
        found = {"scene": scene, "points": [], "factors": study.factors(points), "environment": ENVIRONMENT}
        (tmp_path / scene).mkdir()
        (tmp_path / scene / "results.json").write_text(json.dumps(found), encoding="utf-8")
    table = of(results, "path_lengths")
    results.fill(table, results.collected(tmp_path, "*/results.json", "factors"), "abc1234", None)
    nrc = [["0.00", "0.1"], ["1.00", "0.001"], ["0.50", "1.00"]]
    assert table["rows"][0][2:] == [["0.000", "0.01"], *nrc, ""]
    assert table["rows"][2][2:] == [["1.000", "0.01"], *nrc, ["0.5", "1"]]


def test_errors_asked_for_and_found_are_read(results, tmp_path):
    """As `studies/until_error.py` writes them, a folder a scene."""
    study, table = load_study("until_error"), of(results, "until_error")
    for scene in ("cornell-box", "staircase2", "veach-ajar"):
        images = [study.asdict(study.Image(name, error, 0.0299, 0.04444, 10, 15)) for name in ("path", "neural_path")
                  for error in (0.03, 0.01)]  # fmt: skip
        (tmp_path / scene).mkdir()
        text = json.dumps({"scene": scene, "size": [8, 8], "images": images, "environment": ENVIRONMENT})
        (tmp_path / scene / "results.json").write_text(text, encoding="utf-8")
    results.fill(table, results.collected(tmp_path, "*/results.json", "images"), "abc1234", None)
    assert [row[2:] for row in table["rows"]] == [["0.0299", "0.0444", "10", "15"]] * 7


def test_what_a_plan_saves_is_read(results, tmp_path):
    """As `studies/ablation.py` writes it, several scenes a file."""
    study, table = load_study("ablation"), of(results, "plan")
    modes = (study.EVERYTHING, study.PLANNED, study.EQUAL_TIME)
    parts = {"wide": table["extract"]["rows"][1:7], "square": [table["extract"]["rows"][k] for k in (0, 7)]}
    for folder, rows in parts.items():
        estimates = [{mode: study.Estimate(k + 0.1 * n, 0.0) for n, mode in enumerate(modes)} for k in (1, 2)]
        found = [study.asdict(study.Result(row["scene"], "nirc", {modes[0]: 273.6, modes[1]: 187.2},
                                           study.Estimate(1.634, 0.346), {}, *estimates, {}, ["reliability"]))
                 for row in rows]  # fmt: skip
        (tmp_path / folder).mkdir()
        text = json.dumps({"arguments": {}, "rows": found, "environment": ENVIRONMENT})
        (tmp_path / folder / "ablation.json").write_text(text, encoding="utf-8")
    before = results.tables.rows(results.tables.read("plan"))[7]["cells"]
    results.fill(table, results.collected(tmp_path, "*/ablation.json", "rows"), "abc1234", None)
    assert table["rows"][7][:-1] == [
        before[0], {"values": ["274", "187"], "as": "{} / {}"}, {"values": ["1.63", "0.35"], "as": "{} ± {}"},
        ["1", "2.000"], ["1.1", "2.100"], ["1.2", "2.200"],
    ]  # fmt: skip


def test_efficiencies_of_the_study_are_read(results, tmp_path):
    """As `studies/efficiency.py` writes them, a file a scene."""
    table = of(results, "unbiased")
    labels = [column["integrator"] for column in table["extract"]["columns"][1:]]
    for row in table["extract"]["rows"]:
        rows = [{"integrator": label, "efficiency": 0.234 + n, "statistics": {"split": "path tracing, 4 paths"}}
                for n, label in enumerate(["path", *labels])]  # fmt: skip
        text = json.dumps({"scene": row["scene"], "rows": rows, "environment": ENVIRONMENT})
        (tmp_path / f"{row['scene']}.json").write_text(text, encoding="utf-8")
    results.fill(table, results.collected(tmp_path, "*.json", "rows"), "abc1234", None)
    assert table["rows"][6][1:] == [f"{n + 0.23:.2f}" for n in range(1, 10)]


def test_what_a_frame_costs_is_read(results, tmp_path):
    """As `studies/frame_profile.py` writes it, one record a file; what was measured before stays."""
    study, table = load_study("frame_profile"), results.tables.read("frame_cost")
    before = [row["cells"][:2] for row in results.tables.rows(table)]
    found = {
        "frame": {"spp": 1, "total": 0.05, "train": 0.02, "query": 0.01, "trace": 0.01, "film": 0.0005,
                  "python": 0.0095},
        "memory": 293.2, "query": 43.44, "network": {"ns": 50.7, "gflops": 80.0, "blas_same_shape_gflops": 100.0,
                                                     "blas_square_gflops": 200.0},
        "training": dict.fromkeys(("total", "records", "network", "products", "optimiser", "python",
                                   "us_per_record_step", "us_per_record"), 2.04),
        "first_image": {name: {"first": 9.1, "done": 12.2} for name in ("cold", "warm")},
    }  # fmt: skip
    for width in (320, 1920):
        row = {"scene": "ajar_door", "width": width, "shown": study.shown(found), **found, "environment": ENVIRONMENT}
        if width == 1920:
            del row["first_image"]
        (tmp_path / f"{width}.json").write_text(json.dumps(row), encoding="utf-8")
    results.fill(table, results.collected(tmp_path, "*.json", "."), "abc1234", None)
    assert [row[:2] for row in table["rows"]] == before
    texts = results.tables._cells(table, [row[2] for row in table["rows"]])
    assert texts[0] == "50.0 ms: train 40 %, query 20 %, trace 20 %, film 1.0 %, Python and launches 19.0 % (9.5 ms)"
    assert texts[2] == "2.04 us in the step, 2.04 us with its tracing"
    assert texts[4] == "50.7 ns, 80 GFLOP/s: 80 % of NumPy's product of its shape (100), 40 % of a large one (200)"
    assert texts[5] == "9.1 / 9.1 s; the finished one after 12.2 / 12.2 s"
    assert texts[6] == "293 MiB; 293 MiB at 1920x1080"


def test_a_sequence_is_read(results, tmp_path):
    """As `mi-neural sequence` writes it."""
    table = of(results, "changing_scene")
    fields = ("flip_before", "flip_first", "flip_late", "flip_area", "smape_before", "smape_late")
    cases = [{"label": row["label"], "rows": [{"frame": 0}], "folder": "x",
              "summary": {name: n + k / 10 for k, name in enumerate(fields)} | {"smape_mean": None}}
             for n, row in enumerate(table["extract"]["rows"])]  # fmt: skip
    text = json.dumps({"scene": "sun", "cases": cases, "environment": ENVIRONMENT})
    (tmp_path / "results.json").write_text(text, encoding="utf-8")
    results.fill(table, results.collected(tmp_path, "results.json", "cases"), "abc1234", None)
    assert table["rows"][6][1:] == ["6.000", "6.100", "6.200", "6.3", "6.400", "6.500"]


def test_files_without_what_is_read_are_named(results, table, tmp_path):
    with pytest.raises(results.ResultsError, match=r"no records: there is no \*\.json"):
        results.collected(tmp_path, "*.json", "lines")
    (tmp_path / "a.json").write_text('{"lines": {}}', encoding="utf-8")
    with pytest.raises(results.ResultsError, match=r"a\.json has no list 'lines'"):
        results.collected(tmp_path, "*.json", "lines")
    with pytest.raises(results.ResultsError, match="no group of the comparison has a field flop"):
        results.cell({"scene": "a", "label": "path", "budget_seconds": 2, "values": {"flop": "3g"}}, GROUPS)


def test_records_are_rows_where_fields_are_named(results, table):
    asked = {**table, "columns": ["a", "b"], "extract": {"fields": ["a", "b"]}}
    records = [{"a": "x", "b": 1, "c": 0}, {"a": "x", "b": 2}, {"a": "y", "b": 3}]
    machine = {"cores": 2, "cpu": "c", "mitsuba": "3.9.1"}
    results.fill(asked, {"groups": records, "environment": machine}, "abc1234", None)
    assert asked["rows"] == [["x", "1"], ["", "2"], ["y", "3"]] and asked["commit"] == "abc1234"


def test_commands_of_one_table_run_in_turn(results, table, tmp_path, monkeypatch):
    """The second fails at first; the one before it is not run again."""
    written = '{"r": [{"a": 1}], "environment": {}}'
    code = f"import pathlib, sys; pathlib.Path(sys.argv[1], sys.argv[2]).open('x').write({written!r})"
    (tmp_path / "write.py").write_text(code, encoding="utf-8")
    monkeypatch.setattr(results, "OUT", tmp_path / "out")
    monkeypatch.setattr(results, "version", lambda paths: "abc1234")
    commands = [f"python {tmp_path / 'write.py'} $OUT {name}" for name in ("1.json", "2/2.json")]
    asked = {**table, "extract": {"file": "**/*.json", "records": "r", "commands": commands}}
    with pytest.raises(results.ResultsError, match="status 1"):
        results.run(asked)
    next((tmp_path / "out").iterdir()).joinpath("2").mkdir()
    assert [g["a"] for g in results.run(asked)["groups"]] == [1, 1]
