"""`studies/gradients.py`: noise times time of gradients, the command."""

import json

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
