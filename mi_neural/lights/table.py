"""One flat table of all that emits in a scene.

An entry is a *light*: a triangle or parallelogram of an emissive mesh, or a whole emitter of any other kind (sphere,
disk, point, spot, directional, environment, ...). Entries are made with vectorised calls, whatever their number.
"""

from __future__ import annotations

import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from ..render import vertex
from .sky import REACH, Sky

#: More entries than this are refused: 100 bytes each, besides what building them takes.
MAX_LIGHTS = 2**24
#: Samples of an emitter's light or place that its entry is made from.
PROBES = 16

#: Shadow rays end this share of their length before the light, so that the light itself is not in the way.
SHADOW_EPSILON = 1e-3

LOCAL, DIRECTION, ENVIRONMENT = range(3)


class LightTable:
    """What emits, as arrays of `size` entries (structure of arrays; a PyTree).

    emitter   index into the scene's emitters
    flat      whether the entry is a triangle or parallelogram, sampled here; others are sampled by their emitter
    corner, edge1, edge2, normal   of flat ones: points ``corner + u edge1 + v edge2``; unit normal, on the emitting
                                   side
    folded    of flat ones: a triangle, points have u + v <= 1
    prim      primitive of the emitter's shape
    area      of flat ones; 0 elsewhere
    radiance  mean emitted radiance of flat ones
    plain     radiance and normal are constant over the entry, so that `radiance` can be used as it is
    kind      LOCAL, DIRECTION or ENVIRONMENT (as a whole; its texels are of kind DIRECTION)
    center, radius   bounding sphere of a LOCAL entry; DIRECTION: `center` is the direction towards the light
    axis, cone       mean normal, and cosine of the largest angle of a normal to it; -1: light leaves in all directions.
                     DIRECTION: `cone` is the cosine of the largest angle of its directions to `center`
    intensity        LOCAL: radiance times area, or radiant intensity; else irradiance of a surface that faces the light

    `n_lights` etc. are Python numbers; `facts` are all of them, for which a frozen function is recorded anew. `first`,
    `stride` lead from an emitter's registry number and a primitive to an entry.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "emitter": object, "flat": object, "corner": object, "edge1": object, "edge2": object, "normal": object,
        "folded": object, "prim": object, "area": object, "radiance": object, "plain": object, "kind": object,
        "center": object, "radius": object, "axis": object, "cone": object, "intensity": object,
        "first": object, "stride": object, "facts": object,
    }  # fmt: skip

    def __init__(self, scene, seed: int = 0, texels: bool = False):
        emitters = scene.emitters_dr()
        n_emitters = dr.width(emitters)
        rng = np.random.default_rng(seed)
        shapes = emitters.get_shape()
        is_mesh = np.array(shapes.is_mesh() & (dr.reinterpret_array(mi.UInt32, shapes) > 0)) & np.ones(n_emitters, bool)
        counts = np.array(
            [e.get_shape().primitive_count() if m else 1 for e, m in zip(scene.emitters(), is_mesh, strict=True)]
        )
        if counts.sum() > MAX_LIGHTS:
            raise ValueError(
                f"the scene has {counts.sum()} emissive triangles, more than the light table holds ({MAX_LIGHTS}); "
                "leave the light_sampler out, or make the emissive meshes simpler"
            )
        columns = _meshes(emitters, shapes, counts, is_mesh, rng)
        _others(columns, scene, emitters, rng)
        self.sky = None
        if texels and (columns["kind"] == ENVIRONMENT).any():
            columns, self.sky = _texels(columns, scene, seed)
        self.assign(columns)

        ids = np.array(dr.reinterpret_array(mi.UInt32, emitters)).ravel()
        first, stride = np.zeros(ids.max(initial=0) + 1, np.uint32), np.zeros(ids.max(initial=0) + 1, np.uint32)
        first[ids[columns["emitter"][::-1]]] = np.arange(self.n_lights, dtype=np.uint32)[::-1]
        stride[ids] = (np.bincount(columns["emitter"], minlength=n_emitters) > 1).astype(np.uint32)
        self.first, self.stride = own(mi.UInt32(first)), own(mi.UInt32(stride))
        extent = np.array(scene.bbox().extents(), np.float64).ravel()
        self.cross_section = float(np.pi / 4 * (extent**2).sum()) if np.isfinite(extent).all() else 1.0
        dr.eval(self)

    def assign(self, columns: dict[str, np.ndarray]) -> None:
        """Take over `columns`, NumPy arrays by name; what is known of all entries becomes a Python fact."""
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
        self.any_flat, self.all_flat = bool(columns["flat"].any()), bool(columns["flat"].all())
        n_texels = self.sky.size**2 if self.sky is not None else 0
        self.any_other = int((~columns["flat"]).sum()) > n_texels  # sampled by their emitters
        self.all_plain = bool((columns["plain"] | ~columns["flat"]).all())
        self.kinds = sorted(set(columns["kind"].tolist()))
        known = self.any_flat, self.all_flat, self.any_other, self.all_plain
        self.facts = (self.n_lights, n_texels, *known, *self.kinds)

    # -------------------------------------------------------------------------------------------------------------

    def index_of(self, scene, si, active=True):
        """Entry that a ray met at `si`, the environment included, and whether what was met emits (else any entry)."""
        emitter = si.emitter(scene, active)
        number = dr.reinterpret_array(mi.UInt32, emitter)
        emits = active & (number > 0)
        first = dr.gather(mi.UInt32, self.first, number, emits)
        stride = dr.gather(mi.UInt32, self.stride, number, emits)
        beyond = self.sky.texel_of(-si.wi) if self.sky is not None else mi.UInt32(0)
        return first + stride * dr.select(si.is_valid(), si.prim_index, beyond), emits

    def sample(self, scene, si, index, sample, active):
        """A point on (direction to) light `index`, seen from `si`.

        Returns (direction sample, radiance over its density, density over solid angle). The density is 0 where the
        light does not reach `si`; of delta lights it is 1, and `ds.delta` is set. No shadow ray is traced.
        """
        ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
        weight, pdf = mi.Color3f(0), mi.Float(0)
        flat = dr.gather(mi.Bool, self.flat, index, active) if not self.all_flat else mi.Bool(True)
        if self.any_flat:
            ds, weight, pdf = self._sample_flat(scene, si, index, sample, active & flat)
        if self.any_other:
            other = active & ~flat & ~self._is_texel(index)
            emitter = dr.gather(
                mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.emitter, index, other), other
            )
            ds_other, w_other = emitter.sample_direction(si, sample, other)
            ds = dr.select(flat, ds, ds_other) if self.any_flat else ds_other
            weight, pdf = dr.select(flat, weight, w_other), dr.select(flat, pdf, ds_other.pdf)
        if self.sky is not None:
            texel = active & self._is_texel(index)
            ds_sky, w_sky = self.sky.sample(scene, si.p, index - self.sky.first, sample, texel)
            alone = not (self.any_flat or self.any_other)
            ds = ds_sky if alone else dr.select(texel, ds_sky, ds)
            weight, pdf = dr.select(texel, w_sky, weight), dr.select(texel, ds_sky.pdf, pdf)
        return ds, dr.select(active & (pdf > 0), weight, 0), dr.select(active, pdf, 0)

    def _is_texel(self, index):
        return index >= self.sky.first if self.sky is not None else mi.Bool(False)

    def _point(self, index, sample, active):
        """A uniform point of flat lights, and its coordinates: (p, u, v)."""
        u, v = sample.x, sample.y
        fold = dr.gather(mi.Bool, self.folded, index, active) & (u + v > 1)
        u, v = dr.select(fold, 1 - u, u), dr.select(fold, 1 - v, v)
        corner, edge1, edge2 = (dr.gather(mi.Vector3f, a, index, active) for a in (self.corner, self.edge1, self.edge2))
        return mi.Point3f(corner + u * edge1 + v * edge2), u, v

    def _sample_flat(self, scene, si, index, sample, active):
        p, u, v = self._point(index, sample, active)
        normal = dr.gather(mi.Vector3f, self.normal, index, active)
        to_light = p - si.p
        d2 = dr.squared_norm(to_light)
        d = to_light * dr.rsqrt(dr.maximum(d2, 1e-30))
        cos = -dr.dot(d, normal)
        area = dr.gather(mi.Float, self.area, index, active)
        pdf = dr.select(active & (cos > 0) & (area > 0), d2 / (cos * area), 0)
        ds = dr.zeros(mi.DirectionSample3f, dr.width(index))
        ds.p, ds.n, ds.uv, ds.d, ds.dist = p, mi.Normal3f(normal), mi.Point2f(u, v), d, dr.sqrt(d2)
        ds.pdf, ds.delta = pdf, mi.Bool(False)
        radiance = dr.gather(mi.Color3f, self.radiance, index, active)
        if not self.all_plain:
            emitter = dr.gather(
                mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.emitter, index, active), active
            )
            varied = active & ~dr.gather(mi.Bool, self.plain, index, active)
            at = _interaction(emitter.get_shape(), dr.gather(mi.UInt32, self.prim, index, varied), mi.Point2f(u, v),
                              mi.Ray3f(si.p, d), varied)  # fmt: skip
            radiance = dr.select(varied, emitter.eval(at, varied), radiance)
        return ds, dr.select(pdf > 0, radiance / pdf, 0), pdf

    def pdf(self, scene, si_ref, index, si_light, ds, active):
        """Density over solid angle with which `sample` would have found the point `si_light` on light `index`."""
        pdf = mi.Float(0)
        flat = dr.gather(mi.Bool, self.flat, index, active) if not self.all_flat else mi.Bool(True)
        if self.any_flat:
            area = dr.gather(mi.Float, self.area, index, active & flat)
            cos = -dr.dot(ds.d, dr.gather(mi.Vector3f, self.normal, index, active & flat))
            pdf = dr.select((cos > 0) & (area > 0), dr.square(ds.dist) / (cos * area), 0)
        if self.any_other:
            other = active & ~flat & ~self._is_texel(index)
            pdf = dr.select(flat, pdf, ds.emitter.pdf_direction(si_ref, ds, other))
        if self.sky is not None:
            pdf = dr.select(self._is_texel(index), 1 / self.sky.solid_angle, pdf)
        return dr.select(active, pdf, 0)

    def shadow_ray(self, scene, p, index, sample, active):
        """A ray from the points `p` to a random point of light `index`, for a visibility test: uniform on the area of
        flat lights, the emitter's own choice on others. Not normalised by what the point may receive."""
        it = vertex.reference_point(p, mi.Normal3f(0, 0, 1))
        target = mi.Point3f(p)
        flat = dr.gather(mi.Bool, self.flat, index, active) if not self.all_flat else mi.Bool(True)
        if self.any_flat:
            target = self._point(index, sample, active & flat)[0]
        if self.any_other:
            other = active & ~flat & ~self._is_texel(index)
            emitter = dr.gather(
                mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, self.emitter, index, other), other
            )
            ds, _ = emitter.sample_direction(it, sample, other)
            target = dr.select(flat, target, ds.p)
        if self.sky is not None:
            away = p + self.sky.at(index - self.sky.first, sample) * self.sky.distance
            target = dr.select(self._is_texel(index), away, target)
        to = target - p
        distance = dr.norm(to)
        ray = mi.Ray3f(p, to / dr.maximum(distance, 1e-30))
        ray.maxt = distance * (1 - SHADOW_EPSILON)
        return ray, distance > 0


