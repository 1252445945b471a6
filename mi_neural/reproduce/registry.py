"""The list of entries, and finding those that a user names."""

from __future__ import annotations

import difflib

from mi_neural.bench.load import InputError

from . import fsr, made_scenes, nirc, nirc_images, nvc, nvc_settings, reliability, reliability_times
from .entry import SOURCES, Entry


def _of(source: str, *modules) -> list[Entry]:
    """The entries of a source, by name."""
    found = [e for m in modules for e in m.ENTRIES if e.name.partition("/")[0] == source]
    return sorted(found, key=lambda entry: entry.name)


#: All entries by name, in the order of the list.
ENTRIES: dict[str, Entry] = {
    entry.name: entry
    for entry in (
        *reliability.ENTRIES,
        *reliability_times.ENTRIES,
        *_of("nirc", nirc, nirc_images, made_scenes),
        *_of("nvc", nvc, nvc_settings, made_scenes),
        *fsr.ENTRIES,
    )
}


def find(name: str) -> list[Entry]:
    """The entry of this name, or all of a source. Raises :class:`InputError` for an unknown name, with close ones."""
    if name in ENTRIES:
        return [ENTRIES[name]]
    if name in SOURCES:
        return [e for e in ENTRIES.values() if e.name.startswith(f"{name}/")]
    last = {e.rpartition("/")[2]: e for e in ENTRIES}
    close = difflib.get_close_matches(name, ENTRIES, 3, 0.5)
    close += [last[k] for k in difflib.get_close_matches(name.rpartition("/")[2], last, 2)]
    close = list(dict.fromkeys(close)) or list(ENTRIES)
    raise InputError(f"there is no entry {name!r}; close to it: {', '.join(close)} (mi-neural reproduce lists all)")
