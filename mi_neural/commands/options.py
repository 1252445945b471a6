"""Options that several commands share, and how a command says what went wrong."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperCommand

from mi_neural.bench import load, terminal
from mi_neural.bench.load import InputError

Scene = Annotated[
    str, typer.Argument(metavar="SCENE", help="a Mitsuba XML file, or a name that mi-neural scenes lists")
]
Set = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="a key of each integrator that has it; a.b=v sets key b of the nested plugin a",
    ),
]
Define = Annotated[
    list[str] | None, typer.Option("--define", "-D", metavar="NAME=VALUE", help="a $parameter of the scene")
]
Size = Annotated[str | None, typer.Option(metavar="WxH", help="size of the film, in place of the scene's")]
Seed = Annotated[int, typer.Option(min=0, help="seed of the random numbers; the same seed gives the same image")]
Variant = Annotated[str, typer.Option(help="Mitsuba variant")]
ReferenceFile = Annotated[
    Path | None,
    typer.Option(
        "--reference",
        metavar="REF.exr",
        help="measure errors against this image; its size may be N times that of the film, or an Nth",
    ),
]
Denoise = Annotated[bool, typer.Option("--denoise", help="remove noise by Open Image Denoise, with albedo and normals")]

Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="let the workers of this Dask scheduler do it, for example tcp://HOST:8786"),
]


def readable(command: Callable) -> Callable:
    """Run a command so that what goes wrong is one line on stderr and an exit code. A `~` at the start of a path is the
    user's home, also where the shell left it: in quotes, and after `--output=`."""

    @functools.wraps(command)
    def wrapper(*args, **kwargs):
        kwargs = {name: load.user_path(v) if isinstance(v, Path) else v for name, v in kwargs.items()}
        try:
            return command(*args, **kwargs)
        except KeyboardInterrupt as error:
            terminal.err.print(str(error) or "interrupted", soft_wrap=True, markup=False)
            raise typer.Exit(128 + terminal.stopped_by()) from None
        except (ValueError, OSError, ImportError, RuntimeError) as error:
            if os.environ.get("MI_NEURAL_TRACEBACK"):
                raise
            hint = "" if isinstance(error, (InputError, ImportError)) else " (MI_NEURAL_TRACEBACK=1 shows where)"
            terminal.err.print(f"mi-neural: {load.one_line(error)}{hint}", soft_wrap=True, markup=False)
            raise typer.Exit(2) from None

    return wrapper


def given(context: typer.Context) -> list[str]:
    """The options that were typed, each by its first name."""
    source = {p: context.get_parameter_source(p.name) for p in context.command.params if p.param_type_name == "option"}
    return [p.opts[0] for p, of in source.items() if of is not None and of.name == "COMMANDLINE"]


class Command(TyperCommand):
    """A command that refuses an option which is given again: of its values only the last would count."""

    def parse_args(self, context, arguments):
        typed = list(arguments)
        rest = super().parse_args(context, arguments)
        self._refuse_repeated(self.make_parser(context).parse_args(args=typed)[2])
        return rest

    @readable
    def _refuse_repeated(self, given: list) -> None:
        for option in given:
            single = option.param_type_name == "option" and not (option.multiple or option.is_flag)
            if not single or (n := given.count(option)) == 1:
                continue
            more = "leave all but one out"
            if option.name == "integrator":
                more += ", or compare several: mi-neural compare SCENE -i A -i B -o DIR"
            elif ",..." in (option.metavar or ""):
                more = "separate several values by commas"
            raise InputError(f"{'/'.join(option.opts)} is given {n} times, and {self.name} takes it once: {more}")