def own(values):
    """A copy in memory of Dr.Jit's own. NumPy's is aligned by chance, and for each pattern of what is aligned in its
    arguments a frozen function is recorded anew."""
    scalar = type(values) if dr.depth_v(values) == 1 else dr.value_t(type(values))
    dr.make_opaque(values)  # no literals, which would be compiled
    return values ^ dr.opaque(scalar, False) if dr.is_mask_v(values) else values + dr.opaque(scalar, 0)


def importance(light, x, n, two_sided):
    """Bound on what a surface at x with normal n receives of a light without shadows, up to a constant of order one.

    `light` has the columns kind, center, radius, axis, cone, intensity, for one light each lane. Positive wherever any
    point of the light can be seen: angles are widened by the bounding sphere's (Conty Estevez and Kulla 2018, eq. 3).
    `two_sided` receivers (transmissive ones) count light from behind as well. Where `light.kind` is a Python number,
    only its case is computed.
    """
    if isinstance(light.kind, int) and light.kind == ENVIRONMENT:
        return mi.Float(light.intensity)
    if isinstance(light.kind, int) and light.kind == DIRECTION:
        cos = dr.dot(light.center, n)
        cos = _widen(dr.select(two_sided, dr.abs(cos), cos), light.cone, _sine(light.cone))
        return light.intensity * dr.maximum(cos, 0)
    if not isinstance(light.kind, int):
        cases = []
        for kind in (LOCAL, DIRECTION, ENVIRONMENT):
            one = copy.copy(light)
            one.kind = kind
            cases.append(importance(one, x, n, two_sided))
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
    cos_i = dr.select(inside, 1, _widen(cos_i, cos_b, sin_b))
    cos_o = light.cone
    cos_l = _widen(-dr.dot(d, light.axis), cos_o, _sine(cos_o))
    cos_l = dr.select(inside | (cos_o <= -1), 1, _widen(cos_l, cos_b, sin_b))
    return light.intensity * dr.maximum(cos_i, 0) * dr.maximum(cos_l, 0) / dr.maximum(d2, dr.maximum(r2, 1e-30))


