"""What each light would give a surface if nothing stood between them: unshadowed reflected radiance, without noise.

Lights of a :class:`~mi_neural.lights.table.LightTable`, by their form:

- triangles, parallelograms, disks, spheres: linearly transformed cosines (:mod:`.ltc`), spheres as the disk that they
  look like. Their radiance is taken to be constant over the light;
- point, spot, directional, projector: exact, one evaluation of emitter and BSDF;
- the environment: its irradiance by spherical harmonics of degree 2 (Ramamoorthi and Hanrahan 2001: 1 % off in the
  mean where light is soft; suns are blurred), for a glossy lobe in the mirror direction;
- others (cylinders, textured spheres): the mean of sixteen fixed points on them.

Materials, by what is known of them: ``diffuse``, ``plastic``, ``roughplastic`` and ``roughconductor`` of constant
roughness, also in ``twosided``, are a Lambert lobe plus a GGX lobe (for Beckmann lobes see `BECKMANN`). Any other BSDF
is evaluated at the light's centre and multiplied with the light's form factor: good where it is smooth over the light.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import parameters
from . import entries, ltc
from .entries import ENVIRONMENT, LOCAL
from .table import LightTable

TRIANGLE, PARALLELOGRAM, DISK, SPHERE, DELTA, OTHER, SKY = range(7)
#: Materials whose lobes are known, by the names of their classes.
KNOWN = ("SmoothDiffuse", "SmoothPlastic", "RoughPlastic", "RoughConductor")
#: A Beckmann lobe is treated as a GGX lobe of so many times its alpha: least error against Monte Carlo (0.28 in the
#: mean at alpha 0.2 under a light of 45 degrees; 0.42 for equal alphas).
BECKMANN = 0.7
#: Cosine at which the Fresnel loss of a Lambert lobe under a coat is taken; see `Receiver.albedo`.
GRAZING = 0.3
#: Points of a light of the kind OTHER that are evaluated.
POINTS = tuple((0.25 * i + 0.125, 0.25 * j + 0.125) for i in range(4) for j in range(4))
#: Directions from which the environment's harmonics are made.
SKY_SAMPLES = 2**15


@dataclass
class Receiver:
    """A surface point and its lobes, as `UnshadowedLights.receive` found them.

    known     whether the lobes are; elsewhere the BSDF is evaluated for each light
    side      ±1: where wi is; `wi`, and what `local` gives, have z > 0 there
    diffuse   albedo of the Lambert lobe for light along the normal, and what it loses (Fresnel) towards grazing
    glossy    albedo of the GGX lobe, Fresnel included; `lobe`: its shape, or None
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    known: mi.Bool
    transmits: mi.Bool
    side: mi.Float
    diffuse: mi.Color3f
    lost: mi.Color3f
    glossy: mi.Color3f
    lobe: ltc.Lobe | None

    def albedo(self, cos):
        """Of the Lambert lobe for light from that angle: a coat reflects like ``(1 - cos)^5`` (Schlick 1994)."""
        x = 1 - dr.maximum(cos, 0)
        return self.diffuse - self.lost * (dr.square(dr.square(x)) * x)

    def local(self, p, side):
        """World position `p`, seen from the surface, with z > 0 on `side`."""
        v = self.si.to_local(p - self.si.p)
        return mi.Vector3f(v.x, v.y, v.z * side)


