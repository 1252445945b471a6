"""A trainable function of position and direction: hash grid, MLP, optimiser, averaged copy."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from operator import attrgetter

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from ..render.kernels import on_gpu
from . import backprop, encoding, files
from .files import FILE_VERSION, CacheFileError
from .hash_grid import HashGrid
from .optimizer import Stride, attach_adam, descend, moments_of, own_copy, set_moments

__all__ = ["FILE_VERSION", "CacheFileError", "Field", "FieldShape", "TrainedField", "Weights"]

#: Largest sizes of a field: beyond, a slip of the pen or a damaged file fills the memory.
LARGEST = {"n_levels": 32, "n_features": 16, "hashmap_size": 2**24, "base_resolution": 2**12, "width": 1024,
           "n_hidden": 32, "n_outputs": 1024}  # fmt: skip
#: Points are looked up so many cells of the finest level above their surface: both sides of a thin wall are one point,
#: and lifted they are apart (manual, measured).
LIFT = 2.0


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
    width: int = 32
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


class TrainedField:
    """Base of the learned functions: weights being trained, in an optimiser, and their average; copies and files of
    both. Subclasses give `KIND`, `make` and the like, see there.
    """

    #: What such a field holds, in the words of file headers and messages.
    KIND = ""
    #: Arrays beside the weights that training changes, as paths of attributes; those of `UNKNOWN` may hold NaN.
    BESIDE: tuple[str, ...] = ()
    UNKNOWN: tuple[str, ...] = ()
    #: What one set of its weights is.
    WEIGHTS: type

    shape: FieldShape
    current: Weights
    averaged: Weights

    def _attach_optimizer(self) -> None:
        self.optimizer = attach_adam(self.current.parameters())
        self.averaged.assign({k: own_copy(v) for k, v in self.averaged.parameters().items()})
        self.averaged.pack()
        dr.eval(self.optimizer, self.averaged)

    def sync(self) -> None:
        """Bring `current` up to date with training, for queries with ``averaged=False``; a frozen function that makes
        such queries calls it itself, before them."""
        self.current.assign({k: dr.detach(v) for k, v in self.optimizer.items()})
        self.current.order = self.averaged.order  # the same, but known to frozen functions
        self.current.pack()

    def trainable(self) -> Weights:
        """`current`, made of the optimiser's parameters themselves, so that gradients arrive there."""
        self.current.assign(self.optimizer)
        self.current.order = self.averaged.order
        return self.current

    def lift(self, x, n):
        """Where the grid is looked up for a point `x` of a surface: `LIFT` cells towards the unit normal `n`. Without a
        normal, `x` itself."""
        if n is None:
            return x
        shape = self.shape
        share = LIFT / (shape.base_resolution * shape.per_level_scale ** (shape.n_levels - 1))
        return x + mi.Vector3f(n) * (share * dr.rcp(self.box_inv_extent))

    def optimizers(self) -> list:
        """The optimisers that hold the weights being trained."""
        return [self.optimizer]

    def n_parameters(self) -> int:
        """Number of trained numbers."""
        return sum(int(np.prod(v.shape)) for v in self.averaged.parameters().values())

    def snapshot(self) -> dict[str, np.ndarray]:
        """All weights as NumPy arrays."""
        self.sync()
        return {
            f"{name}.{k}": np.array(dr.detach(v))
            for name in ("current", "averaged")
            for k, v in getattr(self, name).parameters().items()
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Weights from :meth:`snapshot` of a field of equal shape; the optimiser's moments start anew."""
        for name in ("current", "averaged"):
            weights = getattr(self, name)
            weights.assign({k: own_copy(type(v)(arrays[f"{name}.{k}"])) for k, v in weights.parameters().items()})
            weights.pack()
        self._attach_optimizer()

    # -------------------------------------------------------------------------------------------------------------
    # To be given by subclasses, beside `reset`

    def constants(self) -> dict:
        """JSON values that :meth:`make` makes such a field of."""
        raise NotImplementedError(f"{type(self).__name__} must define constants()")

    @classmethod
    def make(cls, constants: dict):
        """A field as `constants` describe it. Raises any exception for such that make no sense."""
        raise NotImplementedError(f"{cls.__name__} must define make()")

    def scalars(self) -> dict:
        """Numbers beside the arrays of :meth:`arrays` that training changes."""
        return {"steps": self.steps}

    def set_scalars(self, given: dict) -> None:
        """Go on from :meth:`scalars`. Raises any exception for numbers that make no sense."""
        steps = given["steps"]
        if not (isinstance(steps, int) and steps >= 0):
            raise ValueError(f"it says that {steps} steps were made")
        self.steps = steps

    # -------------------------------------------------------------------------------------------------------------
    # All that training changes

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays that training changes: :meth:`snapshot`, the optimiser's moments, and what is beside."""
        beside = {f"beside.{name}": np.array(attrgetter(name)(self)) for name in self.BESIDE}
        return self.snapshot() | moments_of(self.optimizer) | beside

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        """Go on from :meth:`arrays` of a field of equal shape as if nothing had been in between.

        Raises ``KeyError`` or ``ValueError`` where something is missing or has another size.
        """
        expected = {k: v.shape for k, v in self.snapshot().items()}
        if {k: v.shape for k, v in arrays.items() if k in expected} != expected:
            raise ValueError("its weights do not have the sizes that its header says")
        self.restore(arrays)
        set_moments(self.optimizer, arrays)
        for name in self.BESIDE:
            path, _, attribute = name.rpartition(".")
            owner = attrgetter(path)(self) if path else self
            value, given = getattr(owner, attribute), arrays[f"beside.{name}"]
            if given.shape != np.array(value).shape:
                raise ValueError(f"its {name} does not have the size that its header says")
            setattr(owner, attribute, own_copy(type(value)(given)))

    def checkpoint(self) -> tuple:
        """The whole state, for :meth:`rollback`."""
        return self.arrays(), self.scalars()

    def rollback(self, state: tuple) -> None:
        """Go back to a :meth:`checkpoint`."""
        self.set_arrays(state[0])
        self.set_scalars(state[1])

    # -------------------------------------------------------------------------------------------------------------
    # Files

    def save(self, path, extra: dict[str, np.ndarray] | None = None, **facts) -> None:
        """Write all that training changes, shape, box, scale, and `facts` (JSON values) to an ``.npz`` file, whole or
        not at all. `extra`: further arrays, under names that begin with ``extra.``"""
        arrays = self.arrays() | {f"extra.{k}": v for k, v in (extra or {}).items()}
        files.write(path, self.KIND, {**self.constants(), **self.scalars(), **facts}, arrays)

    @classmethod
    def read(cls, path) -> tuple:
        """(the field of a file, its header, the `extra` arrays). No code in the file is run.

        Raises `CacheFileError` for a file that is missing, cut short, not of such a field, or of another version.
        """
        header, arrays = files.read(path, cls.KIND, cls.UNKNOWN)
        extra = {k.removeprefix("extra."): arrays.pop(k) for k in list(arrays) if k.startswith("extra.")}
        try:
            field = cls.make(header)
            if unknown := arrays.keys() - field.arrays().keys():
                raise ValueError(f"it holds {', '.join(sorted(unknown))}, which is no part of such a cache")
            field.set_arrays(arrays)
            field.set_scalars(header)
        except Exception as e:
            raise files.damaged(path, e) from None
        return field, header, extra

    @classmethod
    def load(cls, path) -> tuple:
        """(the field of a file, its header); see :meth:`read`."""
        return cls.read(path)[:2]


class Field(TrainedField):
    """Values of position and direction, learned online.

    ``query(features, w)`` is `scale` times ``max(0, 1 + MLP(hash grid(x), SH(w)))``: an untrained field answers about
    `scale` everywhere, and constants of training mean the same in every scene. Two sets of weights exist: those being
    trained, and their exponential moving average, which is what queries use unless told otherwise.

    Parameters: `box_min`, `box_max` (corners in world space), `shape`, `scale` (mean radiance of the scene, W/m²/sr or
    whatever the scene's unit is), `seed` (of the initial weights).

    A PyTree: may be passed to frozen functions. The weights being trained are in it once, in the optimiser; `current`
    is a view of them for queries, brought up to date by :meth:`sync`.
    """

    KIND, WEIGHTS = "incident", Weights
    #: Of :func:`shortcut`. In a room lit through a door ajar, 400 steps: relMSE 0.088, 0.092, 0.097 with 0, 8, 16; two
    #: rooms in a row, 30 steps in the second: 0.19, -, 0.005.
    GAIN = 8.0
    DRJIT_STRUCT = {  # noqa: RUF012
        "averaged": object, "optimizer": object, "box_min": object, "box_inv_extent": object,
        "scale": object, "mean": object, "stride": object,
    }  # fmt: skip

    def __init__(self, box_min, box_max, shape: FieldShape | None = None, *, scale: float = 1.0, seed: int = 0):
        self.shape = shape or FieldShape()
        self.seed = seed
        box_min, box_max = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        if not (np.isfinite(box_min).all() and np.isfinite(box_max).all() and (box_max > box_min).all()):
            raise ValueError(f"the box {box_min.tolist()} .. {box_max.tolist()} is empty or not finite")
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number")
        self.box = (box_min.tolist(), box_max.tolist())
        self.box_min = mi.Point3f(box_min.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (box_max - box_min)).tolist())
        self.scale = mi.Float(float(scale))
        self.reset()

    def reset(self) -> None:
        """Start anew: the weights and the optimiser as they were when the field was made, bit for bit."""
        self.current = self.WEIGHTS(self.shape, self.seed)
        self.averaged = self.WEIGHTS(self.shape, self.seed)
        self.mean = mi.Float(1.0)  # running mean of the targets over `scale`
        self.stride = Stride.make()
        self._attach_optimizer()
        self.steps = 0
        dr.make_opaque(self.box_min, self.box_inv_extent, self.scale, self.mean)

    # -------------------------------------------------------------------------------------------------------------
    # Query

    def encode(self, x, n=None, averaged: bool = True, material: tuple | None = None) -> list:
        """What depends on the point alone: once per point, however many directions follow. `n`: its unit normal on the
        side that it is seen from, see :meth:`lift`; `material`: its albedo and roughness, where the shape has them
        as inputs (:func:`~mi_neural.caches.material.material_of`); both the same at training and at queries."""
        more = self.surface_inputs(n, material)
        return self.features(self.averaged if averaged else self.current, self.lift(x, n), *more)

    def surface_inputs(self, n, material: tuple | None) -> list:
        """What the network gets of a surface beside its position."""
        names = getattr(self.shape, "surface", ())
        return encoding.surface_inputs(names, n, material) if names else []

    def raw(self, features: list, w, averaged: bool = True):
        """The network's output over `scale`, not clamped."""
        return self.output(self.averaged if averaged else self.current, features, w)

    def query(self, features: list, w, averaged: bool = True):
        """Radiance from direction `w` (unit, away from the surface) at the encoded position; never negative."""
        return self.answer(self.averaged if averaged else self.current, features, w)

    def features(self, weights: Weights, x, *more) -> list:
        """:meth:`encode` by any weights of this field's shape; `more`: its :meth:`surface_inputs`."""
        values = self._grid_values(weights, x)
        return [*weights.start([*values, *more]), *shortcut(values, self.GAIN)]

    def _grid_values(self, weights: Weights, x) -> list:
        return list(weights.grid(encoding.in_box(x, self.box_min, self.box_inv_extent)))

    def output(self, weights: Weights, features: list, w):
        """:meth:`raw` by any weights of this field's shape."""
        *started, r, g, b = features
        values = weights.finish(started, encoding.direction(w, self.shape.direction_degree))
        return mi.Color3f(*values) + mi.Color3f(r, g, b) + 1

    def answer(self, weights: Weights, features: list, w):
        """:meth:`query` by any weights of this field's shape."""
        value = dr.maximum(self.output(weights, features, w), 0)
        return dr.select(dr.isfinite(value), value, 0) * self.scale

    # -------------------------------------------------------------------------------------------------------------
    # Training

    def predict(self, x, w, n=None, material: tuple | None = None):
        """What :meth:`raw` gives at points with normals `n` for the weights being trained, differentiable with respect
        to them. `material`: see :meth:`encode`.

        Call it once per :meth:`step`, before it.
        """
        weights = self.trainable()
        values = self._grid_values(weights, self.lift(x, n))
        surface = self.surface_inputs(n, material)
        inputs = [*values, *surface, *encoding.direction(w, self.shape.direction_degree)]
        return mi.Color3f(*weights.differentiable(inputs)) + shortcut(values, self.GAIN) + 1

    def step(self, losses, learning_rate, decay):
        """One step of Adam down the gradient of the sum of `losses`, a differentiable array; then the averaged copy.
        Returns the sum.

        ``averaged <- decay averaged + (1 - decay) current``: with a `decay` that grows from 0, as the integrators give
        it, the average is free of bias from its start. What diverges changes nothing and returns NaN, see
        :func:`~mi_neural.caches.optimizer.descend`. May be frozen.
        """
        average, loss = descend(
            self.optimizer, losses, self.averaged.parameters(), learning_rate, decay, self.stride
        )
        self.averaged.assign(average)
        self.averaged.pack()
        return loss

    # -------------------------------------------------------------------------------------------------------------
    # State and files

    def constants(self) -> dict:
        return {"shape": asdict(self.shape), "box": self.box, "scale": float(self.scale[0]), "seed": self.seed}

    @classmethod
    def make(cls, constants: dict) -> Field:
        shape, scale, seed = (constants[k] for k in ("shape", "scale", "seed"))
        return cls(*constants["box"], FieldShape(**shape), scale=scale, seed=seed)

    def scalars(self) -> dict:
        return {**super().scalars(), "mean": float(self.mean[0])}

    def set_scalars(self, given: dict) -> None:
        mean = given["mean"]
        if not (np.isfinite(mean) and mean >= 0):
            raise ValueError(f"it says that targets had a mean of {mean}")
        super().set_scalars(given)
        self.mean = dr.opaque(mi.Float, mean)