def _widen(cos, cos_by, sin_by):
    """Cosine of an angle made smaller by another, at least 0."""
    return dr.select(cos >= cos_by, 1, cos * cos_by + _sine(cos) * sin_by)


def _sine(cos):
    return dr.sqrt(dr.maximum(1 - dr.square(cos), 0))


def _texels(columns, scene, seed) -> tuple[dict[str, np.ndarray], Sky]:
    """Columns with the texels of the environment, at the end, in the place of its one entry."""
    row = int(np.flatnonzero(columns["kind"] == ENVIRONMENT)[0])
    sky = Sky(scene, int(columns["emitter"][row]), seed)
    n = sky.size**2
    rest = np.arange(len(columns["emitter"])) != row
    sky.first = int(rest.sum())
    new = {k: np.repeat(v[row : row + 1], n, axis=0) for k, v in columns.items()}
    new["prim"] = np.arange(n, dtype=np.uint32)
    new["kind"][:] = DIRECTION
    new["center"] = sky.direction.astype(np.float32)
    new["intensity"] = sky.irradiance.astype(np.float32)
    new["cone"][:] = np.cos(min(REACH / sky.size, np.pi))  # the longest half diagonal of a texel is below
    return {k: np.concatenate([v[rest], new[k]]) for k, v in columns.items()}, sky


