"""NRC: the neural radiance cache of what surfaces send out (Müller et al. 2021), and its use without our integrators.

The cache learns ``L(x, ω)``: the radiance that leaves the surface at x towards ω, whatever of it the caller puts into
the targets (with or without emission, with or without direct light: the same at training and at queries). The
reflectance is factored out: the network learns ``L / albedo``, so that it need not know textures, and queries multiply
it back. :class:`OutgoingField` is the function that is learned, :class:`OutgoingCache` trains it in a scene,
:class:`RadianceCache` is a whole cache for other renderers, with the interface of AMD's guide "FSR Radiance Caching"
(the seed).
"""

from __future__ import annotations

import enum
import json
import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.freezing import undisturbed
from ..transport.samples import PathSampler
from ..transport.suffixes import CONTENTS, Suffixes, packed, scene_is_glossy, trace_suffixes
from . import encoding, loss
from .field import CacheFileError, FieldShape, Weights, attach_adam, descend, own_copy
from .incident import SCALE_TRIM, IncidentCache, Training

#: Changes when a file written before cannot be read any more.
FILE_VERSION = 1
#: Reflectances below this count as this, so that no target is divided by 0 and black surfaces have an answer.
ALBEDO_MIN = 0.05
#: Targets above this many times the scale are cut.
TARGET_MAX = 1e4
#: Of the relative loss, over the squared scale (Müller et al. 2021).
EPSILON = 1e-2
#: Bins of the roughness, encoded as 1 - e^-roughness.
ROUGHNESS_BINS = 4
#: Defaults of the guide.
LEARNING_RATE, WEIGHT_SMOOTHING = 0.002, 0.99
#: Cells along each axis of the box in which training records are counted.
DENSITY_CELLS = 32
#: Places that are remembered, and steps after which all earlier ones weigh as much as the next 1000.
N_PLACES, PLACES_HORIZON = 4096, 1000


@dataclass(frozen=True)
class OutgoingShape(FieldShape):
    """Sizes of an outgoing field, see :class:`~mi_neural.caches.field.FieldShape`.

    Spherical harmonics encode the view direction (`direction_degree`) and the normal (`normal_degree`). Measured on an
    analytic function of all inputs, most normals along the axes, squared error after 300 steps: degree 3 for both
    0.139, degree 2 0.163, plain x, y, z 0.169, one-blob of polar angles (4 bins each) 0.180, neither 0.66; their costs
    lie within the noise. Unlike polar angles they have no pole, and floors have their normal at the pole.
    """

    normal_degree: int = 3

    def __post_init__(self):
        super().__post_init__()
        for name in ("direction_degree", "normal_degree"):
            if not 0 <= getattr(self, name) <= 7:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in 0..7")
        if self.n_outputs != 3:
            raise ValueError(f"n_outputs is {self.n_outputs}; outgoing radiance has 3, its colours")

    @property
    def n_inputs(self) -> int:
        directions = (self.direction_degree + 1) ** 2 - 1 + (self.normal_degree + 1) ** 2 - 1  # no constants
        return self.n_levels * self.n_features + directions + 3 + ROUGHNESS_BINS


def reflectance(albedo):
    """The factor that is taken out of the targets and multiplied back at queries."""
    return dr.maximum(albedo, ALBEDO_MIN)


def _check_box(box_min: np.ndarray, box_max: np.ndarray) -> None:
    finite = box_min.shape == box_max.shape == (3,) and np.isfinite([box_min, box_max]).all()
    if not (finite and (box_max > box_min).all()):
        raise ValueError(f"the box {box_min.tolist()} .. {box_max.tolist()} is empty or not finite")


class Places:
    """Where records lay, and from where they were seen: an even sample of all steps so far, so that training can come
    back to what has left the view. A PyTree.

    position   world space; not finite: unknown
    view       towards the viewer
    age        steps so far, 1-wide
    """

    DRJIT_STRUCT = {"position": object, "view": object, "age": object}  # noqa: RUF012

    def __init__(self, n: int):
        self.position = dr.full(mi.Point3f, math.nan, n)
        self.view = dr.zeros(mi.Vector3f, n)
        self.age = mi.Float(0)

    def copy(self) -> Places:
        out = Places(1)
        out.position, out.view, out.age = mi.Point3f(self.position), mi.Vector3f(self.view), mi.Float(self.age)
        return out

    def remember(self, position, view, valid, sampler) -> None:
        """Put random records of this step into so many random places as make all steps equally likely (reservoir
        sampling); after a horizon, recent ones more so."""
        self.age = self.age + 1
        n = dr.width(valid)
        i = dr.minimum(mi.UInt32(sampler.next_1d() * n), n - 1)
        new = dr.gather(mi.Bool, valid, i)
        new &= (sampler.next_1d() * dr.minimum(self.age, PLACES_HORIZON) < 1) | ~dr.isfinite(self.position.x)
        self.position = dr.select(new, dr.gather(mi.Point3f, position, i, new), self.position)
        self.view = dr.select(new, dr.gather(mi.Vector3f, view, i, new), self.view)
        dr.eval(self.position, self.view, self.age)


