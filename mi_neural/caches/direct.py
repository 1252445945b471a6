"""NRC-DI: direct light as a radiance cache has it, the baseline that the visibility cache is compared with.

The network of the visibility cache with three outputs, the colours of what a surface of albedo 1 reflects of all
lights, and a leaky ReLU in place of the sigmoid; learned from one sample of direct light per training point (the
seed's paper on visibility caches, section 4.2, "NRC DI"). It depends on position alone: where surfaces meet, and on
glossy ones, it blurs what the visibility cache keeps apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.sampling import PathSampler
from . import encoding, loss
from .field import Field
from .schedule import Ramp
from .trainer import Trainer, found
from .visibility import initialize_he
from .voxels import Ages
from .weights import FieldShape, Weights

#: Slope of the output below 0.
LEAK = 0.01
#: Targets above this many times the scene's mean are cut.
TARGET_MAX = 1e4
#: Albedos below this count as this, so that no target is divided by 0.
ALBEDO_MIN = 0.05
#: What training lessens; the second is the seed's.
LOSSES = ("relative", "squared")
#: Levels of the hash grid.
GRID = {"n_levels": 8, "base_resolution": 8, "per_level_scale": 1.5}


@dataclass(frozen=True)
class DirectTraining(Ramp):
    """Constants of training, see :class:`~mi_neural.caches.schedule.Ramp`; each point has one sample of direct light.

    loss          ``relative``: `loss.relative_l2`, ``squared``: ``|p - y|²``, radiances over the scene's mean
    epsilon       of the former, over the squared mean target
    world_points  share of the points that lie anywhere in the box, see `air_records`; the others where the camera looks
    """

    n_points: int = 8192
    ema_decay: float = 0.98
    first_rate: float = 0.02
    last_rate: float = 0.002
    epsilon: float = 0.1
    loss: str = "relative"
    world_points: float = 0.0

    def __post_init__(self):
        super().__post_init__()
        if self.loss not in LOSSES:
            raise ValueError(f"loss is '{self.loss}'; give one of: {', '.join(LOSSES)}")
        if not 0 <= self.world_points <= 1:
            raise ValueError(f"world_points is {self.world_points}; it must lie in [0, 1]")


def albedo(si, bsdf, active):
    """The factor that is taken out of the cached radiance; any positive one is right if it is always the same."""
    diffuse = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    value = bsdf.eval_diffuse_reflectance(si, diffuse)
    return dr.select(diffuse & dr.all(dr.isfinite(value)), dr.clip(value, ALBEDO_MIN, 1), 1)


def air_records(scene, field: Field, n: int, seed) -> tuple:
    """Points anywhere in the field's box: (position, direct light, valid), as if each were on a white Lambertian of
    random orientation. One emitter sample of the scene's each, with its shadow ray."""
    lane = dr.arange(mi.UInt32, n)
    sampler = PathSampler.make(lane, seed, index=lane, scramble=seed)
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d()) / field.box_inv_extent + field.box_min
    normal = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), True)
    y = weight * (dr.maximum(dr.dot(ds.d, normal), 0) * dr.inv_pi)
    valid = dr.all(dr.isfinite(y))
    return si.p, mi.Color3f(dr.select(valid & (ds.pdf > 0), y, 0)), valid


class HeWeights(Weights):
    """Weights that begin as He et al. 2015 have them."""

    def __init__(self, shape: FieldShape, seed: int, half: bool | None = None):
        super().__init__(shape, seed, half)
        initialize_he(self, seed)


class HeField(Field):
    """A field of such weights."""

    WEIGHTS = HeWeights


