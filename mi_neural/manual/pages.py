"""Manual pages: parsed out of the plugins' docstrings (reStructuredText as Mitsuba's own), and guides (Markdown)."""

from __future__ import annotations

import difflib
import inspect
import re
from dataclasses import dataclass, field
from pathlib import Path

_GUIDES = Path(__file__).resolve().parent


class PageError(ValueError):
    """There is no such page, or it cannot be read; the message says what there is."""


@dataclass(frozen=True)
class Key:
    """One key of a plugin: its name, the type of its value, what it means, and its default ('' where none is said)."""

    name: str
    type: str
    text: str
    default: str


@dataclass
class Page:
    """A plugin's manual page.

    name     plugin type
    kind     'integrator' or 'emitter'
    title    what it is called
    tree     the whole page as a docutils document
    keys     the rows of its table
    """

    name: str
    kind: str
    title: str
    tree: object = field(repr=False)
    keys: list[Key]


# ------------------------------------------------------------------------------------------------------------------
# Plugins


def plugins() -> dict[str, str]:
    """Plugin types of this package and their kinds."""
    from mi_neural import emitters, integrators
    from mi_neural.registration import plugin_names

    found = dict.fromkeys(plugin_names(integrators), "integrator")
    return found | dict.fromkeys(plugin_names(emitters), "emitter")


def plugin_page(name: str) -> Page:
    """The page of a plugin under the active variant. Raises :class:`PageError`."""
    import mitsuba as mi

    kinds = plugins()
    if name not in kinds:
        raise PageError(unknown(name))
    text = type(mi.load_dict({"type": name})).__doc__
    return parse(name, kinds[name], text or "")


def parse(name: str, kind: str, docstring: str) -> Page:
    """A page out of a class's docstring. Raises :class:`PageError` where it is no valid reStructuredText."""
    from docutils import nodes
    from docutils.core import publish_doctree
    from docutils.utils import SystemMessage

    from mi_neural.manual import directives

    directives.register()
    text = inspect.cleandoc(docstring) + directives.SUBSTITUTIONS
    settings = {"report_level": 2, "halt_level": 2, "warning_stream": False, "input_encoding": "unicode"}
    try:
        tree = publish_doctree(text, source_path=name, settings_overrides=settings)
    except SystemMessage as error:
        raise PageError(f"the manual page of '{name}' cannot be read: {error}") from None
    titles = [n.astext() for n in tree.findall(nodes.title)]
    return Page(name, kind, titles[0] if titles else name, tree, list(_keys(tree)))


def _keys(tree):
    from docutils import nodes

    for table in tree.findall(lambda n: isinstance(n, nodes.table) and "parameters" in n["classes"]):
        for row in table.findall(nodes.row):
            name, kind, text = (cell.astext().replace("\n", " ") for cell in row.children)
            default = re.search(r"\(Default: (.*)\)\s*$", text)
            yield Key(name, kind, text[: default.start()].strip() if default else text, default[1] if default else "")


# ------------------------------------------------------------------------------------------------------------------
# Guides


def guides() -> dict[str, str]:
    """Names of the guides and their titles, in the order in which a newcomer reads them."""
    files = sorted(_GUIDES.glob("*.md"))
    return {re.sub(r"^\d+_", "", f.stem): f.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ") for f in files}


def guide(name: str) -> str:
    """A guide's Markdown. Raises :class:`PageError`."""
    for file in _GUIDES.glob("*.md"):
        if re.sub(r"^\d+_", "", file.stem) == name:
            return file.read_text(encoding="utf-8")
    raise PageError(unknown(name))


def unknown(name: str) -> str:
    """The error for a page that there is not."""
    known = [*plugins(), *guides()]
    close = difflib.get_close_matches(name, known, 1)
    meant = f", did you mean '{close[0]}'?" if close else ""
    return f"there is no page '{name}'{meant}; plugins: {', '.join(plugins())}; guides: {', '.join(guides())}"
