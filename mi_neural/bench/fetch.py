"""Getting public scenes: from their address, a mirror, a folder or an archive on this machine.

The folder of the scenes holds complete scenes only: a scene is unpacked beside it and then moved there. An archive that
was fetched in part is kept, and the same call goes on from there if the server can and its file has not changed.
Archives are checked against the checksum in the catalogue; where none is known, against the one that was found the
first time. Their files are checked against those that are known, see :mod:`.checksums`.
"""

from __future__ import annotations

import contextlib
import datetime
import difflib
import errno
import http.client
import os
import re
import shutil
import stat
import tarfile
import tempfile
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from mi_neural import scenes
from mi_neural.scenes import public

from . import checksums
from .checksums import BLOCK
from .load import InputError, user_path

Progress = Callable[[float, float | None], None]
SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2")
#: Seconds without an answer after which a server counts as silent.
SILENCE = 30
#: Upper bound of what an archive unpacks to, in bytes: larger ones are damaged or meant to fill the disk.
MOST_BYTES = 8 << 30


@dataclass
class Found:
    """A scene that was got. `sha256`: of its archive, None where it came as a folder; `new`: nothing was known to
    compare it with; `files`: its files beside the known ones, None where it was there before."""

    name: str
    folder: Path
    sha256: str | None = None
    new: bool = False
    files: checksums.Compared | None = None


def entry(name: str) -> tuple[str, public.Public]:
    """The public scene of that name, or of that file: (its own name, what is known of it). Raises `InputError`."""
    own = name.partition("/")[0]
    if own in public.SCENES and (name == own or name in public.names()):
        return own, public.SCENES[own]
    if name in scenes.names():
        raise InputError(f"{name} is shipped with the package: there is nothing to get")
    known = [*public.SCENES, *public.names()]
    close = difflib.get_close_matches(name, known, 1)
    hint = f", did you mean {close[0].partition('/')[0]!r}?" if close else ""
    raise InputError(f"no public scene {name!r}{hint}; there are: {', '.join(public.SCENES)}")


def get(name: str, source: str | None = None, progress: Progress | None = None, accept: bool = False) -> Found:
    """Get a public scene into :func:`~mi_neural.scenes.public.folder`; one that is there already is left as it is.

    source    a folder that holds the scene's folder or archive, an archive, or the address of an archive or of a
              folder with it (http or https); None: the scene's own address
    progress  is called with the bytes that came, and all of them where the server says how many
    accept    take an archive whose checksum differs from that of an earlier one, and files that differ from known ones

    Raises :class:`InputError` where it cannot be had, or is not what it should be; nothing is left half-made then.
    """
    name, scene = entry(name)
    target = public.folder() / name
    if all((target / f"{file}.xml").is_file() for file in scene.files):
        return Found(name, target)
    if target.exists():
        raise InputError(f"{target} is there but lacks a scene file of {', '.join(scene.files)}: remove it, try again")
    if source is None and scene.url is None:
        raise InputError(f"{name} has no public archive ({scene.note}): give --from FOLDER or URL")
    try:
        public.folder().mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write to {public.folder()} ({error.strerror}): set MI_NEURAL_SCENES") from None
    if source is None or source.startswith(("http://", "https://")):
        archive = download(address(scene, name, source), _part(name), progress)
    else:
        archive = local(user_path(source), name, scene)
    if archive.is_dir():
        copied = _install(name, scene, source, accept, lambda new: shutil.copytree(archive, new, dirs_exist_ok=True))
        return Found(name, target, files=copied)
    fetched = archive.parent == _parts()
    try:
        sha256 = checksums.digest(archive)
        new = check(name, scene, sha256, accept)
        files = _install(name, scene, source or scene.url, accept, lambda new: unpack(archive, new), sha256)
    except InputError:
        if fetched:  # complete, but not the right file: continuing it would not help
            _forget(archive)
        raise
    checksums.remember(name, sha256, source or scene.url)
    if fetched:
        _forget(archive)
    return Found(name, target, sha256, new, files)


# ------------------------------------------------------------------------------------------------------------------
# Where it comes from