class OutgoingField:
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

    DRJIT_STRUCT = {  # noqa: RUF012
        "averaged": object, "optimizer": object, "box_min": object, "box_inv_extent": object, "scale": object,
        "eta": object, "density": object, "places": object,
    }  # fmt: skip

    def __init__(
        self, box_min, box_max, shape: OutgoingShape | None = None, *, scale: float | None = 1.0, seed: int = 0
    ):
        self.shape, self.seed = shape or OutgoingShape(), seed
        box_min, box_max = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        _check_box(box_min, box_max)
        if scale is not None and not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale is {scale}; it must be a positive number, or None")
        self.box = (box_min.tolist(), box_max.tolist())
        self.box_min = mi.Point3f(box_min.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (box_max - box_min)).tolist())
        self.given_scale = None if scale is None else float(scale)
        self.reset()

    def reset(self) -> None:
        """Start anew: the weights, the scale and the optimiser as they were when the field was made, bit for bit."""
        self.current = Weights(self.shape, self.seed)
        self.averaged = Weights(self.shape, self.seed)
        self._attach_optimizer()
        self.scale = mi.Float(self.given_scale or 0.0)
        self.eta = mi.Float(0.0)  # 1 - a^t: the share of the average that training has filled
        self.density = dr.zeros(mi.Float, DENSITY_CELLS**3)  # mean training records of a step in each cell of the box
        self.places = Places(N_PLACES)
        self.steps = 0
        dr.make_opaque(self.box_min, self.box_inv_extent, self.scale, self.eta, self.density, self.places)

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

    # -------------------------------------------------------------------------------------------------------------
    # Query

    def usable(self, x, n, w, albedo, roughness):
        """Mask of the inputs that the network may see: finite, the two directions of about unit length."""
        finite = dr.all(dr.isfinite(x)) & dr.all(dr.isfinite(albedo)) & dr.isfinite(roughness)
        return finite & (dr.squared_norm(n) < 4) & (dr.squared_norm(w) < 4)

    def _encode(self, weights: Weights, x, n, w, albedo, roughness) -> list:
        return [
            *weights.grid(encoding.to_unit_cube(x, self.box_min, self.box_inv_extent)),
            *encoding.direction(n, self.shape.normal_degree)[1:],
            *encoding.direction(w, self.shape.direction_degree)[1:],
            *dr.clip(albedo, 0, 1),
            *encoding.one_blob(1 - dr.exp(-dr.maximum(roughness, 0)), ROUGHNESS_BINS),
        ]

    def raw(self, x, n, w, albedo, roughness, averaged: bool = True):
        """The network's output: radiance over albedo and `scale`, not clamped; all inputs must be `usable`."""
        weights = self.averaged if averaged else self.current
        return mi.Color3f(*weights(self._encode(weights, x, n, w, albedo, roughness))) + 1

    def query(self, x, n, w, albedo, roughness, averaged: bool = True):
        """Radiance that leaves the surface towards `w`; never negative, and 0 where an input is not `usable`."""
        usable = self.usable(x, n, w, albedo, roughness)
        inputs = _sanitize(usable, x, n, w, albedo, roughness)
        value = dr.maximum(self.raw(*inputs, averaged), 0) * self.scale * reflectance(inputs[3])
        return dr.select(usable & dr.all(dr.isfinite(value)), value, 0)

    # -------------------------------------------------------------------------------------------------------------
    # Training

    def predict(self, x, n, w, albedo, roughness):
        """What :meth:`raw` gives for the weights being trained, differentiable with respect to them."""
        self.current.assign(self.optimizer)
        width = dr.width((x, n, w, albedo, roughness))
        inputs = [i + dr.zeros(mi.Float, width) for i in self._encode(self.current, x, n, w, albedo, roughness)]
        out = self.current.mlp(mi.TensorXf(dr.concat(inputs), shape=(self.shape.n_inputs, width)))
        return mi.Color3f(*(out[i, :].array for i in range(3))) + 1

    def learn(self, x, n, w, albedo, roughness, target, valid, learning_rate, smoothing, epsilon=EPSILON):
        """One step of Adam on records of radiance `target`, then the averaged copy. May be frozen.

        The loss is ``mean |p - y|² / (luminance(p)² + ε)`` with p and y over albedo and `scale`. The average is

            w̄_t = (1 - a)/η_t w_t + a η_{t-1}/η_t w̄_{t-1},   η_t = a η_{t-1} + 1 - a   (η_t = 1 - a^t for constant a)

        with a = `smoothing`: 0 is no smoothing, 1 changes nothing that averaged queries see. Records whose inputs or
        targets are not finite are left out; with no record left, or a loss that is not finite, nothing changes
        (but Adam's own count of steps).

        `learning_rate` and `smoothing` are 1-wide Dr.Jit floats. Returns (loss, mean target, mean |prediction|, number
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
        error = dr.sum(dr.select(usable, loss.relative_l2(p, y, epsilon), 0)) * share
        error = dr.select(able, error, math.nan)
        mean_prediction = dr.sum(dr.select(usable, dr.abs(loss.luminance(dr.detach(p))), 0)) * share
        dr.schedule(mean_prediction)

        learned = dr.isfinite(dr.detach(error))
        moves = learned & (smoothing < 1)
        eta = smoothing * self.eta + (1 - smoothing)
        decay = dr.select(smoothing < 1, smoothing * self.eta / dr.maximum(eta, 1e-30), 1)
        self.averaged.assign(descend(self.optimizer, error, self.averaged.parameters(), learning_rate, decay))
        self.averaged.pack()
        self.eta = dr.select(moves, eta, self.eta)
        self.scale = dr.select(moves, scale, self.scale)
        dr.eval(self.averaged, self.eta, self.scale)
        return dr.detach(error), mean_target, mean_prediction, n_bad

    # -------------------------------------------------------------------------------------------------------------
    # Where records lie

    def _cell(self, x):
        unit = encoding.to_unit_cube(x, self.box_min, self.box_inv_extent)
        i = mi.Point3u(dr.minimum(unit * DENSITY_CELLS, DENSITY_CELLS - 1))
        return (i.z * DENSITY_CELLS + i.y) * DENSITY_CELLS + i.x

    def count(self, x, valid, decay) -> None:
        """Take this step's records into `density`: ``density <- decay density + (1 - decay) count``."""
        counted = dr.zeros(mi.Float, DENSITY_CELLS**3)
        dr.scatter_add(counted, 1, self._cell(x), valid)
        self.density = dr.lerp(counted, self.density, decay)
        dr.eval(self.density)

    def density_at(self, x):
        """Mean number of training records per step in the cell of `x`."""
        return dr.gather(mi.Float, self.density, self._cell(x))

    # -------------------------------------------------------------------------------------------------------------
    # Files

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

    def save(self, path, **facts) -> None:
        """Write weights, shape, box, scale and `facts` (JSON values) to an ``.npz`` file, whole or not at all."""
        path = Path(path)
        header = {
            "kind": "outgoing", "version": FILE_VERSION, "shape": asdict(self.shape), "box": self.box,
            "given_scale": self.given_scale, "scale": float(self.scale[0]), "eta": float(self.eta[0]),
            "seed": self.seed, "steps": self.steps, **facts,
        }  # fmt: skip
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with open(temporary, "wb") as file:
                np.savez(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8), **self.snapshot())
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    @staticmethod
    def load(path) -> tuple[OutgoingField, dict]:
        """The field of a file, and its header. No code in the file is run.

        Raises `CacheFileError` for a file that is missing, cut short, not of an outgoing field, or of another version.
        """
        path = Path(path)
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as entries:
                arrays = {k: entries[k] for k in entries.files}
            header = json.loads(bytes(arrays.pop("header")).decode())
            version, kind = header["version"], header.get("kind")
        except FileNotFoundError:
            raise CacheFileError(f"there is no cache file '{path}'") from None
        except Exception as e:
            raise CacheFileError(f"'{path}' is not a cache file of mi_neural, or is damaged ({e})") from None
        if kind != "outgoing":
            raise CacheFileError(f"'{path}' holds no outgoing radiance; train an outgoing cache and save it")
        if version != FILE_VERSION:
            raise CacheFileError(
                f"'{path}' has cache format {version}, this version reads {FILE_VERSION}; train and save it again"
            )
        try:
            shape = OutgoingShape(**header["shape"])
            field = OutgoingField(*header["box"], shape, scale=header["given_scale"], seed=header["seed"])
            if {k: v.shape for k, v in arrays.items()} != {k: v.shape for k, v in field.snapshot().items()}:
                raise ValueError("its arrays do not have the sizes that its header says")
            if not all(np.isfinite(v).all() for v in arrays.values()):
                raise ValueError("it holds weights that are not finite")
            scale, eta, steps = header["scale"], header["eta"], header["steps"]
            if not (isinstance(steps, int) and steps >= 0 and 0 <= scale < math.inf and 0 <= eta <= 1):
                raise ValueError(f"it says {steps} steps, a scale of {scale} and an average filled to {eta}")
            field.restore(arrays)
            field.scale, field.eta, field.steps = dr.opaque(mi.Float, scale), dr.opaque(mi.Float, eta), steps
        except Exception as e:
            raise CacheFileError(f"'{path}' is not a cache file of mi_neural, or is damaged ({e})") from None
        return field, header


