"""How a light is chosen: one interface, four ways.

``choose(si, n, transmits, u, sampler, hit, active)`` draws a light for the surface point `si` with normal `n` (a mask
says whether light from behind counts) by the uniform number `u` and further numbers of `sampler`; the choice holds the
advanced sampler and the probability of light `hit`. ``pmf(si, n, transmits, index, active)`` is that probability alone.
In scenes with participating media both have the mask `around` besides: it names the points in a medium, which receive
light from all directions alike. Each light that can contribute keeps a positive probability, so every estimate made
with any of them is unbiased: E[contribution(light) weight] = sum of all lights' contributions.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import tree
from .clusters import Groups
from .entries import DIRECTION, ENVIRONMENT, LOCAL
from .importance import importance
from .table import LightTable, own

#: Predicted visibilities below this count as this. In a hall with 32 lights the published 0.001 gave fireflies where
#: the network is wrong: relMSE 2.1 (trimmed 0.09); 0.03: 0.17 (0.10); 0.06: 0.13 (0.10).
VISIBILITY_FLOOR = 0.06
#: The same for parts of the environment: BSDF sampling finds what the network misses, and most parts are hidden
#: indoors. Living room, direct light: variance 4.4 with the environment as one light, 3.8 with 0.06, 3.2 with 0.005.
CELL_FLOOR = 0.005
#: Random numbers have 23 bits. Among more lights than these a second number adds bits: with 8 million lights some would
#: never be chosen, and with this many probabilities are wrong by 1/2048 at most.
FEW_LIGHTS = 2**12
#: Distance of neighbouring random numbers.
STEP = 2.0**-23


@dataclass
class Choice:
    """A chosen light.

    index    the light
    weight   factor of its contribution: 1 / pmf, or the weight of a resampled candidate, whose expected value is 1 /
             pmf
    pmf      probability of the light, for MIS weights (with resampling: of it as a candidate)
    pmf_hit  the same of the light `hit`; None where the method `pmf` computes it, for the lanes alone that need it
    sampler  the sampler that was given, advanced by what was drawn; None where nothing was
    """

    index: mi.UInt32
    weight: mi.Float
    pmf: mi.Float
    pmf_hit: mi.Float | None
    sampler: object = None

    def advanced(self, sampler):
        """The sampler to go on with, `sampler` being the one that was given."""
        return sampler if self.sampler is None else self.sampler

    def of_hit(self, lights, si, n, transmits, hit, active, **in_media):
        """Probability of the light `hit`, with which `lights` made this choice; `active`: where it is needed."""
        return lights.pmf(si, n, transmits, hit, active, **in_media) if self.pmf_hit is None else self.pmf_hit


def _finer(u, sampler, step):
    """The uniform number `u`, which is a multiple of `step`, with further bits of `sampler`."""
    return dr.minimum(u + sampler.next_1d() * step, dr.one_minus_epsilon(mi.Float))


class UniformLights:
    """Every light with the same probability."""

    DRJIT_STRUCT = {"table": object}  # noqa: RUF012

    def __init__(self, table: LightTable):
        self.table = table

    def choose(self, si, n, transmits, u, sampler, hit, active, around=None) -> Choice:
        count = self.table.n_lights
        if count > FEW_LIGHTS:
            bits = (mi.UInt32(u * 2**23) << 9) | mi.UInt32(sampler.next_1d() * 2**9)
            index = dr.mul_hi(bits, mi.UInt32(count))
        else:
            index = dr.minimum(mi.UInt32(u * count), count - 1)
        return Choice(index, mi.Float(count), mi.Float(1 / count), mi.Float(1 / count), sampler)

    def pmf(self, si, n, transmits, index, active, around=None):
        return mi.Float(1 / self.table.n_lights)


class PowerLights:
    """Lights in proportion to what they emit."""

    DRJIT_STRUCT = {"table": object, "groups": object}  # noqa: RUF012

    def __init__(self, table: LightTable):
        self.table = table
        c = table.columns
        # Lights at infinity are weighed by the irradiance they would give the whole scene
        intensity = c["intensity"].astype(np.float64)
        power = np.where(c["kind"] == LOCAL, np.pi * intensity, intensity * table.cross_section)
        self.groups = Groups(table, np.zeros(table.n_lights, int), power / max(power.max(initial=0), 1e-300))

    def choose(self, si, n, transmits, u, sampler, hit, active, around=None) -> Choice:
        if self.table.n_lights > FEW_LIGHTS:
            u = _finer(u, sampler, STEP)
        index, pmf = self.groups.sample_light(mi.UInt32(0), u, active)
        return Choice(index, dr.rcp(pmf), pmf, dr.gather(mi.Float, self.groups.within, hit, active), sampler)

    def pmf(self, si, n, transmits, index, active, around=None):
        return dr.gather(mi.Float, self.groups.within, index, active)


class TreeLights:
    """Lights by a walk down a light tree, each step in proportion to bounds on what the two children give the point
    (Conty Estevez and Kulla 2018, section 5, without their adaptive splitting: one light is chosen).

    The probability of a light is the product of its steps. It is found by the way back, from the leaf to the root. A
    node's bound is 0 where none of its lights can reach the point, so what can reach it is never left out.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "table": object, "spheres": object, "cones": object, "intensity": object, "kind": object, "left": object,
        "parent": object, "light": object, "leaf": object, "facts": object,
    }  # fmt: skip

    def __init__(self, table: LightTable):
        self.table = table
        nodes = tree.build(table.columns)
        flat = lambda *v: own(mi.Float(np.column_stack(v).astype(np.float32).ravel()))  # noqa: E731
        whole = lambda v: own(mi.UInt32(v.astype(np.uint32)))  # noqa: E731
        big = np.finfo(np.float32).max
        self.spheres = flat(np.clip(nodes["center"], -big, big), np.minimum(nodes["radius"], big))
        self.cones = flat(nodes["axis"], nodes["cone"])
        self.intensity, self.kind = flat(nodes["intensity"]), whole(nodes["kind"])
        self.left, self.parent, self.light = whole(nodes["left"]), whole(nodes["parent"]), whole(nodes["light"])
        self.leaf = whole(nodes["leaf"])
        kinds = sorted(set(table.columns["kind"].tolist()))
        self.facts = (int(kinds[0]) if len(kinds) == 1 else None,)  # the kind of all lights
        dr.eval(self)

    def _weight(self, node, p, n, transmits, around, active):
        """Unnormalised weight of a node for a surface at `p` with normal `n`, or for points in a medium."""
        return importance(Node(self, node, active), p, n, transmits, around)

    def choose(self, si, n, transmits, u, sampler, hit, active, around=None) -> Choice:
        # Each step takes bits of u for its own; once most are gone, a second number goes on
        spare = sampler.next_1d()
        node = mi.UInt32(0)
        left = dr.gather(mi.UInt32, self.left, node, active)

        def down(node, left, pmf, u, renewed):
            a, b = (self._weight(left + k, si.p, n, transmits, around, active) for k in (0, 1))
            total = a + b
            share = a * dr.select(total > 0, dr.rcp(total), 0)
            right = u >= share
            taken = dr.select(right, b, a) * dr.select(total > 0, dr.rcp(total), 0)
            u = dr.select(right, u - share, u) / dr.select(taken > 0, taken, 1)
            pmf *= taken
            renew = ~renewed & (pmf < 2**-12)
            u = dr.clip(dr.select(renew, spare, u), 0, dr.one_minus_epsilon(mi.Float))
            node = dr.select(right, left + 1, left)
            left = dr.select(taken > 0, dr.gather(mi.UInt32, self.left, node, active), 0)
            return node, left, pmf, u, renewed | renew

        node, _, pmf, _, _ = dr.while_loop(
            (node, left, mi.Float(1), mi.Float(u), mi.Bool(False)), lambda _, left, *__: active & (left > 0), down,
            label="light tree, down",
        )  # fmt: skip
        index = dr.gather(mi.UInt32, self.light, node, active)
        return Choice(index, dr.select(pmf > 0, dr.rcp(pmf), 0), pmf, None, sampler)

    def pmf(self, si, n, transmits, index, active, around=None):
        def up(node, pmf):
            mine = self._weight(node, si.p, n, transmits, around, active)
            other = self._weight(((node - 1) ^ 1) + 1, si.p, n, transmits, around, active)
            total = mine + other
            pmf *= mine * dr.select(total > 0, dr.rcp(total), 0)
            return dr.gather(mi.UInt32, self.parent, node, active), pmf

        leaf = dr.gather(mi.UInt32, self.leaf, index, active)
        _, pmf = dr.while_loop(
            (leaf, mi.Float(1)), lambda node, pmf: active & (node > 0) & (pmf > 0), up, label="light tree, up"
        )
        return pmf


