"""The function that NRC learns: outgoing radiance over reflectance, by a hash grid and an MLP (Müller et al. 2021).

The reflectance is factored out: the network learns ``L / albedo``, so that it need not know textures, and queries
multiply it back. :mod:`.outgoing` trains it in a scene.
"""


from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import encoding, loss
from .field import TrainedField
from .optimizer import Stride, descend
from .places import N_PLACES, Places
from .voxels import Voxels, check_box
from .weights import FieldShape, Weights, shortcut

#: Reflectances below this count as this, so that no target is divided by 0 and black surfaces have an answer.
ALBEDO_MIN = 0.05
#: Targets above this many times the scale are cut.
TARGET_MAX = 1e4
#: Of the relative loss, over the squared scale (Müller et al. 2021).
EPSILON = 1e-2
#: Bins of the roughness, encoded as 1 - e^-roughness.
ROUGHNESS_BINS = 4
#: What the network can be told of a surface beside its position.
INPUTS = ("normal", "view", "albedo", "roughness")
#: Cells along the longest axis of the box in which training records are counted, and entries of their table.
DENSITY_CELLS, DENSITY_ENTRIES = 32, 2**15


@dataclass(frozen=True)
class OutgoingShape(FieldShape):
    """Sizes of an outgoing field, see :class:`~mi_neural.caches.weights.FieldShape`.

    Spherical harmonics encode the view direction (`direction_degree`) and the normal (`normal_degree`). Measured on an
    analytic function of all inputs, most normals along the axes, squared error after 300 steps: degree 3 for both
    0.139, degree 2 0.163, plain x, y, z 0.169, one-blob of polar angles (4 bins each) 0.180, neither 0.66; their costs
    lie within the noise. Unlike polar angles they have no pole, and floors have their normal at the pole.

    `inputs`: what the network is told of a surface beside its position, any of `INPUTS`.
    """

    width: int = 32
    normal_degree: int = 3
    inputs: tuple[str, ...] = INPUTS

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "inputs", tuple(self.inputs))  # files hold lists
        if unknown := set(self.inputs) - set(INPUTS):
            raise ValueError(f"unknown inputs: {', '.join(sorted(unknown))}; give some of: {', '.join(INPUTS)}")
        for name in ("direction_degree", "normal_degree"):
            if not 0 <= getattr(self, name) <= 7:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in 0..7")
        if self.n_outputs != 3:
            raise ValueError(f"n_outputs is {self.n_outputs}; outgoing radiance has 3, its colours")

    @classmethod
    def like(cls, sizes: FieldShape) -> OutgoingShape:
        """The sizes of the grid and the network of another field."""
        return cls(
            n_levels=sizes.n_levels, hashmap_size=sizes.hashmap_size, width=sizes.width, n_hidden=sizes.n_hidden
        )

    @property
    def n_inputs(self) -> int:
        directions = [(degree + 1) ** 2 - 1 for degree in (self.normal_degree, self.direction_degree)]  # no constants
        sizes = dict(zip(INPUTS, (*directions, 3, ROUGHNESS_BINS), strict=True))
        return self.n_levels * self.n_features + sum(sizes[name] for name in self.inputs)

    @property
    def n_first(self) -> int:
        return self.n_inputs  # every query is at another point


def reflectance(albedo):
    """The factor that is taken out of the targets and multiplied back at queries."""
    return dr.maximum(albedo, ALBEDO_MIN)


