"""The environment as many small lights: texels of equal solid angle, to be clustered and chosen as lights are.

Directions are mapped to the unit square without change of area (Clarberg 2008, "Fast equal-area mapping of the
(hemi)sphere using SIMD"), so a texel of an R x R grid covers 4 pi / R² sr, and a uniform point of it has that density.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import parameters
from ..render.spectrum import as_three, at_probes

#: Texels a side, at least and at most. The most are 6 million bytes a hundred texels a side, and 0.4 degrees a texel.
SIZES = (32, 512)
#: Samples of the environment that texels' shares are estimated from, half of them by its own sampling.
LOOKS = 2**20
#: Points of a texel lie within this angle of its centre, over R (measured: 3.54; see the tests).
REACH = 4.0
#: Points on the environment lie so many times the scene's size away: beyond whatever moves outwards in it later.
BEYOND = 1e4
#: A texel whose samples were dark counts as this share of the mean, so that nothing bright is left out.
DARK = 1e-3


def to_square(d):
    """Point of the unit square of a unit direction."""
    x, y, z = dr.abs(d.x), dr.abs(d.y), dr.abs(d.z)
    r = dr.sqrt(dr.maximum(1 - z, 0))
    longer, shorter = dr.maximum(x, y), dr.minimum(x, y)
    phi = dr.atan(shorter / dr.maximum(longer, 1e-30)) * (2 / dr.pi)
    v = r * dr.select(x < y, 1 - phi, phi)
    u = r - v
    below = d.z < 0
    u, v = dr.select(below, 1 - v, u), dr.select(below, 1 - u, v)
    return mi.Point2f(dr.mulsign(u, d.x), dr.mulsign(v, d.y)) * 0.5 + 0.5


def to_direction(p):
    """Unit direction of a point of the unit square."""
    u, v = 2 * p.x - 1, 2 * p.y - 1
    d = 1 - (dr.abs(u) + dr.abs(v))
    r = 1 - dr.abs(d)
    phi = dr.select(r > 0, (dr.abs(v) - dr.abs(u)) / dr.maximum(r, 1e-30) + 1, 1) * (dr.pi / 4)
    sin, cos = dr.sincos(phi)
    flat = r * dr.sqrt(dr.maximum(2 - r * r, 0))
    return mi.Vector3f(dr.mulsign(flat * cos, u), dr.mulsign(flat * sin, v), dr.mulsign(1 - r * r, d))


class Sky:
    """The texels of a scene's environment.

    size       texels a side, R
    emitter    index of the environment among the scene's emitters
    distance   how far away points on it are put
    first      entry of the first texel in the light table
    irradiance   (R²,) of a surface that faces the texel, W/m² or the scene's unit: mean radiance times solid angle
    direction    (R², 3) of the texels' centres
    """

    def __init__(self, scene, emitter: int, seed: int = 0):
        environment = scene.emitters()[emitter]
        self.emitter, self.size, self.first = emitter, _size(environment), 0
        self.solid_angle = 4 * np.pi / self.size**2
        extent = np.array(scene.bbox().extents(), np.float64).ravel()
        size = float(np.linalg.norm(extent)) if np.isfinite(extent).all() and extent.any() else 1.0
        self.distance = BEYOND * size
        n = self.size**2

        # Stratified samples of every texel, and the environment's own samples, which find what is small and bright
        side = max(1, int((LOOKS / n) ** 0.5))
        k = side**2
        lane = dr.arange(mi.UInt32, n * k)
        rng = mi.PCG32(n * k, seed)
        jitter = mi.Point2f(rng.next_float32(), rng.next_float32())
        within = (mi.Point2f(mi.Float(lane % k % side), mi.Float(lane % k // side)) + jitter) / side
        looks = self.radiance(environment, self.at(lane // k, within))
        looks = np.array(mi.luminance(as_three(looks)) + dr.zeros(mi.Float, n * k), np.float64).reshape(n, k)
        it = at_probes(dr.zeros(mi.Interaction3f, n * k))
        it.p = mi.Point3f(*np.nan_to_num(np.array(scene.bbox().center()).ravel()).tolist())
        ds, weight = environment.sample_direction(it, mi.Point2f(rng.next_float32(), rng.next_float32()), True)
        share = np.array(mi.luminance(as_three(weight)) + dr.zeros(mi.Float, n * k), np.float64)
        texel = np.array(self.texel_of(ds.d) + dr.zeros(mi.UInt32, n * k))
        clean = lambda v: np.maximum(np.nan_to_num(v, nan=0, posinf=0, neginf=0), 0)  # noqa: E731
        found = np.bincount(texel, clean(share), n) / (n * k)
        found = (found + clean(looks).mean(axis=1) * self.solid_angle) / 2
        self.irradiance = np.maximum(found, DARK * found.mean())
        self.direction = np.array(to_direction(self.center_of(dr.arange(mi.UInt32, n))), np.float64).T

    def center_of(self, texel):
        return self._square(texel, mi.Point2f(0.5))

    def _square(self, texel, p):
        return (mi.Point2f(mi.Float(texel % self.size), mi.Float(texel // self.size)) + p) * (1 / self.size)

    def at(self, texel, p):
        """Direction of a point `p` in the unit square of a texel."""
        return to_direction(self._square(texel, p))

    def texel_of(self, d):
        """Texel that a unit direction lies in."""
        cell = mi.Point2u(dr.fmin(dr.fmax(to_square(d) * self.size, 0), self.size - 1))  # NaN: the first
        return cell.y * self.size + cell.x

    def sample(self, scene, si, texel, sample, active):
        """A point of a texel as seen from `si`: (direction sample, radiance over its density)."""
        environment = scene.emitters()[self.emitter]
        ds = dr.zeros(mi.DirectionSample3f, dr.width(texel))
        ds.d = self.at(texel, sample)
        ds.dist = mi.Float(self.distance)
        ds.p, ds.n = si.p + ds.d * self.distance, mi.Normal3f(-ds.d)
        ds.pdf, ds.delta = mi.Float(1 / self.solid_angle), mi.Bool(False)
        ds.emitter = mi.EmitterPtr(environment)
        return ds, self.radiance(environment, ds.d, active, si) * self.solid_angle

    @staticmethod
    def radiance(environment, d, active=True, seen_from=None):
        """Radiance that arrives from `d`, in the wavelengths of `seen_from` or at those of the probes."""
        si = at_probes(dr.zeros(mi.SurfaceInteraction3f, dr.width(d)))
        if mi.is_spectral and seen_from is not None:
            si.wavelengths = seen_from.wavelengths
        si.t, si.wi = mi.Float(dr.inf), -d
        return environment.eval(si, active)


def _size(environment) -> int:
    """Texels a side: as fine as the environment's bitmap, within `SIZES`."""
    if environment.class_name() == "ConstantBackgroundEmitter":
        return SIZES[0]
    values = [value for _, value in parameters.traverse(environment)]
    rows = [v.shape[0] for v in values if dr.is_tensor_v(v) and v.ndim == 3]
    rows = max(rows, default=SIZES[1] // 2)
    return int(np.clip(2 ** int(np.ceil(np.log2(max(rows, 1)))), *SIZES))
