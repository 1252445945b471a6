"""NVC: the neural visibility cache (Bokšanský and Meister 2025), and how it is trained.

``V(x)`` is the share of each light, or of each cluster of lights, that is visible from x: a hash grid and a small MLP
with one output per light, learned from shadow rays while rendering. It depends on position alone.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.frozen import undisturbed
from ..render.media import media_of
from ..render.sampling import PathSampler
from ..render.tracking import shadowed
from . import encoding
from .field import TrainedField
from .optimizer import Stride, descend, own_copy
from .schedule import Ramp
from .trainer import Trainer, found
from .voxels import Ages
from .weights import FieldShape, Weights

#: Steps whose points are found in one go, where there are so many to do.
BATCH = 8
#: To find a normal, rays start so far beside, as a share of their length; and the steepest surface, as a tangent.
BESIDE, STEEPEST = 1e-3, 30.0
#: Losses of training; the second is the published one.
LOSSES = ("cross_entropy", "squared")

#: Levels of the hash grid.
GRID = {"n_levels": 6, "base_resolution": 8, "per_level_scale": 1.7}


@dataclass(frozen=True)
class VisibilityTraining(Ramp):
    """Constants of training, see :class:`~mi_neural.caches.schedule.Ramp`; points: see `training_points`.

    loss  ``cross_entropy``: of the visibility, ``-t log V - (1 - t) log(1 - V)``, the outputs beginning at the mean
          visibility of their lights; ``squared``: ``(V - t)²`` as published, beginning at about 1/2. Its gradient
          vanishes where the sigmoid is near 0 or 1: where each light is seen by few points all outputs fell to 0 within
          five steps, and stayed there
    world_points  share of the points that lie anywhere in the box, the others lie on surfaces
    vertices      these lie at the first so many vertices of paths from the camera, in turn
    """

    n_points: int = 2048
    ema_decay: float = 0.9
    first_rate: float = 0.05
    last_rate: float = 0.001
    loss: str = "cross_entropy"
    world_points: float = 0.25
    vertices: int = 3

    def __post_init__(self):
        super().__post_init__()
        if self.loss not in LOSSES:
            raise ValueError(f"loss is '{self.loss}'; give one of: {', '.join(LOSSES)}")


class VisibilityField(TrainedField):
    """``V(x)`` in [0, 1] for `shape.n_outputs` lights or clusters. A PyTree.

    ``query(x)`` gives a list of Dr.Jit floats. An untrained field says about 1/2 for all.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "averaged": object, "optimizer": object, "box_min": object, "box_inv_extent": object, "stride": object,
    }  # fmt: skip

    def __init__(self, box_min, box_max, shape: FieldShape, seed: int = 0, he: bool = False):
        self.shape, self.seed, self.he = shape, seed, he
        box_min, box_max = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        self.box = (box_min.tolist(), box_max.tolist())
        self.box_min = mi.Point3f(box_min.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (box_max - box_min)).tolist())
        self.reset()

    def reset(self) -> None:
        """The weights as they were when the field was made."""
        self.current, self.averaged = Weights(self.shape, self.seed), Weights(self.shape, self.seed)
        if self.he:
            for weights in (self.current, self.averaged):
                initialize_he(weights, self.seed)
        self.stride, self.steps = Stride.make(), 0
        self._attach_optimizer()
        dr.make_opaque(self.box_min, self.box_inv_extent)

    def query(self, x) -> list:
        """Predicted visibility of every light from x."""
        return [_sigmoid(v) for v in self.averaged(self._encode(self.averaged, x))]

    def _encode(self, weights: Weights, x) -> list:
        return list(weights.grid(encoding.in_box(x, self.box_min, self.box_inv_extent)))

    def begin_at(self, visible) -> None:
        """Have outputs begin at the mean of what they are to learn: `visible` is a tensor (n_outputs, points).

        Such a mean is at most so near 0 or 1 as half a point in all would bring it."""
        n = visible.shape[1]
        seen = dr.sum(visible, axis=1)
        for weights in (self.current, self.averaged):
            parameters = {k: own_copy(v) for k, v in weights.parameters().items()}
            last = [k for k in parameters if k.endswith("bias")][-1]
            parameters[last] = own_copy(dr.log((seen + 0.5) / (n - seen + 0.5)))
            weights.assign(parameters)
        self._attach_optimizer()

    def step(self, x, visible, learning_rate, decay, loss: str = "squared"):
        """One step of Adam on the mean `loss` of V(x), one of `LOSSES`; `visible` is a tensor (n_outputs, points).
        Returns the mean squared error, whatever the loss.

        Queries use ``averaged <- decay averaged + (1 - decay) trained``.
        """
        weights, n = self.trainable(), dr.width(x)
        out = weights.differentiable(self._encode(weights, x))
        lane = dr.arange(mi.UInt32, n)
        losses = mi.Float(0)
        for k, v in enumerate(out):
            error = _sigmoid(v) - dr.gather(mi.Float, visible.array, lane + k * n)
            # The gradient of the cross-entropy by v is the error itself
            gradient = v * dr.detach(error) if loss == "cross_entropy" else dr.square(error)
            losses += dr.replace_grad(dr.square(error), gradient)
        losses *= 1 / (n * len(out))
        averaged, loss = descend(
            self.optimizer, losses, self.averaged.parameters(), learning_rate, decay, self.stride
        )
        self.averaged.assign(averaged)
        self.averaged.pack()
        dr.eval(self.averaged)
        return loss


