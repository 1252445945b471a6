"""Cache files: NumPy arrays and a header of JSON values in one ``.npz``, written whole or not at all."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np


class CacheFileError(ValueError):
    """A cache file that cannot be used; the message says why and what to do."""


def write(path, header: dict, arrays: dict[str, np.ndarray]) -> None:
    """Write `header` and `arrays` to `path`."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with open(temporary, "wb") as file:
            np.savez(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **arrays)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read(path, version: int, kind: str | None, of_parts):
    """``(of_parts(header, arrays), header)`` of the file at `path`. No code in the file is run.

    Raises `CacheFileError` for a file that is missing, cut short, not ours, of another version or `kind` (see
    :data:`KINDS`), and for all that ``of_parts`` finds wrong.
    """
    path = Path(path)
    try:
        # Opened here: np.load() leaves a damaged file open
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as entries:
            arrays = {k: entries[k] for k in entries.files}
        header = json.loads(bytes(arrays.pop("header")).decode())
        found, found_kind = header["version"], header.get("kind")
    except FileNotFoundError:
        raise CacheFileError(f"there is no cache file '{path}'") from None
    except Exception as e:
        raise _damaged(path, e) from None
    if found_kind != kind:
        raise CacheFileError(f"'{path}' {KINDS.get(kind, KINDS[None])}")
    if found != version:
        raise CacheFileError(
            f"'{path}' has cache format {found}, this version reads {version}; train and save it again"
        )
    try:
        return of_parts(header, arrays), header
    except Exception as e:
        raise _damaged(path, e) from None


#: What is said of a file that is not of the kind asked for.
KINDS = {
    None: "holds no incident radiance alone; train an incident cache and save it",
    "outgoing": "holds no outgoing radiance; train an outgoing cache and save it",
    "pair": "does not hold both incident and outgoing radiance; train and save a cache with termination='auto'",
}


def _damaged(path, error) -> CacheFileError:
    return CacheFileError(f"'{path}' is not a cache file of mi_neural, or is damaged ({error})")


def check_arrays(arrays: dict[str, np.ndarray], known: dict[str, np.ndarray]) -> None:
    """Raise ValueError unless `arrays` have the names and sizes of the `known` ones and are finite."""
    if {k: v.shape for k, v in arrays.items()} != {k: v.shape for k, v in known.items()}:
        raise ValueError("its arrays do not have the sizes that its header says")
    if not all(np.isfinite(v).all() for v in arrays.values()):
        raise ValueError("it holds weights that are not finite")
