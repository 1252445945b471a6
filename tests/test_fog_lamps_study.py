"""studies/fog_lamps.py and the halls of fog of studies/many_lamps.py."""

import json

import mitsuba as mi
import numpy as np
import pytest
from load_study import load_study


def test_hall_is_full_of_fog_and_the_camera_is_in_it():
    many = load_study("many_lamps")
    scene = mi.load_string(many.scene_xml(12, 0.2), resx=16, resy=9)
    assert scene.sensors()[0].get_medium() is not None
    foggy, clear = (np.array(mi.render(s, integrator=mi.load_dict({"type": "plain_path", "max_depth": 4}), spp=64))
                    for s in (scene, mi.load_string(many.scene_xml(12), resx=16, resy=9)))  # fmt: skip
    assert np.isfinite(foggy).all() and foggy.mean() > 0
    assert abs(foggy.mean() / clear.mean() - 1) > 0.05
    with pytest.raises(SystemExit):
        many.main(["4", "hall.xml", "--fog", "-1"])


def test_records_of_the_study(tmp_path):
    study = load_study("fog_lamps")
    study.main(["--lamps", "4", "--method", "tree_lights", "--size", "8", "8", "--spp", "4", "--repeats", "3",
                "-o", str(tmp_path)])  # fmt: skip
    records = json.loads((tmp_path / "fog_lamps.json").read_text())["methods"]
    assert [r["label"] for r in records] == ["volpath", "tree_lights"]
    assert records[0]["gain_trimmed"] == 1 and all(r["nonfinite"] == 0 and r["variance"] > 0 for r in records)
