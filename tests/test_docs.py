"""The HTML manual: its configuration, its pages, and the whole of it built by Sphinx where that is installed."""

import importlib
import re
import runpy
import subprocess
import sys
from importlib.util import find_spec

import pytest

import mi_neural
from mi_neural import cli
from mi_neural.manual import pages


@pytest.fixture(scope="module")
def stage(docs_script):
    """The script that writes the pages, as a module."""
    return docs_script("stage")


@pytest.fixture(scope="module")
def source(stage, tmp_path_factory):
    """All pages as Sphinx gets them."""
    folder = tmp_path_factory.mktemp("docs") / "source"
    stage.stage(folder)
    return folder


def toctree(page) -> list[str]:
    """What a page lists."""
    found = re.findall(r"^```\{toctree\}\n(.*?)^```", page.read_text(encoding="utf-8"), re.M | re.S)
    return [line for block in found for line in block.splitlines() if line.strip() and not line.startswith(":")]


def files(folder) -> set[str]:
    found = [f for f in folder.rglob("*") if f.suffix in (".md", ".rst", ".ipynb")]
    return {str(f.relative_to(folder).with_suffix("")) for f in found}


def test_configuration_can_be_imported(root):
    found = runpy.run_path(str(root / "docs/conf.py"))
    assert found["release"] == mi_neural.__version__
    for name in found["extensions"]:
        assert (root / f"docs/{name}.py").exists() or not find_spec("sphinx") or find_spec(name), name
    for name in found["html_static_path"]:
        assert (root / "docs" / name).is_dir()


def test_every_page_is_in_one_list_and_every_entry_has_its_page(source):
    listed = [*toctree(source / "index.md")]
    for folder in ("notebooks", "python"):
        listed += [f"{folder}/{name}" for name in toctree(source / folder / "index.md")]
    assert len(listed) == len(set(listed))
    assert set(listed) == files(source) - {"index"}


def test_every_guide_and_plugin_has_its_page(source):
    names = files(source)
    assert names >= set(pages.guides()) and names >= {f"plugins/{name}" for name in pages.plugins()}
    for name in pages.plugins():
        assert f"(:monosp:`{name}`)" in (source / f"plugins/{name}.rst").read_text(encoding="utf-8")


def test_public_names_have_entries(source):
    text = (source / "python/mi_neural.rst").read_text(encoding="utf-8")
    for name in mi_neural.__all__:
        entry = rf"^\.\. auto(class|function|data):: mi_neural\.{name}$"
        assert re.search(entry, text, re.M) or (source / f"python/mi_neural.{name}.rst").exists(), name


def test_a_guide_that_names_a_missing_page_is_refused(stage):
    assert stage.linked("see `mi-neural doc nirc`") == "see [`mi-neural doc nirc`](plugins/nirc.rst)"
    with pytest.raises(pages.PageError, match="did you mean 'limits'"):
        stage.linked("see `mi-neural doc limit`")


@pytest.mark.parametrize(
    "lines, expected",
    [
        ("width   of it, in\n        pixels", "``width``\n    of it, in\n    pixels\n"),
        ("a, b\n        two\nc       one", "a, b\n        two\nc       one\n"),
        ("c       one\na, b\n        two", "``c``\n    one\n``a, b``\n    two\n"),
        ("Text:\n\n    x = f(1)", "Text:\n\n.. code-block:: python\n\n    x = f(1)\n"),
        ("Text:\n\n    x -> y z", "Text:\n\n.. code-block:: text\n\n    x -> y z\n"),
        ("of |a - b| and `|a|`", "of \\|a - b\\| and `|a|`\n"),
    ],
)
def test_docstrings_become_restructuredtext(stage, lines, expected):
    converted = importlib.import_module("docstrings").converted
    assert "\n".join(converted(lines.splitlines())) == expected


def test_names_that_do_not_exist_are_not_taken_for_names_without_a_page(stage, tmp_path, monkeypatch):
    """`needs_more` is a module that needs another, which is not installed."""
    (tmp_path / "needs_more.py").write_text("import not_installed\n\n\nclass Thing:\n    pass\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    exists = importlib.import_module("docstrings").exists
    for name in ("mi_neural.Field.query", "mi_neural.caches.field", "mitsuba.Scene", "ValueError",
                 "needs_more.Thing", "mi_neural.image.metrics.Flip.mean"):  # fmt: skip
        assert exists(name), name
    for name in ("mi_neural.Field.nonsense", "mi_neural.nonsense", "nonsense", "needs_more.Nonsense"):
        assert not exists(name), name


# ---------------------------------------------------------------- built


@pytest.fixture(scope="module")
def built(root, source, tmp_path_factory):
    """The manual as HTML, built as `make docs` does: a warning is an error."""
    for name in ("sphinx", "myst_nb", "furo"):
        if find_spec(name) is None:
            pytest.skip(f"the manual is built by {name}, which is not installed; type: pip install 'mi_neural[docs]'")
    out = tmp_path_factory.mktemp("docs") / "html"
    words = [sys.executable, "-m", "sphinx", "-q", "-n", "-W", "--keep-going", "-c", root / "docs", source, out]
    done = subprocess.run(words, cwd=source.parent, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_built_manual_has_all_pages_and_no_dead_links(built, source):
    names = {str(f.relative_to(built).with_suffix("")) for f in built.rglob("*.html")}
    assert names >= files(source)
    for file in built.rglob("*.html"):
        text = file.read_text(encoding="utf-8")
        assert "system-message" not in text and "problematic" not in text
        for target in re.findall(r'(?:href|src)="([^"#:?]+)["#?]', text):
            assert (file.parent / target).exists(), f"{file.name} leads to {target}"


def test_built_manual_reads_nothing_from_the_network(built):
    for file in built.rglob("*.html"):
        text = file.read_text(encoding="utf-8")
        assert not re.findall(r'<(?:script|img|iframe)[^>]+src="(?:https?:)?//', text), file
        assert not re.findall(r'<link[^>]+href="(?:https?:)?//', text), file


def test_built_manual_has_formulas_keys_and_commands(built):
    page = (built / "plugins/nirc.html").read_text(encoding="utf-8")
    assert "<math" in page and "cache_samples" in page and "highlight-xml" in page
    commands = (built / "commands.html").read_text(encoding="utf-8")
    for command in cli.app.registered_commands:
        assert f"Usage: mi-neural {command.name or command.callback.__name__}" in commands
    assert "cache_sampl" in (built / "searchindex.js").read_text(encoding="utf-8"), "found by the search"
