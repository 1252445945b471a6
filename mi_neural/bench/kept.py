"""Rows that an unfinished comparison has measured, kept on disk, so that the same command goes on from there.

`rows.jsonl` holds the settings and then a line for each row, written as soon as its image is. It is removed at the end:
a finished comparison is measured anew.
"""

from __future__ import annotations

import json
from pathlib import Path

from mi_neural.image import exr

from .benchmark import WITHOUT_PICTURE, Picture, Row, plain
from .judging import flip_map
from .reference import Reference

FILE = "rows.jsonl"


def settings_of(loaded, cases, plan, reference: Reference, denoised: bool) -> dict[str, object]:
    """All that two runs must have in common for their rows to belong in one table."""
    import mitsuba as mi

    import mi_neural

    settings = {
        "scene": loaded.name, "scene_file": loaded.digest, "parameters": loaded.parameters, "size": loaded.size,
        "integrators": {case.spec.label: case.keys for case in cases}, "plan": vars(plan), "denoised": denoised,
        "reference": [str(reference.path), reference.metadata.get("spp")], "variant": mi.variant(),
        "version": mi_neural.__version__,
    }  # fmt: skip
    return json.loads(json.dumps(plain(settings)))


class Kept:
    """Rows in `folder` that were measured with the same `settings`; those of others are forgotten.

    A row is identified by label, mode, budget, whether it was denoised, and repeat; those of a curve by their samples,
    too. One that an interruption cut short does not count.
    """

    def __init__(self, folder: Path, settings: dict[str, object]) -> None:
        self.folder, self.path = folder, folder / FILE
        self.rows: dict[tuple, Row] = {}
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.is_file() else []
        try:
            if json.loads(lines[0])["settings"] == settings:
                for line in lines[1:]:
                    row = Row(**json.loads(line))
                    there = row.mode in WITHOUT_PICTURE or (folder / str(row.image)).is_file()
                    if not row.interrupted and there:
                        self.rows[_key(row)] = row
        except (IndexError, KeyError, TypeError, ValueError):
            pass  # nothing there, not ours, or the end of an interrupted write: what was read so far counts
        exr.write_text(self.path, json.dumps({"settings": settings}) + "\n" + "".join(map(_line, self.rows.values())))

    def add(self, row: Row) -> None:
        """Remember a row, whose image, if it has one, is written. A row that is kept already is not written again."""
        if self.rows.get(_key(row)) is row:
            return
        self.rows[_key(row)] = row
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(_line(row))

    def pictures(self, keys: list[tuple], reference: Reference | None, exposures) -> list[Picture] | None:
        """The rows of `keys` (label, mode, budget, denoised, repeat) with their images, and before them the curves that
        belong to them; None if a row is missing."""
        found = []
        for key in keys:
            if key not in self.rows:
                return None
            row = self.rows[key]
            if row.mode in WITHOUT_PICTURE:
                found.append(Picture(row, None, None, None))
                continue
            if row.mode == "one-shot":
                curve = (row.label, "curve", *key[2:])
                found += [Picture(r, None, None, None) for k, r in self.rows.items() if k[: len(curve)] == curve]
            try:
                rgb = exr.read(self.folder / str(row.image)).rgb
            except (OSError, ValueError):
                return None
            # Errors stay as they were measured; the map is not on disk
            found.append(Picture(row, None, rgb, flip_map(rgb, reference, exposures)))
        return found

    def finish(self) -> None:
        """Remove the file: all is done and reported."""
        self.path.unlink(missing_ok=True)


def _key(row: Row) -> tuple:
    key = (row.label, row.mode, row.budget_seconds, row.denoised, row.repeat)
    return (*key, row.spp) if row.mode == "curve" else key


def _line(row: Row) -> str:
    return json.dumps(row.to_json()) + "\n"