def _sanitize(usable, x, n, w, albedo, roughness) -> tuple:
    """The inputs with finite stand-ins where they are not usable."""
    up = mi.Vector3f(0, 0, 1)
    return (
        dr.select(usable, mi.Point3f(x), 0), dr.select(usable, mi.Vector3f(n), up),
        dr.select(usable, mi.Vector3f(w), up), dr.select(usable, mi.Color3f(albedo), 0),
        dr.select(usable, mi.Float(roughness), 0),
    )  # fmt: skip


# -----------------------------------------------------------------------------------------------------------------
# Training in a scene


@dataclass(frozen=True)
class OutgoingTraining(Training):
    """Constants of one training step; those of :class:`~mi_neural.caches.incident.Training`, and

    epsilon           of the relative loss, over the squared scale. Relative squared error of the cache seen directly,
                      300 steps in a stairwell: 0.070 with 0.01, 0.069 with 0.1, 0.066 with 1
    n_records         places for records in a step; more are left out
    suffix, threshold, world_share, roughening, content
                      see :class:`~mi_neural.transport.suffixes.Suffixes`
    unbounded_share   share of the paths that run on without self-training (Müller et al. 2021: 1/16). In a room lit
                      through a door ajar the image had 0.77 of its light after 300 steps with 0, 0.94 with 1/16, 0.98
                      with 1/4; in a stairwell 1.00 with any
    """

    epsilon: float = 1.0
    n_records: int | None = None
    suffix: str = "spread"
    threshold: float = 0.01
    unbounded_share: float = 1 / 16
    world_share: float = 0.25
    roughening: float = 0.0
    content: str = "reflected"

    def __post_init__(self):
        super().__post_init__()
        for name, choices in (("suffix", ("spread", "full")), ("content", CONTENTS)):
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} is '{getattr(self, name)}'; give one of: {', '.join(choices)}")
        for name in ("unbounded_share", "world_share", "roughening"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; it must lie in [0, 1]")
        if not self.threshold >= 0:
            raise ValueError(f"threshold is {self.threshold}; it must be 0 or more")

    def paths(self, probe: bool = False) -> Suffixes:
        """How training paths run; those of the `probe` end in nothing, for want of a cache."""
        return Suffixes(
            self.n_paths, self.n_vertices, "full" if probe else self.suffix, self.threshold,
            0 if probe else round(self.n_paths * self.unbounded_share), self.world_share, self.roughening, self.content,
        )  # fmt: skip

    @property
    def capacity(self) -> int:
        """Places for the records of a step."""
        most = self.n_paths * (self.n_vertices - 1)
        return min(most, self.n_records or (3 * self.n_paths if self.suffix == "spread" else most))


def trace_outgoing(scene, sensor, field: OutgoingField | None, training: OutgoingTraining, seed, lights, glossy: bool):
    """Fresh training records, targets ending in the averaged cache (in nothing without a field)."""
    lane = dr.arange(mi.UInt32, training.n_paths)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)
    plan = training.paths(probe=field is None)
    if field is None:
        return trace_suffixes(scene, sensor, sampler, plan, None, lights, None, glossy)
    # Close before the place, where hardly anything can lie between
    places = field.places.position, field.places.view, 1e-3 * dr.norm(1 / field.box_inv_extent)
    records, n_bad = trace_suffixes(
        scene, sensor, sampler, plan, lambda surface: field.query(*surface.inputs()), lights, places, glossy
    )
    if training.capacity < dr.width(records.valid):
        dr.eval(records, n_bad)
        records = packed(records, training.capacity)
    return records, n_bad


