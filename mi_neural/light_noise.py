"""What each way of choosing lights would leave of the noise of direct light, measured by some thousand shadow rays."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .caches.visibility import surface_point
from .lights.clusters import make_groups
from .lights.entries import ENVIRONMENT, LOCAL
from .lights.importance import importance
from .lights.sampling import VISIBILITY_FLOOR, Columns, PowerLights
from .lights.table import LightTable
from .render.frozen import undisturbed
from .render.sampling import PathSampler

#: Most outputs of the visibility network; more lights are known by clusters.
MOST_OUTPUTS = 32
#: Points that lights are looked at from.
N_POINTS = 2048


@dataclass(frozen=True)
class LightNoise:
    """Relative variance that the choice of a light adds to direct light, over surfaces that the camera sees and those
    one bounce further: chosen uniformly, by power, and by what is visible (infinite where that cannot be done)."""

    uniform: float
    power: float
    visibility: float

    def __str__(self):
        return f"{self.uniform:.2g} chosen uniformly, {self.power:.2g} by power, {self.visibility:.2g} by visibility"


def light_noise(scene, sensor, n_points: int = N_POINTS, n_rays: int = 4, seed: int = 0) -> LightNoise:
    """Look at all lights, or clusters of them, from `n_points` points along `n_rays` shadow rays each.

    With unshadowed contributions E and visible shares V of the lights at a point, a choice with probabilities p has the
    variance ``sum E² V / p - (sum E V)²``; it is taken relative to the squared sum of all light, as in relMSE, and
    averaged without the largest 0.1 %. Learned visibility chooses by E max(V, floor). The environment has no part in
    the variance: BSDF rays find it as well.
    """
    with dr.suspend_grad(), undisturbed():
        table = LightTable(scene)
        far = int((table.columns["kind"] != LOCAL).sum())  # never clustered
        groups = make_groups(table, max(MOST_OUTPUTS, far + 1), "auto", seed)
        k, n = groups.n_groups, n_points
        lane = dr.arange(mi.UInt32, n)
        sampler = PathSampler.make(lane, mi.UInt32(seed), index=lane, scramble=mi.UInt32(seed))
        ray, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, sampler.stratified_2d(0), sampler.next_2d())
        p, normal, found = surface_point(scene, mi.Ray3f(ray.o, ray.d), mi.Bool(True))
        wo = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(sampler.next_2d()))
        beyond, normal_beyond, further = surface_point(scene, mi.Ray3f(p, wo), found & (lane % 2 == 1))
        p = mi.Point3f(dr.select(further, beyond, p))
        normal = mi.Vector3f(dr.select(further, normal_beyond, normal))
        dr.eval(p, normal, found)

        lane = dr.arange(mi.UInt32, n * k)
        point, group = lane % n, lane // n
        x = dr.gather(mi.Point3f, p, point)
        kind = dr.gather(mi.UInt32, mi.UInt32(groups.kind), group)
        unshadowed = importance(Columns(groups, group, kind), x, dr.gather(mi.Vector3f, normal, point), mi.Bool(False))
        sampler = PathSampler.make(lane, mi.UInt32(seed + 1))

        def look(i, seen, sampler):
            light = groups.sample_light(group, sampler.next_1d(), mi.Bool(True))[0]
            shadow, some = table.shadow_ray(scene, x, light, sampler.next_2d(), mi.Bool(True))
            return i + 1, seen + dr.select(some & scene.ray_test(shadow, some), 0, mi.Float(1)), sampler

        _, seen, _ = dr.while_loop(
            (mi.UInt32(0), dr.zeros(mi.Float, n * k), sampler), lambda i, *_: i < n_rays, look, label="lights seen"
        )
        dr.eval(unshadowed, seen)
    found = np.array(found)
    e = np.array(unshadowed, np.float64).reshape(k, n)[:, found]
    v = np.array(seen, np.float64).reshape(k, n)[:, found] / n_rays

    label = groups.host["label"]
    uniform = np.bincount(label) / len(label)
    power = np.bincount(label, np.array(PowerLights(table).groups.within, np.float64))
    visible = e * np.maximum(v, VISIBILITY_FLOOR)
    counts = np.array(groups.kind) != ENVIRONMENT
    noise = [_variance(e, v, pmf, counts) for pmf in (uniform[:, None], power[:, None], visible)]
    return LightNoise(*noise[:2], noise[2] if far < MOST_OUTPUTS else math.inf)


def _variance(e: np.ndarray, v: np.ndarray, pmf: np.ndarray, counts: np.ndarray) -> float:
    """Mean relative variance of one light chosen by `pmf`, not normalised; arrays (lights, points). Only lights that
    `counts` names have a part in it."""
    total = (e * v).sum(axis=0)
    if not (total > 0).any():
        return 0.0
    level = np.median(total[total > 0])  # points on a lamp itself are brighter by far
    pmf = np.broadcast_to(pmf, e.shape)
    pmf = (pmf / np.maximum(pmf.sum(axis=0), 1e-300))[counts]
    e, v = e[counts], v[counts]
    second = np.divide(e**2 * v, pmf, out=np.zeros_like(e), where=pmf > 0).sum(axis=0)
    relative = np.sort((second - (e * v).sum(axis=0) ** 2) / (total**2 + 1e-2 * level**2))
    return float(max(relative[: max(1, int(0.999 * relative.size))].mean(), 0.0))
