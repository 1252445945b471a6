"""`studies/cpu_seconds.py`: the command, in a process of its own, as it changes the number of threads."""

import json
import subprocess
import sys

import numpy as np
from load_study import FOLDER

from mi_neural.image import exr


def test_images_in_equal_cpu_seconds(tmp_path):
    words = ["-i", "path", "-i", "plain_path:light_sampler.type=tree_lights", "-D", "max_depth=2", "--size", "8x8"]
    words += ["--seconds", "0.3", "--repeats", "1", "--reference-spp", "256", "-o", str(tmp_path)]
    subprocess.run([sys.executable, FOLDER / "cpu_seconds.py", "cornell_box", *words], check=True)
    found = json.loads((tmp_path / "results.json").read_text())["records"]
    assert [record["label"] for record in found] == [words[1], words[3]] and found[0]["times_less"] == 1
    assert all(r["spp"] >= 1 and 0 <= r["relmse_trimmed"] < 10 for r in found)
    assert all(np.isfinite(r["times_less"]) and r["least"] <= r["most"] for r in found)
    reference = exr.read(tmp_path / "reference.exr")
    noise = reference.layer("variance")
    assert noise.shape == reference.rgb.shape and 0 < noise.mean() < 0.01 * np.square(reference.rgb).mean()
