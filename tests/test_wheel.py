"""The wheel: built, installed into a folder of its own, and used from an empty folder without the source tree.

The folder comes first on Python's path, before an editable installation of this checkout. What the package needs
(Mitsuba, NumPy) is that of the environment that runs the tests.
"""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("pip", reason="python -m ensurepip")

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "mi_neural", "integrators", "emitters", "scenes")
#: What is no module, and must be in the wheel: suffixes by folder of the package.
DATA = {"mi_neural/manual": (".md", ".png"), "mi_neural/lights": (".npz",), "mi_neural/bench": (".css", ".js"),
        "scenes": (".xml", ".exr", ".json")}  # fmt: skip


def run(*words, folder: Path, **variables) -> str:
    """Output of a command; the test fails where it does."""
    done = subprocess.run([str(w) for w in words], cwd=folder, env={**os.environ, **variables}, timeout=240,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)  # fmt: skip
    assert done.returncode == 0, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built from a copy of the sources, so that the checkout stays as it is."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    ignored = shutil.ignore_patterns("__pycache__")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, source / name, ignore=ignored)
        else:
            shutil.copy(ROOT / name, source / name)
    newest = int(importlib.metadata.version("setuptools").partition(".")[0]) >= 77  # else pip fetches one to build with
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", *(["--no-build-isolation"] if newest else []),
        "-w", out, source, folder=out)  # fmt: skip
    (found,) = out.glob("mi_neural-*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """A function that runs Python in an empty folder with the wheel, and where the wheel is installed."""
    target, empty = tmp_path_factory.mktemp("installed"), tmp_path_factory.mktemp("empty")
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", target, wheel, folder=empty)

    def python(*words) -> str:
        return run(sys.executable, *words, folder=empty, PYTHONPATH=str(target))

    return python, target


def test_wheel_holds_every_module_and_every_file_that_is_read(wheel):
    with zipfile.ZipFile(wheel) as file:
        names = set(file.namelist())
    for folder in ("mi_neural", "integrators", "emitters", "scenes"):
        for path in sorted((ROOT / folder).rglob("*")):
            parent = path.parent.relative_to(ROOT).as_posix()
            if "__pycache__" in path.parts or path.suffix not in (".py", *DATA.get(parent, ())):
                continue
            inside = path.relative_to(ROOT).as_posix()
            assert (inside if folder == "mi_neural" else f"mi_neural/{inside}") in names
    assert not [name for name in names if not re.match(r"mi_neural(-[\d.]+\.dist-info)?/", name)]


def test_modules_come_from_the_wheel_and_none_from_the_checkout(installed):
    python, target = installed
    shown = python("-c", (
        "import mi_neural, mitsuba as mi, sys; mi.set_variant('llvm_ad_rgb'); mi.load_dict({'type': 'neural_path'});"
        "import mi_neural.cli, mi_neural.bench.benchmark, mi_neural.explore.figures, mi_neural.manual.pages;"
        "print(*sorted(m.__file__ for n, m in sys.modules.items() if n.split('.')[0] == 'mi_neural'), sep='\\n')"
    ))  # fmt: skip
    files = [Path(line) for line in shown.split("\n") if line.endswith(".py")]
    assert len(files) > 40
    assert not [file for file in files if target not in file.parents]


def test_a_shipped_scene_is_rendered(installed):
    python, _ = installed
    python("-m", "mi_neural", "render", "cornell_box", "-i", "plain_path", "--size", "8x8", "--spp", "2",
           "-o", "box.exr")  # fmt: skip
    shown = python("-c", "from mi_neural.image import exr; print(exr.read('box.exr').rgb.shape)")
    assert "(8, 8, 3)" in shown


def test_the_shipped_reference_is_found(installed):
    python, target = installed
    shown = python("-c", (
        "from mi_neural import scenes; from mi_neural.bench import reference;"
        "print(reference.beside(scenes.path('ajar_door'), (320, 180)))"
    ))  # fmt: skip
    assert Path(shown.strip()) == target / "mi_neural/scenes/ajar_door_reference_320x180.exr"


@pytest.mark.parametrize("page", [pytest.param("neural_path", marks=pytest.mark.slow), "nvc_lights", "speed"])
def test_pages_of_the_manual_are_shown_by_the_program(installed, page):
    _, target = installed
    shown = run(target / "bin/mi-neural", "doc", page, folder=target.parent, PYTHONPATH=str(target))
    assert len(shown) > 1000