def initialize_he(weights: Weights, seed: int) -> None:
    """Normal weights of variance 2 / inputs, and no biases (He et al. 2015, eq. 10)."""
    rng = np.random.default_rng(seed)
    for name, tensor in list(weights.mlp.items()):
        shape = tuple(tensor.shape)
        new = rng.normal(0, np.sqrt(2 / shape[-1]), shape) if name.endswith("weights") else np.zeros(shape)
        weights.mlp[name] = mi.TensorXf(new.astype(np.float32))
    weights.pack()


def _sigmoid(v):
    return dr.rcp(1 + dr.exp(-v))


def training_points(scene, sensor, field: VisibilityField, lane, seed, world_points: float = 0.25, vertices: int = 3):
    """One point for each entry of `lane`: the share `world_points` uniform in the field's box, the others on surfaces,
    at the first to last of so many `vertices` of paths that start at the camera and bounce diffusely.

    A path that leaves the scene stays at the vertex before; one that never met a surface gives a point in the box.
    """
    sampler = _numbers(lane, seed, index=lane, scramble=seed)
    in_box = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d()) / field.box_inv_extent + field.box_min
    ray, _ = sensor.sample_ray(sensor.shutter_open(), sampler.next_1d(), sampler.stratified_2d(0), sampler.next_2d())
    boxed = mi.UInt32(mi.Float(lane) * world_points + 1)  # points in the box up to this one
    on_surface = (lane > 0) & (boxed == mi.UInt32((mi.Float(lane) - 1) * world_points + 1)) | (world_points == 0)
    n_bounces = dr.select(on_surface, 1 + (lane - (boxed if world_points > 0 else 0)) % vertices, 0)

    def bounce(k, ray, x, found, active, sampler):
        p, n, active = surface_point(scene, ray, active)
        found |= active
        x = dr.select(active, p, x)
        wo = mi.Frame3f(n).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        return k + 1, mi.Ray3f(x, wo), x, found, active & (k + 1 < n_bounces), sampler

    _, _, x, found, _, _ = dr.while_loop(
        (mi.UInt32(0), mi.Ray3f(ray.o, ray.d), mi.Point3f(in_box), mi.Bool(False), mi.Bool(on_surface), sampler),
        lambda k, ray, x, found, active, sampler: active,
        bounce,
        label="visibility points",
    )
    return dr.select(found, x, in_box)


def _numbers(lane, seed, index=0, scramble=0) -> PathSampler:
    """A sampler whose numbers depend on `lane` and `seed` alone, not on where in the arrays they stand: `PCG32` adds
    that to its seeds."""
    state, sequence = mi.sample_tea_32(lane, seed, 6)
    before = mi.UInt64(dr.arange(mi.UInt32, dr.width(lane)) - lane)
    pcg = mi.PCG32(dr.width(lane), mi.UInt64(state) - before, mi.UInt64(sequence) - before)
    return PathSampler(pcg, mi.UInt32(index), mi.UInt32(scramble))


def surface_point(scene, ray, active):
    """What a ray meets: (point just off the surface, normal on the side that is seen, whether there is one).

    No shape is asked, so that nothing is traced or handed over for each shape of the scene: the normal is that of the
    plane through what two rays beside this one meet, or points back along it where those meet nothing near.
    """
    t = scene.ray_intersect_preliminary(ray, active=active).t
    active = active & dr.isfinite(t)
    t = dr.select(active, t, 1)
    s1, s2 = mi.coordinate_system(ray.d)
    n = -ray.d
    step = BESIDE * t
    for s in (s1, s2):
        beside = mi.Ray3f(ray)
        beside.o = ray.o + step * s
        slope = (scene.ray_intersect_preliminary(beside, active=active).t - t) / step
        n += dr.select(dr.abs(slope) < STEEPEST, slope, 0) * s
    n = dr.normalize(n)
    p = ray.o + t * ray.d
    away = (1 + dr.max(dr.abs(p))) * mi.math.RayEpsilon
    return p + away * n, n, active