class UnshadowedLights:
    """Unshadowed reflected radiance of the lights of `table` in `scene`.

    ``receive`` evaluates a surface, ``radiance`` one light from it, and ``total`` sums over all of them. No randomness,
    no rays. `refresh` takes over roughnesses that were changed in the scene; for changed lights there is a new table,
    hence a new object.
    """

    def __init__(self, scene, table: LightTable):
        self.table = table
        self.materials = _glossy_materials(scene)
        self._form(scene)
        self.refresh()

    def refresh(self) -> None:
        """Read the materials' roughness anew."""
        alpha = np.full((2, len(self.materials.known)), -1, np.float32)
        for number, params, keys, factor in self.materials.rough:
            alpha[:, number] = _alpha(params, keys) * np.array([1, factor])
        self.alpha, self.alpha_ggx = mi.Float(alpha[0]), mi.Float(alpha[1])
        self.is_known = mi.Bool(self.materials.known)
        dr.eval(self.alpha, self.alpha_ggx, self.is_known)

    def _form(self, scene) -> None:
        """Sort lights by their form, and put disks, spheres and the environment into numbers."""
        c = self.table.columns
        n = self.table.n_lights
        emitters = scene.emitters()
        forms = {entries.TRIANGLE: TRIANGLE, entries.PARALLELOGRAM: PARALLELOGRAM, entries.DISK: DISK,
                 entries.SPHERE: SPHERE, entries.POINT: DELTA}  # fmt: skip
        form = np.array([forms.get(int(f), OTHER) for f in c["form"]])
        form[c["kind"] == ENVIRONMENT] = SKY
        center, u, v = (np.zeros((n, 3), np.float32) for _ in range(3))
        disk, sphere = form == DISK, form == SPHERE
        center[disk], u[disk], v[disk] = c["corner"][disk], c["edge1"][disk], c["edge2"][disk]
        outwards = (np.cross(u, v) * c["normal"]).sum(axis=1) >= 0
        u, v = np.where((disk & ~outwards)[:, None], v, u), np.where((disk & ~outwards)[:, None], u, v)
        center[sphere], u[sphere, 0] = c["center"][sphere], c["radius"][sphere]
        self.sky: list = []
        for i in np.flatnonzero((form == OTHER) | (form == SKY)):
            emitter = emitters[c["emitter"][i]]
            if form[i] == SKY:
                self.sky = _harmonics(emitter)
            elif mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta) or c["kind"][i] != LOCAL:
                form[i] = DELTA
        self.form = form
        self.center, self.u, self.v = (mi.Vector3f(np.ascontiguousarray(a.T)) for a in (center, u, v))
        self.lists = {f: np.flatnonzero(form == f).astype(np.uint32) for f in sorted(set(form.tolist()))}
        self.members = {f: mi.UInt32(index) for f, index in self.lists.items()}
        dr.eval(self.center, self.u, self.v, self.sky, self.members)

    # -------------------------------------------------------------------------------------------------------------

    def receive(self, si, bsdf, active) -> Receiver:
        """The lobes at `si`: albedos are evaluated from the BSDF itself, with its textures and Fresnel terms."""
        number = dr.reinterpret_array(mi.UInt32, bsdf)
        known = mi.Bool(False)
        if self.materials.any_known:
            # Materials inside instances cannot be read and have no entry
            listed = active & (number < len(self.materials.known))
            known = listed & dr.gather(mi.Bool, self.is_known, number, listed)
        side = dr.mulsign(mi.Float(1), si.wi.z)
        transmits = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
        diffuse = lost = glossy = mi.Color3f(0)
        lobe = None
        if self.materials.any_known:
            ctx, sin = _only(mi.BSDFFlags.DiffuseReflection), (1 - GRAZING**2) ** 0.5
            diffuse = dr.select(known, bsdf.eval(ctx, si, mi.Vector3f(0, 0, side), known) * dr.pi, 0)
            if self.materials.any_coat:
                grazing = bsdf.eval(ctx, si, mi.Vector3f(sin, 0, GRAZING * side), known) * (dr.pi / GRAZING)
                lost = dr.select(known, (diffuse - grazing) * (1 - GRAZING) ** -5, 0)
        if self.materials.rough:
            alpha = dr.gather(mi.Float, self.alpha, number, known)
            shiny = known & (alpha >= 0)
            wi = mi.Vector3f(si.wi.x, si.wi.y, dr.abs(si.wi.z))
            lobe = ltc.lobe(dr.gather(mi.Float, self.alpha_ggx, number, known), wi, active=shiny)
            # Seen and lit along the normal: f cos = F D(n) / 4 with D(n) = 1 / (π α²), F the reflectance there
            si_n = mi.SurfaceInteraction3f(si)
            si_n.wi = mi.Vector3f(0, 0, side)
            value = bsdf.eval(_only(mi.BSDFFlags.GlossyReflection), si_n, si_n.wi, shiny)
            f0 = value * (4 * dr.pi * dr.square(dr.clip(alpha, 1e-3, 1)))
            f0 = dr.select(shiny & dr.all(dr.isfinite(f0)), f0, 0)
            glossy = dr.select(shiny, f0 * lobe.a + dr.maximum(1 - f0, 0) * lobe.b, 0)
            lobe = ltc.Lobe(lobe.x, lobe.y, mi.Float(1), mi.Float(0))
        return Receiver(si, bsdf, known, transmits, side, diffuse, lost, glossy, lobe)

    def radiance(self, scene, receiver: Receiver, form: int, index, active):
        """Radiance that light `index`, of the given form, would send by way of the surface along ``wi``, unshadowed."""
        if form == SKY:
            return self._sky(receiver, active)
        if form in (DELTA, OTHER):
            return self._by_points(scene, receiver, index, POINTS if form == OTHER else ((0.5, 0.5),), active)
        corners, radiance, active = self._polygon(form, index, receiver.si.p, active)
        centre = sum(corners) / len(corners)
        side = receiver.side
        if self.materials.any_other:
            towards = receiver.local(centre, side)
            side = dr.select(~receiver.known & receiver.transmits, dr.mulsign(side, towards.z * side), side)
        shape = [receiver.local(p, side) for p in corners]
        value = mi.Color3f(0)
        if self.materials.any_known:
            diffuse = receiver.albedo(_cosine(shape)) if self.materials.any_coat else receiver.diffuse
            value = ltc.reflected(shape, diffuse, receiver.glossy, receiver.lobe)
        if self.materials.any_other:
            other = active & ~receiver.known
            E = ltc.integrate_polygon(shape)
            d = receiver.local(centre, side)
            d = dr.normalize(mi.Vector3f(d.x, d.y, dr.maximum(d.z, 0.05 * dr.norm(d) + 1e-20)))
            at = mi.Vector3f(d.x, d.y, d.z * side)
            f = receiver.bsdf.eval(mi.BSDFContext(), receiver.si, at, other & (E > 0)) / d.z
            value = dr.select(other, f * (dr.pi * E), value)
        return dr.select(active & dr.all(dr.isfinite(value)), value * radiance, 0)

    def total(self, scene, si, bsdf, visible: list, active):
        """``sum_k unshadowed_k visible[k]``, one number in [0, 1] for every light.

        Of the environment `visible` is the share of the whole sphere, as the visibility cache learns it: on open ground
        1/2, which counts as all.
        """
        receiver = self.receive(si, bsdf, active)
        total = mi.Color3f(0)
        shares = dr.alloc_local(mi.Float, self.table.n_lights)
        for k, v in enumerate(visible):
            shares[k] = mi.Float(v)
        for form, index in self.lists.items():
            if form == SKY:
                share = dr.minimum(2 * visible[int(index[0])], 1)
                total += share * self._sky(receiver, active)
                continue
            members, count = self.members[form], len(index)

            def add(i, total, shares, form=form, members=members):
                light = dr.gather(mi.UInt32, members, i, active)
                return i + 1, total + shares[light] * self.radiance(scene, receiver, form, light, active), shares

            def more(i, total, shares, count=count):
                return active & (i < count)

            _, total, shares = dr.while_loop((mi.UInt32(0), total, shares), more, add, label="unshadowed lights")
        return total

    # -------------------------------------------------------------------------------------------------------------

    def _polygon(self, form: int, index, x, active):
        """Corners of the light as seen from x, its radiance, and whether it emits towards x."""
        t = self.table
        take = lambda a: dr.gather(mi.Vector3f, a, index, active)  # noqa: E731
        x = mi.Vector3f(x)
        if form in (TRIANGLE, PARALLELOGRAM):
            corner, edge1, edge2 = take(t.corner), take(t.edge1), take(t.edge2)
            corners = [corner, corner + edge1, corner + edge2]
            if form == PARALLELOGRAM:
                corners.insert(2, corner + edge1 + edge2)
            active = active & (dr.dot(x - corner, take(t.normal)) > 0)
            return corners, dr.gather(mi.Color3f, t.radiance, index, active), active
        radiance = dr.gather(mi.Color3f, t.radiance, index, active)
        centre, u, v = take(self.center), take(self.u), take(self.v)
        if form == SPHERE:
            # The circle along which it is seen edge-on: nearer than the centre, and smaller
            to = centre - x
            r2, d2 = dr.squared_norm(u), dr.squared_norm(to)
            active = active & (d2 > r2)
            share = dr.select(active, r2 / d2, 0)
            s, w = mi.coordinate_system(to * dr.rsqrt(dr.maximum(d2, 1e-30)))
            radius = dr.sqrt(r2 * (1 - share))
            centre, u, v = centre - share * to, radius * s, radius * w
        else:
            active = active & (dr.dot(x - centre, dr.cross(u, v)) > 0)
        step = 2 * np.pi / ltc.DISK_VERTICES
        grow = float(np.sqrt(step / np.sin(step)))  # an octagon of equal area
        angles = step * (np.arange(ltc.DISK_VERTICES) + 0.5)
        turns = [(grow * float(np.cos(a)), grow * float(np.sin(a))) for a in angles]
        return [centre + u * c + v * s for c, s in turns], radiance, active

    def _by_points(self, scene, receiver: Receiver, index, points, active):
        si = receiver.si
        which = dr.gather(mi.UInt32, self.table.emitter, index, active)
        emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), which, active)
        value = mi.Color3f(0)
        for point in points:
            ds, weight = emitter.sample_direction(si, mi.Point2f(*point), active)
            reaches = active & (ds.pdf > 0)
            f = receiver.bsdf.eval(mi.BSDFContext(), si, si.to_local(ds.d), reaches)
            one = f * weight
            value += dr.select(reaches & dr.all(dr.isfinite(one)), one, 0)
        return value / len(points)

    def _sky(self, receiver: Receiver, active):
        si = receiver.si
        n = mi.Vector3f(si.sh_frame.n) * receiver.side
        value = mi.Color3f(0)
        if self.materials.any_known:
            value = receiver.albedo(0.456) * self._irradiance(n)  # there (1 - cos)^5 has its mean, 1/21
        if receiver.lobe is not None:
            mirror = si.to_world(mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z))
            value += receiver.glossy * self._irradiance(mirror)
        value *= dr.inv_pi
        if self.materials.any_other:
            other = active & ~receiver.known
            up = mi.Vector3f(0, 0, receiver.side)
            f = receiver.bsdf.eval(mi.BSDFContext(), si, up, other)
            through = receiver.bsdf.eval(mi.BSDFContext(), si, -up, other & receiver.transmits)
            value = dr.select(other, f * self._irradiance(n) + through * self._irradiance(-n), value)
        return dr.select(active & dr.all(dr.isfinite(value)), value, 0)

    def _irradiance(self, n):
        """Of a surface with normal `n` under the environment (Ramamoorthi and Hanrahan 2001, eq. 6-8)."""
        total = mi.Color3f(0)
        for k, (y, c) in enumerate(zip(dr.sh_eval(n, 2), self.sky, strict=True)):
            total += (np.pi if k == 0 else 2 * np.pi / 3 if k < 4 else np.pi / 4) * y * c
        return dr.maximum(total, 0)


