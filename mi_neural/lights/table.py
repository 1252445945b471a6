"""One flat table of all that emits in a scene, and how its entries are sampled.

An entry is a *light*: a triangle or parallelogram of an emissive mesh, or a whole emitter of any other kind (sphere,
disk, point, spot, directional, environment, ...).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render.kernels import on_gpu
from ..render.spectrum import is_rgb
from .entries import (
    CYLINDER,
    CYLINDER_INSIDE,
    CYLINDERS,
    DISK,
    ENVIRONMENT,
    FEW,
    OTHER,
    PARALLELOGRAM,
    PLANE,
    POINT,
    SPHERE,
    TRIANGLE,
    UNSAMPLED,
    cylinder_point,
    interaction,
    is_emissive_mesh,
    make_columns,
    seen_from,
    with_texels,
)

#: More entries than this are refused: 100 bytes each, besides what building them takes.
MAX_LIGHTS = 2**24
#: Shadow rays end this share of their length before the light, so that the light itself is not in the way.
SHADOW_EPSILON = 1e-3


class LightTable:
    """What emits, as arrays of `n_lights` entries (structure of arrays; a PyTree).

    emitter   index into the scene's emitters
    form      how the entry is sampled: TRIANGLE, PARALLELOGRAM, DISK, CYLINDER (CYLINDER_INSIDE: light leaves inwards):
              uniformly by area; SPHERE: uniformly by solid angle; POINT; OTHER: as its emitter does, except texels of
              the environment; UNSAMPLED: shapes that Mitsuba cannot sample, whose light BSDF samples alone find
    corner, edge1, edge2, normal   of planes: points ``corner + u edge1 + v edge2``, with u + v <= 1 in a triangle and
              u² + v² <= 1 in a disk; unit normal, on the emitting side. Of cylinders ``corner + cos φ edge1 + sin φ
              edge2 + z normal``
    prim      primitive of the emitter's shape
    area      of what is sampled by area, and of spheres; 0 elsewhere
    radiance  mean emitted radiance of all these, intensity of points
    plain     radiance and normal are constant over the entry, so that `radiance` can be used as it is; only in RGB
              variants
    kind      LOCAL, DIRECTION or ENVIRONMENT (as a whole; its texels are of kind DIRECTION)
    center, radius   bounding sphere of a LOCAL entry; DIRECTION: `center` is the direction towards the light
    axis, cone       mean normal, and cosine of the largest angle of a normal to it; -1: light leaves in all directions.
                     DIRECTION: `cone` is the cosine of the largest angle of its directions to `center`
    intensity        LOCAL: radiance times area, or radiant intensity; else irradiance of a surface that faces the light

    `n_lights`, `forms`, `kinds` etc. are Python values; a frozen function is recorded anew where `facts`, all of them,
    differ. `first`, `stride` lead from an emitter's registry number and a primitive to an entry.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "emitter": object, "form": object, "corner": object, "edge1": object, "edge2": object, "normal": object,
        "prim": object, "area": object, "radiance": object, "plain": object, "kind": object, "center": object,
        "radius": object, "axis": object, "cone": object, "intensity": object, "first": object, "stride": object,
        "facts": object,
    }  # fmt: skip

    def __init__(self, scene, seed: int = 0, texels: bool = False):
        emitters = scene.emitters()
        rng = np.random.default_rng(seed)
        counts = np.array([e.get_shape().primitive_count() if is_emissive_mesh(e) else 1 for e in emitters], np.int64)
        if counts.sum() > MAX_LIGHTS:
            raise ValueError(
                f"the scene has {counts.sum()} emissive triangles, more than the light table holds ({MAX_LIGHTS}); "
                "leave the light_sampler out, or make the emissive meshes simpler"
            )
        columns = make_columns(scene, emitters, counts, rng)
        self.sky, self.n_emitters = None, len(emitters)
        if texels and (columns["kind"] == ENVIRONMENT).any():
            columns, self.sky = with_texels(columns, scene, seed)
        self.assign(columns)

        ids = np.array(dr.reinterpret_array(mi.UInt32, scene.emitters_dr())).ravel()
        first, stride = np.zeros(ids.max(initial=0) + 1, np.uint32), np.zeros(ids.max(initial=0) + 1, np.uint32)
        first[ids[columns["emitter"][::-1]]] = np.arange(self.n_lights, dtype=np.uint32)[::-1]
        stride[ids] = (np.bincount(columns["emitter"], minlength=len(emitters)) > 1).astype(np.uint32)
        self.first, self.stride = own(mi.UInt32(first)), own(mi.UInt32(stride))
        extent = np.array(scene.bbox().extents(), np.float64).ravel()
        self.cross_section = float(np.pi / 4 * (extent**2).sum()) if np.isfinite(extent).all() else 1.0
        dr.eval(self)

    def assign(self, columns: dict[str, np.ndarray]) -> None:
        """Take over `columns`, NumPy arrays by name; what all entries have in common becomes a Python value."""
        self.columns = columns
        self.n_lights = len(columns["emitter"])
        for name, values in columns.items():
            if values.ndim == 2:
                kind = mi.Color3f if name == "radiance" else mi.Vector3f
                values = kind(np.ascontiguousarray(values.T, np.float32))
            else:
                kinds = {"u": mi.UInt32, "b": mi.Bool, "f": mi.Float}
                values = kinds[values.dtype.kind](values)
            setattr(self, name, own(values))
        n_texels = self.sky.size**2 if self.sky is not None else 0
        form = columns["form"][: self.n_lights - n_texels]
        self.forms = frozenset(form.tolist())
        others = np.unique(columns["emitter"][: len(form)][form == OTHER])
        #: Indices of the emitters that sample themselves; None where these are called through pointers: if they are too
        #: many to be called one by one, and if one is an environment on a GPU, where such a call in a recorded function
        #: ends the process (Dr.Jit 1.5.0, "jit_var(r0): unknown variable")
        ended = on_gpu() and bool((columns["kind"] == ENVIRONMENT).any())
        self.others = tuple(others.tolist()) if len(others) <= FEW < self.n_emitters and not ended else None
        self.any_flat, self.all_flat = self._has(TRIANGLE, PARALLELOGRAM), self.forms <= {TRIANGLE, PARALLELOGRAM}
        sampled = np.isin(columns["form"], (*PLANE, *CYLINDERS, SPHERE))
        self.all_plain = bool((columns["plain"] | ~sampled).all())
        self.kinds = sorted(set(columns["kind"].tolist()))
        self.facts = (self.n_lights, n_texels, *sorted(self.forms), self.others, self.all_plain, *self.kinds)

    def n_dark(self) -> int:
        """Number of lamps without extent that emit nothing, so that no BSDF sample finds them, and a light sampler that
        weighs by intensity none either."""
        c = self.columns
        return int(((c["intensity"] == 0) & ((c["form"] == POINT) | (c["form"] == OTHER)) & (c["radius"] == 0)).sum())

    def _has(self, *forms: int) -> bool:
        return not self.forms.isdisjoint(forms)

    def _form(self, index, active):
        if len(self.forms) == 1:
            return mi.UInt32(min(self.forms))
        return dr.gather(mi.UInt32, self.form, index, active)

    # -------------------------------------------------------------------------------------------------------------

    def index_of(self, scene, si, active=True):
        """Entry that a ray hit at `si`, the environment included, and whether what was hit emits (else any entry)."""
        emitter = si.emitter(scene, active)
        number = dr.reinterpret_array(mi.UInt32, emitter)
        emits = active & (number > 0)
        first = dr.gather(mi.UInt32, self.first, number, emits)
        stride = dr.gather(mi.UInt32, self.stride, number, emits)
        beyond = self.sky.texel_of(-si.wi) if self.sky is not None else mi.UInt32(0)
        return first + stride * dr.select(si.is_valid(), si.prim_index, beyond), emits

    def emitted(self, scene, si, index, active):
        """Radiance towards ``-si.wi`` of light `index`, which a ray hit at `si`."""
        if self.sky is not None or self._has(OTHER, UNSAMPLED) or not self.all_plain:
            return dr.select(active, si.emitter(scene, active).eval(si, active), 0)
        front = active & (mi.Frame3f.cos_theta(si.wi) > 0)
        return dr.gather(mi.Color3f, self.radiance, index, front)

    def sample(self, scene, si, index, sample, active, attached: bool = False):
        """A point on (direction to) light `index`, seen from `si`.

        Returns (direction sample, radiance over its density, density over solid angle). The density is 0 where the
        light does not reach `si`; of delta lights it is 1, and `ds.delta` is set. No shadow ray is traced. With
        `attached` the radiance is what the emitters say, not the table: it has derivatives with respect to them.
        """
        form = self._form(index, active)
        ds, weight, pdf = dr.zeros(mi.DirectionSample3f, dr.width(index)), mi.Spectrum(0), mi.Float(0)
        cases = []
        if self._has(*PLANE, *CYLINDERS):
            mine = active & _by_area(form)
            cases.append((mine, *self._sample_area(scene, si, index, form, sample, mine, attached)))
        if self._has(SPHERE):
            mine = active & (form == SPHERE)
            cases.append((mine, *self._sample_sphere(scene, si, index, sample, mine, attached)))
        if self._has(POINT):
            mine = active & (form == POINT)
            cases.append((mine, *self._sample_point(scene, si, index, mine, attached)))
        if self._has(OTHER):
            mine = active & (form == OTHER) & ~self._is_texel(index)
            ds_other, w_other = self._by_emitters(scene, index, mine, lambda e, m: e.sample_direction(si, sample, m))
            if attached:
                w_other = self._by_emitters(scene, index, mine, lambda e, m: e.eval_direction(si, ds_other, m))
                w_other = dr.select(ds_other.pdf > 0, w_other / dr.detach(ds_other.pdf), 0)
            cases.append((mine, ds_other, w_other, ds_other.pdf))
        if self.sky is not None:
            mine = active & self._is_texel(index)
            ds_sky, w_sky = self.sky.sample(scene, si, index - self.sky.first, sample, mine)
            cases.append((mine, ds_sky, w_sky, ds_sky.pdf))
        for k, (mine, ds_one, w_one, pdf_one) in enumerate(cases):
            ds = dr.select(mine, ds_one, ds) if k else ds_one
            weight, pdf = dr.select(mine, w_one, weight), dr.select(mine, pdf_one, pdf)
        return ds, dr.select(active & (pdf > 0), weight, 0), dr.select(active, pdf, 0)

    def _is_texel(self, index):
        return index >= self.sky.first if self.sky is not None else mi.Bool(False)

    def _by_emitters(self, scene, index, active, call):
        """``call(emitter, active)`` for the emitter of each entry."""
        which = dr.gather(mi.UInt32, self.emitter, index, active)
        if self.others is None:
            return call(dr.gather(mi.EmitterPtr, scene.emitters_dr(), which, active), active)
        emitters, result = scene.emitters(), None
        for k in self.others:
            mine = active & (which == k)
            one = call(emitters[k], mine)
            result = one if result is None else dr.select(mine, one, result)
        return result

    def _on_area(self, index, form, sample, active):
        """A uniform point of what is sampled by area: (p, unit normal on the emitting side, area per unit of the
        sample, coordinates)."""
        take = lambda column: dr.gather(mi.Vector3f, column, index, active)  # noqa: E731
        corner, edge1, edge2, normal = (take(c) for c in (self.corner, self.edge1, self.edge2, self.normal))
        area = dr.gather(mi.Float, self.area, index, active)
        uv = mi.Point2f(sample)
        if self._has(TRIANGLE):
            fold = (form == TRIANGLE) & (uv.x + uv.y > 1)
            uv = dr.select(fold, 1 - uv, uv)
        if self._has(DISK):
            uv = dr.select(form == DISK, mi.warp.square_to_uniform_disk_concentric(sample), uv)
        p = mi.Point3f(corner + uv.x * edge1 + uv.y * edge2)
        if self._has(*CYLINDERS):
            round_ = (form == CYLINDER) | (form == CYLINDER_INSIDE)
            uv = dr.select(round_, mi.Point2f(sample.y, sample.x), uv)
            p_round, across = cylinder_point(corner, edge1, edge2, normal, uv)
            length = dr.norm(across)
            side = self._side(form, edge1, edge2, normal) / dr.maximum(length, 1e-30)
            p = dr.select(round_, p_round, p)
            normal, area = dr.select(round_, side * across, normal), dr.select(round_, dr.two_pi * length, area)
        return p, normal, area, uv

    @staticmethod
    def _side(form, edge1, edge2, along):
        """1 where light leaves a cylinder along ``dp/dφ x dp/dz``, -1 where against it."""
        right_handed = dr.dot(dr.cross(edge1, edge2), along) > 0
        return dr.select(right_handed == (form == CYLINDER), mi.Float(1), -1)

    def _emitter(self, scene, index, active):
        return dr.gather(mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.emitter, index, active), active)

    def _sample_area(self, scene, si, index, form, sample, active, attached):
        p, normal, area, uv = self._on_area(index, form, sample, active)
        to_light = p - si.p
        d2 = dr.squared_norm(to_light)
        d = to_light * dr.rsqrt(dr.maximum(d2, 1e-30))
        cos = -dr.dot(d, normal)
        pdf = dr.select(active & (cos > 0) & (area > 0), d2 / (cos * area), 0)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
        ds.p, ds.n, ds.uv, ds.d, ds.dist = p, mi.Normal3f(normal), mi.Point2f(uv), d, dr.sqrt(d2)
        ds.pdf, ds.delta = pdf, mi.Bool(False)
        radiance = dr.gather(mi.Color3f, self.radiance, index, active) if is_rgb() else mi.Spectrum(0)
        if attached or not self.all_plain:
            varied = active if attached else active & ~dr.gather(mi.Bool, self.plain, index, active)
            emitter = self._emitter(scene, index, varied)
            at = _surface(p, normal, uv, d, ds.dist)
            if self._has(TRIANGLE, PARALLELOGRAM):
                flat = varied & ((form == TRIANGLE) | (form == PARALLELOGRAM))
                on_mesh = interaction(emitter.get_shape(), dr.gather(mi.UInt32, self.prim, index, flat), uv,
                                      mi.Ray3f(si.p, d), flat)  # fmt: skip
                at = dr.select(flat, on_mesh, at)
            if mi.is_spectral:
                at.wavelengths = si.wavelengths
            radiance = dr.select(varied, emitter.eval(at, varied), radiance)
        return ds, dr.select(pdf > 0, radiance / pdf, 0), pdf

    def _sample_sphere(self, scene, si, index, sample, active, attached=False):
        """Uniformly within the cone that a sphere fills, seen from outside (Shirley et al. 1996)."""
        center = dr.gather(mi.Vector3f, self.center, index, active)
        radius = dr.gather(mi.Float, self.radius, index, active)
        to_center = center - si.p
        distance, sin2_max, one_minus_cos, outside = _cone(to_center, radius)
        outside &= active
        # Cosine of the angle at p, then of that at the centre between the point and p
        x = one_minus_cos * sample.x
        sin2 = x * (2 - x)
        sin_max = dr.sqrt(sin2_max)
        ratio = dr.minimum(sin2 / dr.maximum(sin2_max, 1e-30), 1)
        cos_center = dr.minimum(sin2 / dr.maximum(sin_max, 1e-30) + (1 - x) * dr.sqrt(1 - ratio), 1)
        sin_center = dr.safe_sqrt(1 - dr.square(cos_center))
        sin_phi, cos_phi = dr.sincos(dr.two_pi * sample.y)
        n = mi.Frame3f(-to_center / dr.maximum(distance, 1e-30)).to_world(
            mi.Vector3f(cos_phi * sin_center, sin_phi * sin_center, cos_center)
        )
        p = mi.Point3f(center + radius * n)
        to_light = p - si.p
        d2 = dr.squared_norm(to_light)
        pdf = dr.select(outside, dr.inv_two_pi / dr.maximum(one_minus_cos, 1e-30), 0)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
        ds.p, ds.n, ds.d, ds.dist = p, mi.Normal3f(n), to_light * dr.rsqrt(dr.maximum(d2, 1e-30)), dr.sqrt(d2)
        ds.pdf, ds.delta = pdf, mi.Bool(False)
        if attached:
            radiance = self._emitter(scene, index, active).eval(_surface(p, n, ds.uv, ds.d, ds.dist), active)
        else:
            radiance = dr.gather(mi.Color3f, self.radiance, index, active)
        return ds, dr.select(outside, radiance / pdf, 0), pdf

    def _sample_point(self, scene, si, index, active, attached):
        p = mi.Point3f(dr.gather(mi.Vector3f, self.center, index, active))
        to_light = p - si.p
        d2 = dr.squared_norm(to_light)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
        ds.p, ds.d, ds.dist = p, to_light * dr.rsqrt(dr.maximum(d2, 1e-30)), dr.sqrt(d2)
        ds.pdf, ds.delta = dr.select(active & (d2 > 0), mi.Float(1), 0), mi.Bool(True)
        if attached:
            irradiance = self._emitter(scene, index, active).eval_direction(si, ds, active)
        else:
            irradiance = dr.gather(mi.Color3f, self.radiance, index, active) / dr.maximum(d2, 1e-30)
        return ds, irradiance, ds.pdf

    def pdf(self, scene, si_ref, index, si_light, ds, active):
        """Density over solid angle with which `sample` would have found the point `si_light` on light `index`."""
        form = self._form(index, active)
        pdf = mi.Float(0)
        if self._has(*PLANE, *CYLINDERS):
            mine = active & _by_area(form)
            area = dr.gather(mi.Float, self.area, index, mine)
            cos = -dr.dot(ds.d, dr.gather(mi.Vector3f, self.normal, index, mine))
            if self._has(*CYLINDERS):
                round_ = mine & ((form == CYLINDER) | (form == CYLINDER_INSIDE))
                edge1, edge2, along = (dr.gather(mi.Vector3f, c, index, round_) for c in (self.edge1, self.edge2,
                                                                                         self.normal))  # fmt: skip
                across = cylinder_point(0, edge1, edge2, along, si_light.uv)[1]
                length = dr.norm(across)
                facing = self._side(form, edge1, edge2, along) * dr.dot(ds.d, across) / dr.maximum(length, 1e-30)
                cos, area = dr.select(round_, -facing, cos), dr.select(round_, dr.two_pi * length, area)
            pdf = dr.select(mine & (cos > 0) & (area > 0), dr.square(ds.dist) / (cos * area), pdf)
        if self._has(SPHERE):
            mine = active & (form == SPHERE)
            to_center = dr.gather(mi.Vector3f, self.center, index, mine) - si_ref.p
            _, _, one_minus_cos, outside = _cone(to_center, dr.gather(mi.Float, self.radius, index, mine))
            pdf = dr.select(mine & outside, dr.inv_two_pi / dr.maximum(one_minus_cos, 1e-30), pdf)
        if self._has(OTHER):
            mine = active & (form == OTHER) & ~self._is_texel(index)
            theirs = self._by_emitters(scene, index, mine, lambda e, m: e.pdf_direction(si_ref, ds, m))
            pdf = dr.select(mine, theirs, pdf)
        if self.sky is not None:
            pdf = dr.select(self._is_texel(index), 1 / self.sky.solid_angle, pdf)
        return dr.select(active, pdf, 0)

    def shadow_ray(self, scene, p, index, sample, active):
        """A ray from the points `p` to a random point of light `index`, for a visibility test: as it is sampled, also
        on its back. Not normalised by what the point may receive."""
        form = self._form(index, active)
        it = seen_from(p)
        target = mi.Point3f(dr.gather(mi.Vector3f, self.center, index, active))
        if self._has(*PLANE, *CYLINDERS):
            mine = active & _by_area(form)
            target = dr.select(mine, self._on_area(index, form, sample, mine)[0], target)
        if self._has(SPHERE):
            mine = active & (form == SPHERE)
            ds, _, pdf = self._sample_sphere(scene, it, index, sample, mine)
            target = dr.select(mine & (pdf > 0), ds.p, target)
        if self._has(OTHER):
            mine = active & (form == OTHER) & ~self._is_texel(index)
            ds, _ = self._by_emitters(scene, index, mine, lambda e, m: e.sample_direction(it, sample, m))
            target = dr.select(mine, ds.p, target)
        if self.sky is not None:
            away = p + self.sky.at(index - self.sky.first, sample) * self.sky.distance
            target = dr.select(self._is_texel(index), away, target)
        to = target - p
        distance = dr.norm(to)
        ray = mi.Ray3f(p, to / dr.maximum(distance, 1e-30))
        ray.maxt = distance * (1 - SHADOW_EPSILON)
        return ray, distance > 0