def address(scene: public.Public, name: str, source: str | None) -> str:
    """The address of the archive: the scene's own, that of an archive, or its name in a mirror's folder."""
    if source is None or source.lower().endswith(SUFFIXES):
        return source or scene.url
    return f"{source.rstrip('/')}/{scene.archive or f'{name}.zip'}"


def local(source: Path, name: str, scene: public.Public) -> Path:
    """The scene's folder or archive in a place of this machine. Raises `InputError`."""
    if source.is_file():
        return source
    if not source.is_dir():
        raise InputError(f"--from {source}: there is no such folder or archive")
    for folder in (source / name, source):
        if all((folder / f"{file}.xml").is_file() for file in scene.files):
            return folder
    archives = [source / archive for archive in (scene.archive, *(name + s for s in SUFFIXES)) if archive]
    if found := next((archive for archive in archives if archive.is_file()), None):
        return found
    raise InputError(f"--from {source}: it holds neither a folder {name} with {', '.join(scene.files)}.xml nor an "
                     f"archive {scene.archive or f'{name}.zip'}")  # fmt: skip


def download(url: str, part: Path, progress: Progress | None = None) -> Path:
    """Fetch `url` into the file `part`, which may hold the beginning of it; returns `part`, whole.

    Raises :class:`InputError` where it does not come whole; what came is kept.
    """
    part.parent.mkdir(parents=True, exist_ok=True)
    state = part.with_suffix(".json")
    known = checksums.read_json(state)
    start = part.stat().st_size if part.is_file() and known.get("url") == url and known.get("tag") else 0
    headers = {"Range": f"bytes={start}-", "If-Range": known["tag"]} if start else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=SILENCE) as answer:
            sent = answer.headers.get("Content-Range", "")
            start = start if answer.status == 206 and sent.startswith(f"bytes {start}-") else 0  # else it sends all
            tag = answer.headers.get("ETag") or answer.headers.get("Last-Modified")
            checksums.write_json(state, {"url": url, "tag": None if tag and tag.startswith("W/") else tag})
            length = answer.headers.get("Content-Length")
            total = None if length is None else start + int(length)
            done = _receive(answer, part, start, total, progress)
    except urllib.error.HTTPError as error:
        if error.code == 416 and start:  # it is shorter than what is here
            _forget(part)
            return download(url, part, progress)
        raise InputError(f"{url}: the server says {error.code} {error.reason}; give --from FOLDER or URL") from None
    except (urllib.error.URLError, http.client.HTTPException, OSError) as error:
        raise InputError(_stopped(url, part, getattr(error, "reason", None) or error)) from None
    except KeyboardInterrupt:
        raise KeyboardInterrupt(_stopped(url, part, "interrupted")) from None
    if total is not None and done != total:
        raise InputError(_stopped(url, part, "the connection ended early"))
    return part


def _receive(answer, part: Path, start: int, total: int | None, progress: Progress | None) -> int:
    """Write what a server sends behind the first `start` bytes of a file; returns how many it has then."""
    with open(part, "r+b" if start else "wb") as file:
        file.seek(start)
        file.truncate()
        while block := answer.read(BLOCK):
            file.write(block)
            if progress:
                progress(file.tell(), total)
        return file.tell()


def _stopped(url: str, part: Path, why) -> str:
    kept = part.stat().st_size if part.is_file() else 0
    again = f"{kept / 1e6:.1f} MB are kept, the same command goes on from there" if kept else "nothing came"
    return f"{url}: {why}; {again}. Or give --from FOLDER or URL"


# ------------------------------------------------------------------------------------------------------------------
# Whether it is what it should be


def check(name: str, scene: public.Public, sha256: str, accept: bool = False) -> bool:
    """Compare the checksum of an archive with the known one; returns whether none is known. Raises `InputError`."""
    if scene.sha256:
        if sha256 != scene.sha256:
            raise InputError(f"the archive of {name} is not the one that is known: its SHA-256 is {sha256}, it should "
                             f"be {scene.sha256}")  # fmt: skip
        return False
    before = checksums.remembered(name)
    if before and before["sha256"] != sha256 and not accept:
        raise InputError(f"the archive of {name} has changed: its SHA-256 is {sha256}, that of {before['from']} was "
                         f"{before['sha256']} on {before['date']}; add --accept if you want the new one")  # fmt: skip
    return before is None or before["sha256"] != sha256