def _interaction(shape, prim, uv, ray, active):
    """The surface at barycentric or local coordinates of a primitive, seen along `ray`."""
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(prim))
    pi.t, pi.prim_uv, pi.prim_index = mi.Float(1), uv, prim
    si = shape.compute_surface_interaction(ray, pi, mi.RayFlags.All, active)
    si.wi = si.to_local(-ray.d)
    return si


def _meshes(emitters, shapes, counts, is_mesh, rng) -> dict[str, np.ndarray]:
    """Columns of all entries, those of meshes filled in."""
    emitter = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
    n = len(emitter)
    prim = np.arange(n, dtype=np.uint32) - np.repeat(np.cumsum(counts) - counts, counts).astype(np.uint32)
    flat = is_mesh[emitter]
    zeros = lambda *shape: np.zeros((n, *shape), np.float32)  # noqa: E731
    columns = {
        "emitter": emitter, "flat": flat, "corner": zeros(3), "edge1": zeros(3), "edge2": zeros(3), "normal": zeros(3),
        "folded": flat.copy(), "prim": prim, "area": zeros(), "radiance": zeros(3), "plain": np.ones(n, bool),
        "kind": np.zeros(n, np.uint32), "center": zeros(3), "radius": zeros(), "axis": zeros(3),
        "cone": -np.ones(n, np.float32),
        "intensity": zeros(),
    }  # fmt: skip
    if not flat.any():
        return columns

    # One call for all entries, their corners and PROBES points of each
    m = int(flat.sum())
    b = np.concatenate([np.eye(3)[:, 1:], rng.dirichlet((1, 1, 1), PROBES)[:, :2]])
    k = len(b)
    rows = np.repeat(np.flatnonzero(flat), k)
    varies = np.array(emitters.flags() & int(mi.EmitterFlags.SpatiallyVarying)) > 0
    lights = dr.gather(mi.EmitterPtr, emitters, mi.UInt32(emitter[rows]))
    on = dr.gather(mi.ShapePtr, shapes, mi.UInt32(emitter[rows]))
    uv = mi.Point2f(np.tile(b, (m, 1)).T.astype(np.float32))
    ray = mi.Ray3f(dr.zeros(mi.Point3f, m * k), mi.Vector3f(0, 0, 1))
    si = _interaction(on, mi.UInt32(prim[rows]), uv, ray, mi.Bool(True))
    si.wi = mi.Vector3f(0, 0, 1)
    Le = lights.eval(si, True)
    dr.eval(si, Le)
    wide = lambda v: np.array(v, np.float64).T.reshape(m, k, 3)  # noqa: E731
    p, n_geo, n_sh = wide(si.p), wide(si.n), wide(si.sh_frame.n)
    Le = wide(Le + dr.zeros(mi.Color3f, m * k))[:, 3:]
    Le = np.where(np.isfinite(Le), Le, 0)
    p0, p1, p2 = p[:, 0], p[:, 1], p[:, 2]
    radiance, n_sh0 = Le.mean(axis=1), n_sh[:, 3]
    bent = (np.abs(np.abs((n_geo * n_sh).sum(axis=-1)) - 1) > 1e-4).any(axis=1)
    cross = np.cross(p1 - p0, p2 - p0)
    length = np.linalg.norm(cross, axis=1)
    normal = cross / np.maximum(length, 1e-300)[:, None]
    # The side that emits is that of the shading normal
    normal *= np.where((normal * n_sh0).sum(axis=1) < 0, -1, 1)[:, None]
    constant = (Le.max(axis=1) - Le.min(axis=1)).max(axis=1) <= 1e-5 * Le.max(axis=(1, 2))

    def put(name, values):
        columns[name][flat] = values

    put("corner", p0), put("edge1", p1 - p0), put("edge2", p2 - p0), put("normal", normal)
    put("area", 0.5 * length), put("radiance", radiance)
    put("plain", constant & ~bent & ~(varies & np.ones(len(counts), bool))[emitter[flat]])
    center = (p0 + p1 + p2) / 3
    put("center", center)
    put("radius", np.sqrt(np.max([((p - center) ** 2).sum(axis=1) for p in (p0, p1, p2)], axis=0)))
    put("axis", normal)
    put("cone", np.where(bent, -1, 1))
    put("intensity", radiance.mean(axis=1) * 0.5 * length)
    return _merge_rectangles(columns, counts, is_mesh)


