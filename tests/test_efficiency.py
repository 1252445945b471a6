"""Efficiency: variance times time, one integrator over another."""

import json

import mitsuba as mi
import numpy as np
import pytest
from load_study import load_study

efficiency = load_study("efficiency")


def test_relative_variance_is_that_of_one_sample():
    """Noise of standard deviation 0.5 a sample on a grey of 2: variance 0.25 / (4 + 0.04), for any number of samples.

    40 images of 32x32x3 values: a relative error of 0.4 % of the mean variance, of which 5 are allowed.
    """
    rng = np.random.default_rng(1)
    for spp in (1, 16):
        images = 2 + 0.5 / np.sqrt(spp) * rng.normal(size=(40, 32, 32, 3))
        plain, trimmed = efficiency.relative_variance(images, spp)
        assert plain == pytest.approx(0.25 / 4.04, rel=0.02) and trimmed < plain
    images[:, 0, 0] *= rng.normal(size=(40, 1)) * 100
    assert efficiency.relative_variance(images, spp)[1] == pytest.approx(trimmed, rel=0.05), "fireflies are left out"


def test_command_compares_with_the_first_integrator(tmp_path, capsys):
    file = tmp_path / "facts.json"
    specs = ["path", "plain_path", "nirc_two_level:cache_samples=0"]
    arguments = ["cornell_box", "--size", "16x16", "--spp", "4", "--rounds", "6", "--frames", "0", "-o", str(file)]
    assert efficiency.main([*arguments, *(a for s in specs for a in ("-i", s))]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert [r["integrator"].partition(":")[0] for r in rows] == ["path", "plain_path", "nirc_two_level"]
    assert rows[0]["efficiency"] == rows[0]["efficiency_trimmed"] == 1
    for r in rows:
        expected = rows[0]["variance"] * rows[0]["ns_per_sample"] / (r["variance"] * r["ns_per_sample"])
        assert r["efficiency"] == pytest.approx(expected) and 0.05 < r["mean"] < 1
    assert rows[1]["variance"] == pytest.approx(rows[0]["variance"], rel=0.3)  # 5 degrees of freedom, 768 values
    assert rows[2]["variance"] < rows[0]["variance"], "stratified numbers"
    assert capsys.readouterr().out.count("efficiency") == 3


def test_unknown_scene_is_refused(capsys):
    assert efficiency.main(["no_such_scene", "-i", "path"]) == 2
    assert "no_such_scene" in capsys.readouterr().err and mi.variant() == "llvm_ad_rgb"
