"""Measuring an entry in parts that are kept on disk, so that an interrupted command goes on where it stopped.

Below the folder of all results, `measured/GROUP-KEY` holds what belongs together: a file `NAME.json` for each part that
is finished, with its arrays in `NAME.npz`. KEY follows from everything that the measurement depends on, so that results
of other settings, versions or sizes are never mixed. Entries that need the same measurement share it.
"""

from __future__ import annotations

import gc
import hashlib
import json
import time
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mi_neural.bench.benchmark import plain
from mi_neural.bench.budget import Progress
from mi_neural.image import exr


@dataclass
class Part:
    """What one finished part of a measurement gave: `numbers`, as JSON holds them, and `arrays` by name."""

    numbers: dict[str, Any] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)


#: Seconds after which a part that is being measured is kept again.
KEEP_SECONDS = 20.0


class Unfinished:
    """What a part has found so far, so that an interrupted command goes on inside of it."""

    def __init__(self, path: Path) -> None:
        self.path, self._kept = path, time.monotonic()

    def read(self) -> Part | None:
        """What was kept; None where nothing was, or where the file is damaged."""
        try:
            with open(self.path, "rb") as file, np.load(file) as kept:
                arrays = dict(kept)
            return Part(json.loads(str(arrays.pop("numbers"))), arrays)
        except (OSError, KeyError, ValueError, zipfile.BadZipFile):
            return None

    def keep(self, found: Callable[[], Part], now: bool = False) -> None:
        """Write what `found` gives, if :data:`KEEP_SECONDS` have passed since the last time, or `now`."""
        if not now and time.monotonic() - self._kept < KEEP_SECONDS:
            return
        part = found()
        with exr.replacing(self.path) as temporary:
            np.savez(temporary, numbers=json.dumps(plain(part.numbers)), **part.arrays)
        self._kept = time.monotonic()


class Group:
    """Parts in one folder, see :class:`Work`."""

    def __init__(self, folder: Path, progress: Callable[[str], Progress | None]) -> None:
        self.folder, self.progress = folder, progress
        folder.mkdir(parents=True, exist_ok=True)

    def part(self, name: str, measure: Callable[[Progress | None], Part]) -> Part:
        """The part of this name: read from disk where it is finished, else measured by `measure` and written.

        `measure` gets a callable (done, total) for the progress, or None.
        """
        path = self.folder / f"{name}.json"
        try:
            numbers = json.loads(path.read_text(encoding="utf-8"))
            arrays = {}
            if path.with_suffix(".npz").is_file():
                # Opened here: np.load() leaves a damaged file open
                with open(path.with_suffix(".npz"), "rb") as file, np.load(file) as kept:
                    arrays = dict(kept)
            return Part(numbers, arrays)
        except (OSError, ValueError, zipfile.BadZipFile):
            pass  # not there, or damaged: it is measured
        # Scenes and integrators of earlier parts refer to each other in circles. As long as they are there, they are
        # compiled into the kernels of this part, and they could be freed at any moment of it
        gc.collect()
        found = measure(self.progress(name.replace("_", " ")))
        numbers = json.loads(json.dumps(plain(found.numbers)))
        if found.arrays:
            with exr.replacing(path.with_suffix(".npz")) as temporary:
                np.savez(temporary, **found.arrays)
        exr.write_text(path, json.dumps(numbers, indent=1) + "\n")  # last: it says that the part is finished
        self.unfinished(name).path.unlink(missing_ok=True)
        return Part(numbers, found.arrays)

    def unfinished(self, name: str) -> Unfinished:
        """Where the part of this name may keep what it has, while it is measured."""
        return Unfinished(self.folder / f"{name}.unfinished.npz")


class Work:
    """What an entry's `measure` is given.

    folder    of all results; `measured` below it holds finished parts
    quick     whether to measure small
    size      (width, height) of the film, in place of the entry's own
    progress  called with the name of each step; gives a callable (done, total), or None
    """

    def __init__(
        self, folder: Path, quick: bool = False, size: tuple[int, int] | None = None,
        progress: Callable[[str], Progress | None] | None = None,
    ) -> None:  # fmt: skip
        self.folder, self.quick, self.size = folder, quick, size
        self.progress = progress or (lambda text: None)
        self.settings: dict[str, object] = {}

    def choose(self, quick, full):
        """One of two settings, dataclasses with a field `size`; that field is replaced where the user gave a size."""
        chosen = quick if self.quick else full
        return chosen if self.size is None else type(chosen)(**(asdict(chosen) | {"size": self.size}))

    def group(self, name: str, settings: object) -> Group:
        """The folder of parts that were measured with these settings, a dataclass or a dictionary."""
        import mitsuba as mi

        import mi_neural

        values = dict(settings) if isinstance(settings, Mapping) else asdict(settings)
        self.settings |= values
        key = {**values, "variant": mi.variant(), "version": mi_neural.__version__}
        digest = hashlib.sha256(json.dumps(plain(key), sort_keys=True).encode()).hexdigest()[:10]
        return Group(self.folder / "measured" / f"{name}-{digest}", self.progress)
