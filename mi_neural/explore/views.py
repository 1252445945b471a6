"""What caches say, shown: the hemisphere above a point, where which weights are believed, which light is seen where.

Each view is an object that takes samples (`add`) and gives arrays. Prediction and truth are asked with the same
geometry, so that they can stand side by side.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.caches.blend import Blend
from mi_neural.caches.outgoing_field import OutgoingField
from mi_neural.render import vertex
from mi_neural.render.film import sensor_of
from mi_neural.render.sampling import PathSampler
from mi_neural.render.surface import scene_is_glossy, surface_of


class Unavailable(ValueError):
    """This integrator, or this scene, has nothing of the kind to show; the message says what would have."""


class Hemisphere:
    """Radiance that arrives at a surface point from each direction above it, emission left out.

    The picture is a disk seen along the normal, of equal areas for equal solid angles (Lambert's azimuthal projection):
    pixel offsets (u, v) in [-1, 1] stand for the direction (u s, v s, 1 - u² - v²), s = sqrt(2 - u² - v²), in the frame
    of the normal. Outside of the disk all is 0.

    scene, integrator   whose cache is asked; without one there is no prediction
    pixel               (x, y) of the picture of `sensor`, whose first surface is meant
    size                width and height of the disk in pixels
    max_depth           of the path tracer that gives the truth; -1: no limit
    """

    def __init__(self, scene, integrator, pixel: tuple[float, float], sensor: int = 0, size: int = 64,
                 max_depth: int = -1) -> None:  # fmt: skip
        self.scene, self.integrator, self.size = scene, integrator, size
        self.path = mi.load_dict({"type": "path", "max_depth": max_depth})
        self.pixel = pixel
        camera = sensor_of(scene, sensor, "the view")
        width, height = (int(n) for n in camera.film().crop_size())
        if not (0 <= pixel[0] < width and 0 <= pixel[1] < height):
            raise ValueError(f"pixel {pixel} lies outside of the picture of {width}x{height}")
        si = _seen(scene, camera, dr.opaque(mi.Float, pixel[0] + 0.5), dr.opaque(mi.Float, pixel[1] + 0.5))
        if not bool(si.is_valid()[0]):
            raise Unavailable(f"nothing is seen in pixel {pixel}; choose one that shows a surface")
        normal = mi.Normal3f(vertex.facing(si))
        self.position, self.normal = (_numbers(v) for v in (si.p, normal))
        self.restart()

    def restart(self) -> None:
        """Forget what was traced: the light has changed."""
        self._total, self.spp = None, 0

    def add(self, spp: int = 1) -> None:
        """Trace `spp` more paths through each pixel of the disk."""
        with dr.suspend_grad():
            radiance = mi.Color3f(0)
            for k in range(spp):
                sampler = mi.load_dict({"type": "independent"})
                sampler.seed(self.spp + k, self.size**2)
                ray, active = self._rays(sampler.next_2d())
                L, _, _ = self.path.sample(self.scene, sampler, mi.RayDifferential3f(ray), None, active)
                si = self.scene.ray_intersect(ray, active)
                radiance = radiance + vertex.finite(L - vertex.emission(self.scene, si, active), active)
                dr.eval(radiance)
            image = self._image(radiance)
        self._total = image if self._total is None else self._total + image
        self.spp += spp

    @property
    def traced(self) -> np.ndarray:
        """Path-traced radiance, the mean of all paths so far, float32 of shape (size, size, 3)."""
        return self._total / self.spp if self.spp else np.zeros((self.size, self.size, 3), np.float32)

    def predicted(self) -> np.ndarray:
        """What the cache says now, float32 of shape (size, size, 3); :class:`Unavailable` without a cache."""
        field = _cache(self.integrator)
        plain = getattr(field, "field", field)
        with dr.suspend_grad():
            ray, active = self._rays(dr.zeros(mi.Point2f, self.size**2) + 0.5)
            if isinstance(plain, OutgoingField):  # what the surfaces around send here
                si = self.scene.ray_intersect(ray, active)
                active &= si.is_valid()
                surface = surface_of(si, si.bsdf(), active, scene_is_glossy(self.scene))
                radiance = field.query(*surface.inputs())
            else:
                p, n = mi.Point3f(*self._opaque(self.position)), mi.Normal3f(*self._opaque(self.normal))
                radiance = field.query(field.encode(p, n), ray.d)
            return self._image(vertex.finite(radiance, active))

    def _rays(self, offset):
        """A ray through each pixel of the disk, and where there is one."""
        lane = dr.arange(mi.UInt32, self.size**2)
        u = 2 * (mi.Float(lane % self.size) + offset.x) / self.size - 1
        v = 1 - 2 * (mi.Float(lane // self.size) + offset.y) / self.size
        r2 = u * u + v * v
        s = dr.safe_sqrt(2 - r2)
        n = mi.Normal3f(*self._opaque(self.normal))
        w = mi.Frame3f(n).to_world(mi.Vector3f(u * s, v * s, 1 - r2))
        p = mi.Point3f(*self._opaque(self.position))
        p += n * (1 + dr.max(dr.abs(p))) * mi.math.RayEpsilon
        return mi.Ray3f(p, w), r2 < 1

    @staticmethod
    def _opaque(values):
        return [dr.opaque(mi.Float, float(v)) for v in values]

    def _image(self, radiance) -> np.ndarray:
        return np.array(radiance).T.reshape(self.size, self.size, 3)


class ReliabilityMap:
    """Weight σ in [0, 1] of the weights being trained, against their average, at the first surface of each pixel.

    For integrators with ``blend`` of ``reliability`` or ``switch``; it is 1 everywhere with ``fast``.
    """

    def __init__(self, scene, integrator, sensor: int = 0) -> None:
        self.scene, self.integrator, self.sensor = scene, integrator, sensor

    def predicted(self) -> np.ndarray:
        """σ now, float32 of shape (height, width), 0 where no surface is seen."""
        blend = _cache(self.integrator)
        if not isinstance(blend, Blend):
            raise Unavailable("this integrator asks the averaged weights everywhere; give it blend='reliability'")
        with dr.suspend_grad():
            si, shape = _first_surfaces(self.scene, self.sensor)
            sigma = blend.sigma(si.p, vertex.facing(si))
            return np.array(dr.select(si.is_valid(), sigma, 0)).reshape(shape)


class VisibilityMap:
    """Share of a light that the first surface of each pixel sees.

    light   number of the light in the table of the integrator's light sampler; of clustered lights, its cluster counts
    """

    def __init__(self, scene, integrator, light: int = 0, sensor: int = 0) -> None:
        self.scene, self.integrator, self.light, self.sensor = scene, integrator, light, sensor
        self.restart()

    def restart(self) -> None:
        """Forget what was traced: the light or the camera has changed."""
        self._total, self.spp = None, 0

    @property
    def group(self) -> int:
        """The output of the network that stands for the light."""
        lights = _lights(self.integrator)
        if not 0 <= self.light < lights.table.n_lights:
            raise ValueError(f"light is {self.light}; the scene has lights 0..{lights.table.n_lights - 1}")
        return int(np.array(lights.groups.group_of)[self.light])

    def add(self, spp: int = 1) -> None:
        """Send `spp` more shadow rays from each pixel's surface to a random point of the light, or of its cluster."""
        lights, group = _lights(self.integrator), dr.opaque(mi.UInt32, self.group)
        with dr.suspend_grad():
            si, shape = _first_surfaces(self.scene, self.sensor)
            p = si.spawn_ray(vertex.facing(si)).o
            lane, visible = dr.arange(mi.UInt32, dr.width(p)), mi.Float(0)
            for k in range(spp):
                sampler = PathSampler.make(lane, dr.opaque(mi.UInt32, self.spp + k))
                light = lights.groups.sample_light(group, sampler.next_1d(), mi.Bool(True))[0]
                ray, some = lights.table.shadow_ray(self.scene, p, light, sampler.next_2d(), si.is_valid())
                some &= si.is_valid()
                visible += dr.select(some & ~self.scene.ray_test(ray, some), 1, 0)
            image = np.array(visible).reshape(shape)
        self._total = image if self._total is None else self._total + image
        self.spp += spp

    @property
    def traced(self) -> np.ndarray:
        """Share of the shadow rays that met nothing, float32 of shape (height, width); 0 where no surface is seen."""
        if not self.spp:
            raise ValueError("nothing was traced yet; call add() first")
        return self._total / self.spp

    def predicted(self) -> np.ndarray:
        """The network's answer now, float32 of shape (height, width); 0 where nothing is seen."""
        lights, group = _lights(self.integrator), self.group
        with dr.suspend_grad():
            si, shape = _first_surfaces(self.scene, self.sensor)
            visible = lights.field.query(si.p)[group]
            return np.array(dr.select(si.is_valid(), visible, 0)).reshape(shape)


def _cache(integrator):
    """What answers queries of radiance; :class:`Unavailable` where there is nothing, or not yet."""
    field = getattr(getattr(integrator, "cache", None), "queried", None)
    if field is None:
        raise Unavailable("no cache of radiance here; use nirc or nrc, and train it or render an image first")
    return field


def _lights(integrator):
    """What chooses lights by learned visibility; :class:`Unavailable` where nothing does."""
    for owner in (getattr(integrator, "state", None), integrator):
        lights = getattr(owner, "lights", None)
        if getattr(lights, "field", None) is not None:
            return lights
    raise Unavailable("no visibility is learned here; nest an nvc_lights as light_sampler, in a scene with several "
                      "lights, and render an image first")  # fmt: skip


def _first_surfaces(scene, sensor: int):
    """What each pixel's centre shows, and the shape (height, width)."""
    camera = sensor_of(scene, sensor, "the view")
    width, height = (int(n) for n in camera.film().crop_size())
    lane = dr.arange(mi.UInt32, width * height)
    return _seen(scene, camera, mi.Float(lane % width) + 0.5, mi.Float(lane // width) + 0.5), (height, width)


def _seen(scene, camera, x, y):
    """The first surface at film positions in pixels."""
    width, height = (int(n) for n in camera.film().crop_size())
    ray, _ = camera.sample_ray(camera.shutter_open(), 0.5, mi.Point2f(x / width, y / height), mi.Point2f(0.5))
    return scene.ray_intersect(ray)


def _numbers(v) -> list[float]:
    return [float(x) for x in np.array(v, np.float64).ravel()]
