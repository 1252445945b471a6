"""The manual as static HTML: ``mi-neural doc --html DIR``, or ``make docs``.

Plugins' pages by docutils, guides by markdown-it, the Python interface by pdoc, commands by what their ``--help`` says.
"""

from __future__ import annotations

import html
import re
import shutil
import tempfile
from pathlib import Path

from mi_neural.image import exr
from mi_neural.manual import pages

#: What the Python pages are of: the interface that the guides speak of.
MODULES = ("mi_neural", "mi_neural.explore.live", "mi_neural.explore.session", "mi_neural.explore.views",
           "mi_neural.caches.field", "mi_neural.caches.incident", "mi_neural.caches.outgoing",
           "mi_neural.caches.visibility", "mi_neural.caches.radiance_cache", "mi_neural.lights.sampling",
           "mi_neural.lights.table", "mi_neural.estimators.two_level", "mi_neural.estimators.reservoir",
           "mi_neural.image.metrics", "mi_neural.image.exr", "mi_neural.bench.changes",
           "mi_neural.scenes")  # fmt: skip

STYLE = """
body { font: 16px/1.55 system-ui, sans-serif; margin: 0 auto; max-width: 60rem; padding: 1rem; color: #222 }
nav { border-bottom: 1px solid #ddd; padding-bottom: .5rem; font-size: 14px } nav a { margin-right: .7rem }
a { color: #0b5cad; text-decoration: none } a:hover { text-decoration: underline }
h1 { font-size: 1.6rem } h2 { font-size: 1.2rem; margin-top: 2rem }
code, pre, .literal { font: 13.5px/1.45 ui-monospace, monospace; background: #f4f4f6 }
code, .literal { padding: .1em .25em }
pre { padding: .8rem; overflow-x: auto } pre code { padding: 0 }
table { border-collapse: collapse; margin: 1rem 0; font-size: 15px }
th, td { padding: .35rem .6rem; border-bottom: 1px solid #ddd; text-align: left; vertical-align: top }
td p { margin: 0 }
table.parameters td:first-child { font-family: ui-monospace, monospace; font-size: 13.5px; white-space: nowrap }
img { max-width: 100%; image-rendering: pixelated } math { font-size: 1.1em }
pre.xml::before { content: "XML" } pre.python::before { content: "Python" }
pre.xml::before, pre.python::before { float: right; color: #888; font-family: system-ui, sans-serif }
"""

TEMPLATE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title} - mi_neural</title><style>{style}</style></head><body>
<nav><b>mi_neural</b> {links}</nav>
{body}
</body></html>
"""


def plugin_html(page: pages.Page) -> str:
    """A plugin's page as the inside of an HTML body."""
    from docutils.core import publish_from_doctree

    settings = {"output_encoding": "unicode", "math_output": "MathML", "embed_stylesheet": False, "report_level": 3}
    found = publish_from_doctree(page.tree, writer="html5", settings_overrides=settings)
    return re.search(r"<main[^>]*>(.*)</main>", found, re.S)[1]


def guide_html(markdown: str) -> str:
    """A guide as the inside of an HTML body."""
    from markdown_it import MarkdownIt

    return MarkdownIt("commonmark").enable("table").render(markdown)


def commands(context) -> dict[str, str]:
    """What ``--help`` says, by command; '' for the program itself, whose context is given."""
    program, texts = context.command, {"": context.command.get_help(context)}
    for name in program.list_commands(context):
        command = program.get_command(context, name)
        inner = type(context)(command, info_name=name, parent=context, max_content_width=100, terminal_width=100)
        texts[name] = command.get_help(inner)
    return texts


def write(folder: Path, context, python: bool = True) -> None:
    """Write all pages to `folder`; `context` is the program's, as click has it. The Python pages need pdoc."""
    found = {name: pages.plugin_page(name) for name in pages.plugins()}
    titles = pages.guides()
    folder.mkdir(parents=True, exist_ok=True)
    links = [("index.html", "contents"), *((f"{name}.html", name) for name in titles), ("commands.html", "commands")]
    if python:
        links.append(("python/index.html", "Python"))
    shown = " ".join(f'<a href="{target}">{html.escape(text)}</a>' for target, text in links)

    def put(name: str, title: str, body: str) -> None:
        text = TEMPLATE.format(title=html.escape(title), style=STYLE, links=shown, body=body)
        exr.write_text(folder / f"{name}.html", text)

    for name, page in found.items():
        put(name, name, plugin_html(page))
    for name, title in titles.items():
        put(name, title, guide_html(pages.guide(name)))
    for picture in Path(__file__).parent.glob("*.png"):
        shutil.copy(picture, folder / picture.name)
    parts = [f"<h2>mi-neural {name}</h2>\n<pre>{html.escape(text)}</pre>" for name, text in commands(context).items()]
    put("commands", "commands", "<h1>Commands</h1>\n" + "\n".join(parts))
    put("index", "contents", _contents(found, titles))
    if python:
        _python(folder / "python")


def _contents(found: dict[str, pages.Page], titles: dict[str, str]) -> str:
    def listing(heading: str, entries) -> str:
        rows = "".join(f'<tr><td><a href="{name}.html">{name}</a></td><td>{html.escape(text)}</td></tr>'
                       for name, text in entries)  # fmt: skip
        return f"<h2>{heading}</h2>\n<table>{rows}</table>\n"

    kinds = {kind: [(p.name, p.title.partition(" (")[0]) for p in found.values() if p.kind == kind]
             for kind in ("integrator", "emitter")}  # fmt: skip
    return ("<h1>mi_neural</h1>\n" + listing("Guides", titles.items()) + listing("Integrators", kinds["integrator"])
            + listing("Light samplers", kinds["emitter"]))  # fmt: skip


def _python(folder: Path) -> None:
    """The Python interface, by pdoc."""
    try:
        import pdoc
    except ImportError:
        raise ImportError("the Python pages need pdoc; type: pip install 'mi_neural[docs]'") from None
    with tempfile.TemporaryDirectory() as templates:
        # Docstrings line up names and what they mean; without their line breaks they could not be read
        (Path(templates) / "custom.css").write_text(".docstring p { white-space: pre-wrap }")
        pdoc.render.configure(docformat="restructuredtext", show_source=False, template_directory=Path(templates))
        pdoc.pdoc(*MODULES, output_directory=folder)

