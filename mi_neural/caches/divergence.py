"""Noticing that training diverges by the length of its steps."""

from __future__ import annotations

import drjit as dr
import numpy as np

#: Steps longer than this share of the network's weights leave nothing of what they were, later ones too little of it.
#: The first step of healthy training is the longest: 0.08 at the default rates of `nirc` and `nrc`, 0.5 in
#: `nvc_lights`; after ten steps none was longer than 0.04 and 0.1.
LONGEST, LONGEST_LATER = 1.0, 0.25
#: From this step on.
LATER = 16


class StepWatch:
    """Compares the network in an optimiser with what it was a step before.

    The loss tells too late or not at all: it is relative to the cache's own mean, and a network whose rectifiers have
    all died, or whose outputs are saturated, has a small and steady one. The hash grid is left out: it starts near 0.
    """

    def begin(self, *optimizers) -> None:
        """Remember the weights before a step."""
        self.known = [_network(o) for o in optimizers]

    def step(self, *optimizers) -> float:
        """Length of the step since `begin`, over that of the weights before it; NaN where they are not finite, 0 where
        there is no network."""
        with np.errstate(all="ignore"):
            moved = [np.linalg.norm(_network(o) - w) for o, w in zip(optimizers, self.known, strict=True)]
            lengths = [m / max(np.linalg.norm(w), 1e-30) for m, w in zip(moved, self.known, strict=True)]
            return float(np.max(lengths, initial=0.0))


def healthy(length: float, steps: int) -> bool:
    """Whether the latest of so many steps was of a length with which training can go on."""
    return length <= (LONGEST if steps <= LATER else LONGEST_LATER)


def _network(optimizer) -> np.ndarray:
    layers = [np.array(dr.detach(v), np.float64).ravel() for k, v in optimizer.items() if k != "grid"]
    return np.concatenate(layers) if layers else np.zeros(0)
