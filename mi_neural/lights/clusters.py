"""Groups of lights: what a visibility cache has an output for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .entries import DIRECTION, ENVIRONMENT, LOCAL
from .table import LightTable, own

METHODS = ("auto", "kmeans", "emitter")


class Groups:
    """A partition of a light table into at most `n_outputs` groups. A PyTree.

    Like a light, each group has the columns of :func:`~mi_neural.lights.table.importance`: `kind` is a Python list, the
    others are arrays. `cell`: which groups are parts of the environment. `start`, `count`: its range in `member`, the
    lights sorted by group; `within` is the probability of a light in its group (proportional to its intensity, or with
    `equal` the same for all), `cumulative` its running sum over `member`; `group_of` leads from light to group.
    `facts`: see the light table.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "center": object, "radius": object, "axis": object, "cone": object, "intensity": object, "start": object,
        "count": object, "member": object, "within": object, "cumulative": object, "group_of": object,
        "facts": object,
    }  # fmt: skip

    def __init__(self, table: LightTable, label: np.ndarray, intensity: np.ndarray | None = None, equal: bool = False):
        c = table.columns
        label = np.unique(label, return_inverse=True)[1].ravel()
        self.n_groups = int(label.max(initial=-1)) + 1
        self.n_lights = table.n_lights
        order = np.lexsort((morton(c["center"]), label))
        count = np.bincount(label, minlength=self.n_groups)
        start = np.cumsum(count) - count
        intensity = np.maximum((c["intensity"] if intensity is None else intensity).astype(np.float64), 0)
        total = np.bincount(label, intensity, self.n_groups)
        # No light is left out: a tenth is shared equally, so that a dark mean hides no bright part
        share = np.where((total > 0) & (not equal), 0.1, 1)[label]
        within = (1 - share) * intensity / np.where(total > 0, total, 1)[label] + share / count[label]
        cumulative = np.cumsum(within[order])
        cumulative -= (cumulative[start] - within[order][start])[label[order]]
        cumulative[start + count - 1] = 1.0
        # Lights are drawn by the rounded sums, so these decide their probabilities
        cumulative = np.maximum.accumulate(cumulative.astype(np.float32) + label[order].astype(np.float64))
        cumulative -= label[order]
        before = np.where(np.arange(len(order)) == start[label[order]], 0, np.concatenate([[0], cumulative[:-1]]))
        within[order] = cumulative - before
        self.single = bool((count == 1).all())

        b = bounds(c, label, self.n_groups, intensity)
        self.kind = [int(k) for k in c["kind"][order][start]]
        first_texel = table.sky.first if table.sky is not None else table.n_lights
        self.cell = [bool(i >= first_texel) for i in order[start]]
        self.host = {"label": label, "count": count, "intensity": total, "center": b["center"], "radius": b["radius"]}
        vec = lambda v: own(mi.Vector3f(np.ascontiguousarray(v.T, np.float32)))  # noqa: E731
        big = np.finfo(np.float32).max
        flt = lambda v: own(mi.Float(np.ascontiguousarray(np.minimum(v, big), np.float32)))  # noqa: E731
        num = lambda v: own(mi.UInt32(np.ascontiguousarray(v, np.uint32)))  # noqa: E731
        self.center, self.radius, self.axis = vec(b["center"]), flt(b["radius"]), vec(b["axis"])
        self.cone, self.intensity = flt(b["cone"]), flt(total)
        self.start, self.count, self.member = num(start), num(count), num(order)
        self.within, self.cumulative, self.group_of = flt(within), flt(cumulative), num(label)
        self.search_steps = int(count.max(initial=1) - 1).bit_length()
        self.facts = (self.n_groups, self.single, self.search_steps, *self.kind, *self.cell)
        dr.eval(self)

    def sample_light(self, group, u, active):
        """A light of `group` with probability `within`: (index, probability)."""
        first = dr.gather(mi.UInt32, self.start, group, active)
        if self.single:
            return dr.gather(mi.UInt32, self.member, first, active), mi.Float(1)
        count = dr.gather(mi.UInt32, self.count, group, active)
        low = mi.UInt32(0)
        for bit in reversed(range(self.search_steps)):
            right = low + 2**bit
            ahead = active & (right < count)
            low = dr.select(ahead & (u >= dr.gather(mi.Float, self.cumulative, first + right - 1, ahead)), right, low)
        low += first
        light = dr.gather(mi.UInt32, self.member, low, active)
        return light, dr.gather(mi.Float, self.within, light, active)


