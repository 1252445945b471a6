"""NRC-DI: direct light as a radiance cache has it, the baseline that the visibility cache is compared with.

The network of the visibility cache with three outputs, the colours of what a surface of albedo 1 reflects of all
lights, and a leaky ReLU in place of the sigmoid; learned from one sample of direct light per training point (the
seed's paper on visibility caches, "NRC DI"). It depends on position alone: where surfaces meet, and on glossy ones, it
blurs what the visibility cache keeps apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import encoding, loss
from .field import Field, FieldShape
from .schedule import Ramp
from .trainer import Trainer, found
from .voxels import Ages

#: Slope of the output below 0.
LEAK = 0.01
#: Targets above this many times the scene's mean are cut.
TARGET_MAX = 1e4
#: Albedos below this count as this, so that no target is divided by 0.
ALBEDO_MIN = 0.05


@dataclass(frozen=True)
class DirectTraining(Ramp):
    """Constants of training, see :class:`~mi_neural.caches.schedule.Ramp`; each point has one sample of direct light.

    epsilon    of the relative loss, over the squared mean target
    """

    n_points: int = 8192
    ema_decay: float = 0.98
    first_rate: float = 0.02
    last_rate: float = 0.002
    epsilon: float = 0.1


def albedo(si, bsdf, active):
    """The factor that is taken out of the cached radiance; any positive one is right if it is always the same."""
    diffuse = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    value = bsdf.eval_diffuse_reflectance(si, diffuse)
    return dr.select(diffuse & dr.all(dr.isfinite(value)), dr.clip(value, ALBEDO_MIN, 1), 1)


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

    def __init__(self, trace: Callable, training: DirectTraining | None = None, seed: int = 0):
        super().__init__(training or DirectTraining(), seed)
        self.trace = trace

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
        shape = FieldShape(
            n_levels=8, n_features=4, hashmap_size=2**14, base_resolution=8, per_level_scale=1.5, direction_degree=-1,
            width=32, n_hidden=2, leak=0.01,
        )  # fmt: skip
        self.field, self.ages = Field(low, high, shape, scale=scale, seed=self.seed), Ages(low, high)
        dr.eval(self.field)

    def frame(self, scene, sensor, lights, field, ages, seed, rate_factor):
        training = self.training
        with dr.suspend_grad():
            x, y, valid = self.trace(scene, sensor, lights, training.n_points, seed)
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
        epsilon = training.epsilon * dr.maximum(dr.square(field.mean), 1e-12)
        errors = dr.select(valid, loss.relative_l2(p, y, epsilon), 0) * share
        value = field.step(errors, learning_rate, decay)
        mean_prediction = dr.sum(dr.select(valid, dr.abs(loss.luminance(prediction)), 0)) * share
        return found(value, ages, mean_target, mean_prediction, n_valid)

    def train_step(self, scene, sensor, lights) -> None:
        """Trace direct light at fresh points and take one step on it."""
        seed = dr.opaque(mi.UInt32, self.random_seed(self.steps))
        self.step("frame", sensor, scene, sensor, lights, self.field, self.ages, seed)
