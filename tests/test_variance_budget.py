"""`studies/variance_budget.py`: shares of the variance by vertex, the command."""

import json

from load_study import load_study

study = load_study("variance_budget")


def test_command_divides_the_variance_of_the_box(tmp_path, capsys):
    """What is made behind a vertex falls with its number; its parts are less than all that is made from there on."""
    assert study.main(["cornell_box", "--size", "16x16", "--vertices", "3", "--pairs", "32",
                       "-o", str(tmp_path / "b.json")]) == 0  # fmt: skip
    found = json.loads((tmp_path / "b.json").read_text())
    first, second, third = found["rows"]
    print(found["variance"], found["rows"])
    assert first["all"] > second["all"] > third["all"] > 0
    assert 0.7 < first["all"] < 1.3  # the place in the pixel makes the rest
    for r in found["rows"]:
        assert r["nee"] > 0 and r["behind"] < r["all"] + 1e-6
    light = first["light_nee"] + first["light_hit"] + first["light_behind"]
    assert 0.4 < light < 0.6  # the other half is the lamp, seen by the camera
    assert study.main(["nowhere"]) == 2 and "no scene file" in capsys.readouterr().err
