"""`mi-neural scenes`: the scenes that have a name, and how to get those that are not shipped."""

from __future__ import annotations

from typing import Annotated

import typer

from mi_neural import scenes as shipped
from mi_neural.bench import checksums, fetch, terminal
from mi_neural.bench.load import InputError
from mi_neural.commands import options
from mi_neural.scenes import public

scenes = typer.Typer(name="scenes", invoke_without_command=True, rich_markup_mode=None)


@scenes.callback()
@options.readable
def list_(context: typer.Context) -> None:
    """List the scenes that every command takes by name, and get public ones.

    Public ones lie in the folder MI_NEURAL_SCENES, by default ~/.cache/mi_neural/scenes.
    """
    if context.invoked_subcommand:
        return
    show(f"Shipped: {', '.join(shipped.names())}")
    show(f"\nPublic, in {public.folder()}:")
    for name, scene in public.SCENES.items():
        of_it = [n for n in public.names() if n.partition("/")[0] == name]
        here = all(public.file(n).is_file() for n in of_it)
        wanted = f"mi-neural scenes get {name}{'' if scene.url else ' --from FOLDER or URL'}"
        show(f"\n{', '.join(of_it)}: {'here' if here else f'not here; type {wanted}'}")
        show(f"    '{scene.title}' by {scene.author}; {scene.licence}")
        size = "size not known" if scene.size is None else f"{scene.size / 1e6:.1f} MB"
        known = f"{size}, {known_checksum(name, scene)}"
        show(f"    {f'{scene.url}, {known}' if scene.url else 'no public archive'}; {known_files(name)}")
        if scene.note:
            show(f"    {scene.note}")


def known_checksum(name: str, scene: public.Public) -> str:
    """What is known of the checksum of an archive, in words."""
    if scene.sha256:
        return f"SHA-256 {scene.sha256}"
    if found := checksums.remembered(name):
        return f"SHA-256 {found['sha256']} found {found['date']}"
    return "no checksum of it known"


def known_files(name: str) -> str:
    """How many files of a scene have a known checksum, and how large they are."""
    words = {"published": "its files", "measured": "the files of our conversion"}
    found = {of: checksums.files(name, which) for which, of in words.items()}
    return "checksums of " + " and ".join(
        f"{len(known)} of {of} ({sum(size for size, _ in known.values()) / 1e6:.1f} MB)" for of, known in found.items()
        if known)  # fmt: skip


def show(text: str) -> None:
    """Print a line as it is, for a terminal of any width."""
    terminal.out.print(text, soft_wrap=True, markup=False, highlight=False)


@scenes.command(cls=options.Command)
@options.readable
def get(
    name: Annotated[list[str], typer.Argument(metavar="NAME", help="public scenes")],
    source: Annotated[
        str | None,
        typer.Option("--from", metavar="FOLDER|URL", help="a folder, an archive or a mirror to get it from"),
    ] = None,
    accept: Annotated[
        bool, typer.Option("--accept", help="take an archive, or files, that differ from what is known")
    ] = False,
) -> None:
    """Get public scenes into the folder MI_NEURAL_SCENES, by default ~/.cache/mi_neural/scenes.

    After an interruption the same command goes on.
    """
    for one in name:
        fetch.entry(one)
    for one in name:
        with terminal.Bars() as bars:
            found = fetch.get(one, source, bars(f"getting {one}"), accept)
        if found.sha256:
            known = "no checksum was known before; later ones are compared with it" if found.new else "as expected"
            show(f"SHA-256 {found.sha256}: {known}")
        if found.files:
            show(found.files.text)
        show(f"{found.name} is in {found.folder}")
        scene = public.SCENES[found.name]
        show(f"'{scene.title}' by {scene.author}; {scene.licence}")


@scenes.command(cls=options.Command)
@options.readable
def check(
    name: Annotated[list[str] | None, typer.Argument(metavar="NAME", help="public scenes; default: all here")] = None,
) -> None:
    """Compare the files of public scenes on this machine with the known checksums."""
    wanted = [fetch.entry(one)[0] for one in name or public.SCENES]
    here = [one for one in wanted if (public.folder() / one).is_dir()]
    if missing := [one for one in wanted if name and one not in here]:
        raise InputError(f"{missing[0]} is not on this machine: type mi-neural scenes get {missing[0]}")
    found = {one: checksums.compare(one, public.folder() / one) for one in here}
    for one, compared in found.items():
        show(f"{one}: {compared.text}")
    if different := [one for one, compared in found.items() if compared.differing]:
        raise InputError(f"files of {', '.join(different)} are not the known ones")
