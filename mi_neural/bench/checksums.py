"""Checksums of public scenes: of files, of archives that were got before, and of the files of a folder.

The authors publish no checksum of their archives. `scenes/public_files.json` has what is known of their files:

published  files that are the same, byte for byte, in public copies of the archive by at least two owners, named in
           `copies`: meshes, textures, licence and the author's picture. Not the scene file: every copy has edited it
measured   files of the conversion on which the tables of the manual were measured
"""

from __future__ import annotations

import datetime
import functools
import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path

from mi_neural import scenes
from mi_neural.image import exr
from mi_neural.scenes import public

BLOCK = 1 << 18
#: What a list of files is called in a sentence.
WORDS = {"published": "of public copies of the archive", "measured": "that the tables were measured on"}
#: Most files that a sentence names.
MOST = 3


def digest(file: Path) -> str:
    """SHA-256 of a file."""
    found = hashlib.sha256()
    with open(file, "rb") as data:
        while block := data.read(BLOCK):
            found.update(block)
    return found.hexdigest()


@functools.cache
def _lists() -> dict[str, dict]:
    path = Path(scenes.__file__).resolve().parent / "public_files.json"
    return json.loads(path.read_text(encoding="utf-8"))


def files(name: str, which: str) -> dict[str, tuple[int, str]]:
    """Known files of a public scene, `published` or `measured`: path in its folder -> (bytes, SHA-256)."""
    return {path: tuple(facts) for path, facts in _lists().get(name, {}).get(which, {}).items()}


def copies(name: str) -> list[str]:
    """Repositories whose copies of the archive agree, as owner/name on GitHub."""
    return list(_lists().get(name, {}).get("copies", []))


@dataclass
class Compared:
    """The files of a folder beside a list of known ones.

    which      `published` or `measured`
    same       files with the known checksum, `total` of them are known
    differing  files of a known name with another checksum
    unknown    files of which nothing is known
    """

    which: str
    same: list[str] = field(default_factory=list)
    total: int = 0
    differing: list[str] = field(default_factory=list)
    unknown: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """One sentence."""
        if not self.total:
            return "no checksum of its files is known"
        found = f"{len(self.same)} of {self.total} known files are there, byte for byte as those {WORDS[self.which]}"
        found += f"; different: {several(self.differing)}" if self.differing else ""
        return found + (f"; not known: {several(self.unknown)}" if self.unknown else "")


def several(names: list[str]) -> str:
    """The first names of a list, and how many more there are."""
    more = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more


def compare(name: str, folder: Path) -> Compared:
    """Compare the files of a scene's folder with the known ones: of the archive, or, where the folder holds the
    conversion, of that. References and hidden files do not count."""
    here = {file.relative_to(folder).as_posix(): file for file in sorted(folder.rglob("*")) if file.is_file()}
    here = {path: file for path, file in here.items() if not path.startswith(".") and "reference_" not in path}
    lists = {which: files(name, which) for which in WORDS}
    archive_alone = set(lists["published"]) - set(lists["measured"])
    converted = lists["measured"] and not archive_alone & set(here) and set(lists["measured"]) <= set(here)
    which = "measured" if converted else "published"
    known = lists[which]
    found = Compared(which, total=len(known))
    for path, file in here.items():
        if path not in known:
            found.unknown.append(path)
        elif digest(file) == known[path][1]:
            found.same.append(path)
        else:
            found.differing.append(path)
    return found


# ------------------------------------------------------------------------------------------------------------------
# Archives that were got before


def remembered(name: str) -> dict | None:
    """The checksum of the archive that was got last: `sha256`, `from` and `date`; None: there was none."""
    found = read_json(_kept()).get(name)
    return found if isinstance(found, dict) and {"sha256", "from", "date"} <= set(found) else None


def remember(name: str, sha256: str, source: str) -> None:
    """Keep the checksum of an archive, for later ones to be compared with."""
    found = {"sha256": sha256, "from": str(source), "date": datetime.date.today().isoformat()}
    write_json(_kept(), {**read_json(_kept()), name: found})


def _kept() -> Path:
    return public.folder() / "checksums.json"


def read_json(file: Path) -> dict:
    """A dictionary from a file; empty where there is none, or another thing."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_json(file: Path, what: dict) -> None:
    """Write a dictionary; the file is whole at any time."""
    exr.write_text(file, json.dumps(what, indent=1) + "\n")