def _merge_rectangles(columns, counts, is_mesh) -> dict[str, np.ndarray]:
    """Two triangles that are all of an emitter and form a parallelogram become one entry."""
    pair = np.flatnonzero(is_mesh & (counts == 2))
    if not pair.size:
        return columns
    a = (np.cumsum(counts) - counts)[pair]
    p = [columns["corner"], columns["corner"] + columns["edge1"], columns["corner"] + columns["edge2"]]
    one, two = (np.stack([q[i] for q in p], axis=1).astype(np.float64) for i in (a, a + 1))
    # The corner of the second that the first has not, and the corner of the first opposite to it
    distance = np.linalg.norm(one[:, :, None] - two[:, None], axis=-1)
    scale = distance.max(axis=(1, 2))
    shared = distance < 1e-5 * scale[:, None, None]
    lone1, lone2 = ~shared.any(axis=2), ~shared.any(axis=1)
    ok = (lone1.sum(axis=1) == 1) & (lone2.sum(axis=1) == 1)
    i1, i2 = lone1.argmax(axis=1), lone2.argmax(axis=1)
    rows = np.arange(len(pair))
    corner, opposite = one[rows, i1], two[rows, i2]
    q1, q2 = one[rows, (i1 + 1) % 3], one[rows, (i1 + 2) % 3]
    ok &= np.linalg.norm(q1 + q2 - corner - opposite, axis=1) < 1e-4 * scale
    ok &= columns["plain"][a] & columns["plain"][a + 1]
    ok &= np.abs(columns["radiance"][a] - columns["radiance"][a + 1]).max(axis=1) <= 1e-5 * columns["radiance"][a].max(
        axis=1
    )
    a, corner, q1, q2 = a[ok], corner[ok], q1[ok], q2[ok]
    c = columns
    c["corner"][a], c["edge1"][a], c["edge2"][a] = corner, q1 - corner, q2 - corner
    c["folded"][a] = False
    c["area"][a] += c["area"][a + 1]
    c["intensity"][a] += c["intensity"][a + 1]
    c["center"][a] = (q1 + q2) / 2
    c["radius"][a] = (
        np.maximum(np.linalg.norm(q1 - q2, axis=1), np.linalg.norm(corner - (q1 + q2 - corner), axis=1)) / 2
    )
    keep = np.ones(len(c["emitter"]), bool)
    keep[a + 1] = False
    return {k: v[keep] for k, v in c.items()}


