"""`mi-neural scenes`: the scenes that have a name, and how to get those that are not shipped."""

from __future__ import annotations

from typing import Annotated

import typer

from mi_neural import scenes as shipped
from mi_neural.bench import fetch, terminal
from mi_neural.commands import options
from mi_neural.scenes import public

scenes = typer.Typer(name="scenes", invoke_without_command=True, rich_markup_mode=None)


@scenes.callback()
@options.readable
def list_(context: typer.Context) -> None:
    """Scenes that every command takes by name: those of the package, and public ones.

    Public ones lie in the folder MI_NEURAL_SCENES, by default in the user's cache.
    """
    if context.invoked_subcommand:
        return
    show = lambda text: terminal.out.print(text, soft_wrap=True, markup=False, highlight=False)  # noqa: E731
    show(f"Shipped: {', '.join(shipped.names())}")
    show(f"\nPublic, in {public.folder()}:")
    for name, scene in public.SCENES.items():
        of_it = [n for n in public.names() if n.partition("/")[0] == name]
        here = all(public.file(n).is_file() for n in of_it)
        wanted = f"mi-neural scenes get {name}{'' if scene.url else ' --from FOLDER or URL'}"
        show(f"\n{', '.join(of_it)}: {'here' if here else f'not here; type {wanted}'}")
        show(f"    '{scene.title}' by {scene.author}; {scene.licence}")
        size = "size not known" if scene.size is None else f"{scene.size / 1e6:.1f} MB"
        sha256 = known_checksum(name, scene)
        show(f"    {f'{scene.url}, {size}, {sha256}' if scene.url else 'no public archive'}")
        if scene.note:
            show(f"    {scene.note}")


def known_checksum(name: str, scene: public.Public) -> str:
    """What is known of the checksum of an archive, in words."""
    if scene.sha256:
        return f"SHA-256 {scene.sha256}"
    if found := fetch.remembered(name):
        return f"SHA-256 {found['sha256']} found {found['date']}"
    return "no checksum known"


@scenes.command()
@options.readable
def get(
    name: Annotated[list[str], typer.Argument(metavar="NAME", help="public scenes")],
    source: Annotated[
        str | None,
        typer.Option("--from", metavar="FOLDER|URL", help="a folder, an archive or a mirror to get it from"),
    ] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="take an archive that differs from the one got before")
    ] = False,
) -> None:
    """Get public scenes into the folder MI_NEURAL_SCENES, by default the user's cache.

    Interrupted, the same command goes on from there.
    """
    for one in name:
        fetch.entry(one)
    for one in name:
        with terminal.Bars() as bars:
            found = fetch.get(one, source, bars(f"getting {one}"), accept)
        if found.sha256:
            known = "no checksum was known before; later ones are compared with it" if found.new else "as expected"
            terminal.out.print(f"SHA-256 {found.sha256}: {known}", soft_wrap=True, markup=False, highlight=False)
        terminal.out.print(f"{found.name} is in {found.folder}", soft_wrap=True, markup=False, highlight=False)
