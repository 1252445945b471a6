"""The entries of a light table: what is read from emitters, as NumPy columns.

Meshes are read by a few vectorised calls, whatever their number; spheres, disks, cylinders and point lights are read
from their parameters, 40 us each; for any other emitter, samples of its light are taken.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import parameters
from ..render.spectrum import as_three, at_probes, is_rgb
from .sky import REACH, Sky

LOCAL, DIRECTION, ENVIRONMENT = range(3)
#: How an entry is sampled. OTHER: as its emitter does. UNSAMPLED: not at all, only BSDF samples find its light.
OTHER, TRIANGLE, PARALLELOGRAM, DISK, CYLINDER, CYLINDER_INSIDE, SPHERE, POINT, UNSAMPLED = range(9)
PLANE = (TRIANGLE, PARALLELOGRAM, DISK)
CYLINDERS = (CYLINDER, CYLINDER_INSIDE)

#: Samples of an emitter's light or place that its entry is made from.
PROBES = 16
#: Emitters are called one by one if they are at most so many. A call through pointers is compiled for each emitter of
#: the scene.
FEW = 4
#: Textures that have the same `value` everywhere.
CONSTANT = ("UniformSpectrum", "SRGBReflectanceSpectrum", "RawConstantTexture")


def is_emissive_mesh(emitter) -> bool:
    """Whether each triangle of its mesh is a light."""
    shape = emitter.get_shape()
    return shape is not None and shape.is_mesh() and emitter.class_name() == "AreaLight"


def make_columns(scene, emitters, counts: np.ndarray, rng) -> dict[str, np.ndarray]:
    """Columns of all entries. `emitters`: the scene's, as a list; `counts`: entries of each."""
    emitter = np.repeat(np.arange(len(counts), dtype=np.uint32), counts)
    n = len(emitter)
    prim = np.arange(n, dtype=np.uint32) - np.repeat(np.cumsum(counts) - counts, counts).astype(np.uint32)
    zeros = lambda *shape: np.zeros((n, *shape), np.float32)  # noqa: E731
    columns = {
        "emitter": emitter, "form": np.zeros(n, np.uint32), "corner": zeros(3), "edge1": zeros(3), "edge2": zeros(3),
        "normal": zeros(3), "prim": prim, "area": zeros(), "radiance": zeros(3), "plain": np.ones(n, bool),
        "kind": np.zeros(n, np.uint32), "center": zeros(3), "radius": zeros(), "axis": zeros(3),
        "cone": -np.ones(n, np.float32), "intensity": zeros(),
    }  # fmt: skip
    columns["axis"][:, 2] = 1
    is_mesh = np.array([is_emissive_mesh(e) for e in emitters], bool)
    others = []
    for row in np.flatnonzero(~is_mesh[emitter]):
        if not _read(columns, int(row), emitters[emitter[row]]):
            others.append(int(row))
    if is_mesh.any():
        _meshes(columns, scene, counts, is_mesh, rng)
    _look(columns, scene, emitters, others, rng)
    return _merge_rectangles(columns, counts, is_mesh)


# ---------------------------------------------------------------- shapes that are known by their parameters


