"""What one frame of ``restir_di`` leaves to the next, and which pixel of the frame before saw a point."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.estimators.reservoir import Reservoir
from mi_neural.render import vertex


@dataclass
class Past:
    """What one frame leaves to the next, one entry a pixel.

    kept     what was kept of the light samples
    surface  what the pixel's camera ray met, as far as a BSDF asks for it
    usable   whether that has a smooth lobe
    """

    kept: Reservoir
    surface: mi.SurfaceInteraction3f
    usable: mi.Bool


def nothing(n: int) -> Past:
    """A past in which nothing was seen."""
    past = Past(Reservoir.empty(n), dr.zeros(mi.SurfaceInteraction3f, n), dr.zeros(mi.Bool, n))
    kept = past.kept
    slim = past.surface
    dr.make_opaque(kept, past.usable, slim.t, slim.p, slim.n, slim.uv, slim.sh_frame, slim.dp_du, slim.dp_dv, slim.wi,
                   slim.shape, slim.prim_index)  # fmt: skip
    return past


def slim_surface(si):
    """A copy of what BSDFs and light samples ask of a surface; the rest is 0 and takes no memory."""
    slim = dr.zeros(mi.SurfaceInteraction3f, dr.width(si))
    for name in ("t", "p", "n", "uv", "sh_frame", "dp_du", "dp_dv", "wi", "shape", "prim_index"):
        setattr(slim, name, getattr(si, name))
    return slim


def camera_of(sensor) -> tuple:
    """((matrix, eye), pinhole): the matrix takes ``p - eye`` to the film, (x, y, 1) z with x and y in [0, 1].

    Found from rays through the film's corners, so that it holds for any pinhole camera, shifted ones too; `pinhole` is
    false where the rays do not meet or a further one disagrees, and the matrix then means nothing.
    """
    x, y = np.array([0, 1, 0, 1, 0.3], np.float32), np.array([0, 0, 1, 1, 0.6], np.float32)
    ray, _ = sensor.sample_ray_differential(sensor.shutter_open(), 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    d = np.array(ray.d + dr.zeros(mi.Vector3f, 5), np.float64)
    o = np.array(ray.o + dr.zeros(mi.Point3f, 5), np.float64)
    to_film, eye, pinhole = np.eye(3), o.mean(axis=1), False
    # The point nearest to all rays: they start on the near plane
    across = np.eye(3)[None] - np.einsum("ir,jr->rij", d, d)
    if np.linalg.matrix_rank(across.sum(axis=0), tol=1e-6) == 3 and np.linalg.matrix_rank(d[:, 1:4], tol=1e-6) == 3:
        eye = np.linalg.solve(across.sum(axis=0), np.einsum("rij,jr->i", across, o))
        # Corners of a parallelogram: d0 + l3 d3 = l1 d1 + l2 d2
        l1, l2, l3 = np.linalg.solve(np.stack([d[:, 1], d[:, 2], -d[:, 3]], axis=1), d[:, 0])
        basis = np.stack([l1 * d[:, 1] - d[:, 0], l2 * d[:, 2] - d[:, 0], d[:, 0]], axis=1)
        if min(l1, l2, l3) > 0 and np.linalg.matrix_rank(basis, tol=1e-6) == 3:
            to_film = np.linalg.inv(basis)
            a, b, c = to_film @ d[:, 4]
            miss = np.abs(np.einsum("rij,jr->ir", across, o - eye[:, None])).max()
            pinhole = bool(c > 0 and abs(a / c - 0.3) < 1e-3 and abs(b / c - 0.6) < 1e-3
                           and miss <= 1e-4 * (1 + np.abs(o).max()))  # fmt: skip
    # Matrices of Dr.Jit are written row by row
    matrix = mi.Matrix3f(to_film.tolist())
    eye = mi.Point3f(*eye.tolist())
    dr.make_opaque(matrix, eye)
    return (matrix, eye), pinhole


def reproject(integrator, si, past, past_camera, size, border, pixel, pinhole, active):
    """Pixel of the frame before that saw the point `si`, or one beside it that saw the same surface, as at edges:
    (its number, whether there is one)."""
    to_film, origin = past_camera
    width, height = (n + 2 * border for n in size)
    x, y, inside = mi.Int32(pixel % width), mi.Int32(pixel // width), mi.Bool(active)
    distance = dr.norm(si.p - origin)
    if pinhole:
        film = to_film @ mi.Vector3f(si.p - origin)
        inv_z = dr.rcp(dr.select(film.z > 0, film.z, 1))
        u, v = film.x * inv_z * size[0] + border, film.y * inv_z * size[1] + border
        inside &= (film.z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        x, y = mi.Int32(dr.select(inside, u, 0)), mi.Int32(dr.select(inside, v, 0))

    def look(x, y, inside):
        inside = inside & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        lane = mi.UInt32(dr.select(inside, x + y * width, 0))
        there = dr.gather(mi.SurfaceInteraction3f, past.surface, lane, inside)
        seen = inside & dr.gather(mi.Bool, past.usable, lane, inside)
        return lane, seen & alike(integrator, si, distance, there, dr.norm(there.p - origin))

    def beside(k, _, found):
        lane, found = look(x + dr.select(k < 2, 2 * k - 1, 0), y + dr.select(k < 2, 0, 2 * k - 5), inside)
        return k + 1, lane, found

    before, found = look(x, y, inside)
    _, before, found = dr.while_loop(
        (mi.Int32(0), before, found), lambda k, _, found: inside & ~found & (k < 4), beside, label="pixels beside"
    )
    return before, found


def alike(integrator, a, distance_a, b, distance_b):
    """Whether two surfaces may share light samples: their normals and distances from the camera are close."""
    facing = dr.dot(vertex.facing(a), vertex.facing(b)) >= integrator.normal_threshold
    return facing & (dr.abs(distance_a - distance_b) <= integrator.depth_threshold * distance_a)
