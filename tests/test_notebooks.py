"""The notebooks: each runs from top to bottom, shortened, and what is kept of the last full run is whole and small.

They run in kernels of their own, as in Jupyter, with `MI_NEURAL_NOTEBOOK_TEST` set (sizes are a sixteenth) and kernels
compiled quickly (`quick_kernels`). ``make notebooks`` runs them in full length and keeps the outputs.
"""

import ast
import importlib
import json
import os
import re
import sys
from pathlib import Path

import pytest

from mi_neural.explore import lesson

nbformat = pytest.importorskip("nbformat", reason="pip install 'mi_neural[test]'")
nbclient = pytest.importorskip("nbclient", reason="pip install 'mi_neural[test]'")

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted((ROOT / "notebooks").glob("*.ipynb"))
NAMES = ["00_quickstart", "01_inside_the_cache", "02_where_to_stop", "03_unbiased_anyway", "04_incident_or_outgoing",
         "05_many_lights", "06_moving_light", "07_measure_honestly", "08_your_own_cache",
         "09_gradients", "10_fog", "11_your_own_renderer"]  # fmt: skip
LARGEST = 500_000  # bytes of a file

each = pytest.mark.parametrize("file", FILES, ids=[f.stem for f in FILES])


def read(file: Path):
    return nbformat.read(file, as_version=4)


def code(file: Path) -> list[str]:
    return [cell.source for cell in read(file).cells if cell.cell_type == "code"]


def test_there_are_these():
    assert [f.stem for f in FILES] == NAMES


# ---------------------------------------------------------------- run


@pytest.mark.notebooks
@each
def test_runs_from_top_to_bottom(file, tmp_path, monkeypatch):
    """Shortened, in a fresh kernel and an empty folder: no cell fails, and nothing is left in the folder."""
    monkeypatch.setenv(lesson.VARIABLE, "1")
    path = os.pathsep.join(filter(None, [str(ROOT / "tests"), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("PYTHONPATH", path)  # where quick_kernels is found
    notebook = read(file)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}},
        extra_arguments=["--IPKernelApp.exec_lines=import quick_kernels"],
    )  # fmt: skip
    client.execute()  # raises what a cell raises
    assert all(cell.execution_count for cell in notebook.cells if cell.cell_type == "code")
    assert not list(tmp_path.iterdir())


def test_sizes_are_small_under_test(monkeypatch):
    monkeypatch.setenv(lesson.VARIABLE, "1")
    assert lesson.sizes(320, 16, 3) == (20, 2, 2)
    for off in ("", "0"):
        monkeypatch.setenv(lesson.VARIABLE, off)
        assert lesson.sizes(320, 16) == (320, 16)


# ---------------------------------------------------------------- what is kept


@each
def test_outputs_of_the_full_run_are_kept(file):
    """Cells were run in order, none failed or warned, there are figures, and figures are all that is large."""
    assert file.stat().st_size < LARGEST
    cells = [cell for cell in read(file).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert {o.output_type for o in outputs} <= {"stream", "execute_result", "display_data"}
    assert all(o.name == "stdout" for o in outputs if o.output_type == "stream")
    pictures = [o for o in outputs if "data" in o and {"image/png", "image/jpeg"} & set(o.data)]
    assert len(pictures) >= 3
    assert not any("WARN" in o.text for o in outputs if o.output_type == "stream")


@each
def test_metadata_is_clean(file):
    """What a kernel leaves behind is not kept: times, widgets, folders of the machine that it ran on."""
    text = file.read_text(encoding="utf-8")
    notebook = json.loads(text)
    assert set(notebook["metadata"]) <= {"kernelspec", "language_info"}
    assert notebook["metadata"]["kernelspec"]["name"] == "python3"
    assert not any(cell["metadata"] for cell in notebook["cells"])
    assert not re.search(r"/(home|root|work|Users)/", re.sub(r'"image/\w+": "[^"]*"', "", text))
    ids = [cell["id"] for cell in notebook["cells"]]
    assert len(set(ids)) == len(ids)


@each
def test_begins_as_the_others_do(file):
    cells = read(file).cells
    first = cells[0]
    assert first.cell_type == "markdown" and re.match(r"# \S", first.source)
    assert "## Overview" in first.source and "You will learn" in first.source
    assert "## See also" in cells[-1].source
    setup = code(file)[0]
    assert "set_variant" in setup or "set_variant" in code(file)[1]


@each
def test_names_of_the_package_exist(file):
    """Every module and name of `mi_neural` that is imported, and those that the prose puts between backticks."""
    tree = ast.parse("\n".join(code(file)))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "mi_neural":
            for alias in node.names:
                known(f"{node.module}.{alias.name}")
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == "mi_neural":
                    known(alias.name)
    prose = "\n".join(cell.source for cell in read(file).cells if cell.cell_type == "markdown")
    for name in re.findall(r"mi_neural(?:\.\w+)+", prose):
        known(name)
    for link in re.findall(r"\]\((\w+\.ipynb)\)", prose):
        assert (file.parent / link).is_file(), link
    for path in re.findall(r"`(mi_neural/[\w/]+\.py|(?:integrators|emitters)/\w+\.py)`", prose):
        assert (ROOT / path).is_file(), path


def known(name: str) -> None:
    """Import a dotted name: a module, or something in it."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:k]))
        except ModuleNotFoundError:
            continue
        for part in parts[k:]:
            found = getattr(found, part)
        return
    raise AssertionError(name)


# ---------------------------------------------------------------- reading of names


def test_unknown_names_are_noticed():
    known("mi_neural.image.metrics.relmse")
    with pytest.raises(AttributeError):
        known("mi_neural.image.metrics.nonsense")
    assert "ipykernel" not in sys.modules  # kernels are processes of their own