def _reaching(low, high, scene_low, scene_high) -> tuple:
    """The box of what a camera's paths met, grown by its longest side towards what else is in the scene: training
    paths start there too, but what is far away must not take the grid's cells."""
    low, high = np.array(low), np.array(high)
    reach = (high - low).max()
    if not (np.isfinite(scene_low).all() and np.isfinite(scene_high).all()):
        return low, high
    return np.minimum(low, np.maximum(scene_low, low - reach)), np.maximum(high, np.minimum(scene_high, high + reach))


class OutgoingCache(IncidentCache):
    """A field of outgoing radiance together with its training. In all but what it learns an `IncidentCache`."""

    def __init__(self, training: OutgoingTraining | None = None, shape: OutgoingShape | None = None, seed: int = 0):
        super().__init__(training or OutgoingTraining(), shape or OutgoingShape(), seed)

    def _probe_plain(self, scene, sensor, lights, seed):
        records, _ = trace_outgoing(scene, sensor, None, self.training, seed, lights, False)
        target = records.target / reflectance(records.surface.albedo)
        return records.surface.position, loss.luminance(target), records.valid

    def _frame_plain(self, scene, sensor, lights, field, seed, learning_rate, decay):
        with dr.suspend_grad():
            records, n_bad = trace_outgoing(scene, sensor, field, self.training, seed, lights, scene_is_glossy(scene))
            n_valid = dr.count(records.valid)
            dr.eval(records, n_bad, n_valid)
            field.count(records.surface.position, records.valid, decay)
            if self.training.world_share > 0:
                sampler = PathSampler.make(dr.arange(mi.UInt32, N_PLACES), seed + 0x9E3779B9)
                field.places.remember(records.surface.position, records.surface.view, records.valid, sampler)
        value, mean_target, mean_prediction, more = field.learn(
            *records.surface.inputs(), records.target, records.valid, learning_rate, decay, self.training.epsilon
        )
        value = dr.select(n_valid > 0, value, 0)  # nothing to learn is no divergence
        return value, mean_target, mean_prediction, n_valid, n_bad + more, mi.Float(0)

    def start(self, scene, sensor, lights=None) -> None:
        """Measure where light is asked for and how bright it is, and make the field; no training."""
        with dr.suspend_grad(), undisturbed():
            probe = self._probe if self.freezes(sensor) else self._probe_plain
            points, target, valid = (np.array(v) for v in probe(scene, sensor, lights, mi.UInt32(self._seed(0xFFFFFF))))
        box = scene.bbox()
        whole = np.array(box.min).ravel(), np.array(box.max).ravel()
        low, high = encoding.record_box(points.T[valid], *whole)
        if self.training.world_share > 0:
            low, high = _reaching(low, high, *whole)
        target, scale = np.sort(target[valid]), 0.0
        if target.size:
            scale = float(target[: max(1, int(target.size * (1 - SCALE_TRIM)))].mean())
        if not (math.isfinite(scale) and scale > 1e-20):
            scale = 1e-20  # no light found: the cache answers with nothing
        self.field = OutgoingField(low, high, self.shape, scale=scale, seed=self.seed)
        dr.eval(self.field)

    def checkpoint(self):
        field = self.field
        state = None if field is None else (
            field.snapshot(), mi.Float(field.scale), mi.Float(field.eta), mi.Float(field.density), field.places.copy()
        )  # fmt: skip
        return state, self.steps, self.rate_factor, list(self.history), self._good, dict(self.statistics)

    def rollback(self, state) -> None:
        if state is None:
            super().rollback(None)
            return
        held, self.steps, self.rate_factor, self.history, self._good, self.statistics = state
        if held is not None:
            self.field.restore(held[0])
            self.field.scale, self.field.eta, self.field.density, self.field.places = held[1:]
            self.field.steps, self.levels = self.steps, []


