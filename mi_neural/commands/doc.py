"""`mi-neural doc`: the manual in the terminal."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table

from mi_neural.bench import terminal
from mi_neural.bench.load import InputError
from mi_neural.commands.options import readable


@readable
def doc(
    page: Annotated[str | None, typer.Argument(metavar="[PAGE]", help="a plugin or a guide")] = None,
) -> None:
    """Show the page of a plugin (`mi-neural doc nirc`) or a guide (`mi-neural doc choose`); without PAGE, list them."""
    from mi_neural.manual import pages
    from mi_neural.manual import terminal as shown

    if page in pages.guides():
        terminal.out.print(shown.guide(pages.guide(page)))
        return
    if page is not None and page not in pages.plugins():
        raise InputError(pages.unknown(page))
    terminal.set_variant(terminal.DEFAULT_VARIANT)
    if page is not None:
        terminal.out.print(shown.page(pages.plugin_page(page)))
        return
    table = Table.grid(padding=(0, 2))
    for name, kind in pages.plugins().items():
        table.add_row(name, kind, pages.plugin_page(name).title.partition(" (")[0])
    for name, title in pages.guides().items():
        table.add_row(name, "guide", title)
    terminal.out.print(table)
