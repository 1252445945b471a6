"""Write the source pages of the manual: `python docs/stage.py FOLDER`; sphinx-build then makes HTML of them.

Nothing is written down twice: guides are copied from `mi_neural/manual`, plugins' pages are their docstrings, commands
say their `--help`, notebooks are copied with their outputs. Tables say how old they are, and whether they are older
than the code that they measure.
"""

from __future__ import annotations

import inspect
import re
import shutil
import sys
from pathlib import Path

import tables

from mi_neural.manual import directives, pages

ROOT = Path(__file__).resolve().parents[1]
#: Modules whose names have entries: the interface that the guides speak of. `mi_neural` itself comes before them.
MODULES = ("mi_neural.explore.session", "mi_neural.explore.views", "mi_neural.caches.field",
           "mi_neural.caches.weights", "mi_neural.caches.incident", "mi_neural.caches.outgoing",
           "mi_neural.caches.outgoing_field", "mi_neural.caches.visibility", "mi_neural.caches.radiance_cache",
           "mi_neural.lights.sampling", "mi_neural.lights.table",
           "mi_neural.estimators.two_level", "mi_neural.estimators.reservoir", "mi_neural.image.denoise",
           "mi_neural.image.metrics", "mi_neural.image.exr", "mi_neural.bench.changes", "mi_neural.bench.cluster",
           "mi_neural.bench.workers",
           "mi_neural.scenes")  # fmt: skip
#: Pictures of `scenes` that pages of `docs` show.
PICTURES = ("ajar_door.png", "gallery.webp", "moving_light.webp")
LINK = re.compile(r"`mi-neural doc ([a-z_]\w*)`")


def linked(markdown: str, folder: str = "") -> str:
    """Markdown in which every `mi-neural doc NAME` leads to that page. Raises `PageError` where there is none."""
    known = {**dict.fromkeys(pages.guides(), ".md"), **dict.fromkeys(pages.plugins(), ".rst")}

    def target(found: re.Match) -> str:
        name = found[1]
        if name not in known:
            raise pages.PageError(f"{found[0]}: {pages.unknown(name)}")
        place = f"plugins/{name}" if known[name] == ".rst" else name
        return f"[{found[0]}]({folder}{place}{known[name]})"

    return LINK.sub(target, markdown)


def page(markdown: str) -> str:
    """A page with links in place of commands, pictures beside it, and the age of its tables."""
    return tables.with_age(linked(markdown), ROOT).replace("](../scenes/", "](")


def plugin(name: str) -> str:
    """A plugin's page in reStructuredText: the docstring of its class."""
    import mitsuba as mi

    text = inspect.cleandoc(type(mi.load_dict({"type": name})).__doc__)
    return text + directives.SUBSTITUTIONS


def commands() -> str:
    """What `--help` of every command says."""
    import typer

    from mi_neural import cli

    program = typer.main.get_command(cli.app)
    context = program.context_class(program, info_name="mi-neural", max_content_width=100, terminal_width=100)
    parts = ["# Commands", "", "```text", context.get_help(), "```"]
    for name in program.list_commands(context):
        command = program.get_command(context, name)
        inner = type(context)(command, info_name=name, parent=context, max_content_width=100, terminal_width=100)
        parts += ["", f"## mi-neural {name}", "", "```text", command.get_help(inner), "```"]
        for below in getattr(command, "commands", {}).values():
            last = type(context)(below, info_name=below.name, parent=inner, max_content_width=100, terminal_width=100)
            parts += ["", "```text", below.get_help(last), "```"]
    return "\n".join(parts) + "\n"


def python() -> dict[str, str]:
    """Pages of the Python interface by the names of their files: the package itself, then one a module."""
    import mi_neural

    found = {"mi_neural": _module("mi_neural", "")}
    for name in mi_neural.__all__:
        value = getattr(mi_neural, name)
        kind = "module" if inspect.ismodule(value) else "class" if inspect.isclass(value) else (
            "function" if callable(value) else "data")  # fmt: skip
        if kind == "module":
            found[value.__name__] = _module(value.__name__)
            continue
        # A class that the package shows by a shorter name is described there alone
        options = "   :members:\n" if kind == "class" else "   :no-value:\n" if kind == "data" else ""
        found["mi_neural"] += f"\n.. auto{kind}:: mi_neural.{name}\n{options}"
    shown = {getattr(mi_neural, n).__module__: n for n in mi_neural.__all__ if inspect.isclass(getattr(mi_neural, n))}
    return found | {name: _module(name, exclude=shown.get(name, "")) for name in MODULES}


def _module(name: str, members: str = "   :members:\n", exclude: str = "") -> str:
    left_out = f"   :exclude-members: {exclude}\n" if exclude else ""
    return f"{name}\n{'=' * len(name)}\n\n.. automodule:: {name}\n{members or '   :no-members:'}{left_out}\n"


def contents(title: str, folder: str, names, intro: str = "") -> str:
    """A page that lists the pages of a folder."""
    entries = "\n".join(f"{folder}{name}" for name in names)
    return f"# {title}\n\n{intro}\n\n```{{toctree}}\n:maxdepth: 1\n\n{entries}\n```\n"


def stage(folder: Path) -> None:
    """Write all pages to `folder`, which is emptied before."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    shutil.rmtree(folder, ignore_errors=True)

    def put(name: str, text: str) -> None:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")

    for file in (ROOT / "docs").glob("*.md"):
        put(file.name, page(file.read_text(encoding="utf-8")))
    for name in pages.guides():
        put(f"{name}.md", page(pages.guide(name)))
    for name in pages.plugins():
        put(f"plugins/{name}.rst", plugin(name))
    for name, text in python().items():
        put(f"python/{name}.rst", text)
    put("commands.md", commands())
    notebooks = sorted((ROOT / "notebooks").glob("*.ipynb"))
    for file in notebooks:
        put(f"notebooks/{file.name}", file.read_text(encoding="utf-8"))
    put("notebooks/index.md", contents("Notebooks", "", [f.stem for f in notebooks], "With the outputs that they are "
        "kept with. To run them: `pip install 'mi_neural[notebooks]'`, then `jupyter lab notebooks`."))  # fmt: skip
    put("python/index.md", contents("Python interface", "", python()))
    for picture in [*(ROOT / "mi_neural/manual").glob("*.png"), *(ROOT / "scenes" / name for name in PICTURES)]:
        shutil.copy(picture, folder / picture.name)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("stage.py takes the folder to write to; type: python docs/stage.py out/docs_source")
    stage(Path(sys.argv[1]))
