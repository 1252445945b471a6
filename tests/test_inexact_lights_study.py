"""`studies/inexact_lights.py`: errors by reason, with a few samples."""

import pytest
import test_inexact_lights
from load_study import load_study


@pytest.mark.filterwarnings("ignore")
def test_errors_of_path_are_found_and_ours_are_not(monkeypatch):
    lamps = {name: (lamp, why) for name, (lamp, why) in test_inexact_lights.WRONG.items()
             if why in ("a mesh attribute", "a mesh with bent normals")}  # fmt: skip
    monkeypatch.setattr(test_inexact_lights, "WRONG", lamps)
    found = {r["why"]: r for r in load_study("inexact_lights").measure(images=4, spp=16)}
    print(found)
    attribute = found["a mesh attribute"]
    assert attribute["most"] < -90 and attribute["lamps"] == 2
    assert attribute["ours"] < 5 * attribute["standard_error"] + 1
    assert found["a mesh with bent normals"]["least"] < -20