# -----------------------------------------------------------------------------------------------------------------
# The interface of the guide


class DispatchFlags(enum.Flag):
    """What one :meth:`RadianceCache.dispatch` does; combine with ``|``. The order is fixed: reset, inference, training,
    clearing of counters."""

    INFERENCE = enum.auto()
    TRAINING = enum.auto()
    CLEAR_INFERENCE_COUNTER = enum.auto()
    CLEAR_TRAINING_COUNTER = enum.auto()
    CLEAR_ALL_COUNTERS = CLEAR_INFERENCE_COUNTER | CLEAR_TRAINING_COUNTER
    RESET = enum.auto()
    OVERRIDE_LEARNING_RATE = enum.auto()
    OVERRIDE_WEIGHT_SMOOTHING = enum.auto()


@dataclass
class CacheInput:
    """Surface points for a :class:`RadianceCache`, as Dr.Jit arrays; make them with :meth:`RadianceCache.pack`.

    position   over the box: [0, 1]^3
    normal     polar angles (θ from +z, φ from +x) of the shading normal on the viewer's side, radians
    view_dir   of the direction towards the viewer
    albedo     diffuse and specular reflectance together, RGB
    roughness  at least 0

    As NumPy: one array (points, 11) of these columns in this order.
    """

    position: mi.Point3f
    normal: mi.Vector2f
    view_dir: mi.Vector2f
    albedo: mi.Color3f
    roughness: mi.Float

    def columns(self) -> list:
        """The eleven numbers of a point."""
        return [*self.position, *self.normal, *self.view_dir, *self.albedo, self.roughness]


N_COLUMNS = 11


def _direction(polar):
    """Polar angles to a unit vector."""
    (sin_theta, cos_theta), (sin_phi, cos_phi) = dr.sincos(polar.x), dr.sincos(polar.y)
    return mi.Vector3f(sin_theta * cos_phi, sin_theta * sin_phi, cos_theta)


def _surface(flat, width: int) -> tuple:
    """Columns one after the other to the arguments of an `OutgoingField`."""
    lane = dr.arange(mi.UInt32, width)
    c = [dr.gather(mi.Float, flat, lane + i * width) for i in range(N_COLUMNS)]
    return (
        mi.Point3f(c[:3]), _direction(mi.Vector2f(c[3:5])), _direction(mi.Vector2f(c[5:7])), mi.Color3f(c[7:10]), c[10],
    )  # fmt: skip


