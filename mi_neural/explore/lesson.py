"""What the notebooks of this package share beside their figures."""

from __future__ import annotations

import os

#: Set to anything but "" or "0", all cells run in seconds, to see whether they run; what they show then says nothing.
VARIABLE = "MI_NEURAL_NOTEBOOK_TEST"
#: By what sizes are then divided, and what is left at least.
DIVISOR, LEAST = 16, 2


def sizes(*numbers: int) -> tuple[int, ...]:
    """The numbers that decide how long a notebook takes (pixels, samples, frames): as given, or much smaller where
    ``MI_NEURAL_NOTEBOOK_TEST`` is set."""
    if os.environ.get(VARIABLE, "") in ("", "0"):
        return numbers
    return tuple(max(LEAST, n // DIVISOR) for n in numbers)
