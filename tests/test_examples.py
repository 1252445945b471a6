"""The Python examples of the guides run, at 16x16 pixels with caches of two training frames."""

import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK

from mi_neural import scenes
from mi_neural.manual import pages
from mi_neural.scenes import public

CACHED = ("nirc", "nrc", "neural_path", "nirc_two_level")
#: Examples that are not run, by a part of their text, and why.
NOT_RUN = {"cluster.render": "needs machines; tests/test_cluster.py has workers", "class ByDistance": "an outline"}


def examples(name: str) -> list[str]:
    blocks = re.findall(r"^```python\n(.*?)^```", pages.guide(name), re.M | re.S)
    return [b for b in blocks if not any(part in b for part in NOT_RUN)]


GUIDES = [name for name in pages.guides() if examples(name)]


def shortened(keys: dict) -> dict:
    """The dictionary of a plugin, with so little training that a test can wait for it."""
    keys = {k: shortened(v) if isinstance(v, dict) else v for k, v in keys.items()}
    if keys.get("type") in CACHED:
        return {"train_frames": 2, "train_samples": 64, **NETWORK, **keys}
    return keys | {"width": 16, "height": 16} if keys.get("type") == "hdrfilm" else keys


def test_there_are_examples():
    assert {"quickstart", "cameras", "wrappers", "denoise", "lights", "gradients"} <= set(GUIDES)


def _have_public_scenes(folder, monkeypatch):
    """The examples name public scenes, which nothing fetches here: a shipped one stands for each."""
    monkeypatch.setenv("MI_NEURAL_SCENES", str(folder))
    for name in public.names():
        file = public.file(name)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(scenes.path("cornell_box").read_bytes())


@pytest.mark.parametrize("name", GUIDES)
def test_examples_of_guides_run(name, tmp_path, monkeypatch):
    load_file, load_dict, range_ = mi.load_file, mi.load_dict, range
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mi, "load_file", lambda file, **keys: load_file(file, resx=16, resy=16, **keys))
    monkeypatch.setattr(mi, "load_dict", lambda keys, *args, **more: load_dict(shortened(keys), *args, **more))
    monkeypatch.setattr(mi, "set_variant", lambda name: None)
    _have_public_scenes(tmp_path / "public", monkeypatch)
    if name == "denoise":
        pytest.importorskip("mitsuba_oidn", reason="the example denoises; type: pip install 'mi_neural[denoise]'")
    names = {"mi": mi, "dr": dr, "np": np, "range": lambda n: range_(min(n, 3))}
    for k, block in enumerate(examples(name)):
        short = block.replace(".train(scene, 100)", ".train(scene, 2)")
        exec(compile(short, f"{name}, example {k + 1}", "exec"), names)
