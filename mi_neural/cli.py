"""Render Mitsuba scenes with integrators that learn their light, compare integrators at equal time or over a
changing scene, and read the manual.

Progress goes to stderr and results to stdout. Exit codes: 0 done, 2 the input cannot be used (one line says why),
130 (Ctrl-C) and 143 (SIGTERM) interrupted, with what was rendered so far on disk.
"""

from __future__ import annotations

from typing import Annotated

import typer

from mi_neural.bench import terminal
from mi_neural.commands import options
from mi_neural.commands.compare import compare
from mi_neural.commands.doc import doc
from mi_neural.commands.info import info
from mi_neural.commands.plan import plan
from mi_neural.commands.render import render
from mi_neural.commands.reproduce import reproduce
from mi_neural.commands.scenes import scenes
from mi_neural.commands.sequence import sequence

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help=__doc__.split("\n\n")[0],
)


def _version(wanted: bool) -> None:
    if wanted:
        from mi_neural import __version__

        terminal.out.print(__version__, highlight=False)
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None: ...


app.command(cls=options.Command)(render)
app.command(cls=options.Command)(compare)
app.command(cls=options.Command)(sequence)
app.command(cls=options.Command)(reproduce)
app.command(cls=options.Command)(plan)
app.add_typer(scenes)
app.command(cls=options.Command)(info)
app.command(cls=options.Command)(doc)


def main() -> None:
    """Entry point of the program."""
    terminal.stop_alike()
    app()


if __name__ == "__main__":
    main()
