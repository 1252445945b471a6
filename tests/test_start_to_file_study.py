"""`studies/start_to_file.py`: what the command waits for."""

import json

from load_study import load_study

study = load_study("start_to_file")


def test_command_waits_for_the_file_with_and_without_kernels(tmp_path, variant):
    arguments = ["cornell_box", "-i", "path", "--seconds", "0.01", "--size", "8x8", "--repeats", "1"]
    assert study.main([*arguments, "--variant", variant, "-o", str(tmp_path)]) == 0
    records = json.loads((tmp_path / "results.json").read_text())["records"]
    assert [(r["label"], r["kernels"]) for r in records] == [("path", "empty"), ("path", "warm")]
    assert all(r["seconds"] > 0.1 for r in records) and (tmp_path / "image.exr").is_file()
    (kept,) = (tmp_path / "kernels").iterdir()
    assert list(kept.iterdir()), "no kernel was kept where the second command looks"
