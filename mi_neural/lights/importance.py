"""How much unshadowed light a light, or a cluster of them, can send to a point at most, for choosing among them."""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi

from .entries import (
    DIRECTION,
    ENVIRONMENT,
    LOCAL,
)


def importance(light, x, n, two_sided, around=None):
    """Bound on what a surface at x with normal n receives from a light without shadows, up to a constant of order one.

    `light` has the columns kind, center, radius, axis, cone, intensity, for one light each lane. Positive wherever any
    point of the light can be seen: angles are widened by the bounding sphere's (Conty Estevez and Kulla 2018, eq. 3).
    `two_sided` receivers (transmissive ones) count light from behind as well; those that the mask `around` names are
    points in a medium, and count light from all directions alike. Where `light.kind` is a Python number,
    only its case is computed.
    """
    if isinstance(light.kind, int) and light.kind == ENVIRONMENT:
        return mi.Float(light.intensity)
    if isinstance(light.kind, int) and light.kind == DIRECTION:
        cos = dr.dot(light.center, n)
        cos = _widen(dr.select(two_sided, dr.abs(cos), cos), light.cone, _sine(light.cone))
        cos = cos if around is None else dr.select(around, 1, cos)
        return light.intensity * dr.maximum(cos, 0)
    if not isinstance(light.kind, int):
        cases = []
        for kind in (LOCAL, DIRECTION, ENVIRONMENT):
            one = copy.copy(light)
            one.kind = kind
            cases.append(importance(one, x, n, two_sided, around))
        return dr.select(light.kind == LOCAL, cases[0], dr.select(light.kind == DIRECTION, cases[1], cases[2]))
    to = light.center - x
    d2 = dr.squared_norm(to)
    r2 = dr.square(light.radius)
    inv_d = dr.rsqrt(dr.maximum(d2, 1e-30))
    sin_b2 = dr.minimum(r2 * dr.square(inv_d), 1)
    cos_b, sin_b = dr.sqrt(1 - sin_b2), dr.sqrt(sin_b2)
    inside = d2 <= r2
    d = to * inv_d
    cos_i = dr.dot(d, n)
    cos_i = dr.select(two_sided, dr.abs(cos_i), cos_i)
    cos_i = dr.select(inside if around is None else inside | around, 1, _widen(cos_i, cos_b, sin_b))
    cos_o = light.cone
    cos_l = _widen(-dr.dot(d, light.axis), cos_o, _sine(cos_o))
    cos_l = dr.select(inside | (cos_o <= -1), 1, _widen(cos_l, cos_b, sin_b))
    return light.intensity * dr.maximum(cos_i, 0) * dr.maximum(cos_l, 0) / dr.maximum(d2, dr.maximum(r2, 1e-30))


def _widen(cos, cos_by, sin_by):
    """Cosine of an angle made smaller by another, at least 0."""
    return dr.select(cos >= cos_by, 1, cos * cos_by + _sine(cos) * sin_by)


def _sine(cos):
    return dr.sqrt(dr.maximum(1 - dr.square(cos), 0))