class RadianceCache:
    """A neural radiance cache for a renderer of your own, with the interface of AMD's "FSR Radiance Caching" guide.

    Parameters: `max_inference_sample_count`, `max_training_sample_count` (per dispatch), `box_min`, `box_max` (the
    scene's, world space; what lies outside is moved to its surface), `scale` (see :class:`OutgoingField`; None:
    measured on the first training samples, and until then predictions are 0), `shape`, `seed`.

    Points are :class:`CacheInput` (answers: `mi.Color3f`) or NumPy arrays (n, 11) (answers: (n, 3) of 32 bit). Unlike
    in the guide, targets and predictions are whole radiance: the cache divides by the albedo and multiplies it back.

        cache = RadianceCache(320 * 180, 16384, bbox.min, bbox.max)
        points = cache.pack(si.p, si.sh_frame.n, si.to_world(si.wi), albedo, roughness)
        L = cache.dispatch(DispatchFlags.INFERENCE | DispatchFlags.TRAINING, prediction_inputs=points,
                           train_inputs=..., train_targets=...)

    See :func:`self_training_frame` for a whole frame.
    """

    #: Smallest size that buffers are padded to: work is recorded once per size (half, quarter, ... of the maximum).
    SMALLEST = 1024

    def __init__(
        self, max_inference_sample_count: int, max_training_sample_count: int, box_min=(0, 0, 0), box_max=(1, 1, 1),
        *, scale: float | None = None, shape: OutgoingShape | None = None, seed: int = 0,
    ):  # fmt: skip
        for name, value in (
            ("max_inference_sample_count", max_inference_sample_count),
            ("max_training_sample_count", max_training_sample_count),
        ):
            if not (_is_integer(value) and 1 <= value < 2**28):
                raise ValueError(f"{name} is {value}; it must be an integer in 1..2^28 - 1")
        self.max_inference_sample_count = int(max_inference_sample_count)
        self.max_training_sample_count = int(max_training_sample_count)
        box_min, box_max = (np.array(b, np.float64).ravel() for b in (box_min, box_max))
        _check_box(box_min, box_max)
        self.box = (box_min.tolist(), box_max.tolist())
        self._adopt(OutgoingField((0, 0, 0), (1, 1, 1), shape, scale=scale, seed=seed))

    def _adopt(self, field: OutgoingField) -> None:
        self.field = field
        self._inference: dict = {}  # frozen functions by width
        self._training: dict = {}
        self._forget_counts()

    def _forget_counts(self) -> None:
        self._counts = {"inference_samples": 0, "training_samples": 0, "steps": self.field.steps}
        self._bad_inference, self._bad_training = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, 0)
        self._loss = mi.Float(math.nan)

    def reset(self) -> None:
        """As if the cache had just been made, bit for bit. Compiled kernels are kept."""
        self.field.reset()
        self._forget_counts()

    @property
    def statistics(self) -> dict:
        """Counts since the start: samples asked and trained on, inputs and records that were not finite (and did not
        enter the network), steps (those before a file was written are among them); the latest loss."""
        return {
            **self._counts, "nonfinite_inference": int(self._bad_inference[0]),
            "nonfinite_training": int(self._bad_training[0]), "loss": float(self._loss[0]),
        }  # fmt: skip

    # -------------------------------------------------------------------------------------------------------------

    def pack(self, position, normal, view_dir, albedo, roughness):
        """Inputs from world-space values: `CacheInput` from Dr.Jit arrays, an array (n, 11) from NumPy's (four (n, 3)
        and one (n,)). `normal` and `view_dir` are unit vectors, see :class:`CacheInput`."""
        low, high = (np.array(b) for b in self.box)
        if isinstance(position, np.ndarray):
            angles = []
            for v in (np.asarray(normal), np.asarray(view_dir)):
                angles += [np.arccos(np.clip(v[:, 2], -1, 1)), np.arctan2(v[:, 1], v[:, 0])]
            columns = [*((position - low) / (high - low)).T, *angles, *np.asarray(albedo).T, np.asarray(roughness)]
            return np.stack(columns, axis=-1).astype(np.float32)
        inverse = mi.Vector3f((1 / (high - low)).tolist())
        position = mi.Point3f((mi.Point3f(position) - mi.Point3f(low.tolist())) * inverse)
        polar = [mi.Vector2f(dr.safe_acos(v.z), dr.atan2(v.y, v.x)) for v in map(mi.Vector3f, (normal, view_dir))]
        return CacheInput(position, *polar, mi.Color3f(albedo), mi.Float(roughness))

    def dispatch(
        self, flags: DispatchFlags, *, prediction_inputs=None, train_inputs=None, train_targets=None,
        sample_counters=None, learning_rate: float | None = None, weight_smoothing: float | None = None,
    ):  # fmt: skip
        """All that is done with the cache in a frame: reset, then inference, then training, as `flags` say.

        prediction_inputs   points to predict radiance at, with INFERENCE
        train_inputs        points to learn at, with TRAINING
        train_targets       radiance at these: `mi.Color3f`, or a NumPy array (n, 3)
        sample_counters     how many points of the two buffers count, from the front: [inference, training], a list, a
                            NumPy array or `mi.UInt32` (which `dr.scatter_inc` can fill); None: all. CLEAR_... set its
                            entries to 0 in the end
        learning_rate, weight_smoothing
                            in place of 0.002 and 0.99, with OVERRIDE_...; smoothing 0: none, 1: predictions stay

        Returns the predictions, of the kind and length of `prediction_inputs`, 0 beyond the counter; None without
        INFERENCE. Points that are not finite are predicted as 0, and not trained on. Raises ValueError for counts above
        the maxima and for all other impossible arguments; nothing has been changed then.
        """
        if not isinstance(flags, DispatchFlags):
            raise ValueError(f"flags is {flags!r}; combine DispatchFlags, as in DispatchFlags.INFERENCE")
        rate, smoothing = _overrides(flags, learning_rate, weight_smoothing)
        counters = _Counters(sample_counters, flags)
        points = asked = records = None
        if DispatchFlags.INFERENCE in flags:
            points = _Buffer("prediction_inputs", prediction_inputs, N_COLUMNS)
            asked = counters.count(0, "inference", points, self.max_inference_sample_count)
        if DispatchFlags.TRAINING in flags:
            records = _Buffer("train_inputs", train_inputs, N_COLUMNS)
            targets = _Buffer("train_targets", train_targets, 3)
            if records.width != targets.width:
                raise ValueError(f"there are {records.width} train_inputs but {targets.width} train_targets")
            known = counters.count(1, "training", records, self.max_training_sample_count)

        if DispatchFlags.RESET in flags:
            self.reset()
        predictions = None if points is None else self._infer(points, asked)
        if records is not None and known:
            self._train(records, targets, known, rate, smoothing)
        counters.clear()
        return predictions

    def _bucket(self, count: int, maximum: int) -> int:
        """The size that `count` points are padded to."""
        size = maximum
        while size // 2 >= max(count, self.SMALLEST):
            size = size // 2
        return size

    def _infer(self, points: _Buffer, count: int):
        if not count:
            return points.zeros()
        width = self._bucket(count, self.max_inference_sample_count)
        if width not in self._inference:
            self._inference[width] = dr.freeze(_inference_of(width), auto_opaque=False)
        flat = points.flat(width, count)
        with dr.suspend_grad(), undisturbed():
            radiance, self._bad_inference = self._inference[width](
                self.field, flat, dr.opaque(mi.UInt32, count), self._bad_inference
            )
        self._counts["inference_samples"] += count
        return points.answer(radiance, width)

    def _train(self, records: _Buffer, targets: _Buffer, count: int, rate: float, smoothing: float) -> None:
        width = self._bucket(count, self.max_training_sample_count)
        if width not in self._training:
            self._training[width] = dr.freeze(_training_of(width), auto_opaque=False)
        with undisturbed():
            self._loss, self._bad_training = self._training[width](
                self.field, records.flat(width, count), targets.flat(width, count), dr.opaque(mi.UInt32, count),
                dr.opaque(mi.Float, rate), dr.opaque(mi.Float, smoothing), self._bad_training,
            )  # fmt: skip
        self.field.steps += 1
        self._counts["steps"] += 1
        self._counts["training_samples"] += count

    # -------------------------------------------------------------------------------------------------------------

    def save(self, path) -> None:
        """Write the cache to an ``.npz`` file, whole or not at all."""
        self.field.save(
            path, max_inference_sample_count=self.max_inference_sample_count,
            max_training_sample_count=self.max_training_sample_count, scene_box=self.box,
        )  # fmt: skip

    @staticmethod
    def load(path) -> RadianceCache:
        """The cache of a file; the optimiser's moments start anew. Raises as :meth:`OutgoingField.load`."""
        field, header = OutgoingField.load(path)
        try:
            maxima = header["max_inference_sample_count"], header["max_training_sample_count"]
            cache = RadianceCache(*maxima, *header["scene_box"], shape=field.shape)
        except Exception as e:
            raise CacheFileError(f"'{path}' holds a field, but no RadianceCache, or is damaged ({e})") from None
        cache._adopt(field)
        return cache


