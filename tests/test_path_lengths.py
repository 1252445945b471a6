"""`studies/path_lengths.py`: rays at equal bias, the command."""

import json

import numpy as np
import pytest
from load_study import load_study

from mi_neural.image import exr

path_lengths = load_study("path_lengths")
Point, factors = path_lengths.Point, path_lengths.factors


def test_factor_is_the_rays_of_nrc_at_the_bias_of_nirc():
    points = [Point("nrc", 0, 0.0, 0.1), Point("nrc", 1, 1.0, 0.01), Point("nrc", 2, 2.0, 0.02),
              Point("nrc", 3, 3.0, 0.001),
              Point("nirc", 0, 0.1, 10**-1.5), Point("nirc", 1, 0.2, 1e-4), Point("nirc", 2, 0.5, 0.5),
              Point("nirc", 3, 0.0, 0.01)]  # fmt: skip
    found = factors(points)
    assert found[0]["rays_nrc"] == pytest.approx(0.5) and found[0]["factor"] == pytest.approx(5)
    assert found[0]["rays_nrc_measured"] == 1
    assert found[1]["rays_nrc"] is None and found[1]["factor"] is None, "out of reach"
    assert found[2]["rays_nrc"] == 0 and found[2]["factor"] == 0
    assert found[3]["rays_nrc"] == pytest.approx(1) and found[3]["factor"] is None, "no ray at all"


def test_command_measures_both_caches(tmp_path, capsys):
    """The point-lit sphere, where the image is 1: paths grow longer with the threshold, and the bias is small."""
    exr.write(tmp_path / "reference.exr", np.ones((8, 8, 3), np.float32))
    arguments = ["point_lit_sphere", "--reference", str(tmp_path / "reference.exr"), "--frames", "8", "--samples", "8",
                 "--thresholds", "1e4", "-o", str(tmp_path / "out")]  # fmt: skip
    assert path_lengths.main(arguments) == 0
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    rays = {(p["integrator"], p["threshold"]): p["rays"] for p in results["points"]}
    print(rays)
    assert rays["nrc", 0] == rays["nirc", 0] == 0
    assert rays["nrc", 1e4] > 1 and rays["nirc", 1e4] > 1
    assert all(abs(p["bias"]) < 0.1 for p in results["points"])
    assert (tmp_path / "out" / "curves.png").stat().st_size > 1000
    assert path_lengths.main(["nowhere", *arguments[1:]]) == 2 and "no scene file" in capsys.readouterr().err
