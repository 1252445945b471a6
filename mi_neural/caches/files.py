"""Files of what was learned: named arrays, and a header of JSON values. Written whole or not at all; nothing in a file
is ever run."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import numpy as np

from mi_neural.image.exr import replacing

#: Changes when a file written before cannot be read any more.
FILE_VERSION = 4
#: What is said of a file that is not of the kind asked for.
KINDS = {
    "incident": "holds no incident radiance alone; train an incident cache and save it",
    "spatial_hash": "holds no spatial hash; train and save one with cache='spatial_hash'",
    "sh_grid": "holds no grid of spherical harmonics; train and save one with cache='sh_grid'",
    "outgoing": "holds no outgoing radiance; train an outgoing cache and save it",
}
#: Largest size of all arrays together, in bytes: a damaged or hostile file must not fill the memory.
LARGEST = 2**31


class CacheFileError(ValueError):
    """A cache file that cannot be used; the message says why and what to do."""


def write(path, kind: str, header: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write `header` (JSON values) and `arrays` of a cache of some `kind` to an ``.npz`` file.

    Raises ``OSError`` where that fails; a file of that name that was there before is then still there.
    """
    sizes = {name: list(values.shape) for name, values in arrays.items()}
    text = json.dumps({**header, "kind": kind, "version": FILE_VERSION, "arrays": sizes})
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, header=np.frombuffer(text.encode(), np.uint8), **arrays)
        file.flush()
        os.fsync(file.fileno())  # the name must not outlive the content


def read(path, kind: str, unknown: tuple[str, ...] = ()) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of a file of that kind. All numbers are finite but those of arrays named in `unknown`, in which
    NaN stands for what is not known.

    Raises `CacheFileError` for a file that is missing, cut short, not ours, of another kind or version.
    """
    path = Path(path)
    try:
        # Opened here: np.load() leaves a damaged file open
        with open(path, "rb") as file:
            with zipfile.ZipFile(file) as entries:
                size = sum(entry.file_size for entry in entries.infolist())
            if size > LARGEST:
                raise ValueError(f"it would take {size} bytes of memory")
            file.seek(0)
            with np.load(file, allow_pickle=False) as entries:
                arrays = {k: entries[k] for k in entries.files}
        header = json.loads(bytes(arrays.pop("header")).decode())
        found, version = header.get("kind"), header["version"]
    except FileNotFoundError:
        raise CacheFileError(f"there is no cache file '{path}'") from None
    except Exception as e:
        raise damaged(path, e) from None
    if version != FILE_VERSION:
        raise CacheFileError(
            f"'{path}' has cache format {version}, this version reads {FILE_VERSION}; train and save it again"
        )
    if found != kind:
        raise CacheFileError(f"'{path}' {KINDS.get(kind, f'holds no cache of the kind {kind!r}')}")
    if {name: list(values.shape) for name, values in arrays.items()} != header.get("arrays"):
        raise damaged(path, "its arrays are not those that its header says")
    for name, values in arrays.items():
        if not np.issubdtype(values.dtype, np.number) or not (name in unknown or np.isfinite(values).all()):
            raise damaged(path, f"it holds {name} that are not finite numbers")
    return header, arrays


def damaged(path, why) -> CacheFileError:
    """The error for a file whose content makes no sense."""
    return CacheFileError(f"'{path}' is not a cache file of mi_neural, or is damaged ({why})")