class VisibilityCache(Trainer):
    """A field of visibilities together with its training.

    `groups` is a :class:`~mi_neural.lights.clusters.Groups`: what the outputs stand for.
    """

    NAME, SALT = "visibility", 0x7151B1E
    NAMES = {  # noqa: RUF012
        "steps": "visibility_steps", "loss": "visibility_loss", "recoveries": "visibility_recoveries",
        "seconds": "seconds_visibility",
    }  # fmt: skip

    def __init__(
        self, training: VisibilityTraining | None = None, shape: FieldShape | None = None, seed: int = 0,
        grid: dict | None = None, he: bool = False,
    ):  # fmt: skip
        super().__init__(training or VisibilityTraining(), seed)
        self.shape, self.grid, self.he = shape, {**GRID, **(grid or {})}, he
        self.has_media = False  # in the scene of the field

    def start(self, scene, sensor, table, groups) -> None:
        """Make the field in the box of what the camera sees."""
        box = scene.bbox()
        self.has_media = bool(media_of(scene, [sensor]))
        with dr.suspend_grad():
            n = 2**13
            lane = dr.arange(mi.UInt32, n)
            seed = mi.UInt32(self.seed & 0xFFFFFFFF)
            sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)
            ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, sampler.stratified_2d(0), sampler.next_2d())
            p, normal, valid = surface_point(scene, mi.Ray3f(ray.o, ray.d), mi.Bool(True))
            wo = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
            p_next, _, valid_next = surface_point(scene, mi.Ray3f(p, wo), valid)
            dr.eval(p, valid, p_next, valid_next)
            points = np.concatenate([np.array(q).T[np.array(v)] for q, v in ((p, valid), (p_next, valid_next))])
        low, high = encoding.record_box(points, np.array(box.min).ravel(), np.array(box.max).ravel())
        shape = self.shape or FieldShape(
            **self.grid, n_features=4, hashmap_size=2**14, direction_degree=-1, width=32, n_hidden=2,
            n_outputs=groups.n_groups, leak=0.01,
        )  # fmt: skip
        # Large cells: points in the air are few
        self.field, self.ages = VisibilityField(low, high, shape, self.seed, self.he), Ages(low, high, resolution=2)

    def _records(self, scene, sensor, table, groups, seeds):
        """Training points of some steps, one for each of `seeds`, and what they see: (points, step by step; 1 or 0 by
        step, light or cluster, and point).

        Not frozen: it is traced in 10 ms, whatever the scene, of which Dr.Jit would look at all parts to replay it (40
        us each).
        """
        n, n_out = self.training.n_points, groups.n_groups
        with dr.suspend_grad():
            lane = dr.arange(mi.UInt32, n * dr.width(seeds))
            x = training_points(
                scene, sensor, self.field, lane % n, dr.gather(mi.UInt32, seeds, lane // n),
                self.training.world_points, self.training.vertices,
            )  # fmt: skip
            dr.eval(x)
            lane = dr.arange(mi.UInt32, n * n_out * dr.width(seeds))
            step, lane = lane // (n * n_out), lane % (n * n_out)
            point, group = lane % n, lane // n
            sampler = _numbers(lane, dr.gather(mi.UInt32, seeds, step) + 1)
            light = groups.sample_light(group, sampler.next_1d(), mi.Bool(True))[0]
            p = dr.gather(mi.Point3f, x, step * n + point)
            ray, some = table.shadow_ray(scene, p, light, sampler.next_2d(), mi.Bool(True))
            shadow = shadowed(scene, ray, some) if self.has_media else scene.ray_test(ray, some)
            visible = dr.select(shadow, mi.Float(0), 1)
            dr.eval(visible)
        return x, visible

    def frame(self, field, x, visible, ages, rate_factor):
        with dr.suspend_grad():
            learning_rate, decay = self.pace(ages, x, mi.Bool(True), rate_factor, field)
        visible = mi.TensorXf(visible, shape=(field.shape.n_outputs, dr.width(x)))
        return found(field.step(x, visible, learning_rate, decay, self.training.loss), ages)

    def train_step(self, scene, sensor, table, groups, batch: int = 1) -> None:
        """So many steps, each on fresh points, which are found together."""
        seeds = mi.UInt32([self.random_seed(self.steps + k) for k in range(batch)])
        dr.make_opaque(seeds)
        with undisturbed():
            points = self._records(scene, sensor, table, groups, seeds)
        for k in range(batch):
            x, visible = _part(points, k, batch)
            if self.steps == 0 and self.training.loss == "cross_entropy":
                self.field.begin_at(mi.TensorXf(visible, shape=(groups.n_groups, self.training.n_points)))
            self.step("frame", None, self.field, x, visible, self.ages)

    def train(self, scene, sensor, table, groups, *, frames: int = 1) -> None:
        """So many steps, each on fresh points."""
        t0, done, counted = time.perf_counter(), 0, self._counts["seconds"]
        self.check()
        if self.field is None:
            self.start(scene, sensor, table, groups)
        while done < frames:
            batch = BATCH if frames - done >= BATCH else 1
            self.train_step(scene, sensor, table, groups, batch)
            done += batch
            if frames > 1:  # a single step is not waited for: the next call reads what it found
                self.check()
        self._counts["seconds"] = counted + time.perf_counter() - t0  # `check` counts its own time, which is within


def _part(arrays, k: int, n: int) -> list:
    """Part `k` of `n` of each of `arrays`, in memory of its own."""
    if n == 1:
        return list(arrays)
    parts = []
    for array in arrays:
        size = dr.width(array) // n
        parts.append(dr.gather(type(array), array, dr.arange(mi.UInt32, size) + dr.opaque(mi.UInt32, k * size)))
    dr.eval(parts)
    return parts
