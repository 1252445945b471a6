"""Several scenes at once: those of a folder, and a name for each."""

from __future__ import annotations

import re
from pathlib import Path

from .load import InputError, find_scene

_INCLUDE = re.compile(r"""<include\b[^>]*\bfilename\s*=\s*["']([^"']+)["']""")
_SCENE = re.compile(r"<scene\b")


def scenes_in(folder: Path) -> list[Path]:
    """All scene files in a folder and below it, in alphabetical order, without those that others include.

    Raises :class:`~mi_neural.bench.load.InputError` where there are none.
    """
    if not folder.is_dir():
        raise InputError(f"no folder {folder}: --scenes takes one that holds scene files")
    texts = {}
    for file in sorted(folder.rglob("*.xml")):
        text = file.read_text(encoding="utf-8", errors="replace")
        if _SCENE.search(text):
            texts[file.resolve()] = text
    included = {(file.parent / name).resolve() for file, text in texts.items() for name in _INCLUDE.findall(text)}
    found = [file for file in texts if file not in included]
    if not found:
        raise InputError(f"no scene files in {folder}: they end in .xml and hold a <scene>")
    return found


def choose(names: list[str] | None, folder: Path | None) -> list[Path]:
    """The scene files that are named or lie in a folder that is named, each once."""
    files = [find_scene(name) for name in names or []] + (scenes_in(folder) if folder is not None else [])
    if not files:
        raise InputError("no scene: give names or files, or --scenes DIR for all in a folder")
    return list(dict.fromkeys(files))


def titles(files: list[Path]) -> list[str]:
    """A name for each scene file, none of them twice: its own, or its folder's if it is called `scene.xml`.

    Files of one name are numbered, by numbers that no other file's name ends in. Names that differ in case alone count
    as one, because some file systems make one folder of them.
    """
    names = [file.parent.name if file.stem == "scene" else file.stem for file in files]
    known = [name.casefold() for name in names]
    taken, found = {name for name in known if known.count(name) == 1}, []
    for name in names:
        if known.count(name.casefold()) > 1:
            numbered = (f"{name}_{n}" for n in range(1, 2 * len(files) + 1))
            name = next(one for one in numbered if one.casefold() not in taken)
            taken.add(name.casefold())
        found.append(name)
    return found