def _cosine(shape):
    """Of the angle at which a polygon stands: that of its part above the horizon, weighted as its light is."""
    up = [dr.maximum(p.z, 0) for p in shape]
    height = sum(dr.square(z) for z in up) * dr.rcp(dr.maximum(sum(up), 1e-30))
    return dr.minimum(height * dr.rsqrt(dr.maximum(dr.squared_norm(sum(shape) / len(shape)), 1e-30)), 1)


# ---------------------------------------------------------------- what is read off a scene


@dataclass
class _Materials:
    """`known` says for each registry number of a BSDF whether its lobes are; `rough` lists those with a GGX lobe as
    (number, parameters, keys of the roughness, factor to that of GGX)."""

    known: np.ndarray
    rough: list
    any_known: bool
    any_coat: bool
    any_other: bool


def _glossy_materials(scene) -> _Materials:
    seen: dict[int, object] = {}
    for shape in scene.shapes():
        if (bsdf := shape.bsdf()) is not None:
            seen[int(dr.reinterpret_array(mi.UInt32, mi.BSDFPtr(bsdf))[0])] = bsdf
    known = np.zeros(max(seen, default=0) + 1, bool)
    rough, coat, other = [], False, any(s.bsdf() is None or s.class_name() == "Instance" for s in scene.shapes())
    for number, bsdf in seen.items():
        if not mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth):
            continue  # mirrors and the like receive nothing
        name = bsdf.class_name()
        if name == "TwoSidedBRDF":
            inside = [n for n, (_, depth) in parameters.traverse(bsdf).hierarchy.items() if depth == 1]
            name = inside[0].class_name() if len(inside) == 1 else "different sides"
        if name in KNOWN and (not name.startswith("Rough") or _has_alpha(bsdf)):
            known[number] = True
            coat |= name.endswith("Plastic")
            if name.startswith("Rough"):
                params = parameters.traverse(bsdf)
                factor = BECKMANN if "distribution = beckmann" in parameters.text(bsdf) else 1.0
                rough.append((number, params, _alpha_keys(params), factor))
        else:
            other = True
    return _Materials(known, rough, bool(known.any()), coat, other)


