"""The matrix of hard cases in short: a few cases by a few integrators, which share kernels. `make stress` runs all.

A correct unbiased integrator fails one cell in 10,000 choices of seed (`stress.ERROR_RATE`).
"""

import dataclasses
import json
import re

import numpy as np
import pytest
import stress
from cheap import NETWORK, sweep
from hard_cases import CASES, Case, room

SHORT = ("radiance 1e-6", "radiance 1e6", "far from the origin", "lights off", "albedo 1", "NaN in a texture")
INTEGRATORS = ("plain_path", "nirc", "nirc_two_level")
#: Of the default run: each case by one integrator.
CELLS = [("radiance 1e-6", "nirc"), ("radiance 1e6", "nirc_two_level"), ("far from the origin", "nirc"),
         ("lights off", "nirc_two_level"), ("albedo 1", "nirc_two_level"),
         ("NaN in a texture", "plain_path")]  # fmt: skip
REFUSED = [name for name, case in CASES.items() if case.refusal]


@pytest.fixture(scope="module")
def references():
    """Facts of Mitsuba's `path`, by case; each is measured when it is first asked for."""
    found = {}

    def of(name):
        if name not in found:
            found[name] = stress.cell(CASES[name], stress.REFERENCES["path"], 16, known=True)
        return found[name]

    return of


@pytest.fixture(scope="module")
def integrators():
    """Integrators that meet all scenes one after the other."""
    import mitsuba as mi

    small = {"train_samples": 512, "train_frames": 48, **NETWORK}
    keys = {name: stress.ENTRANTS[name].keys for name in INTEGRATORS}
    return {name: mi.load_dict(k | small if "train_frames" in k else k) for name, k in keys.items()}


@pytest.mark.parametrize("case, name", sweep([(case, name) for case in SHORT for name in INTEGRATORS], CELLS))
def test_image_of_a_hard_case_is_finite_and_as_bright_as_it_must_be(case, name, references, integrators):
    entrant = stress.ENTRANTS[name]
    found = stress.cell(CASES[case], entrant, 8, integrator=integrators[name])
    ok, text = stress.judge(found, references(case), entrant, None)
    print(f"{case}, {name}: {text}, {found['nonfinite']} non-finite samples left out")
    assert ok, text


@pytest.mark.parametrize("name", ["plain_path", "nvc_direct", "restir_di", "nirc", "nrc", "nirc_two_level"])
def test_what_cannot_be_rendered_is_refused_in_one_line_by_every_integrator(name):
    for case in REFUSED:
        if stress.ENTRANTS[name].refusal(CASES[case]) is None:
            continue
        found = stress.cell(CASES[case], stress.ENTRANTS[name], 1)
        assert CASES[case].refusal in found.get("refused", "an image"), case
        assert "\n" not in found["refused"] and len(found["refused"]) < 300


@pytest.mark.parametrize("case", sweep(
    [name for name, case in CASES.items() if case.media], ["thin medium", "thick medium"]
))  # fmt: skip
def test_plain_path_renders_the_media_that_others_refuse(case, integrators):
    entrant = stress.ENTRANTS["plain_path"]
    known = stress.cell(CASES[case], stress.REFERENCES["volpath"], 8, known=True)
    found = stress.cell(CASES[case], entrant, 8, integrator=integrators["plain_path"])
    ok, text = stress.judge(found, known, entrant, entrant.refusal(CASES[case]))
    print(f"{case}: {text}")
    assert ok, text


def test_recordings_of_scenes_that_are_gone_are_not_kept(integrators):
    """An integrator that meets one scene after another holds what it recorded for the last alone."""
    nirc = integrators["nirc"]
    for _ in range(3):
        stress.cell(CASES["room"], stress.ENTRANTS["nirc"], 1, integrator=nirc)
    assert max(nirc.cache.recordings().values()) <= 3
    assert len(nirc.film_state.passes.recorded) == 1


# ---------------------------------------------------------------- the judge


def facts(mean=1.0, spread=0.01, n=8, **more):
    rng = np.random.default_rng(0)
    means = mean + spread * rng.normal(size=n)
    return {"means": list(means - means.mean() + mean), "bad_pixels": 0, "nonfinite": 0, "loss": None, **more}


@pytest.mark.parametrize("found, says", [
    (facts(1.05), "OFF BY"), (facts(bad_pixels=1), "BAD PIXELS"), (facts(loss=[0.5, 50.0]), "LOSS"),
    (facts(loss=[0.5, float("nan")]), "LOSS"), ({"refused": "no"}, "REFUSED"), ({"crashed": "signal 11"}, "CRASH"),
])  # fmt: skip
def test_judge_sees_what_is_wrong(found, says):
    ok, text = stress.judge(found, facts(), stress.ENTRANTS["plain_path"], None)
    assert not ok and says in text


def test_judge_passes_what_is_right_and_allows_a_bias_only_where_it_says_so():
    plain, nirc = stress.ENTRANTS["plain_path"], stress.ENTRANTS["nirc"]
    assert stress.judge(facts(1.001), facts(), plain, None)[0]
    assert stress.judge(facts(1.05), facts(), nirc, None) == (True, "+5.0%")
    assert not stress.judge(facts(1.3), facts(), nirc, None)[0]
    assert stress.judge({"refused": "it has no emitter"}, None, plain, "no emitter") == (True, "refused")
    assert not stress.judge(facts(), None, plain, "no emitter")[0]
    assert not stress.judge({"refused": "no time"}, None, plain, "no emitter")[0]


def test_judge_takes_black_for_black():
    black = facts(0.0, 0.0)
    assert stress.judge(black, black, stress.ENTRANTS["plain_path"], None)[0]
    assert not stress.judge(facts(1e-12, 0.0), black, stress.ENTRANTS["nirc"], None)[0]


def test_table_of_the_documentation_names_every_case_and_integrator(root):
    lines = (root / "tests" / "README.md").read_text().splitlines()
    rows = {line.split("|")[1].strip(): line for line in lines if line.startswith("|")}
    assert set(CASES) <= set(rows)
    assert re.findall("`([^`]+)`", rows[""]) == list(stress.ENTRANTS)


def test_a_process_that_ends_is_a_cell_of_the_table(tmp_path, monkeypatch):
    """The second of three cells kills its process; the others are measured all the same."""
    worker = tmp_path / "worker.py"
    worker.write_text(
        "import json, os, sys\n"
        "for case in sys.argv[sys.argv.index('--case') + 1 :]:\n"
        "    if case == 'b': os.kill(os.getpid(), 11)\n"
        "    print(json.dumps({'integrator': 'x', 'case': case}), flush=True)\n"
    )
    monkeypatch.setattr(stress, "__file__", str(worker))
    stress.run("x", ["a", "b", "c"], tmp_path / "results.jsonl")
    rows = [json.loads(line) for line in (tmp_path / "results.jsonl").read_text().splitlines()]
    assert [r["case"] for r in rows] == ["a", "b", "c"] and rows[1]["crashed"] == "signal 11"


def test_cases_are_frozen_and_their_names_fit_a_table():
    assert all("|" not in name for name in CASES)
    with pytest.raises(dataclasses.FrozenInstanceError):
        Case(room()).spp = 3
