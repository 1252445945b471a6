"""What arrives at one point of a surface from all directions: path-traced, and as a cache predicts it.

The hemisphere is drawn as a disk seen from below, by Lambert's equal-area projection: the normal in the middle,
grazing directions at the rim, and equal areas of the disk are equal solid angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.transport import vertex
from mi_neural.transport.freezing import undisturbed

#: Camera rays traced at once.
AT_ONCE = 2**20


@dataclass(frozen=True)
class SurfacePoint:
    """A point of a surface in world space, and its unit normal on the side that is seen."""

    position: tuple[float, float, float]
    normal: tuple[float, float, float]


def surface_point(scene, x: float, y: float, sensor: int = 0) -> SurfacePoint:
    """What the camera sees in the middle of the pixel at column `x`, row `y` of its film. ValueError: nothing is."""
    camera = scene.sensors()[sensor]
    width, height = camera.film().crop_size()
    at = mi.Point2f((float(x) + 0.5) / int(width), (float(y) + 0.5) / int(height))
    with dr.suspend_grad():
        ray, _ = camera.sample_ray(camera.shutter_open(), 0.5, at, mi.Point2f(0.5))
        si = scene.ray_intersect(ray)
        if not si.is_valid()[0]:
            raise ValueError(f"there is no surface in pixel ({x}, {y})")
        n = dr.mulsign(mi.Vector3f(si.sh_frame.n), si.wi.z)
        position, normal = (tuple(float(v[0]) for v in vector) for vector in (si.p, n))
    return SurfacePoint(position, normal)


class Hemisphere:
    """Directions above a point, one for each of `resolution` x `resolution` pixels of a disk.

    `directions`: unit vectors of shape (resolution, resolution, 3), world space, NaN outside of the disk. What the
    methods give has that shape as well: linear RGB, to be shown by :func:`~mi_neural.explore.figures.pictures`.
    """

    def __init__(self, point: SurfacePoint, resolution: int = 64):
        if resolution < 2:
            raise ValueError(f"resolution is {resolution}; it must be at least 2")
        self.point, self.resolution = point, int(resolution)
        centre = (np.arange(resolution) + 0.5) / resolution * 2 - 1
        u, v = np.meshgrid(centre, -centre)
        r2 = u**2 + v**2
        self.inside = r2 <= 1
        with np.errstate(invalid="ignore"):
            s = np.sqrt(2 - r2)
            local = np.stack([u * s, v * s, 1 - r2], axis=-1)
        # In world space by a frame about the normal, upwards in the disk being as far upwards in the scene as it gets
        n = np.array(point.normal)
        up = np.array([0.0, 1.0, 0.0]) if abs(n[1]) < 0.9 else np.array([0.0, 0.0, -1.0])
        t = np.cross(up, n)
        t /= np.linalg.norm(t)
        world = local @ np.stack([t, np.cross(n, t), n])
        self.directions = np.where(self.inside[..., None], world, np.nan)

    def traced(self, scene, spp: int = 256, seed: int = 0, max_depth: int = -1) -> np.ndarray:
        """Radiance that arrives after at least one reflection, by Mitsuba's ``path`` with `spp` paths a direction.

        That is what :class:`~mi_neural.caches.incident.IncidentCache` learns: emission of what a direction meets is
        left out, since that is direct light at the point.
        """
        path = mi.load_dict({"type": "path", "max_depth": max_depth})
        n = int(self.inside.sum())
        total, done = np.zeros((n, 3)), 0
        with dr.suspend_grad(), undisturbed():
            while done < spp:
                count = min(spp - done, max(1, AT_ONCE // n))
                sampler = mi.load_dict({"type": "independent"})
                sampler.seed(int(np.random.SeedSequence((seed, done)).generate_state(1)[0]), n * count)
                origin, d = self._lanes(count)
                ray = mi.RayDifferential3f(mi.Interaction3f.spawn_ray(origin, d))
                L, _, _ = path.sample(scene, sampler, ray)
                L -= vertex.emission(scene, scene.ray_intersect(ray), mi.Bool(True))
                lane = dr.arange(mi.UInt32, n * count)
                sums = dr.zeros(mi.Color3f, n)
                dr.scatter_reduce(dr.ReduceOp.Add, sums, vertex.finite(L, True), lane % n)
                total += np.array(sums).T
                done += count
        return self._disk(total / spp)

    def predicted(self, integrator, averaged: bool = True) -> np.ndarray:
        """The same as the cache of ``nirc`` or ``nirc_two_level`` says it is; `averaged`: by the averaged weights, or
        by those being trained. Raises ``ValueError`` where there is no cache of incident radiance, or no cache yet."""
        field = getattr(getattr(integrator, "cache", None), "field", None)
        if field is None:
            raise ValueError("there is no cache yet: render an image or call train() first")
        field = getattr(field, "incident", field)
        if not hasattr(field, "encode"):
            raise ValueError("its cache is none of incident radiance: ask nirc or nirc_two_level")
        with dr.suspend_grad(), undisturbed():
            origin, d = self._lanes(1)
            if averaged:
                L = field.query(field.encode(origin.p), d)
            else:
                field.sync()
                L = field.query(field.encode(origin.p, averaged=False), d, averaged=False)
            values = np.array(dr.select(mi.Mask(True), L, 0)).T
        return self._disk(values)

    def mean(self, radiance: np.ndarray) -> np.ndarray:
        """Mean over the solid angle of such a disk: three numbers."""
        return radiance[self.inside].mean(axis=0)

    def _lanes(self, count: int):
        """(the point as an interaction, directions) for `count` rays in each direction, direction by direction."""
        d = mi.Vector3f(np.ascontiguousarray(self.directions[self.inside].T, np.float32))
        n = dr.width(d)
        lane = dr.arange(mi.UInt32, n * count) % n
        d = dr.gather(mi.Vector3f, d, lane)
        at = vertex.reference_point(mi.Point3f(*self.point.position) + dr.zeros(mi.Point3f, n * count),
                                    mi.Normal3f(*self.point.normal))  # fmt: skip
        return at, d

    def _disk(self, values: np.ndarray) -> np.ndarray:
        disk = np.full((self.resolution, self.resolution, 3), np.nan)
        disk[self.inside] = values
        return disk