def _by_area(form):
    return (form >= TRIANGLE) & (form <= CYLINDER_INSIDE)


def _cone(to_center, radius):
    """Of the cone that a sphere fills: (distance of the centre, squared sine and one minus cosine of the cone's angle,
    whether it is seen from outside). Computed without the difference of nearly equal numbers, which the cosine of a
    small angle would need."""
    d2 = dr.squared_norm(to_center)
    outside = d2 > dr.square(radius * (1 + mi.math.RayEpsilon))
    sin2 = dr.minimum(dr.square(radius) / dr.maximum(d2, 1e-30), 1)
    return dr.sqrt(d2), sin2, sin2 / (1 + dr.sqrt(1 - sin2)), outside


def _surface(p, normal, uv, d, distance):
    """The surface at `p` as a ray along `d` would hit it."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.p, si.n, si.uv, si.t = p, mi.Normal3f(normal), uv, distance
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = si.to_local(-d)
    return si


def own(values):
    """A copy in memory of Dr.Jit's own. The alignment of NumPy's arrays varies, and a frozen function is recorded anew
    for each combination of aligned and unaligned arguments."""
    scalar = type(values) if dr.depth_v(values) == 1 else dr.value_t(type(values))
    dr.make_opaque(values)  # no literals, which would be compiled
    return values ^ dr.opaque(scalar, False) if dr.is_mask_v(values) else values + dr.opaque(scalar, 0)
