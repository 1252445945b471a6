"""How training goes on from step to step."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .optimizer import LATER, LONGEST, LONGEST_LATER
from .voxels import Ages


@dataclass(frozen=True)
class Ramp:
    """A learning rate that falls linearly, and averaged weights whose horizon grows. Subclasses give the numbers.

    n_points                points per step
    ema_decay               longest horizon of the averaged weights that queries use: 1 / (1 - ema_decay) steps
    first_rate, last_rate   learning rates of Adam
    ramp                    steps from one to the other
    """

    n_points: int
    ema_decay: float
    first_rate: float
    last_rate: float
    ramp: int = 200

    def __post_init__(self):
        if self.n_points < 4:
            raise ValueError(f"n_points is {self.n_points}; it must be at least 4")
        if not 0 <= self.ema_decay <= 1:
            raise ValueError(f"ema_decay is {self.ema_decay}; it must lie in [0, 1]")
        if not (self.first_rate > 0 and self.last_rate > 0):
            raise ValueError(
                f"the learning rates are first_rate={self.first_rate} and last_rate={self.last_rate}; they must be "
                "greater than 0"
            )

    def rate(self, step):
        """Learning rate after so many steps, a number or a Dr.Jit array."""
        return self.first_rate + (self.last_rate - self.first_rate) * dr.minimum(step / max(self.ramp, 1), 1.0)

    def decay(self, step):
        """Decay of a step: the average spans the last third of the steps so far, at most the full horizon."""
        return dr.minimum(self.ema_decay, 1 - 1 / (step / 3 + 1))


def pace(training, ages: Ages, x, valid, rate_factor, *fields) -> tuple:
    """(learning rate, decay of the average) for records at x, by how long their places have been trained; 1-wide.

    `training` gives ``rate(step)`` and ``decay(step)``. Networks of `fields` learn at a share of that rate, which their
    `stride` is told: places that are out of view need them as they are, and new ones are learned by the entries of the
    grid. It is told how long a step may be, too. May be frozen.
    """
    age = ages.age(x, valid)
    learning_rate, decay = mi.Float(training.rate(age) * rate_factor), mi.Float(training.decay(age))
    share, longest = dr.square(1 - ages.novelty), dr.select(ages.total <= LATER, mi.Float(LONGEST), LONGEST_LATER)
    dr.eval(learning_rate, decay, share, longest)
    for field in fields:
        if hasattr(field, "stride"):
            field.stride.network_share, field.stride.longest = share + 0, longest + 0  # not the same variables twice
            dr.eval(field.stride)
    return learning_rate, decay
