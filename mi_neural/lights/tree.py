"""A light tree: a binary hierarchy of bounds over the lights of a table, built in NumPy, level by level.

Conty Estevez and Kulla 2018, "Importance Sampling of Many Lights with Adaptive Tree Splitting". Nodes are split as in
section 4.2 by their surface area orientation heuristic,

    cost(L, R) = k (Φ_L M_A,L M_Ω,L + Φ_R M_A,R M_Ω,R),   k = largest extent / extent along the axis of the split,

tried at `BINS` - 1 planes on each axis; Φ is power, M_A the surface area of the box, M_Ω the measure of the cone of
normals. That cone is not bounded here but estimated, which changes the shape of the tree and nothing else: from the
mean R of the lights' axes, since normals that fill a cone evenly have R = (1 + cos θ) / 2. What nodes are *sampled* by
is bounded: sphere and cone of :func:`~mi_neural.lights.clusters.bounds`.

Lights at infinity have no place. They have a tree of their own beside that of the local ones, with directions instead
of positions, and the environment as a whole lies beside them: the first choice is between near and far.
"""

from __future__ import annotations

import numpy as np

from .clusters import bounds, extremes
from .entries import OTHER, UNSAMPLED

#: Planes are tried between so many slices of a node along each axis (the paper's number).
BINS = 12
#: From this level on nodes are halved, so that no tree is deeper than this and the bits of the number of lights.
HALVES_FROM = 40
#: Nodes that are split in one go: 3 kB each.
CHUNK = 2**14
#: Bounds are this much larger than computed, for what rounding to single precision takes away.
SLACK = 1e-5
#: Of a light whose radiance is known from a few samples, power counts as at least this share of the mean light's: its
#: samples may have missed a bright part.
UNCERTAIN = 0.1


