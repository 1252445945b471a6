"""Inputs of the networks. Only what a cache needs: incident radiance depends on position and direction alone, outgoing
radiance on the surface as well."""

from __future__ import annotations

from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

#: The box is enlarged by this share on each axis, so that points a little outside stay inside.
MARGIN = 0.15


def in_box(p, box_min, box_inv_extent):
    """Scene position over the box: [0, 1]^3 inside."""
    return mi.Point3f((p - box_min) * box_inv_extent)


def to_unit_cube(p, box_min, box_inv_extent):
    """Scene position to [0, 1]^3; what lies outside is moved to the surface of the cube."""
    return mi.Point3f(dr.clip((p - box_min) * box_inv_extent, 0, 1))


def direction(w, degree: int) -> list:
    """Real spherical harmonics up to `degree` of unit vectors: ``(degree + 1)^2`` values, none for -1."""
    if degree < 0:
        return []
    return dr.sh_eval(mi.Vector3f(w), degree)


def octahedral(w):
    """Point of the unit square of a unit vector, by projection to an octahedron (Cigolle et al. 2014)."""
    scale = dr.rcp(dr.maximum(dr.abs(w.x) + dr.abs(w.y) + dr.abs(w.z), 1e-30))
    x, y = w.x * scale, w.y * scale
    below = w.z < 0
    folded = dr.mulsign(1 - dr.abs(y), x), dr.mulsign(1 - dr.abs(x), y)
    return mi.Point2f(dr.select(below, folded[0], x), dr.select(below, folded[1], y)) * 0.5 + 0.5


def _blob_integral(u):
    """Integral of the kernel ``15/16 (1 - u²)²`` from -1 to u."""
    u = dr.clip(u, -1, 1)
    u2 = dr.square(u)
    return 0.5 + 15 / 16 * u * (1 + u2 * (u2 / 5 - 2 / 3))


def one_blob(v, n_bins: int) -> list:
    """A bump around `v` in [0, 1], as wide as two bins, integrated over each of `n_bins` equal bins (Müller et al.
    2019, with a polynomial in place of the Gaussian)."""
    edges = [_blob_integral(i - n_bins * v) for i in range(n_bins + 1)]
    return [b - a for a, b in pairwise(edges)]


#: What a network of incident radiance can get of a surface beside position and direction, with the number of values.
SURFACE = {"normal": 8, "albedo": 3, "roughness": 4}


def surface_inputs(names: tuple[str, ...], n, material: tuple | None) -> list:
    """Inputs of those `names` in `SURFACE`, in its order, for a unit normal `n` and a `material` (albedo, roughness).

    The normal as one-blob of its octahedral projection (4 bins an axis), the roughness as one-blob of 1 - e^-r (4
    bins), the albedo as it is (authors' configuration of NIRC, METHODS 1). Where nothing is known of the surface: a
    normal along z, a grey Lambertian.
    """
    albedo, roughness = (mi.Color3f(0.5), mi.Float(1)) if material is None else material
    values = []
    if "normal" in names:
        uv = octahedral(mi.Vector3f(0, 0, 1) if n is None else mi.Vector3f(n))
        values += [*one_blob(uv.x, 4), *one_blob(uv.y, 4)]
    if "albedo" in names:
        values += list(dr.clip(albedo, 0, 1))
    if "roughness" in names:
        values += one_blob(1 - dr.exp(-dr.maximum(roughness, 0)), 4)
    return values


def record_box(points: np.ndarray, fallback_min, fallback_max, quantile: float = 0.002):
    """The box in which records fall: where light is asked for, not where geometry is.

    `points` has shape (n, 3). A scene's own box may be many times larger (lights and backdrops far away), and the grid
    would spend its cells there. The outermost `quantile` on each side is left out. With no points: the fallback.
    Returns (min, max) as float lists, enlarged by `MARGIN`, no axis thinner than 1/1000 of the longest.
    """
    points = points[np.isfinite(points).all(axis=-1)]
    if len(points):
        low, high = np.quantile(points, [quantile, 1 - quantile], axis=0)
    else:
        low, high = np.asarray(fallback_min, float), np.asarray(fallback_max, float)
    if not (np.isfinite(low).all() and np.isfinite(high).all() and (high >= low).all()):
        low, high = np.full(3, -1.0), np.full(3, 1.0)
    longest = max(float((high - low).max()), 1e-6 * max(1.0, float(np.abs(low).max())))
    extent = np.maximum((high - low) * (1 + MARGIN), 1e-3 * longest)
    centre = (low + high) / 2
    return (centre - extent / 2).tolist(), (centre + extent / 2).tolist()
