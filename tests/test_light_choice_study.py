"""`studies/light_choice.py`: the command on films of a few pixels, and its ratios."""

import json

from load_study import load_study

study = load_study("light_choice")


def test_command_compares_and_goes_by_the_ratio_within_a_repeat(tmp_path, capsys, variant):
    arguments = ["--lamps", "20", "--size", "16x9", "--seconds", "0.1", "--steady", "0", "--repeats", "2",
                 "--reference-spp", "16", "-i", "plain_path:light_sampler.type=power_lights",
                 "-i", study.CONTROL, "-o", str(tmp_path), "--variant", variant]  # fmt: skip
    assert study.main(arguments) == 0
    groups = json.loads((tmp_path / "results.json").read_text())["groups"]
    scenes = {"lamp_bays_direct", "lamp_bays_all", "hall_20_direct", "hall_20_all"}
    assert {g["scene"] for g in groups} == scenes and all(g["repeats"] == 2 for g in groups)
    for group in groups:
        ratios = [group[name] for name in ("over_tree_least", "over_tree", "over_tree_most")]
        assert ratios == sorted(ratios)
        assert group["label"] != study.CONTROL or ratios == [1, 1, 1]
    assert len(list((tmp_path / "scenes").glob("*_reference_16x9.exr"))) == 4
    assert "power_lights" in capsys.readouterr().out