def bounds(
    c: dict[str, np.ndarray], label: np.ndarray, n: int, intensity: np.ndarray, boxes: bool = False
) -> dict[str, np.ndarray]:  # fmt: skip
    """Sets of lights, each as one light that gives at least what any of its members gives.

    `c`: columns of the lights, `label` (lights,) the set of each, of `n` sets of which none is empty, `intensity`
    (lights,) their weights. The spheres are centred where the light comes from in the mean or, with `boxes`, on the
    middle of the set's box, which makes them smaller. Returns ``kind``, ``center``, ``radius``, ``axis``, ``cone``,
    ``intensity`` of the sets as :func:`~mi_neural.lights.table.importance` reads them, float64. A set of several kinds
    has the largest of them.
    """
    count, total = np.bincount(label, minlength=n), np.bincount(label, intensity, n)
    weight = np.where(total[label] > 0, intensity, 1.0)
    one, some = count == 1, np.zeros(n, np.int64)
    some[label] = np.arange(len(label))
    kind = np.zeros(n, np.uint32)
    np.maximum.at(kind, label, c["kind"])

    def mean(v):
        sums = [np.bincount(label, weight * v[:, i], n) for i in range(3)]
        return np.stack(sums, -1) / np.bincount(label, weight, n)[:, None]

    def widest(directions, middle):
        angle = np.arccos(np.clip((directions * middle[label]).sum(axis=1), -1, 1))
        out = np.zeros(n)
        np.maximum.at(out, label, angle + np.arccos(np.clip(c["cone"], -1, 1)))
        return out + np.where(one, 0, 1e-4)

    def unit(v):
        length = np.linalg.norm(v, axis=1)[:, None]
        return np.where(length > 1e-6, v / np.maximum(length, 1e-30), [0, 0, 1])

    centers, axes = c["center"].astype(np.float64), c["axis"].astype(np.float64)
    center, axis = mean(centers), unit(mean(axes))
    if boxes:
        reach = c["radius"].astype(np.float64)[:, None]
        low, high = extremes(centers - reach, centers + reach, label, n)
        center = np.where(((kind == LOCAL) & ~one)[:, None], (low + high) / 2, center)
    radius = np.zeros(n)
    np.maximum.at(radius, label, np.linalg.norm(centers - center[label], axis=1) + c["radius"])
    radius[one] = c["radius"][some][one]
    radius[kind != LOCAL] = 0
    angle = widest(axes, axis)
    cone = np.where(angle >= np.pi - 1e-3, -1.0, np.cos(angle))
    # Lights at infinity: the angle about their mean direction
    far = kind == DIRECTION
    center[far] = unit(center)[far]
    cone = np.where(far, np.cos(np.minimum(widest(centers, center), np.pi)), cone)
    cone[kind == ENVIRONMENT] = -1
    return {"kind": kind, "center": center, "radius": radius, "axis": axis, "cone": cone, "intensity": total}