def _glow(lamps, places: np.ndarray) -> np.ndarray:
    """Radiant intensity of lamps without extent in the brightest of 1024 directions."""
    m, k = len(places), 1024
    i = np.arange(k) + 0.5
    z, phi = 1 - 2 * i / k, i * np.pi * (3 - np.sqrt(5))  # a spiral of equal steps
    r = np.sqrt(1 - z * z)
    around = places[:, None] + np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    it = vertex.reference_point(mi.Point3f(around.reshape(-1, 3).T.astype(np.float32)), mi.Normal3f(0, 0, 1))
    lamps = dr.gather(mi.EmitterPtr, lamps, dr.repeat(dr.arange(mi.UInt32, m), k))
    _, weight = lamps.sample_direction(it, mi.Point2f(0.5), True)
    weight = np.array(weight + dr.zeros(mi.Color3f, m * k), np.float64).T.reshape(m, k, 3)
    return np.nan_to_num(weight, posinf=0, neginf=0).mean(axis=2).max(axis=1)


def _others(columns, scene, emitters, rng) -> None:
    """Fill in the entries of emitters that are not meshes, by looking at samples of their light."""
    rows = np.flatnonzero(~columns["flat"])
    if not rows.size:
        return
    m = len(rows)
    lights = dr.gather(mi.EmitterPtr, emitters, mi.UInt32(columns["emitter"][rows]))
    flags = np.array(lights.flags()) * np.ones(m, np.uint32)
    environment = np.array(lights.is_environment()) & np.ones(m, bool)
    distant = (flags & int(mi.EmitterFlags.DeltaDirection)) != 0
    surface = (flags & int(mi.EmitterFlags.Surface)) != 0

    # Where they are and what they give, seen from the middle of the scene
    box = scene.bbox()
    middle = np.array(box.center(), np.float64).ravel()
    middle = middle if np.isfinite(middle).all() else np.zeros(3)
    k = 4 * PROBES
    u = mi.Point2f(np.tile(rng.random((k, 2)), (m, 1)).T.astype(np.float32))
    each = dr.repeat(dr.arange(mi.UInt32, m), k)
    lights = dr.gather(mi.EmitterPtr, lights, each)
    n = m * k
    away = mi.Point3f(*middle.tolist()) + dr.zeros(mi.Point3f, n)
    ds, weight = lights.sample_direction(vertex.reference_point(away, mi.Normal3f(0, 0, 1)), u, True)
    # Surfaces: points all over them
    on = lights.get_shape()
    ps = on.sample_position(mi.Float(0), u, mi.Bool(np.repeat(surface, k)))
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.p, si.n, si.uv, si.wi, si.t = ps.p, ps.n, ps.uv, mi.Vector3f(0, 0, 1), mi.Float(1)
    si.sh_frame = mi.Frame3f(ps.n)
    Le = lights.eval(si, mi.Bool(np.repeat(surface, k)))
    area = on.surface_area()
    dr.eval(ds.d, ds.p, weight, ps.p, ps.n, Le, area)

    def probes(v):
        return np.nan_to_num(np.array(v + dr.zeros(type(v), n), np.float64), posinf=0, neginf=0).T.reshape(m, k, 3)

    irradiance = probes(weight).mean(axis=(1, 2))
    direction = probes(ds.d).mean(axis=1)
    points = np.where(surface[:, None, None], probes(ps.p), probes(ds.p))
    normals = probes(ps.n)
    area = (np.array(area, np.float64) * np.ones(n)).reshape(m, k)[:, 0]
    center = points.mean(axis=1)
    radius = 1.25 * np.linalg.norm(points - center[:, None], axis=-1).max(axis=1)
    unit = direction / np.maximum(np.linalg.norm(direction, axis=-1), 1e-30)[:, None]
    even = surface & (np.linalg.norm(normals - normals[:, :1], axis=-1).max(axis=1) < 1e-4)
    intensity = probes(Le).mean(axis=(1, 2)) * area
    lamp = np.flatnonzero(~surface & ~environment & ~distant)
    if lamp.size:
        glow = _glow(dr.gather(mi.EmitterPtr, emitters, mi.UInt32(columns["emitter"][rows[lamp]])), center[lamp])
        # One that was dark in all directions looked at may be a narrow beam
        intensity[lamp] = np.where(glow > 0, glow, 1e-3 * max(glow.max(), intensity.max(initial=0)))
    columns["kind"][rows] = np.where(environment, ENVIRONMENT, np.where(distant, DIRECTION, LOCAL))
    columns["center"][rows] = np.where(distant[:, None], unit, center)
    columns["radius"][rows] = np.where(surface, radius, 0)
    columns["intensity"][rows] = np.where(environment, irradiance / 4, np.where(distant, irradiance, intensity))
    columns["axis"][rows] = np.where(even[:, None], normals[:, 0], [0, 0, 1])
    columns["cone"][rows] = np.where(even | distant, 1, -1)