def _is_integer(value) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _inference_of(width: int):
    """Predictions for `width` packed points, to be frozen."""

    def infer(field, flat, count, n_bad):
        inputs = _surface(flat, width)
        counted = dr.arange(mi.UInt32, width) < count
        radiance = dr.select(counted, field.query(*inputs), 0)
        bad = counted & ~field.usable(*inputs)
        dr.eval(radiance, bad)
        return radiance, n_bad + dr.count(bad)

    return infer


def _training_of(width: int):
    """A training step on `width` packed records, to be frozen."""

    def train(field, flat, targets, count, learning_rate, smoothing, n_bad):
        lane = dr.arange(mi.UInt32, width)
        target = mi.Color3f([dr.gather(mi.Float, targets, lane + i * width) for i in range(3)])
        value, _, _, bad = field.learn(*_surface(flat, width), target, lane < count, learning_rate, smoothing)
        return value, n_bad + bad

    return train


def _overrides(flags: DispatchFlags, learning_rate, weight_smoothing) -> tuple[float, float]:
    """The learning rate and the smoothing of a dispatch."""
    out = []
    for name, value, default, highest in (
        ("learning_rate", learning_rate, LEARNING_RATE, math.inf),
        ("weight_smoothing", weight_smoothing, WEIGHT_SMOOTHING, 1.0),
    ):
        flag = DispatchFlags[f"OVERRIDE_{name.upper()}"]
        if (flag in flags) != (value is not None):
            missing = name if value is None else str(flag)
            raise ValueError(f"{missing} is missing: to override, pass both {flag} and {name}")
        if value is not None and not (
            isinstance(value, float | int | np.number) and math.isfinite(value) and 0 <= value <= highest
        ):
            limits = "at least 0" if highest == math.inf else "in [0, 1]"
            raise ValueError(f"{name} is {value!r}; it must be a number {limits}")
        out.append(default if value is None else float(value))
    return out[0], out[1]