class VisibleLights:
    """Lights in proportion to what they would give the point without shadows, times their predicted visibility.

    All groups are compared; where a group has several lights, one of `candidates` of them is resampled by what it would
    give (RIS; Talbot et al. 2005). Without `field` visibility is taken to be 1. Predictions count as at least `floor`.
    With `visibility_alone` groups of several lights are weighted by visibility alone (as published).
    """

    DRJIT_STRUCT = {"table": object, "groups": object, "field": object, "n_candidates": object, "facts": object}  # noqa: RUF012

    def __init__(self, table: LightTable, groups: Groups, field=None, candidates: int = 16,
                 floor: float = VISIBILITY_FLOOR, visibility_alone: bool = False):  # fmt: skip
        self.table, self.groups, self.field, self.candidates = table, groups, field, candidates
        self.floor, self.several = floor, (groups.host["count"] > 1).tolist() if visibility_alone else None
        # Only what lies nearby differs within its group from point to point
        several = (groups.host["count"] > 1) & (np.array(groups.kind) == LOCAL)
        self.resamples = bool(several.any())
        self.n_candidates = own(mi.UInt32(np.where(several, candidates, 1).astype(np.uint32)))
        self.facts = (candidates, self.resamples, floor, visibility_alone)

    def weights(self, p, n, transmits, around=None) -> list:
        """Unnormalised weight of every group for a surface at `p` with normal `n`, or for points in a medium."""
        g = self.groups
        visible = self.field.query(p) if self.field is not None else [mi.Float(1)] * g.n_groups
        weights = []
        for k, kind in enumerate(g.kind):
            w = mi.Float(1)
            if self.several is None or not self.several[k]:
                w = importance(Columns(g, mi.UInt32(k), kind), p, n, transmits, around)
            weights.append(w * dr.fmax(visible[k], min(CELL_FLOOR, self.floor) if g.cell[k] else self.floor))
        return weights

    def remembering(self, si, n, transmits, several: bool = False) -> VisibleLights:
        """The same choice at the same surface, again and again: the network is queried once.

        With `several` light samples their mean is taken, so that less is gained by a good choice of each: half of the
        candidates do (Sponza with 1,024 lamps, four light samples: 0.83 of the time for the same error)."""
        lights, weights = copy.copy(self), self.weights(si.p, n, transmits)
        lights.weights = lambda *_: weights
        if several:
            lights.n_candidates = (self.n_candidates + 1) // 2
        return lights

    def choose(self, si, n, transmits, u, sampler, hit, active, around=None) -> Choice:
        weights = self.weights(si.p, n, transmits, around)
        hit_group = dr.gather(mi.UInt32, self.groups.group_of, hit, active)
        # The light at which the running sum passes u times the total; how far beyond is the number for what follows
        total = sum(weights[1:], weights[0])
        at, before = u * total, mi.Float(0)
        chosen, w_chosen, start, w_hit = mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0)
        for k, w in enumerate(weights):
            take = (at >= before) & (w > 0)
            chosen, w_chosen = dr.select(take, k, chosen), dr.select(take, w, w_chosen)
            start = dr.select(take, before, start)
            w_hit = dr.select(hit_group == k, w, w_hit)
            before += w
        per_w = dr.rcp(dr.select(w_chosen > 0, w_chosen, 1))
        u = dr.clip((at - start) * per_w, 0, dr.one_minus_epsilon(mi.Float))
        if self.groups.host["count"].max(initial=0) > FEW_LIGHTS:
            u = _finer(u, sampler, STEP * total * per_w)
        inv_total = dr.select(total > 0, dr.rcp(total), 0)
        pmf, pmf_hit = w_chosen * inv_total, w_hit * inv_total
        active = active & (pmf > 0)
        within_hit = dr.gather(mi.Float, self.groups.within, hit, active)
        if not self.resamples:
            index, within = self.groups.sample_light(chosen, u, active)
            pmf *= within
            return Choice(index, dr.select(pmf > 0, dr.rcp(pmf), 0), pmf, pmf_hit * within_hit, sampler)

        # Within the group: candidates at equal distances, one of them resampled. The members of a group lie in spatial
        # order, so candidates spread over its volume. The first one is at random, so each is on its own.
        m = dr.gather(mi.UInt32, self.n_candidates, chosen, active)
        inv_m = dr.rcp(mi.Float(m))

        def candidate(i, best, within, w_best, w_sum, sampler):
            light, q = self.groups.sample_light(chosen, (i + u) * inv_m, active)
            w = importance(Columns(self.table, light, None, active), si.p, n, transmits, around) / q
            w_sum += w
            take = sampler.next_1d() * w_sum < w
            return (i + 1, dr.select(take, light, best), dr.select(take, q, within), dr.select(take, w, w_best), w_sum,
                    sampler)  # fmt: skip

        _, index, within, w_best, w_sum, sampler = dr.while_loop(
            (mi.UInt32(0), mi.UInt32(0), mi.Float(1), mi.Float(0), mi.Float(0), sampler),
            lambda i, *_: active & (i < m), candidate, label="light candidates",
        )  # fmt: skip
        weight = dr.select(w_best > 0, w_sum * inv_m / (w_best * within), 0)
        weight = dr.select(pmf > 0, weight / pmf, 0)
        return Choice(index, weight, pmf * within, pmf_hit * within_hit, sampler)

    def pmf(self, si, n, transmits, index, active, around=None):
        group = dr.gather(mi.UInt32, self.groups.group_of, index, active)
        total, w_index = mi.Float(0), mi.Float(0)
        for k, w in enumerate(self.weights(si.p, n, transmits, around)):
            total += w
            w_index = dr.select(group == k, w, w_index)
        pmf = dr.select(total > 0, w_index / total, 0)
        return pmf * dr.gather(mi.Float, self.groups.within, index, active)