class DirectCache(Trainer):
    """A field of reflected direct light together with its training.

    ``trace(scene, sensor, lights, n, seed)`` gives training points: (position, target, valid), the target being
    reflected direct light over :func:`albedo`.
    """

    NAME, SALT = "direct light", 0xD12EC7
    NAMES = {  # noqa: RUF012
        "steps": "direct_steps", "loss": "direct_loss", "recoveries": "direct_recoveries",
        "seconds": "seconds_direct",
    }  # fmt: skip

    def __init__(
        self, trace: Callable, training: DirectTraining | None = None, seed: int = 0, *, grid: dict | None = None,
        he: bool = False,
    ):  # fmt: skip
        super().__init__(training or DirectTraining(), seed)
        self.trace, self.he = trace, he
        self.shape = FieldShape(
            **{**GRID, **(grid or {})}, n_features=4, hashmap_size=2**14, direction_degree=-1, width=32, n_hidden=2,
            leak=0.01,
        )  # fmt: skip

    def query(self, x):
        """Reflected direct light at x of a surface of albedo 1, never negative."""
        return self.field.query(self.field.encode(x), None)

    def start(self, scene, sensor, lights) -> None:
        """Measure where light is asked for and how bright it is, and make the field; no training."""
        with dr.suspend_grad():
            seed = dr.opaque(mi.UInt32, self.random_seed(0xFFFFFF))
            x, y, valid = self.trace(scene, sensor, lights, self.training.n_points, seed)
            dr.eval(x, y, valid)
        valid = np.array(valid)
        level = np.array(y).mean(axis=0)[valid]
        box = scene.bbox()
        low, high = encoding.record_box(np.array(x).T[valid], np.array(box.min).ravel(), np.array(box.max).ravel())
        scale = float(level.mean()) if level.size else 0.0
        if not (math.isfinite(scale) and scale > 1e-30):
            scale = 1e-20
        kind = HeField if self.he else Field
        self.field, self.ages = kind(low, high, self.shape, scale=scale, seed=self.seed), Ages(low, high)
        dr.eval(self.field)

    def frame(self, scene, sensor, lights, field, ages, seed, rate_factor):
        training = self.training
        with dr.suspend_grad():
            x, y, valid = self._points(scene, sensor, lights, field, seed)
            y = dr.select(valid, dr.clip(y / field.scale, 0, TARGET_MAX), 0)
            dr.eval(x, y, valid)
            learning_rate, decay = self.pace(ages, x, valid, rate_factor, field)
            n_valid = dr.count(valid)
            share = dr.rcp(mi.Float(dr.maximum(n_valid, 1)))
            mean_target = dr.sum(loss.luminance(y)) * share
            field.mean = dr.lerp(mean_target, field.mean, decay)
            dr.eval(field.mean)
        p = field.predict(x, None)
        prediction = dr.detach(p)
        dr.schedule(prediction)
        p = dr.select(p > 0, p, LEAK * p)
        if training.loss == "squared":
            error = dr.squared_norm(p - y)
        else:
            error = loss.relative_l2(p, y, training.epsilon * dr.maximum(dr.square(field.mean), 1e-12))
        errors = dr.select(valid, error, 0) * share
        value = field.step(errors, learning_rate, decay)
        mean_prediction = dr.sum(dr.select(valid, dr.abs(loss.luminance(prediction)), 0)) * share
        return found(value, ages, mean_target, mean_prediction, n_valid)

    def _points(self, scene, sensor, lights, field, seed) -> tuple:
        """Points of a step, what they reflect, and whether they count: first those where the camera looks."""
        n = self.training.n_points
        n_air = round(n * self.training.world_points)
        if n_air == 0:
            return self.trace(scene, sensor, lights, n, seed)
        air = air_records(scene, field, n_air, seed + 0x9E3779B9)
        if n_air == n:
            return air
        seen = self.trace(scene, sensor, lights, n - n_air, seed)

        def both(a, b):
            return dr.concat([a + dr.zeros(mi.Float, n - n_air), b + dr.zeros(mi.Float, n_air)])

        x, y = (type(a)(*(both(a[i], b[i]) for i in range(3))) for a, b in zip(seen[:2], air[:2], strict=True))
        return x, y, both(*(dr.select(part[2], mi.Float(1), 0) for part in (seen, air))) > 0

    def train_step(self, scene, sensor, lights) -> None:
        """Trace direct light at fresh points and take one step on it."""
        seed = dr.opaque(mi.UInt32, self.random_seed(self.steps))
        self.step("frame", sensor, scene, sensor, lights, self.field, self.ages, seed)