def _read(columns, row: int, emitter) -> bool:
    """Fill in the entry of a point light, or of an area light that is a sphere, disk or cylinder; False for another
    emitter.

    Pictures on spheres and disks are left to Mitsuba, which samples the picture. On cylinders it does that wrong, and
    on stretched ones it takes the wrong area.
    """
    kind, shape = emitter.class_name(), emitter.get_shape()
    if shape is None and kind == "PointLight":
        if not is_rgb():
            return False
        values = _constant(parameters.traverse(emitter), "intensity")
        if values is not None:
            center = np.array(emitter.bbox().min, np.float64).ravel()
            _put(columns, row, form=POINT, center=center, radiance=values, intensity=values.mean())
        return values is not None
    round_ = shape.class_name() if shape is not None and kind == "AreaLight" else ""
    if round_ not in ("Sphere", "Disk", "Cylinder"):
        return False
    radiance = _constant(parameters.traverse(emitter), "radiance") if is_rgb() else None
    known = dict(radiance=radiance, plain=radiance is not None)
    if round_ == "Cylinder":
        return _read_cylinder(columns, row, emitter, shape, known)
    if radiance is None or (round_ == "Sphere" and shape.has_flipped_normals()):
        return False
    if round_ == "Sphere":
        center, radius = _ball(shape)
        area = 4 * np.pi * radius**2
        _put(columns, row, form=SPHERE, center=center, radius=radius, area=area, intensity=area * radiance.mean(),
             **known)  # fmt: skip
        return True
    M = _matrix(shape)
    normal = np.cross(M[:, 0], M[:, 1])
    area = np.pi * np.linalg.norm(normal)
    if not area > 0:
        return False
    normal *= np.sign(np.linalg.det(M[:, :3])) * np.pi / area
    _put(columns, row, form=DISK, corner=M[:, 3], edge1=M[:, 0], edge2=M[:, 1], normal=normal, area=area,
         center=M[:, 3], radius=np.linalg.norm(M[:, :2], 2), axis=normal, cone=1, intensity=area * radiance.mean(),
         **known)  # fmt: skip
    return True