class OutgoingField(TrainedField):
    """Outgoing radiance as a function of position, normal, view direction, albedo and roughness, learned online.

    ``query(...)`` is ``albedo * scale * max(0, 1 + MLP(...))``: an untrained field answers about `scale` for a surface
    of albedo 1. Queries use averaged weights unless told otherwise.

    Parameters: `box_min`, `box_max` (corners in world space), `shape`, `scale` (mean of radiance over albedo, in the
    scene's unit; None: measured on the first records, and until then all answers are 0), `seed` (of the initial
    weights).

    Arguments of its methods: `x` (world space), `n` (unit shading normal on the side of `w`), `w` (unit, away from the
    surface, towards the viewer), `albedo` (diffuse and specular reflectance together, RGB), `roughness` (at least 0).

    A PyTree: may be passed to frozen functions, and queried in symbolic loops. `current` is a view of the weights being
    trained, brought up to date by :meth:`sync`.
    """

    KIND = "outgoing"
    #: Of :func:`~mi_neural.caches.weights.shortcut`.
    GAIN = 3.0
    BESIDE = ("density", "places.position", "places.view", "places.age")
    UNKNOWN = ("beside.places.position",)
    DRJIT_STRUCT = {  # noqa: RUF012
        "averaged": object, "optimizer": object, "box_min": object, "box_inv_extent": object, "scale": object,
        "eta": object, "density": object, "places": object, "voxels": object,
        "stride": object,
    }  # fmt: skip

    def __init__(
        self, box_min, box_max, shape: OutgoingShape | None = None, *, scale: float | None = 1.0, seed: int = 0
    ):
        self.shape, self.seed = shape or OutgoingShape(), seed
        box_min, box_max = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        check_box(box_min, box_max)
        if scale is not None and not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number, or None")
        self.box = (box_min.tolist(), box_max.tolist())
        self.box_min = mi.Point3f(box_min.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (box_max - box_min)).tolist())
        self.voxels = Voxels(box_min, box_max, DENSITY_CELLS)
        self.given_scale = None if scale is None else float(scale)
        self.reset()

    def reset(self) -> None:
        """Start anew: the weights, the scale and the optimiser as they were when the field was made, bit for bit."""
        self.current = Weights(self.shape, self.seed)
        self.averaged = Weights(self.shape, self.seed)
        self._attach_optimizer()
        self.scale = mi.Float(self.given_scale or 0.0)
        self.stride = Stride.make()
        self.eta = mi.Float(0.0)  # 1 - a^t: the share of the average that training has filled
        self.density = dr.zeros(mi.Float, DENSITY_ENTRIES)  # mean training records of a step in each cell
        self.places = Places(N_PLACES)
        self.steps = 0
        dr.make_opaque(self.box_min, self.box_inv_extent, self.scale, self.eta, self.density, self.places)

    # -------------------------------------------------------------------------------------------------------------
    # Query

    def usable(self, x, n, w, albedo, roughness):
        """Mask of the inputs that the network may see: finite, the two directions of about unit length."""
        finite = dr.all(dr.isfinite(x)) & dr.all(dr.isfinite(albedo)) & dr.isfinite(roughness)
        return finite & (dr.squared_norm(n) < 4) & (dr.squared_norm(w) < 4)

    def _encode(self, weights: Weights, x, n, w, albedo, roughness) -> list:
        encoded = {
            "normal": lambda: encoding.direction(n, self.shape.normal_degree)[1:],
            "view": lambda: encoding.direction(w, self.shape.direction_degree)[1:],
            "albedo": lambda: dr.clip(albedo, 0, 1),
            "roughness": lambda: encoding.one_blob(1 - dr.exp(-dr.maximum(roughness, 0)), ROUGHNESS_BINS),
        }
        values = list(weights.grid(encoding.in_box(self.lift(x, n), self.box_min, self.box_inv_extent)))
        for name in INPUTS:
            if name in self.shape.inputs:
                values += list(encoded[name]())
        return values

    def _past(self, values: list):
        return shortcut(values[: self.shape.n_features_total], self.GAIN)

    def raw(self, x, n, w, albedo, roughness, averaged: bool = True):
        """The network's output: radiance over albedo and `scale`, not clamped; all inputs must be `usable`."""
        weights = self.averaged if averaged else self.current
        values = self._encode(weights, x, n, w, albedo, roughness)
        return mi.Color3f(*weights(values)) + self._past(values) + 1

    def query(self, x, n, w, albedo, roughness, averaged: bool = True):
        """Radiance that leaves the surface towards `w`; never negative, and 0 where an input is not `usable`."""
        return self.answer(self.averaged if averaged else self.current, x, n, w, albedo, roughness)

    def answer(self, weights: Weights, x, n, w, albedo, roughness):
        """:meth:`query` by any weights of this field's shape."""
        usable = self.usable(x, n, w, albedo, roughness)
        inputs = _sanitize(usable, x, n, w, albedo, roughness)
        values = self._encode(weights, *inputs)
        value = dr.maximum(mi.Color3f(*weights(values)) + self._past(values) + 1, 0)
        value = value * self.scale * reflectance(inputs[3])
        return dr.select(usable & dr.all(dr.isfinite(value)), value, 0)

    # -------------------------------------------------------------------------------------------------------------
    # Training

    def predict(self, x, n, w, albedo, roughness):
        """What :meth:`raw` gives for the weights being trained, differentiable with respect to them."""
        weights = self.trainable()
        values = self._encode(weights, x, n, w, albedo, roughness)
        return mi.Color3f(*weights.differentiable(values)) + self._past(values) + 1

    def learn(
        self, x, n, w, albedo, roughness, target, valid, learning_rate, smoothing, epsilon=EPSILON,
        compare: Callable | None = None,
    ):  # fmt: skip
        """One step of Adam on records of radiance `target`, then the averaged copy. May be frozen.

        The loss is ``mean |p - y|² / (luminance(p)² + ε)`` with p and y over albedo and `scale`. The average is

            w̄_t = (1 - a)/η_t w_t + a η_{t-1}/η_t w̄_{t-1},   η_t = a η_{t-1} + 1 - a   (η_t = 1 - a^t for constant a)

        with a = `smoothing`: 0 is no smoothing, 1 changes nothing that averaged queries see. Records whose inputs or
        targets are not finite are left out; with no record left, or a loss that is not finite, nothing changes
        (but Adam's own count of steps).

        `learning_rate` and `smoothing` are 1-wide Dr.Jit floats. ``compare(y, p, usable)``, if given, is called before
        the step with targets and predictions, both over albedo. Returns (loss, mean target, mean |prediction|, number
        of records left out), 1-wide, the first three over `scale`; the loss is NaN where there was nothing to learn.
        """
        with dr.suspend_grad():
            usable = valid & self.usable(x, n, w, albedo, roughness) & dr.all(dr.isfinite(target))
            n_bad = dr.count(valid & ~usable)
            x, n, w, albedo, roughness = _sanitize(usable, x, n, w, albedo, roughness)
            y = dr.select(usable, dr.maximum(target, 0) / reflectance(albedo), 0)
            n_usable = dr.count(usable)
            share = dr.rcp(mi.Float(dr.maximum(n_usable, 1)))
            level = dr.sum(loss.luminance(y)) * share
            known = self.scale > 0
            scale = dr.select(known, self.scale, level)
            able = (n_usable > 0) & dr.isfinite(scale) & (scale > 1e-30)
            scale = dr.select(able, scale, 1)
            y = dr.minimum(y / scale, TARGET_MAX)
            mean_target = dr.sum(loss.luminance(y)) * share
            dr.eval(usable, n_bad, x, n, w, albedo, roughness, y, share, able, scale, mean_target)

        p = self.predict(x, n, w, albedo, roughness)
        prediction = dr.detach(p)
        dr.schedule(prediction)
        if compare is not None:
            with dr.suspend_grad():
                compare(y * scale, dr.maximum(prediction, 0) * scale, usable)
        errors = dr.select(usable, loss.relative_l2(p, y, epsilon), 0) * share
        errors = dr.select(able, errors, math.nan)
        eta = smoothing * self.eta + (1 - smoothing)
        decay = dr.select(smoothing < 1, smoothing * self.eta / dr.maximum(eta, 1e-30), 1)
        averaged, error = descend(
            self.optimizer, errors, self.averaged.parameters(), learning_rate, decay, self.stride
        )
        self.averaged.assign(averaged)
        self.averaged.pack()
        learned = dr.isfinite(error)
        moves = learned & (smoothing < 1)
        mean_prediction = dr.sum(dr.select(usable, dr.abs(loss.luminance(prediction)), 0)) * share
        self.eta = dr.select(moves, eta, self.eta)
        self.scale = dr.select(moves, scale, self.scale)
        dr.eval(self.averaged, self.eta, self.scale)
        return error, mean_target, mean_prediction, n_bad

    # -------------------------------------------------------------------------------------------------------------
    # Where records lie

    def _cell(self, x):
        return self.voxels.entry(x, DENSITY_ENTRIES)

    def count(self, x, valid, decay) -> None:
        """Take this step's records into `density`: ``density <- decay density + (1 - decay) count``."""
        counted = dr.zeros(mi.Float, DENSITY_ENTRIES)
        dr.scatter_add(counted, 1, self._cell(x), valid)
        self.density = dr.lerp(counted, self.density, decay)
        dr.eval(self.density)

    def density_at(self, x):
        """Mean number of training records per step in the cell of `x`."""
        return dr.gather(mi.Float, self.density, self._cell(x))

    def typical_density(self):
        """Mean of :meth:`density_at` over the training records themselves, 1-wide; 0 before the first."""
        return dr.sum(dr.square(self.density)) / dr.maximum(dr.sum(self.density), 1e-30)

    # -------------------------------------------------------------------------------------------------------------
    # State and files

    def constants(self) -> dict:
        return {"shape": asdict(self.shape), "box": self.box, "given_scale": self.given_scale, "seed": self.seed}

    @classmethod
    def make(cls, constants: dict) -> OutgoingField:
        shape, scale, seed = (constants[k] for k in ("shape", "given_scale", "seed"))
        return cls(*constants["box"], OutgoingShape(**shape), scale=scale, seed=seed)

    def scalars(self) -> dict:
        return {**super().scalars(), "scale": float(self.scale[0]), "eta": float(self.eta[0])}

    def set_arrays(self, arrays: dict[str, np.ndarray]) -> None:
        super().set_arrays(arrays)
        self.places.forget_media()

    def set_scalars(self, given: dict) -> None:
        scale, eta = given["scale"], given["eta"]
        if not (0 <= scale < math.inf and 0 <= eta <= 1):
            raise ValueError(f"it says a scale of {scale} and an average filled to {eta}")
        super().set_scalars(given)
        self.scale, self.eta = dr.opaque(mi.Float, scale), dr.opaque(mi.Float, eta)


def _sanitize(usable, x, n, w, albedo, roughness) -> tuple:
    """The inputs with finite stand-ins where they are not usable."""
    up = mi.Vector3f(0, 0, 1)
    return (
        dr.select(usable, mi.Point3f(x), 0), dr.select(usable, mi.Vector3f(n), up),
        dr.select(usable, mi.Vector3f(w), up), dr.select(usable, mi.Color3f(albedo), 0),
        dr.select(usable, mi.Float(roughness), 0),
    )  # fmt: skip