class _Buffer:
    """Points or colours given to a dispatch: of Dr.Jit, or of NumPy."""

    def __init__(self, name: str, value, n_columns: int):
        self.name = name
        if value is None:
            raise ValueError(f"{name} is missing: the flags ask for it")
        self.numpy = isinstance(value, np.ndarray)
        if self.numpy:
            if value.ndim != 2 or value.shape[1] != n_columns or value.dtype.kind not in "fiu":
                raise ValueError(
                    f"{name} is an array {value.shape} of {value.dtype}; it must be numbers, (n, {n_columns})"
                )
            self.columns, self.width = value, len(value)
            return
        if n_columns == N_COLUMNS and isinstance(value, CacheInput):
            columns = value.columns()
        elif n_columns == 3 and dr.is_jit_v(value) and dr.depth_v(value) == 2 and dr.size_v(value) == 3:
            columns = list(value)
        else:
            kind = "CacheInput" if n_columns == N_COLUMNS else "mi.Color3f"
            raise ValueError(f"{name} is of type {type(value).__name__}; it must be {kind}, or a NumPy array")
        self.columns = [mi.Float(dr.detach(c)) for c in columns]
        widths = {dr.width(c) for c in self.columns}
        self.width = max(widths)
        if widths - {1, self.width}:
            raise ValueError(f"the parts of {name} have different lengths: {sorted(widths)}")

    def flat(self, width: int, count: int):
        """The first `count` entries, column by column, each padded to `width`; in memory of its own."""
        if self.numpy:
            padded = np.zeros((self.columns.shape[1], width), np.float32)
            with np.errstate(over="ignore"):  # becomes infinite, and is counted
                padded[:, :count] = self.columns[:count].T
            return own_copy(mi.Float(padded.ravel()))
        if self.width == width:
            columns = [c + dr.zeros(mi.Float, width) for c in self.columns]
        else:
            index = dr.minimum(dr.arange(mi.UInt32, width), count - 1)
            columns = [dr.gather(mi.Float, c, index if dr.width(c) > 1 else 0 * index) for c in self.columns]
        flat = dr.concat(columns)
        dr.eval(flat)
        return flat

    def zeros(self):
        """Black, in the kind and length of this buffer."""
        return np.zeros((self.width, 3), np.float32) if self.numpy else dr.zeros(mi.Color3f, self.width)

    def answer(self, radiance, width: int):
        """Radiance of `width` points, 0 beyond the counter, in the kind and length of this buffer."""
        if self.numpy:
            out = self.zeros()
            n = min(self.width, width)
            out[:n] = np.array(radiance)[:, :n].T
            return out
        if self.width == width:
            return radiance
        lane = dr.arange(mi.UInt32, self.width)
        return dr.gather(mi.Color3f, radiance, dr.minimum(lane, width - 1), lane < width)


class _Counters:
    """The counters given to a dispatch: how many samples count, and how to clear them."""

    def __init__(self, value, flags: DispatchFlags):
        clears = (DispatchFlags.CLEAR_INFERENCE_COUNTER, DispatchFlags.CLEAR_TRAINING_COUNTER)
        self.value, self.counts = value, None
        self.cleared = [i for i in range(2) if clears[i] in flags]
        if value is None:
            if self.cleared:
                raise ValueError("sample_counters is missing: the flags ask to clear it")
            return
        counts = np.array(value)
        if counts.shape != (2,) or counts.dtype.kind not in "iu" or (counts < 0).any():
            raise ValueError(f"sample_counters is {value!r}; it must be two counts, [inference, training]")
        fixed = isinstance(value, tuple) or (isinstance(value, np.ndarray) and not value.flags.writeable)
        if self.cleared and fixed:
            raise ValueError("sample_counters cannot be written to, but the flags ask to clear it; pass a list")
        self.counts = counts.tolist()

    def count(self, which: int, name: str, buffer: _Buffer, maximum: int) -> int:
        """How many entries of `buffer` count; at most `maximum`."""
        n = buffer.width if self.counts is None else self.counts[which]
        if n > maximum:
            raise ValueError(
                f"{n} {name} samples are more than the maximum of {maximum} that this cache was made with; make it "
                f"with max_{name}_sample_count={n}, or dispatch less"
            )
        if n > buffer.width:
            raise ValueError(f"sample_counters says {n} {name} samples, but {buffer.name} holds {buffer.width}")
        return n

    def clear(self) -> None:
        for which in self.cleared:
            if dr.is_jit_v(self.value):
                dr.scatter(self.value, 0, mi.UInt32(which))
            else:
                self.value[which] = 0


def self_training_frame(
    cache: RadianceCache, train_inputs, train_targets, tail_inputs, tail_weights, tail_index, prediction_inputs=None,
    flags: DispatchFlags = DispatchFlags.TRAINING, **overrides,
):  # fmt: skip
    """One frame by the two-pass self-training recipe of the guide. Returns the radiance at `prediction_inputs`.

    Trace the training paths first. Each of their vertices is a record: the point (`train_inputs`) and the radiance
    gathered from there to the end of the path (`train_targets`). The last vertex of each path is a query
    (`tail_inputs`); record i lies on path `tail_index` [i], and `tail_weights` [i] is the throughput from the record to
    that last vertex: black for a path that left the scene. Then trace the pixels (`prediction_inputs`). What comes back
    is to be weighed with the pixels' throughput and added to the image. All of one kind, NumPy or Dr.Jit.

    `flags` and `overrides` go to the second dispatch, see :meth:`RadianceCache.dispatch`.
    """
    # 1. Training paths have been traced. 2. Queries alone; their answers complete the targets
    radiance = cache.dispatch(DispatchFlags.INFERENCE, prediction_inputs=tail_inputs)
    if isinstance(radiance, np.ndarray):
        rest = tail_weights * radiance[tail_index]
    else:
        rest = tail_weights * dr.gather(mi.Color3f, radiance, tail_index)
    # 3. Pixels have been traced. 4. Queries and training in one; the queries come first
    if prediction_inputs is not None:
        flags |= DispatchFlags.INFERENCE
    return cache.dispatch(
        flags, prediction_inputs=prediction_inputs, train_inputs=train_inputs, train_targets=train_targets + rest,
        **overrides,
    )  # fmt: skip