def build(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The tree over the entries of a light table, from its NumPy `columns`.

    Returns arrays of 2 n - 1 nodes for n lights, the root first and the two children of a node side by side:
    ``left``, the first child (0: a leaf), ``parent``, ``light`` of a leaf (of other nodes any light in them), and the
    columns of :func:`~mi_neural.lights.clusters.bounds`, the intensity relative to the largest of a light; and, over
    lights, ``leaf``, the node of each.
    """
    n = len(columns["emitter"])
    power = powers(columns)
    leaf, levels = np.zeros(n, np.int64), []
    lights, label, k = np.arange(n), np.zeros(n, np.int64), 1
    first, n_nodes = 0, 1
    while True:
        here = {name: columns[name][lights] for name in ("kind", "center", "radius", "axis", "cone")}
        nodes = bounds(here, label, k, power[lights], boxes=True)
        count = np.bincount(label, minlength=k)
        inner = count > 1
        nodes["left"] = np.where(inner, n_nodes + 2 * (np.cumsum(inner) - 1), 0)
        nodes["light"] = np.zeros(k, np.int64)
        nodes["light"][label] = lights
        leaf[lights] = first + label  # of those that go on it is overwritten by deeper levels
        levels.append(nodes)
        if not inner.any():
            return _joined(levels, leaf)
        stays = inner[label]
        lights, label = lights[stays], (np.cumsum(inner) - 1)[label[stays]]
        m = int(inner.sum())
        halve = len(levels) >= HALVES_FROM
        right = _sides({k: v[stays] for k, v in here.items()}, power[lights], label, m, halve)
        label, k = 2 * label + right, 2 * m
        first, n_nodes = n_nodes, n_nodes + k


def powers(columns) -> np.ndarray:
    """What lights count, relative to the largest: their intensity, with a floor where that is a guess."""
    intensity = np.nan_to_num(columns["intensity"].astype(np.float64), nan=0, posinf=np.finfo(np.float32).max)
    power = np.maximum(intensity, 0) / max(intensity.max(initial=0), 1e-300)
    guessed = (columns["form"] == OTHER) | ~columns["plain"]
    power = np.where(guessed, np.maximum(power, UNCERTAIN * power.mean()), power)
    return np.where(columns["form"] == UNSAMPLED, 0, power)  # BSDF samples alone find their light


def _joined(levels: list[dict], leaf) -> dict[str, np.ndarray]:
    nodes = {name: np.concatenate([level[name] for level in levels]) for name in levels[0]}
    inner = np.flatnonzero(nodes["left"])
    nodes["parent"] = np.zeros(len(nodes["left"]), np.int64)
    for child in (0, 1):
        nodes["parent"][nodes["left"][inner] + child] = inner
    nodes["radius"][inner] *= 1 + SLACK
    return nodes | {"leaf": leaf}


# ---------------------------------------------------------------- where nodes are split


def _sides(here: dict, power, label, n: int, halve: bool) -> np.ndarray:
    """For each light whether it goes to the right child (1) or the left one (0); `label` its node, of `n` nodes."""
    order = np.argsort(label, kind="stable")
    ends = np.cumsum(np.bincount(label, minlength=n))
    right = np.zeros(len(label), np.int64)
    for low in range(0, n, CHUNK):
        high = min(low + CHUNK, n)
        part = order[ends[low - 1] if low else 0 : ends[high - 1]]
        some = {name: v[part] for name, v in here.items()}
        right[part] = _sides_of_some(some, power[part], label[part] - low, high - low, halve)
    return right


def _sides_of_some(here: dict, power, label, n: int, halve: bool) -> np.ndarray:
    x = here["center"].astype(np.float64)
    low, high = extremes(x, x, label, n)
    extent = high - low
    chosen, right = np.full(n, -1), np.zeros(len(label), np.int64)  # the axis of the split, -1: none
    many = (np.bincount(label, minlength=n) > 2) & (not halve)
    if many.any():
        rows, number = np.flatnonzero(many[label]), np.cumsum(many) - 1
        some = {name: v[rows] for name, v in here.items()}
        slices = _slices(x[rows], label[rows], low, extent)
        chosen[many], plane = _best_planes(some, x[rows], power[rows], number[label[rows]], slices, extent[many])
        at = np.take_along_axis(slices, np.maximum(chosen, 0)[label[rows]][:, None], axis=1)[:, 0]
        right[rows] = at > plane[number[label[rows]]]
    # Near and far lights apart, then the environment: it has no place among directions
    kind = here["kind"]
    least, most = np.full(n, 3, np.int64), np.zeros(n, np.int64)
    np.minimum.at(least, label, kind)
    np.maximum.at(most, label, kind)
    mixed = (least < most)[label]
    right[mixed] = (kind > least[label])[mixed]
    # Lights in one place, or along no plane apart: halves, in order along the longest axis
    left_over = (chosen < 0)[label] & ~mixed
    if left_over.any():
        rows = np.flatnonzero(left_over)
        along = np.take_along_axis(x, extent.argmax(axis=1)[label][:, None], axis=1)[:, 0]
        rows = rows[np.lexsort((along[rows], label[rows]))]
        count = np.bincount(label[rows], minlength=n)
        rank = np.arange(len(rows)) - (np.cumsum(count) - count)[label[rows]]
        right[rows] = rank >= (count[label[rows]] + 1) // 2
    return right


def _slices(x, label, low, extent) -> np.ndarray:
    """Slice of each light along each axis, (lights, 3)."""
    within = (x - low[label]) / np.where(extent > 0, extent, 1)[label]
    return np.clip((within * BINS).astype(np.int64), 0, BINS - 1)


def _best_planes(here, x, power, label, slices, extent) -> tuple[np.ndarray, np.ndarray]:
    """Of each node the axis of the plane of least cost (-1: none divides it) and the last slice on its left."""
    cell = (3 * label[:, None] + np.arange(3)) * BINS + slices  # (lights, 3)
    n = len(extent)
    size = n * 3 * BINS
    flat = cell.ravel()

    def sums(v):
        return np.bincount(flat, np.repeat(v, 3), size).reshape(n, 3, BINS)

    count = np.bincount(flat, minlength=size).reshape(n, 3, BINS)
    phi = sums(power)
    emits_to_a_side = here["cone"] > -1
    axis = [sums(power * emits_to_a_side * here["axis"][:, i]) for i in range(3)]
    reach = here["radius"].astype(np.float64)[:, None]
    box = extremes(np.repeat(x - reach, 3, axis=0), np.repeat(x + reach, 3, axis=0), flat, size)
    box = [v.reshape(n, 3, BINS, 3) for v in box]
    pad = 1e-3 * np.maximum(extent.max(axis=1), 1e-30)[:, None, None]

    def costs(count, phi, axis, box):
        """Of the first 1, 2, ... BINS - 1 slices; inf where none of their lights is there."""
        count, phi = np.cumsum(count, axis=2)[..., :-1], np.cumsum(phi, axis=2)[..., :-1]
        axis = np.stack([np.cumsum(a, axis=2)[..., :-1] for a in axis], axis=-1)
        corners = [np.minimum.accumulate(box[0], axis=2), np.maximum.accumulate(box[1], axis=2)]
        with np.errstate(invalid="ignore"):  # boxes of nothing
            e = np.maximum((corners[1] - corners[0])[:, :, :-1], pad[..., None])
        area = e[..., 0] * e[..., 1] + e[..., 1] * e[..., 2] + e[..., 2] * e[..., 0]
        mean = np.linalg.norm(axis, axis=-1) / np.where(phi > 0, phi, 1)
        return np.where(count > 0, phi * area * _cone_measure(2 * np.clip(mean, 0, 1) - 1), np.inf)

    left = costs(count, phi, axis, box)
    back = [v[:, :, ::-1] for v in (count, phi, *axis, *box)]
    right = costs(back[0], back[1], back[2:5], back[5:])[..., ::-1]
    stretch = extent.max(axis=1)[:, None] / np.where(extent > 0, extent, np.inf)
    stretch = np.where(extent > 0, stretch, np.inf)[..., None]
    cost = (stretch * np.where(np.isinf(stretch), np.inf, left + right)).reshape(n, -1)
    best = cost.argmin(axis=1)
    found = np.isfinite(cost[np.arange(n), best])
    return np.where(found, best // (BINS - 1), -1), best % (BINS - 1)


def _cone_measure(cos):
    """M_Ω of normals within θ of an axis and light within 90 degrees of a normal (Conty Estevez and Kulla 2018, eq. 1,
    with θ_e = π/2)."""
    θ = np.arccos(cos)
    θ_w = np.minimum(θ + np.pi / 2, np.pi)
    sin = np.sin(θ)
    return 2 * np.pi * (1 - cos) + np.pi / 2 * (2 * θ_w * sin - np.cos(θ - 2 * θ_w) - 2 * θ * sin + cos)

