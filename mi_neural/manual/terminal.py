"""Manual pages in a terminal, by rich: coloured where it is one, plain text where it is piped."""

from __future__ import annotations

from docutils import nodes
from rich.console import Group
from rich.markdown import Markdown
from rich.padding import Padding
from rich.rule import Rule
from rich.syntax import Syntax
from rich.table import Table
from rich.text import Text

from mi_neural.manual import mathtext
from mi_neural.manual.pages import Page

#: Inline nodes and the styles they are shown in.
STYLES = {nodes.literal: "bold cyan", nodes.emphasis: "italic", nodes.strong: "bold", nodes.math: "italic"}


def page(found: Page) -> Group:
    """A plugin's page as one renderable."""
    title = Text.assemble((found.name, "bold cyan"), f"  {found.kind}")
    return Group(Rule(title, align="left"), *_blocks(found.tree))


def guide(markdown: str) -> Markdown:
    """A guide as one renderable."""
    return Markdown(markdown, hyperlinks=False)


def _blocks(parent):
    """Renderables of a node's children, an empty line after each."""
    for node in parent.children:
        if isinstance(node, nodes.title):
            yield Text(node.astext(), "bold")
        elif isinstance(node, nodes.paragraph):
            yield _inline(node)
        elif isinstance(node, nodes.math_block):
            yield Padding(Text(mathtext.to_text(node.astext()), "italic"), (0, 4))
        elif isinstance(node, nodes.literal_block):
            language = next((c for c in node["classes"] if c != "code"), "text")
            code = Syntax(node.astext(), language, theme="ansi_dark", background_color="default", word_wrap=True)
            yield Padding(code, (0, 4))
        elif isinstance(node, nodes.table):
            yield _table(node)
        elif isinstance(node, (nodes.bullet_list, nodes.enumerated_list)):
            for item in node.children:
                yield from _item(item)
        elif isinstance(node, (nodes.section, nodes.container, nodes.block_quote)):
            yield from _blocks(node)
            continue
        else:
            continue
        yield Text()


def _item(item):
    lines = Table.grid(padding=(0, 1))
    lines.add_column(width=1)
    lines.add_column()
    blocks = [b for b in _blocks(item) if not (isinstance(b, Text) and not b.plain)]
    lines.add_row("•", Group(*blocks))
    yield Padding(lines, (0, 2))


def _table(node) -> Table:
    shown = Table(box=None, padding=(0, 1), show_header=False, pad_edge=False)
    for k, _ in enumerate(node.next_node(nodes.tgroup).findall(nodes.colspec)):
        shown.add_column(no_wrap=k < 2)
    for row in node.findall(nodes.row):
        key, *rest = (_inline(cell) for cell in row.children)
        key.stylize("bold cyan")
        shown.add_row(key, *rest)
    return shown


def _inline(node) -> Text:
    """The text of a paragraph or a cell, styled; its lines are one."""
    text = Text()
    for child in node.children:
        if isinstance(child, nodes.Text):
            text.append(str(child).replace("\n", " "))
        elif isinstance(child, nodes.math):
            text.append(mathtext.to_text(child.astext()), "italic")
        elif type(child) in STYLES:
            text.append(child.astext().replace("\n", " "), STYLES[type(child)])
        else:
            text.append_text(_inline(child))
    return text
