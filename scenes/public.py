"""Public scenes that are not part of the package: where they come from, and where they lie on this machine.

A scene is called by the name of its folder, `veach-ajar`, or of a file in it, `sponza-gray/sun`. Folders are looked
for in `folder()`. :mod:`mi_neural.bench.fetch` gets them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

#: Where Benedikt Bitterli's archives for Mitsuba lie.
BITTERLI = "https://benedikt-bitterli.me/resources/mitsuba/"
CC0, CC_BY = "CC0", "CC BY 3.0: name the author and link the licence"


@dataclass(frozen=True)
class Public:
    """A public scene.

    title, author, licence   as its source has them
    url      of the archive; None: no archive of it is public, `note` says why
    size     of the archive, in bytes; None: not known
    sha256   of the archive; None: not known
    main     the scene file in the archive that becomes `scene.xml`
    files    names of the scene files, without suffix
    note     what a reader must know beside
    """

    title: str
    author: str
    licence: str
    url: str | None
    size: int | None = None
    sha256: str | None = None
    main: str = "scene_v3.xml"
    files: tuple[str, ...] = ("scene",)
    note: str = ""

    @property
    def archive(self) -> str | None:
        """File name of the archive."""
        return self.url and self.url.rsplit("/", 1)[1]


def _bitterli(name: str, title: str, author: str, licence: str) -> Public:
    return Public(title, author, licence, f"{BITTERLI}{name}.zip")


#: The public scenes of the tables in the manual.
SCENES: dict[str, Public] = {
    "cornell-box": _bitterli("cornell-box", "Cornell Box", "Benedikt Bitterli", CC0),
    "living-room": _bitterli("living-room", "The Grey & White Room", "Wig42", CC_BY),
    "staircase2": _bitterli("staircase2", "Modern Hall", "NewSee2l035", CC_BY),
    "veach-ajar": _bitterli("veach-ajar", "Veach, Ajar", "Benedikt Bitterli", CC0),
    "veach-bidir": _bitterli("veach-bidir", "Veach, Bidir Room", "Benedikt Bitterli", CC0),
    "sponza-gray": Public(
        "Crytek Sponza without textures", "Frank Meinl, Crytek", CC_BY, None,
        files=("sun", "lights32", "lights1024", "lights24k"),
        note="our conversion, with lights of our own, is published nowhere yet; the geometry is "
        "https://casual-effects.com/g3d/data10/common/model/crytek_sponza/sponza.zip",
    ),
}  # fmt: skip


def folder() -> Path:
    """The folder of the public scenes: MI_NEURAL_SCENES, else one under XDG_CACHE_HOME, by default ~/.cache."""
    if own := os.environ.get("MI_NEURAL_SCENES"):
        return Path(own).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or (os.environ.get("LOCALAPPDATA") if os.name == "nt" else None)
    return Path(base or Path.home() / ".cache") / "mi_neural" / "scenes"


def names() -> list[str]:
    """Every name that a command takes, `sponza-gray/sun` for one file of several; in alphabetical order."""
    found = []
    for name, scene in SCENES.items():
        found += [name] if scene.files == ("scene",) else [f"{name}/{file}" for file in scene.files]
    return sorted(found)


def file(name: str) -> Path:
    """Where the scene file of one of `names()` lies, or would lie."""
    scene, _, part = name.partition("/")
    return folder() / scene / f"{part or 'scene'}.xml"