class Columns:
    """Columns of one light (or group) per lane, as `importance` reads them."""

    def __init__(self, columns, index, kind, active=True):
        self.kind = kind if kind is not None else dr.gather(mi.UInt32, columns.kind, index, active)
        for name, type_ in (("center", mi.Vector3f), ("radius", mi.Float), ("axis", mi.Vector3f), ("cone", mi.Float),
                            ("intensity", mi.Float)):  # fmt: skip
            setattr(self, name, dr.gather(type_, getattr(columns, name), index, active))


class Node:
    """Columns of one node of a light tree per lane, as `importance` reads them."""

    def __init__(self, lights: TreeLights, index, active):
        (kind,) = lights.facts
        self.kind = dr.gather(mi.UInt32, lights.kind, index, active) if kind is None else kind
        sphere = dr.gather(mi.Vector4f, lights.spheres, index, active)
        cone = dr.gather(mi.Vector4f, lights.cones, index, active)
        self.center, self.radius = mi.Vector3f(sphere.x, sphere.y, sphere.z), sphere.w
        self.axis, self.cone = mi.Vector3f(cone.x, cone.y, cone.z), cone.w
        self.intensity = dr.gather(mi.Float, lights.intensity, index, active)


__all__ = [
    "DIRECTION", "ENVIRONMENT", "LOCAL", "Choice", "PowerLights", "TreeLights", "UniformLights", "VisibleLights",
]  # fmt: skip
