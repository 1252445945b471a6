"""NVC: the neural visibility cache (the seed's light-sampling paper), and how it is trained.

``V(x)`` is the share of each light, or of each cluster of lights, that is visible from x: a hash grid and a small MLP
with one output per light, learned from shadow rays while rendering. It depends on position alone.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..transport.freezing import can_freeze, undisturbed
from ..transport.samples import PathSampler
from . import encoding
from .field import FieldShape, Weights, attach_adam, descend, own_copy
from .schedule import Ramp


@dataclass(frozen=True)
class VisibilityTraining(Ramp):
    """Constants of training, see :class:`~mi_neural.caches.schedule.Ramp`; points: see `training_points`."""

    n_points: int = 2048
    ema_decay: float = 0.9
    first_rate: float = 0.05
    last_rate: float = 0.001


class VisibilityField:
    """``V(x)`` in [0, 1] for `shape.n_outputs` lights or clusters. A PyTree.

    ``query(x)`` gives a list of Dr.Jit floats. An untrained field says about 1/2 for all.
    """

    DRJIT_STRUCT = {"weights": object, "optimizer": object, "box_min": object, "box_inv_extent": object}  # noqa: RUF012

    def __init__(self, box_min, box_max, shape: FieldShape, seed: int = 0):
        self.shape, self.seed = shape, seed
        box_min, box_max = np.asarray(box_min, np.float64), np.asarray(box_max, np.float64)
        self.box = (box_min.tolist(), box_max.tolist())
        self.box_min = mi.Point3f(box_min.tolist())
        self.box_inv_extent = mi.Vector3f((1 / (box_max - box_min)).tolist())
        self.reset()

    def reset(self) -> None:
        """The weights as they were when the field was made."""
        self.weights = Weights(self.shape, self.seed)
        self.optimizer = attach_adam(self.weights.parameters())
        self.weights.assign({k: own_copy(v) for k, v in self.weights.parameters().items()})
        self.weights.pack()
        dr.make_opaque(self.box_min, self.box_inv_extent)
        dr.eval(self.optimizer, self.weights)

    def query(self, x) -> list:
        """Predicted visibility of every light from x."""
        return [_sigmoid(v) for v in self.weights(self._encode(x))]

    def _encode(self, x) -> list:
        return list(self.weights.grid(encoding.to_unit_cube(x, self.box_min, self.box_inv_extent)))

    def step(self, x, visible, learning_rate, decay):
        """One step of Adam on ``mean (V(x) - visible)²``; `visible` is a tensor (n_outputs, points). Returns the loss.

        Queries use ``averaged <- decay averaged + (1 - decay) trained``.
        """
        averaged = self.weights.parameters()
        self.weights.assign(self.optimizer)
        n = dr.width(x)
        inputs = dr.concat([i + dr.zeros(mi.Float, n) for i in self._encode(x)])
        inputs = mi.TensorXf(inputs, shape=(self.shape.n_inputs, n))
        out = self.weights.mlp(inputs)
        loss = dr.mean(dr.square(_sigmoid(out) - visible).array)
        averaged = descend(self.optimizer, loss, averaged, learning_rate, decay)
        self.weights.assign(averaged)
        self.weights.pack()
        dr.eval(self.weights)
        return dr.detach(loss)


def _sigmoid(v):
    return dr.rcp(1 + dr.exp(-v))


def training_points(scene, sensor, field: VisibilityField, n: int, seed):
    """`n` points: a quarter uniform in the field's box, the others on surfaces, at the first, second or third vertex
    of paths that start at the camera and bounce diffusely.

    A path that leaves the scene stays at the vertex before; one that never met a surface gives a point in the box.
    """
    lane = dr.arange(mi.UInt32, n)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)
    in_box = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d()) / field.box_inv_extent + field.box_min
    ray, _ = sensor.sample_ray(sensor.shutter_open(), sampler.next_1d(), sampler.stratified_2d(0), sampler.next_2d())
    n_bounces = lane % 4  # 0: in the box
    on_surface = n_bounces > 0

    def bounce(k, ray, x, found, active, sampler):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        found |= active
        side = mi.Vector3f(0, 0, dr.sign(si.wi.z))
        x = dr.select(active, si.spawn_ray(si.to_world(side)).o, x)  # off the surface, to the side that was seen
        wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        wo.z = dr.mulsign(wo.z, si.wi.z)
        return k + 1, si.spawn_ray(si.to_world(wo)), x, found, active & (k + 1 < n_bounces), sampler

    _, _, x, found, _, _ = dr.while_loop(
        (mi.UInt32(0), mi.Ray3f(ray), mi.Point3f(in_box), mi.Bool(False), mi.Bool(on_surface), sampler),
        lambda k, ray, x, found, active, sampler: active,
        bounce,
        label="visibility points",
    )
    return dr.select(found, x, in_box)


class VisibilityCache:
    """A field of visibilities together with its training.

    `groups` is a :class:`~mi_neural.lights.clusters.Groups`: what the outputs stand for.
    """

    def __init__(self, training: VisibilityTraining | None = None, shape: FieldShape | None = None, seed: int = 0):
        self.training, self.seed = training or VisibilityTraining(), seed
        self.shape = shape
        self._frame = dr.freeze(self._frame_plain, auto_opaque=False)
        self._sensor_freezes: dict[int, bool] = {}
        self.reset()

    def reset(self) -> None:
        """Forget all that was learned."""
        self.field: VisibilityField | None = None
        self.steps = 0
        self.statistics = {"visibility_steps": 0, "visibility_loss": math.nan, "seconds_visibility": 0.0}

    def start(self, scene, sensor, n_outputs: int) -> None:
        """Make the field in the box of what the camera sees."""
        box = scene.bbox()
        with dr.suspend_grad():
            n = 2**13
            lane = dr.arange(mi.UInt32, n)
            sampler = PathSampler.make(lane, mi.UInt32(self.seed), index=lane, scramble=mi.UInt32(self.seed))
            ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, sampler.stratified_2d(0), sampler.next_2d())
            si = scene.ray_intersect(ray)
            wo = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
            wo.z = dr.mulsign(wo.z, si.wi.z)
            si_next = scene.ray_intersect(si.spawn_ray(si.to_world(wo)), si.is_valid())
            valid = [np.array(s.is_valid() & mi.Bool(True)) * np.ones(n, bool) for s in (si, si_next)]
            points = np.concatenate([np.array(s.p).T[v] for s, v in zip((si, si_next), valid, strict=True)])
        low, high = encoding.record_box(points, np.array(box.min).ravel(), np.array(box.max).ravel())
        shape = self.shape or FieldShape(
            n_levels=6, n_features=4, hashmap_size=2**14, base_resolution=8, per_level_scale=1.7, direction_degree=-1,
            width=32, n_hidden=2, n_outputs=n_outputs, leak=0.01,
        )  # fmt: skip
        self.field = VisibilityField(low, high, shape, self.seed)

    def _frame_plain(self, scene, sensor, field, table, groups, seed, learning_rate, decay):
        n, n_out = self.training.n_points, groups.n_groups
        with dr.suspend_grad():
            x = training_points(scene, sensor, field, n, seed)
            dr.eval(x)
            lane = dr.arange(mi.UInt32, n * n_out)
            point, group = lane % n, lane // n
            sampler = PathSampler.make(lane, seed + 1)
            light = groups.sample_light(group, sampler.next_1d(), mi.Bool(True))[0]
            p = dr.gather(mi.Point3f, x, point)
            ray, some = table.shadow_ray(scene, p, light, sampler.next_2d(), mi.Bool(True))
            visible = dr.select(scene.ray_test(ray, some), mi.Float(0), 1)
            dr.eval(visible)
        return field.step(x, mi.TensorXf(visible, shape=(n_out, n)), learning_rate, decay)

    def train(self, scene, sensor, table, groups, steps: int = 1) -> None:
        """So many steps, each on fresh points."""
        if self.field is None:
            self.start(scene, sensor, groups.n_groups)
        if id(sensor) not in self._sensor_freezes:
            self._sensor_freezes[id(sensor)] = can_freeze(sensor)
        frame = self._frame if self._sensor_freezes[id(sensor)] else self._frame_plain
        t0 = time.perf_counter()
        for _ in range(steps):
            seed = int(np.random.SeedSequence((self.seed, 0x7151B1E, self.steps)).generate_state(1)[0])
            with undisturbed():
                loss = frame(scene, sensor, self.field, table, groups, dr.opaque(mi.UInt32, seed),
                             dr.opaque(mi.Float, self.training.rate(self.steps)),
                             dr.opaque(mi.Float, self.training.decay(self.steps)))  # fmt: skip
            self.steps += 1
        if steps:
            self.statistics["visibility_loss"] = loss[0]
        self.statistics["visibility_steps"] += steps
        self.statistics["seconds_visibility"] += time.perf_counter() - t0