def _alpha_keys(params) -> list[str]:
    """Keys of a constant roughness; none if it is textured."""
    found = [k for k in params.keys() if re.search(r"(^|\.)alpha(_u|_v)?(\.value)?$", k)]
    return found if len(found) in (1, 2) else []


def _has_alpha(bsdf) -> bool:
    return bool(_alpha_keys(parameters.traverse(bsdf)))


def _alpha(params, keys) -> float:
    """Roughness; of an anisotropic lobe the geometric mean."""
    return float(np.prod([float(np.ravel(np.array(params[k]))[0]) for k in keys]) ** (1 / len(keys)))


def _only(kind) -> mi.BSDFContext:
    ctx = mi.BSDFContext()
    ctx.type_mask = kind
    return ctx


def _harmonics(emitter) -> list:
    """Coefficients of the environment's radiance, degree 2, by sampling it."""
    k = dr.arange(mi.UInt32, SKY_SAMPLES)
    u = mi.Point2f((mi.Float(k) + 0.5) / SKY_SAMPLES, mi.Float(dr.brev(k) >> 8) * 2**-24)
    it = dr.zeros(mi.Interaction3f, SKY_SAMPLES)
    ds, weight = emitter.sample_direction(it, u, True)
    weight = dr.select(dr.all(dr.isfinite(weight)), weight, 0)
    wide = dr.zeros(mi.Float, SKY_SAMPLES)
    return [mi.Color3f(*(dr.mean(w * y + wide) for w in weight)) for y in dr.sh_eval(mi.Vector3f(ds.d), 2)]
