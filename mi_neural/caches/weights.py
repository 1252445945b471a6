"""Sizes of a learned function, and one set of its weights: a hash grid and an MLP."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from ..render.kernels import on_gpu
from . import backprop, encoding
from .hash_grid import HashGrid

#: Largest sizes of a field: beyond, a slip of the pen or a damaged file fills the memory.
LARGEST = {"n_levels": 32, "n_features": 16, "hashmap_size": 2**24, "base_resolution": 2**12, "width": 1024,
           "n_hidden": 32, "n_outputs": 1024}  # fmt: skip


@dataclass(frozen=True)
class FieldShape:
    """Sizes of a field. Two fields of equal shape can exchange their weights.

    n_levels, n_features  levels of the hash grid (Müller et al. 2022) and values per entry
    hashmap_size          most entries of one level
    base_resolution       cells along an axis on the coarsest level
    per_level_scale       factor from level to level
    direction_degree      of the spherical harmonics of the direction; -1: the field depends on the position alone
    width, n_hidden       of the MLP
    n_outputs             values per query
    leak                  slope of its rectifiers below 0
    surface               what it gets of a surface beside its position, any of `encoding.SURFACE`
    """

    n_levels: int = 8
    n_features: int = 2
    hashmap_size: int = 2**15
    base_resolution: int = 8
    per_level_scale: float = 1.6
    direction_degree: int = 3
    width: int = 16
    n_hidden: int = 2
    n_outputs: int = 3
    leak: float = 0.0
    surface: tuple[str, ...] = ()

    def __post_init__(self):
        object.__setattr__(self, "surface", tuple(self.surface))  # files hold lists
        if unknown := set(self.surface) - set(encoding.SURFACE):
            raise ValueError(f"unknown inputs: {', '.join(sorted(unknown))}; give some of: "
                             f"{', '.join(encoding.SURFACE)}")  # fmt: skip
        for name, most in LARGEST.items():
            if not 1 <= getattr(self, name) <= most:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in 1..{most}")
        if not 1 < self.per_level_scale <= 16:
            raise ValueError(f"per_level_scale is {self.per_level_scale}; it must be greater than 1 and at most 16")
        if not -1 <= self.direction_degree <= 7:
            raise ValueError(f"direction_degree is {self.direction_degree}; it must lie in -1..7")
        if self.hashmap_size % self.n_features:
            raise ValueError(f"hashmap_size ({self.hashmap_size}) must be a multiple of n_features ({self.n_features})")

    @property
    def n_features_total(self) -> int:
        """Values that the hash grid gives for a position."""
        return self.n_levels * self.n_features

    @property
    def n_inputs(self) -> int:
        return self.n_first + (self.direction_degree + 1) ** 2

    @property
    def n_first(self) -> int:
        """Inputs, the first ones, whose share of the first layer is computed once per point."""
        return self.n_features_total + sum(encoding.SURFACE[name] for name in self.surface)

    @property
    def n_encoded(self) -> int:
        """Values that :meth:`Field.encode` gives for a position: the first layer's, and the shortcut's three."""
        return self.width + 3


def _split(mlp, n_first: int) -> dict[str, np.ndarray]:
    """The numbers 1, 2, ... of an MLP's parameters, in the shapes and by the names of one whose first layer is split
    behind its first `n_first` inputs."""
    found, start = {}, 1
    for k, v in mlp.items():
        _, index, name = k.split(".")
        numbers = np.arange(start, start + dr.prod(v.shape)).reshape(v.shape)
        start += numbers.size
        if k == "layers.0.weights":
            numbers, others = numbers[:, :n_first], numbers[:, n_first:]
            found["layers.1.weights"] = others if others.size else np.zeros((len(numbers), 1))
        found[f"layers.{int(index) + (index != '0')}.{name}"] = numbers
    return found


class Weights:
    """One set of weights: a hash grid, an MLP as tensors, and the same MLP packed for queries.

    Queries use cooperative vectors, and so does training on the CPU, see :mod:`.backprop`. In half precision, which
    loses small gradients, training multiplies the tensors.
    """

    DRJIT_STRUCT = {"grid": object, "mlp": object, "packed": object, "order": object}  # noqa: RUF012

    def __init__(self, shape: FieldShape, seed: int, half: bool | None = None):
        # The grid starts near 0; anything from 1e-4 to 1e-1 trained alike
        self.grid = HashGrid(
            mi.Float, 3, n_levels=shape.n_levels, n_features_per_level=shape.n_features,
            hashmap_size=shape.hashmap_size, base_resolution=shape.base_resolution,
            per_level_scale=shape.per_level_scale, init_scale=1e-2, rng=dr.rng(seed=2 * seed),
        )  # fmt: skip

        def layers():
            for _ in range(shape.n_hidden):
                yield nn.Linear(-1, shape.width)
                yield nn.LeakyReLU(shape.leak) if shape.leak else nn.ReLU()
            yield nn.Linear(-1, shape.n_outputs)

        network = nn.Sequential(*layers())
        self.mlp = network.alloc(mi.TensorXf, shape.n_inputs, rng=dr.rng(seed=2 * seed + 1))

        # OptiX multiplies cooperative vectors in half precision, LLVM in single
        self.half = on_gpu() if half is None else half
        storage = mi.TensorXf16 if self.half else mi.TensorXf
        # Packed, the first layer has two parts, for the inputs that are known once per point and for the others
        self.n_first, n_others = shape.n_first, shape.n_inputs - shape.n_first
        _, *rest = layers()
        parts = [nn.Linear(self.n_first, shape.width), nn.Linear(max(n_others, 1), shape.width, bias=False)]
        split = nn.Sequential(*parts, *rest)
        # nn.pack() cannot be frozen, so the order it gives is read off once, by packing the numbers 1, 2, ... digit by
        # digit (half precision counts to 2048)
        digits = []
        for divisor in (1, 1024):
            numbered = split.alloc(storage, self.n_first)
            for k, v in _split(self.mlp, self.n_first).items():
                numbered[k] = storage(np.float32(v // divisor % 1024))
            self.packed = nn.pack(numbered)
            digits.append(mi.UInt32(dr.round(mi.Float(self.packed["weights"]))))
        self.order = digits[0] + 1024 * digits[1]  # 0: padding
        self.pack()

    def parameters(self) -> dict:
        """All parameters by name: ``grid`` and the layers of the MLP."""
        return {"grid": mi.Float(self.grid.data), **{k: mi.TensorXf(v) for k, v in self.mlp.items()}}

    def assign(self, parameters) -> None:
        """Take over `parameters`, for training and for queries."""
        self.grid.data = parameters["grid"]
        for k in self.mlp:
            self.mlp[k] = parameters[k]

    def finite(self):
        """Whether all weights are, 1-wide."""
        return dr.isfinite(dr.sum(dr.detach(self.grid.data)) + dr.sum(mi.Float(self.packed["weights"])))

    def pack(self) -> None:
        """Bring the packed MLP up to date."""
        flat = dr.concat([mi.Float(0), *(dr.detach(v).array for v in self.mlp.values())])
        weights = dr.gather(mi.Float, flat, self.order)
        self.packed["weights"] = type(self.packed["weights"])(weights)

    def differentiable(self, inputs: list) -> list:
        """The MLP's outputs as floats, differentiable with respect to `inputs` and the tensors. Packs the latter."""
        self.pack()  # for queries in the same step
        if self.half:
            n = dr.width(inputs)
            inputs = dr.concat([i + dr.zeros(mi.Float, n) for i in inputs])
            out = self.mlp(mi.TensorXf(inputs, shape=(dr.width(inputs) // n, n)))
            return [out[i, :].array for i in range(out.shape[0])]
        layers = self.packed.layers
        return dr.custom(backprop.Perceptron, inputs, dict(self.mlp.items()), lambda: (layers, self.n_first))

    def __call__(self, inputs: list) -> list:
        """The MLP's outputs by cooperative vectors."""
        return self.finish(self.start(inputs[: self.n_first]), inputs[self.n_first :])

    def start(self, inputs: list) -> list:
        """What the first `n_first` inputs add to the first layer, its bias included: once per point."""
        return [mi.Float(v) for v in self.packed.layers[0](self._vector(inputs))]

    def finish(self, started: list, inputs: list) -> list:
        """The MLP's outputs, given :meth:`start` and the other inputs."""
        x = self._vector(started)
        if inputs:
            x = x + self.packed.layers[1](self._vector(inputs))
        for layer in self.packed.layers[2:]:
            x = layer(x)
        return [mi.Float(o) for o in x]

    def _vector(self, values: list) -> nn.CoopVec:
        return nn.CoopVec(*[mi.Float16(v) for v in values] if self.half else values)


def shortcut(values: list, gain: float) -> mi.Color3f:
    """What the first three of a grid's `values`, those of its coarsest levels, add to the outputs past the network.

    Places have the colours of their light in entries of their own then, which are learned in a few steps. Without it, a
    room entered is learned by moving the network's biases, and the room left is forgotten: in a walk of 30 frames a
    room relMSE 0.2 to 0.4 in the new one, above 1 in the old ones, where with it 0.02 is reached in both.
    """
    return mi.Color3f(*(values[k % len(values)] for k in range(3))) * gain
