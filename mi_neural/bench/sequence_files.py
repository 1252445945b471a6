"""Files of a sequence, from which an interrupted run goes on: frames, their rows, and caches."""

from __future__ import annotations

import json
import re
from pathlib import Path

from mi_neural.image import exr

from .budget import clock

#: Share of the time that saving a cache may take.
KEEP_SHARE = 0.05


def frame_path(folder: Path, frame: int) -> Path:
    """The file of a frame."""
    return folder / f"frame_{frame:04d}.exr"


def write_rows(folder: Path, rows: list[dict[str, object]]) -> None:
    exr.write_text(folder / "frames.jsonl", "".join(json.dumps(row) + "\n" for row in rows))


def read_json(path: Path) -> dict[str, object]:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}


class Keeper:
    """Cache files of one case: `cache_0012.npz` is the state after 12 frames. Saves as often as it costs little."""

    def __init__(self, integrator, folder: Path) -> None:
        self.integrator, self.folder = integrator, folder
        self.able = hasattr(integrator, "save_cache") and hasattr(integrator, "load_cache")
        self.cost, self.saved = 0.0, clock()
        if self.able:
            try:
                with exr.replacing(folder / "cache_probe.npz") as probe:
                    integrator.save_cache(str(probe))
                (folder / "cache_probe.npz").unlink()
            except RuntimeError:  # settings with which no cache is ever queried
                self.able = False
            self.cost, self.saved = clock() - self.saved, clock()

    def load(self, n_done: int) -> int | None:
        """Bring back the latest state that is not after `n_done` frames; returns after how many. None: begin anew."""
        if not self.able:
            return n_done or None
        counts = [n for n in self._counts() if n <= n_done]
        if not counts:
            return None
        self.integrator.load_cache(str(self._path(max(counts))))
        return max(counts)

    def due(self) -> bool:
        """Whether saving now keeps its share of the time."""
        return self.able and KEEP_SHARE * (clock() - self.saved) >= self.cost

    def save(self, n_done: int) -> None:
        """Keep the state after `n_done` frames, and no other."""
        if not self.able:
            return
        start = clock()
        self.integrator.save_cache(str(self._path(n_done)))
        for n in self._counts():
            if n != n_done:
                self._path(n).unlink()
        self.saved = clock()
        self.cost = self.saved - start

    def _path(self, n: int) -> Path:
        return self.folder / f"cache_{n:04d}.npz"

    def _counts(self) -> list[int]:
        matches = (re.fullmatch(r"cache_(\d+)\.npz", p.name) for p in self.folder.iterdir())
        return [int(m[1]) for m in matches if m]