# ------------------------------------------------------------------------------------------------------------------
# Unpacking


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip or tar archive. Raises `InputError`, before a file is written, where one would lie outside."""
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as opened:
                for member in opened.infolist():
                    _refuse_outside(archive, member.filename, stat.S_ISLNK(member.external_attr >> 16))
                _refuse_large(archive, sum(member.file_size for member in opened.infolist()))
                opened.extractall(folder)
        elif tarfile.is_tarfile(archive):
            with tarfile.open(archive) as opened:
                for member in opened.getmembers():
                    _refuse_outside(archive, member.name, not (member.isfile() or member.isdir()))
                _refuse_large(archive, sum(member.size for member in opened.getmembers()))
                opened.extractall(folder, **({"filter": "data"} if hasattr(tarfile, "data_filter") else {}))
        else:
            raise InputError(f"{archive.name} is no zip or tar archive; is the address right?")
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, EOFError, NotImplementedError) as error:
        raise InputError(f"{archive.name} is damaged: {error}") from None
    except OSError as error:
        if error.errno != errno.EINVAL:  # a place before the beginning of the file
            raise
        raise InputError(f"{archive.name} is damaged") from None


def _refuse_outside(archive: Path, name: str, is_link: bool) -> None:
    path = PurePosixPath(name.replace("\\", "/"))
    if is_link or path.is_absolute() or ".." in path.parts or re.match("[A-Za-z]:", name):
        raise InputError(f"{archive.name} holds {name!r}, which is a link or lies outside of its folder: refused")


def _refuse_large(archive: Path, size: int) -> None:
    if size > MOST_BYTES:
        raise InputError(f"{archive.name} would unpack to {size / 1e9:.0f} GB: refused")


def _install(
    name: str, scene: public.Public, source, accept: bool, fill: Callable[[Path], object], sha256: str | None = None
) -> checksums.Compared:  # fmt: skip
    """Have `fill` write the scene into a folder beside its place, check it and its files, and move it there."""
    with _temporary(public.folder()) as new:
        fill(new)
        root = _root(new, scene)
        if root is None:
            raise InputError(f"{source} holds no {scene.main} or {', '.join(f'{file}.xml' for file in scene.files)}")
        if not (root / "scene.xml").exists() and (root / scene.main).is_file():
            os.replace(root / scene.main, root / "scene.xml")
        compared = checksums.compare(name, root)
        if compared.differing and not accept:
            raise InputError(f"files of {name} are not those {checksums.WORDS[compared.which]}: "
                             f"{checksums.several(compared.differing)}; add --accept if you want them")  # fmt: skip
        facts = {"from": str(source), "sha256": sha256, "date": datetime.date.today().isoformat()}
        checksums.write_json(root / ".mi_neural.json", facts)
        os.replace(root, public.folder() / name)
        return compared


def _root(folder: Path, scene: public.Public) -> Path | None:
    """The folder that holds the scene files: `folder`, or one below it."""

    def holds(place: Path) -> bool:
        return all((place / f"{file}.xml").is_file() for file in scene.files) or (
            scene.files == ("scene",) and (place / scene.main).is_file())  # fmt: skip

    places = [folder, *sorted(p for p in folder.rglob("*") if p.is_dir())]
    return next((place for place in places if holds(place)), None)


@contextlib.contextmanager
def _temporary(parent: Path):
    """A folder that is removed afterwards, also after an error."""
    folder = Path(tempfile.mkdtemp(prefix=".new-", dir=parent))
    folder.chmod(0o755)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# ------------------------------------------------------------------------------------------------------------------
# Files of its own


def _parts() -> Path:
    return public.folder() / ".parts"


def _part(name: str) -> Path:
    return _parts() / f"{name}.part"


def _forget(part: Path) -> None:
    for file in (part, part.with_suffix(".json")):
        file.unlink(missing_ok=True)