def extremes(low: np.ndarray, high: np.ndarray, label: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Least of `low` and most of `high` (members, 3) over each of `n` sets, (sets, 3) each; inf and -inf of sets
    without a member."""
    least, most = np.full((n, 3), np.inf), np.full((n, 3), -np.inf)
    for i in range(3):
        np.minimum.at(least[:, i], label, low[:, i])
        np.maximum.at(most[:, i], label, high[:, i])
    return least, most


def morton(points: np.ndarray) -> np.ndarray:
    """Place on a space-filling curve (ten bits an axis) of `points` (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    q = ((points - low) / np.maximum(high - low, 1e-30) * 1023).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((q[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return code


def make_groups(
    table: LightTable, n_outputs: int, method: str = "auto", seed: int = 0, n_cells: int = 32, equal: bool = False
) -> Groups:  # fmt: skip
    """Groups of a table: each light alone if they are no more than `n_outputs`, else clusters.

    `method`: ``emitter`` (all triangles of an emitter together), ``kmeans``, or ``auto``: by emitter where they are
    few enough and small, else k-means. Lights at infinity are always alone. The texels of an
    environment, if the table has them, make up to `n_cells` groups more. `equal`: see :class:`Groups`.
    """
    lights = {k: v[: table.sky.first] for k, v in table.columns.items()} if table.sky is not None else table.columns
    label = _label_lights(lights, n_outputs, method, seed)
    if table.sky is not None:
        label = np.concatenate([label, label.max(initial=-1) + 1 + _label_texels(table.sky, n_cells, seed)])
    return Groups(table, label, equal=equal)


def _label_texels(sky, n_cells: int, seed: int) -> np.ndarray:
    """Groups of the sky's texels near each other and of like power, made of square blocks of them."""
    side = min(sky.size, 64)
    texel = np.arange(sky.size**2)
    block = texel // sky.size * side // sky.size * side + texel % sky.size * side // sky.size
    power = np.bincount(block, sky.irradiance)
    middle = np.stack([np.bincount(block, v) for v in sky.direction.T], axis=-1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1), 1e-30)[:, None]
    # A block of mean power counts at least so much that dark parts of the sky are not all one group
    return kmeans(middle, n_cells, power + 0.1 * power.mean(), seed)[block]


def _label_lights(c: dict[str, np.ndarray], n_outputs: int, method: str, seed: int) -> np.ndarray:
    n = len(c["emitter"])
    if n <= n_outputs:
        return np.arange(n)
    by_emitter = np.unique(c["emitter"], return_inverse=True)[1].ravel()
    if method == "emitter" or (method == "auto" and by_emitter.max() + 1 <= n_outputs
                               and np.bincount(by_emitter).max() <= 64):  # fmt: skip
        if by_emitter.max() + 1 <= n_outputs:
            return by_emitter
        raise ValueError(
            f"there are {by_emitter.max() + 1} emitters, more than the {n_outputs} outputs; "
            'use clusters="kmeans" or raise outputs'
        )
    alone = c["kind"] != LOCAL
    n_alone = int(alone.sum())
    if n_alone >= n_outputs:
        raise ValueError(
            f"{n_alone} lights are at infinity, which cannot be clustered, and there are {n_outputs} outputs; "
            "raise outputs"
        )
    label = np.zeros(n, np.int64)
    label[alone] = np.arange(n_alone)
    features = c["center"][~alone].astype(np.float64)
    weights = np.maximum(c["intensity"][~alone].astype(np.float64), 1e-30)
    label[~alone] = n_alone + kmeans(features, n_outputs - n_alone, weights, seed)
    return label


def kmeans(points: np.ndarray, k: int, weights: np.ndarray, seed: int = 0, rounds: int = 30) -> np.ndarray:
    """Labels of Lloyd's algorithm from a k-means++ start; `points` (n, d), `weights` (n,).

    Fewer than k clusters may come out.
    """
    rng = np.random.default_rng(seed)
    n = len(points)
    if n <= k:
        return np.arange(n)
    if not weights.sum() > 0:
        weights = np.ones(n)
    p = weights / weights.sum()
    centers = points[[rng.choice(n, p=p)]]
    d2 = ((points - centers[0]) ** 2).sum(axis=1)
    for _ in range(k - 1):
        mass = d2 * p
        if mass.sum() <= 0:
            break
        centers = np.vstack([centers, points[rng.choice(n, p=mass / mass.sum())]])
        d2 = np.minimum(d2, ((points - centers[-1]) ** 2).sum(axis=1))
    label = np.full(n, -1)
    for _ in range(rounds):
        square = (centers**2).sum(axis=1) - 2 * points @ centers.T
        new = square.argmin(axis=1)
        if (new == label).all():
            break
        label = new
        mass = np.bincount(label, weights, len(centers))
        for axis in range(points.shape[1]):
            mean = np.bincount(label, weights * points[:, axis], len(centers)) / np.maximum(mass, 1e-300)
            centers[:, axis] = np.where(mass > 0, mean, centers[:, axis])
    return label


__all__ = ["DIRECTION", "ENVIRONMENT", "LOCAL", "METHODS", "Groups", "kmeans", "make_groups"]
