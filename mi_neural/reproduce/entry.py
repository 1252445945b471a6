"""What a counterpart of a figure is made of: the entry in the list, and what measuring it gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .work import Work

#: The sources by the first part of an entry's name.
SOURCES = {
    "reliability": "Klepikov, Hanika, Dachsbacher: Reliability-Weighted Averaging for Real-Time Neural Incident "
    "Radiance Caching",
    "nirc": "Dereviannykh, Klepikov, Hanika, Dachsbacher: Neural Two-Level Monte Carlo Real-Time Rendering. Computer "
    "Graphics Forum 44(2), e70050, 2025",
    "nvc": "Bokšanský, Meister: Neural Visibility Cache for Real-Time Light Sampling, 2025",
    "fsr": "Advanced Micro Devices, Inc.: AMD FSR Radiance Caching (Preview), version 0.9.0, 2025",
}
#: What `Statement.agrees` means.
WORDS = {True: "agrees", False: "differs", None: "not comparable"}


@dataclass(frozen=True)
class Statement:
    """One number or claim of a source, beside what was measured here.

    paper     what the source prints, with its unit
    where     the place in the source, as "section 4.2"
    ours      the same quantity as measured here
    agrees    whether both agree; None where they cannot be compared, as times on other machines
    distance  by how much they differ
    reason    why we believe that they differ. A page shows it unless they agree
    """

    paper: str
    where: str
    ours: str
    agrees: bool | None
    distance: str = ""
    reason: str = ""

    @property
    def brief(self) -> str:
        """Whether both agree, and by how much they differ."""
        return ", ".join(part for part in (WORDS[self.agrees], self.distance) if part)

    @property
    def verdict(self) -> str:
        """Whether both agree, by how much they differ, and why."""
        return self.brief if self.agrees or not self.reason else f"{self.brief}: {self.reason}"


@dataclass
class Outcome:
    """What an entry shows.

    statements  the source's numbers and claims beside ours
    tables      title -> cells as text, headings first
    pictures    title -> PNG or JPEG file
    notes       lines that a reader must know: settings, what was replaced and why
    """

    statements: list[Statement]
    tables: dict[str, list[list[str]]] = field(default_factory=dict)
    pictures: dict[str, bytes] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Entry:
    """A counterpart of one figure or table.

    name     SOURCE/NAME, with a key of :data:`SOURCES`
    figure   what it is the counterpart of, as "Figure 4"
    shows    one sentence
    scene    names of shipped scenes; or that the entry makes it, by :mod:`.scene_files`
    seconds  what it takes on two cores with nothing else running: with --quick, as measured (CPU seconds over two), and
             without, as estimated from that
    measure  does the work and gives the outcome; what it has finished is kept, see :class:`.work.Work`
    """

    name: str
    figure: str
    shows: str
    scene: str
    seconds: tuple[float, float]
    measure: Callable[[Work], Outcome]

    @property
    def source(self) -> str:
        """The source in words."""
        return SOURCES[self.name.partition("/")[0]]
