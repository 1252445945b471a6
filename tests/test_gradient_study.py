"""`studies/gradients.py`: noise times time of gradients, the command."""

import json
import subprocess
import sys

import pytest
from load_study import load_study

study = load_study("gradients")
Row = study.Row


def test_efficiency_is_variance_times_time():
    rows = [Row("prb", 2.0, {"a.reflectance.value": 0.4, "lamp.radiance.value": 0.1}, {"a": 0.0, "b": 0.0}, 0.2, -0.1),
            Row("nirc", 1.0, {"a.reflectance.value": 0.1, "lamp.radiance.value": 0.1}, {"a": 0.04, "b": 0.0}, 0.12,
                0.04)]  # fmt: skip
    first, second = study.summary(rows)
    assert first["efficiency"]["all"] == pytest.approx(1) and first["bias"] == 0
    assert second["efficiency"] == pytest.approx({"colours": 8, "emitters": 2, "all": 4})
    assert second["error_1s"] == pytest.approx((0.04 + 0.12) ** 0.5)


def test_command_compares_gradients(tmp_path, capsys):
    file = tmp_path / "facts.json"
    arguments = ["cornell_box", "--size", "12x12", "--spp", "4", "--rounds", "6", "--frames", "32", "--reference", "64",
                 "-i", "prb", "-i", "nrc:train_samples=512", "-o", str(file)]  # fmt: skip
    assert study.main(arguments) == 0
    found = json.loads(file.read_text())
    lines = {line["integrator"].partition(":")[0]: line for line in found["lines"]}
    print(lines)
    assert lines["prb"]["efficiency"]["all"] == pytest.approx(1) and lines["nrc"]["efficiency"]["colours"] > 0.5
    assert lines["nrc"]["bias"] < 0.1 and lines["prb"]["bias"] < 0.05
    assert "efficiency" in capsys.readouterr().out
    assert study.main(["nowhere", *arguments[1:]]) == 2 and "no scene file" in capsys.readouterr().err


def memory_of(tmp_path, *integrators: str) -> list:
    file = tmp_path / "memory.json"
    words = [word for text in integrators for word in ("-i", text)]
    assert study.main(["cornell_box", "--memory", "--size", "8x8", "--spp", "1", "--frames", "1", "-o", str(file),
                       *words]) == 0  # fmt: skip
    return json.loads(file.read_text())["lines"]


def test_memory_of_a_gradient_is_measured(tmp_path, capsys):
    (line,) = memory_of(tmp_path, "prb")
    assert line["integrator"] == "prb" and 0 <= line["gradient"] < 500
    assert "prb: gradient" in capsys.readouterr().out


@pytest.mark.slow
def test_memory_of_gradients_is_measured_in_processes_of_their_own(tmp_path):
    lines = memory_of(tmp_path, "prb", "nirc_two_level")
    assert [line["integrator"] for line in lines] == ["prb", "nirc_two_level"]
    assert all(0 <= line["gradient"] < 500 for line in lines)
    assert study.main(["cornell_box", "--memory", "-i", "no_such_plugin", "-i", "prb"]) == 2


@pytest.mark.slow
def test_a_gradient_takes_no_more_memory_with_more_samples(tmp_path):
    """With a box filter. One colour for each sample would be 12 MiB more."""
    peaks = {}
    for spp in (1, 16):
        file = tmp_path / f"{spp}.json"
        keys = ["--size", "256x256", "--frames", "4", "--max-depth", "6", "-i", "nirc:train_samples=512"]
        command = [sys.executable, study.__file__, "cornell_box", "--memory", "--spp", str(spp), *keys, "-o", str(file)]
        subprocess.run(command, check=True)
        peaks[spp] = json.loads(file.read_text())["lines"][0]["gradient"]
    print(peaks)
    assert peaks[16] < peaks[1] + 6