def _read_cylinder(columns, row: int, emitter, shape, known: dict) -> bool:
    M = _matrix(shape)
    turn = 2 * np.pi * (np.arange(256) + 0.5) / 256
    along = -np.sin(turn)[:, None] * M[:, 0] + np.cos(turn)[:, None] * M[:, 1]
    area = 2 * np.pi * np.linalg.norm(np.cross(along, M[:, 2]), axis=1).mean()
    if not area > 0:
        return False
    center = M[:, 3] + 0.5 * M[:, 2]
    ends = np.cos(turn)[:, None] * M[:, 0] + np.sin(turn)[:, None] * M[:, 1] + 0.5 * M[:, 2]
    ends = np.concatenate([ends, ends - M[:, 2]])
    # Normals of rays that hit it; those of its own sample_position() point the other way in a mirrored one
    form = CYLINDER if (np.linalg.det(M[:, :3]) < 0) == shape.has_flipped_normals() else CYLINDER_INSIDE
    if known["radiance"] is None:
        si = dr.zeros(mi.SurfaceInteraction3f, PROBES**2)
        lane = dr.arange(mi.UInt32, PROBES**2)
        si.uv = (mi.Point2f(mi.Float(lane % PROBES), mi.Float(lane // PROBES)) + 0.5) / PROBES
        si.p = cylinder_point(*(mi.Vector3f(*M[:, k].tolist()) for k in (3, 0, 1, 2)), si.uv)[0]
        si.n, si.wi, si.t = mi.Normal3f(0, 0, 1), mi.Vector3f(0, 0, 1), mi.Float(1)
        si.sh_frame = mi.Frame3f(si.n)
        values = np.array(as_three(emitter.eval(at_probes(si))) + dr.zeros(mi.Color3f, PROBES**2), np.float64)
        known = known | {"radiance": np.nan_to_num(values, posinf=0, neginf=0).mean(axis=1)}
    _put(columns, row, form=form, corner=M[:, 3], edge1=M[:, 0], edge2=M[:, 1], normal=M[:, 2], area=area,
         center=center, radius=1.001 * np.linalg.norm(ends, axis=1).max(), intensity=area * known["radiance"].mean(),
         **known)  # fmt: skip
    return True


def cylinder_point(corner, edge1, edge2, along, uv):
    """A point of a cylinder, stretched or not, and ``dp/dφ x dp/dz`` there: as long as the area of a unit of φ and z,
    and outwards if the edges and `along` are right-handed."""
    sin, cos = dr.sincos(2 * dr.pi * uv.x)
    p = mi.Point3f(corner + cos * edge1 + sin * edge2 + uv.y * along)
    return p, dr.cross(cos * edge2 - sin * edge1, along)


def _put(columns, row: int, **values) -> None:
    for name, value in values.items():
        columns[name][row] = value


def _constant(params, name: str) -> np.ndarray | None:
    """RGB of a radiance or intensity that is the same everywhere and finite; None of another."""
    key = f"{name}.value"
    if key not in params or params.properties[key][2].class_name() not in CONSTANT:
        return None
    value = np.array(parameters.read(params, key), np.float64).ravel()
    return np.broadcast_to(value, 3) if value.size in (1, 3) and np.isfinite(value).all() else None


def _matrix(shape) -> np.ndarray:
    """First three rows of a shape's ``to_world``, as rays see it: they use the inverse."""
    inverse = np.array(parameters.read(mi.traverse(shape), "to_world").inverse_transpose, np.float64).reshape(4, 4).T
    try:
        return np.linalg.inv(inverse)[:3]
    except np.linalg.LinAlgError:
        return np.zeros((3, 4))


def _ball(shape) -> tuple[np.ndarray, float]:
    """Centre and radius of a sphere: from its box, unless that is too coarse for it."""
    box = shape.bbox()
    low, high = np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel()
    center, radius = (low + high) / 2, (high - low).max() / 2
    if radius > 1e-2 * np.abs(center).max():
        return center, radius
    M = _matrix(shape)
    return M[:, 3], np.linalg.norm(M[:, 0])


# ---------------------------------------------------------------- emitters that are known by their light


def _look(columns, scene, emitters, rows: list[int], rng) -> None:
    """Fill in the entries of emitters that are sampled by themselves."""
    if not rows:
        return
    u = rng.random((4 * PROBES, 2)).astype(np.float32)
    batches = [rows] if len(rows) > FEW else [[row] for row in rows]
    lamps, glow = [], []
    for batch in batches:
        mine = [emitters[columns["emitter"][row]] for row in batch]
        lamp, bright = _look_at(columns, scene, batch, mine, u)
        lamps += lamp
        glow += bright
    # A lamp that was dark in all sampled directions may be a narrow beam, also where nothing else gives light
    least = 1e-3 * max([0.0, *np.nan_to_num(glow), float(columns["intensity"].max())])
    for row, bright in zip(lamps, glow, strict=True):
        columns["intensity"][row] = bright if bright > 0 else least if np.isnan(bright) else least or 1.0


def _look_at(columns, scene, rows: list[int], emitters: list, u) -> tuple[list, list]:
    """Fill in some entries with as few calls as can be. Returns which of them are lamps without extent, and how bright
    these are in their brightest direction."""
    m, k = len(rows), len(u)
    n = m * k
    flags = np.array([int(e.flags()) for e in emitters])
    environment = np.array([e.is_environment() for e in emitters])
    distant = (flags & int(mi.EmitterFlags.DeltaDirection)) != 0
    areas = np.array([_area(e.get_shape()) for e in emitters])
    surface = (flags & int(mi.EmitterFlags.Surface)) != 0
    unsampled = surface & ~(areas > 0)
    lights, spread = emitters[0], mi.Bool(True)
    if m > 1:
        pointers = dr.gather(mi.EmitterPtr, scene.emitters_dr(), mi.UInt32(columns["emitter"][rows]))
        lights, spread = dr.gather(mi.EmitterPtr, pointers, dr.repeat(dr.arange(mi.UInt32, m), k)), None
    active = mi.Bool(np.repeat(~unsampled, k)) if spread is None else mi.Bool(bool(~unsampled[0]))

    # Their position and their light, seen from the middle of the scene
    middle = np.array(scene.bbox().center(), np.float64).ravel()
    middle = middle if np.isfinite(middle).all() else np.zeros(3)
    u = mi.Point2f(np.tile(u, (m, 1)).T)
    ds, ps = dr.zeros(mi.DirectionSample3f, n), dr.zeros(mi.PositionSample3f, n)
    weight, Le = mi.Color3f(0), mi.Color3f(0)
    if not unsampled.all():
        it = seen_from(mi.Point3f(*middle.tolist()) + dr.zeros(mi.Point3f, n))
        ds, weight = lights.sample_direction(it, u, active)
        weight = as_three(weight)
    if (surface & ~unsampled).any():  # points all over them
        on = active & (mi.Bool(np.repeat(surface, k)) if m > 1 else mi.Bool(True))
        ps = lights.get_shape().sample_position(mi.Float(0), u, on)
        si = dr.zeros(mi.SurfaceInteraction3f, n)
        si.p, si.n, si.uv, si.wi, si.t = ps.p, ps.n, ps.uv, mi.Vector3f(0, 0, 1), mi.Float(1)
        si.sh_frame = mi.Frame3f(ps.n)
        Le = as_three(lights.eval(at_probes(si), on))
    dr.eval(ds.d, ds.p, weight, ps.p, ps.n, Le)

    def probes(v):
        return np.nan_to_num(np.array(v + dr.zeros(type(v), n), np.float64), posinf=0, neginf=0).T.reshape(m, k, 3)

    irradiance = probes(weight).mean(axis=(1, 2))
    direction = probes(ds.d).mean(axis=1)
    points = np.where(surface[:, None, None], probes(ps.p), probes(ds.p))
    normals = probes(ps.n)
    center = points.mean(axis=1)
    radius = 1.25 * np.linalg.norm(points - center[:, None], axis=-1).max(axis=1)
    for i in np.flatnonzero(unsampled):
        shape = emitters[i].get_shape()
        box = shape.bbox() if shape is not None else scene.bbox()
        low, high = np.array(box.min, np.float64).ravel(), np.array(box.max, np.float64).ravel()
        center[i], radius[i] = (low + high) / 2, np.linalg.norm(high - low) / 2
    unit = direction / np.maximum(np.linalg.norm(direction, axis=-1), 1e-30)[:, None]
    even = surface & ~unsampled & (np.linalg.norm(normals - normals[:, :1], axis=-1).max(axis=1) < 1e-4)
    intensity = probes(Le).mean(axis=(1, 2)) * np.where(unsampled, 0, areas)
    columns["form"][rows] = np.where(unsampled, UNSAMPLED, OTHER)
    columns["kind"][rows] = np.where(environment, ENVIRONMENT, np.where(distant, DIRECTION, LOCAL))
    columns["center"][rows] = np.where(distant[:, None], unit, center)
    columns["radius"][rows] = np.where(surface, radius, 0)
    columns["intensity"][rows] = np.where(environment, irradiance / 4, np.where(distant, irradiance, intensity))
    columns["axis"][rows] = np.where(even[:, None], normals[:, 0], [0, 0, 1])
    columns["cone"][rows] = np.where(even | distant, 1, -1)

    lamp = np.flatnonzero(~surface & ~environment & ~distant)
    if not lamp.size:
        return [], []
    some = lights if m == 1 else dr.gather(mi.EmitterPtr, pointers, mi.UInt32(lamp))
    return [rows[i] for i in lamp], _glow(some, center[lamp]).tolist()


def _area(shape) -> float:
    """Area of an emitter's shape; 0 where it has none or does not implement it: such a shape cannot be sampled
    either."""
    try:
        return float(np.array(shape.surface_area()).ravel()[0]) if shape is not None else 0.0
    except RuntimeError:
        return 0.0


def _glow(lamps, places: np.ndarray) -> np.ndarray:
    """Radiant intensity of lamps without extent in the brightest of 1024 directions; NaN of one that is not finite and
    nowhere bright."""
    m, k = len(places), 1024
    i = np.arange(k) + 0.5
    z, phi = 1 - 2 * i / k, i * np.pi * (3 - np.sqrt(5))  # a spiral of equal steps
    r = np.sqrt(1 - z * z)
    around = places[:, None] + np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    it = seen_from(mi.Point3f(around.reshape(-1, 3).T.astype(np.float32)))
    if m > 1:
        lamps = dr.gather(mi.EmitterPtr, lamps, dr.repeat(dr.arange(mi.UInt32, m), k))
    _, weight = lamps.sample_direction(it, mi.Point2f(0.5), True)
    weight = np.array(as_three(weight) + dr.zeros(mi.Color3f, m * k), np.float64).T.reshape(m, k, 3)
    finite = np.isfinite(weight)
    bright = np.where(finite, weight, 0).mean(axis=2).max(axis=1)
    return np.where((bright > 0) | finite.all(axis=(1, 2)), bright, np.nan)


def seen_from(p):
    """An interaction at the point from which emitters are seen."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p, it.n = mi.Point3f(p), mi.Normal3f(0, 0, 1)
    return at_probes(it)


# ---------------------------------------------------------------- meshes


def interaction(shape, prim, uv, ray, active):
    """The surface at barycentric or local coordinates of a primitive, seen along `ray`."""
    pi = dr.zeros(mi.PreliminaryIntersection3f, dr.width(prim))
    pi.t, pi.prim_uv, pi.prim_index = mi.Float(1), uv, prim
    si = shape.compute_surface_interaction(ray, pi, mi.RayFlags.All, active)
    si.wi = si.to_local(-ray.d)
    return si


def _meshes(columns, scene, counts, is_mesh, rng) -> None:
    """Fill in the entries of meshes, one for each triangle."""
    emitters = scene.emitters_dr()
    shapes = emitters.get_shape()
    emitter, prim = columns["emitter"], columns["prim"]
    flat = is_mesh[emitter]
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
    si = interaction(on, mi.UInt32(prim[rows]), uv, ray, mi.Bool(True))
    si.wi = mi.Vector3f(0, 0, 1)
    Le = as_three(lights.eval(at_probes(si), True))
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

    columns["form"][flat] = TRIANGLE
    put("corner", p0), put("edge1", p1 - p0), put("edge2", p2 - p0), put("normal", normal)
    put("area", 0.5 * length), put("radiance", radiance)
    put("plain", is_rgb() & constant & ~bent & ~(varies & np.ones(len(counts), bool))[emitter[flat]])
    center = (p0 + p1 + p2) / 3
    put("center", center)
    put("radius", np.sqrt(np.max([((p - center) ** 2).sum(axis=1) for p in (p0, p1, p2)], axis=0)))
    put("axis", normal)
    put("cone", np.where(bent, -1, 1))
    put("intensity", radiance.mean(axis=1) * 0.5 * length)


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
    ok &= (columns["normal"][a] * columns["normal"][a + 1]).sum(axis=1) > 0  # both shine to the same side
    ok &= np.abs(columns["radiance"][a] - columns["radiance"][a + 1]).max(axis=1) <= 1e-5 * columns["radiance"][a].max(
        axis=1
    )
    a, corner, q1, q2 = a[ok], corner[ok], q1[ok], q2[ok]
    c = columns
    c["corner"][a], c["edge1"][a], c["edge2"][a] = corner, q1 - corner, q2 - corner
    c["form"][a] = PARALLELOGRAM
    c["area"][a] += c["area"][a + 1]
    c["intensity"][a] += c["intensity"][a + 1]
    c["center"][a] = (q1 + q2) / 2
    c["radius"][a] = (
        np.maximum(np.linalg.norm(q1 - q2, axis=1), np.linalg.norm(corner - (q1 + q2 - corner), axis=1)) / 2
    )
    keep = np.ones(len(c["emitter"]), bool)
    keep[a + 1] = False
    return {k: v[keep] for k, v in c.items()}


# ---------------------------------------------------------------- the environment in parts


def with_texels(columns, scene, seed) -> tuple[dict[str, np.ndarray], Sky]:
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
