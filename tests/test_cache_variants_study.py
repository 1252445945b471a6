"""`studies/cache_variants.py`: other networks are in place while they are trained, and gone afterwards."""

import json
import subprocess
import sys

import mitsuba as mi
import pytest
from load_study import FOLDER, load_study

from mi_neural.caches import encoding, field
from mi_neural.caches.weights import FieldShape


def test_variants_replace_what_they_name_for_a_while():
    study = load_study("cache_variants")
    mi.set_variant("llvm_ad_rgb")
    own = encoding.direction, FieldShape.n_inputs, field.attach_adam
    for name, variant in study.variants().items():
        with study.in_place(variant):
            values = encoding.direction(mi.Vector3f(0, 0.6, 0.8), 3)
            assert FieldShape().n_inputs == FieldShape().n_first + len(values), name
            assert (field.attach_adam is not own[2]) == name.startswith("Muon")
    assert (encoding.direction, FieldShape.n_inputs, field.attach_adam) == own


@pytest.mark.slow
def test_variants_are_compared_in_equal_time(tmp_path):
    words = ["--only", "Muon, rate x 1", "--only", "direction grid 6x6", "--size", "16x16", "--seconds", "0.1,0.3"]
    words += ["--seeds", "1", "--reference-spp", "64", "--spp", "4", "-o", str(tmp_path)]
    subprocess.run([sys.executable, FOLDER / "cache_variants.py", "cornell_box", *words], check=True)
    found = json.loads((tmp_path / "results.json").read_text())["records"]
    ours = [r for r in found if r["scene"] == "cornell_box"]
    assert [(r["label"], r["seconds"]) for r in ours] == [
        (name, s) for name in ("default", "direction grid 6x6", "Muon, rate x 1") for s in (0.1, 0.3)
    ]
    assert all(r["steps"] > 0 and 0 < r["relmse"] < 10 and 0.5 < r["mean"] < 2 for r in ours)
    assert all(r["times"] == r["image_times"] == 1 for r in found if r["label"] == "default")
    refused = subprocess.run([sys.executable, FOLDER / "cache_variants.py", "cornell_box", "--only", "none", *words],
                             capture_output=True, text=True, check=False)  # fmt: skip
    assert refused.returncode == 2 and "there is no variant none" in refused.stderr
