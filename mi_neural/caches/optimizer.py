"""One step of a network: Adam, the averaged copy, and the refusal of steps that would destroy what was learned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

#: Steps longer than this share of the network's weights leave nothing of what they were, later ones too little of it.
#: The first step of healthy training is the longest: 0.08 at the default rates of `nirc` and `nrc`, 0.5 in
#: `nvc_lights`; after ten steps none was longer than 0.04 and 0.1.
LONGEST, LONGEST_LATER = 1.0, 0.25
#: From this step on.
LATER = 16


@dataclass
class Stride:
    """What a step of a network may do, and what the latest did. A PyTree of 1-wide floats.

    network_share  all but the hash grid learns at this share of the learning rate
    longest        a step that changes the network by more than this share of its weights is refused (length: Euclidean)
    length         that share, of the latest step; infinite where it led to weights that are not finite

    The loss tells of divergence too late or not at all: it is relative to the cache's own mean, and a network whose
    rectifiers have all died, or whose outputs are saturated, has a small and steady one. The hash grid does not count:
    it starts near 0, and Adam moves its entries by no more than the learning rate.
    """

    network_share: mi.Float
    longest: mi.Float
    length: mi.Float

    @classmethod
    def make(cls, longest: float = LONGEST) -> Stride:
        """Full rates, steps of at most `longest`."""
        return cls(*(dr.opaque(mi.Float, v) for v in (1.0, longest, 0.0)))


def own_copy(value):
    """An evaluated, detached copy in memory of its own: not shared with another variable or with NumPy (such memory
    must not be freed while a function is being frozen)."""
    copy = dr.detach(value) + dr.opaque(mi.Float, 0)
    dr.eval(copy)
    return copy


def attach_adam(parameters: dict, kind: type[Adam] = Adam) -> Adam:
    """An optimiser of copies of `parameters`, by name, that a frozen step can take; β_2 is 0.99. `kind`: Adam, or a
    class derived from it."""
    optimizer = kind(lr=0.0, beta_1=0.9, beta_2=0.99, epsilon=1e-15)
    optimizer.update(parameters)
    # A frozen step is recorded anew when inputs that shared a variable cease to: from the start, share none
    for key, (value, promoted, lr, (t, *moments)) in optimizer.state.items():
        value = own_copy(value)
        dr.enable_grad(value)
        optimizer.state[key] = value, promoted, lr, (dr.opaque(type(t), 0), *moments)
    return optimizer


def descend(
    optimizer: Adam, losses, averaged: dict, learning_rate, decay, stride: Stride | None = None
) -> tuple[dict, mi.Float]:  # fmt: skip
    """One step of Adam down the gradient of the sum of `losses`, a differentiable array. Returns (the new averaged
    parameters, the sum).

    ``averaged <- decay averaged + (1 - decay) current``. A sum that is not finite changes nothing; nor, but for the
    grid that Adam holds, does a step that `stride` refuses, which returns NaN. Learning rate and decay are 1-wide. May
    be frozen.
    """
    stride = stride or Stride.make(math.inf)
    dr.schedule(dr.detach(losses))  # summed beforehand, they would take a kernel of their own that goes forth
    dr.backward(losses)
    loss = dr.sum(dr.detach(losses))
    ok = dr.isfinite(loss)
    before = {k: dr.detach(v) for k, v in optimizer.items() if k != "grid"}
    # A copy for each parameter: Dr.Jit 1.5.0 multiplies a learning rate that is an array in place
    rate, slower = mi.Float(learning_rate), learning_rate * stride.network_share
    optimizer.set_learning_rate({k: mi.Float(rate if k == "grid" else slower) for k in optimizer})
    optimizer.step(eval=False, active=ok)
    optimizer.set_learning_rate({k: None for k in optimizer})

    after = {k: dr.detach(optimizer[k]) for k in before}
    sums = dr.zeros(mi.Float, 2)  # squared lengths of the step and of the weights
    for k, old in before.items():
        moved = dr.square(after[k].array - old.array)
        moved = dr.select(dr.isfinite(moved), moved, math.inf)  # scatter_add of Dr.Jit 1.5.0 leaves NaN out on LLVM
        dr.scatter_add(sums, moved, mi.UInt32(0))
        dr.scatter_add(sums, dr.square(old.array), mi.UInt32(1))
    dr.eval(optimizer, sums)

    stride.length = dr.sqrt(dr.gather(mi.Float, sums, 0) / dr.maximum(dr.gather(mi.Float, sums, 1), 1e-30))
    ok &= dr.isfinite(stride.length) & (stride.length <= stride.longest)
    kept = {k: dr.select(ok, after[k], old) for k, old in before.items()}
    decay = dr.select(ok, decay, 1)
    average = {k: dr.lerp(kept[k] if k in kept else dr.detach(optimizer[k]), v, decay) for k, v in averaged.items()}
    loss = dr.select(ok, loss, math.nan)
    dr.eval(kept, average, stride, loss)
    optimizer.update(kept)
    return average, loss


def moments_of(optimizer: Adam) -> dict[str, np.ndarray]:
    """What an optimiser of :func:`attach_adam` remembers of the steps so far, by names made of its parameters'."""
    arrays = {}
    for key, (_, _, _, (t, first, second, _)) in optimizer.state.items():
        arrays |= {f"adam_steps.{key}": np.array(t), f"first.{key}": np.array(first), f"second.{key}": np.array(second)}
    return arrays


def set_moments(optimizer: Adam, arrays: dict[str, np.ndarray]) -> None:
    """Go on from :func:`moments_of`. Raises ``KeyError`` or ``ValueError`` where something is missing or too long."""
    for key, (value, promoted, lr, (t, *moments, largest)) in optimizer.state.items():
        given = [arrays[f"{name}.{key}"] for name in ("first", "second")]
        steps = int(arrays[f"adam_steps.{key}"].item())
        if steps < 0 or any(a.shape != m.shape for a, m in zip(given, moments, strict=True)):
            raise ValueError(f"the optimiser's moments of {key} do not have the size of its parameters")
        taken = [own_copy(type(m)(np.float32(a))) for a, m in zip(given, moments, strict=True)]
        optimizer.state[key] = value, promoted, lr, (dr.opaque(type(t), steps), *taken, largest)
