"""`mi-neural reproduce`: counterparts of the sources' figures and tables."""

from __future__ import annotations

import gc
import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from mi_neural.bench import environment, terminal
from mi_neural.bench.load import InputError
from mi_neural.commands import options
from mi_neural.reproduce import page, registry
from mi_neural.reproduce.work import Work


@options.readable
def reproduce(
    context: typer.Context,
    name: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help="entries, or the name of a source for all of its entries")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="small sizes: each takes less than two minutes on two cores")
    ] = False,
    size: options.Size = None,
    variant: options.Variant = terminal.DEFAULT_VARIANT,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="folder for all results; NAME is a folder in it")
    ] = Path("out/reproduce"),
) -> None:
    """Render counterparts of the papers' figures and tables; without NAME, list them.

    Each is one HTML page: pictures, plots, and the paper's numbers beside ours. After Ctrl-C the same command goes on.
    Delete DIR/measured to measure anew.
    """
    if not name:
        if given := options.given(context):
            raise InputError(f"{given[0]} is for an entry: mi-neural reproduce NAME {given[0]} ...; without options "
                             "mi-neural reproduce lists them")  # fmt: skip
        _print_left(listing())
        terminal.out.print("mi-neural reproduce NAME [--quick] renders one; the name of a source, all of it",
                           soft_wrap=True)  # fmt: skip
        return
    entries = list(dict.fromkeys(e for one in name for e in registry.find(one)))
    wanted = terminal.parse_size(size)
    terminal.require_folder(output)
    terminal.set_variant(variant)
    command = shlex.join(["mi-neural", *sys.argv[1:]])
    for entry in entries:
        gc.collect()  # scenes and integrators of the entry before, see Group.part
        work = Work(output, quick, wanted)
        terminal.announce(f"{entry.name}: {entry.shows}")
        try:
            with terminal.Bars() as bars:
                work.progress = bars
                outcome = entry.measure(work)
        except KeyboardInterrupt:
            raise KeyboardInterrupt("interrupted: the same command goes on from here") from None
        written = page.write(entry, outcome, work, command, environment.describe())
        for statement in outcome.statements:
            terminal.out.print(f"{statement.paper} ({statement.where})", soft_wrap=True, markup=False)
            terminal.out.print(f"    here: {statement.ours}", soft_wrap=True, markup=False)
            terminal.out.print(f"    {statement.verdict}", soft_wrap=True, markup=False)
        terminal.out.print(f"wrote {written}", soft_wrap=True, markup=False)


def listing() -> list[list[str]]:
    """The table of entries, headings first."""
    lines = [[e.name, e.figure, e.scene, f"{_time(e.seconds[0])} / {_time(e.seconds[1])}", e.shows]
             for e in registry.ENTRIES.values()]  # fmt: skip
    return [["name", "counterpart of", "scene", "quick / full", "what it shows"], *lines]


def _print_left(lines: list[list[str]]) -> None:
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    for line in lines:
        text = "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True))
        terminal.out.print(text.rstrip(), soft_wrap=True, markup=False)


def _time(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.0f} min"
