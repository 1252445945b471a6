"""Unshadowed light of polygons and disks: exact for Lambert, by linearly transformed cosines for GGX.

Heitz, Dupuy, Hill, Neubelt 2016, "Real-time polygonal-light shading with linearly transformed cosines". A GGX lobe
times cosine is a matrix M applied to a clamped cosine, so that its integral over a polygon is the clamped cosine's over
the polygon times M^-1. `studies/fit_ltc.py` makes the table of M.

All coordinates are local to the shading point: the origin is the point, z its normal. Vertices between 1e-15 and 1e15
units away are handled in single precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

FILE = Path(__file__).with_name("ltc_ggx.npz")

#: Smallest roughness of the table; sharper lobes are taken to be as sharp.
ALPHA_MIN = 1e-3
#: Smallest cosine of the view direction.
COS_MIN = 1e-2
#: Vertices of the polygon that stands for a disk.
DISK_VERTICES = 8
#: Square of the angular size (largest distance of a vertex from the first, over that of the centre from the origin)
#: below which a polygon is taken at its centre.
SMALL = 1.6e-5

# acos(x) / sqrt(1 - x²) on [0, 1]: least squares in Chebyshev points, relative error 6e-7 in single precision
ARC_OVER_SINE = (
    1.57079554, -0.999899655, 0.783238935, -0.648288629, 0.508120568, -0.322599433, 0.135003864, -0.0263715471
)  # fmt: skip

_tables: dict[str, object] = {}


# ---------------------------------------------------------------- clamped cosines


def integrate_polygon(vertices):
    """Form factor ``E = 1/π ∫ max(cos θ, 0) dω`` of a planar convex polygon, in [0, 1], from either side of it.

    `vertices`: three or more Vector3f, in order around the polygon. The part below the horizon (z <= 0) is cut off.
    Lambert's sum over edges (Baum et al. 1989; Heitz et al. 2016, section 4): ``E = 1/2π |Σ γ_i (Γ_i).z|``, where
    each edge is cut at the horizon by itself and an arc along the horizon closes what was cut. All lanes do the same.

    Measured error: 1e-6 at distances like the size; where an edge passes the origin at δ of its length, 1e-6/δ for
    999 in 1000. It is large only where the origin all but lies on the polygon, where E jumps.
    Polygons smaller than 1/250 of their distance are taken at their centre: there the sum cancels in single precision.
    Degenerate polygons (no area, edge-on, vertices at the origin) give finite values.
    """
    total, leaves, enters = mi.Float(0), mi.Vector3f(0), mi.Vector3f(0)
    for a, b in zip(vertices, [*vertices[1:], vertices[0]], strict=True):
        a_above, b_above = a.z > 0, b.z > 0
        t = dr.fmin(dr.fmax(a.z / dr.select(a_above == b_above, 1, a.z - b.z), 0), 1)
        crossing = mi.Vector3f(dr.fma(b.x - a.x, t, a.x), dr.fma(b.y - a.y, t, a.y), 0)
        total += _arc(dr.select(a_above, a, crossing), dr.select(b_above, b, crossing))
        leaves = dr.select(a_above & ~b_above, crossing, leaves)
        enters = dr.select(~a_above & b_above, crossing, enters)
    total += _arc(leaves, enters)
    E = dr.fmin(dr.abs(total) * (0.5 * dr.inv_pi), 1)

    spokes, centre = [v - vertices[0] for v in vertices[1:]], sum(vertices) / len(vertices)
    longest = reduce(dr.maximum, map(dr.squared_norm, spokes))
    is_small = longest < SMALL * dr.squared_norm(centre)
    return dr.select(is_small, _small_polygon(vertices, spokes, centre), E)


def integrate_disk(disk, n_vertices: int = DISK_VERTICES):
    """Form factor of a disk or ellipse with points ``centre + u cos t + v sin t``; `disk`: (centre, u, v), in [0, 1].

    An octagon of equal area stands for it. Measured against 256 vertices, at random angles: relative error 2e-4 in the
    median and at most 1 % beyond two radii of the centre; at half to two radii 1e-3 in the median, but 10 to 25 % for
    one in a hundred (near the rim and the plane of the disk).
    """
    centre, u, v = disk
    step = 2 * np.pi / n_vertices
    grow = np.sqrt(step / np.sin(step))
    angles = [(k + 0.5) * step for k in range(n_vertices)]
    return integrate_polygon([centre + u * float(grow * np.cos(t)) + v * float(grow * np.sin(t)) for t in angles])


def _arc(a, b):
    """z component of the angle from `a` to `b` about their normal, ``γ (a x b).z / |a x b|``; 0 where one is 0."""
    inv_a, inv_b = _inverse_norm(a), _inverse_norm(b)
    half = 0.5 * dr.squared_norm(a * inv_a + b * inv_b)  # 1 + cos γ, to full precision where γ is nearly π
    cos = half - 1
    over_sine = _polynomial(dr.abs(cos), ARC_OVER_SINE)
    blunt = dr.pi * dr.rsqrt(dr.fmax(half * (2 - half), 1e-12)) - over_sine
    edge = b - a  # (a x b).z = (a x edge).z keeps its digits on short edges
    return (a.x * edge.y - a.y * edge.x) * inv_a * inv_b * dr.select(cos < 0, blunt, over_sine)


def _small_polygon(vertices, spokes, centre):
    """E of a polygon seen under a small angle: solid angle times cosine at its centre; positive if a vertex is above.

    The cosine is the mean of the vertices' clamped ones, too large where the horizon cuts the polygon.
    """
    inverse = _inverse_norm(centre)
    area = sum(dr.cross(a * inverse, b * inverse) for a, b in pairwise(spokes)) / 2
    cos = sum(dr.maximum(v.z, 0) for v in vertices) * (inverse / len(vertices))
    return dr.fmin(dr.inv_pi * dr.abs(dr.dot(area, centre * inverse)) * cos, 1)


def _inverse_norm(v):
    """1/|v|, finite for v = 0 and for overflow."""
    return dr.rsqrt(dr.fmin(dr.fmax(dr.squared_norm(v), 1e-36), 1e36))


def _polynomial(x, coefficients):
    """Horner's scheme, lowest order first."""
    value = mi.Float(coefficients[-1])
    for c in coefficients[-2::-1]:
        value = dr.fma(value, x, c)
    return value


# ---------------------------------------------------------------- GGX


@dataclass
class Lobe:
    """A GGX lobe as seen from one direction: M^-1 (its rows less zeros; the third is z) and two directional albedos.

    With Schlick's Fresnel term and reflectance F0 at the normal, ``F0 a + (1 - F0) b`` of uniform light is reflected.
    """

    x: mi.Vector3f
    y: mi.Vector2f
    a: mi.Float
    b: mi.Float


def entries(q, alpha, cos_theta):
    """(m11, m22, m13) from the stored (q11, q22, q13): the limits of sharp lobes and of grazing views factored out.

    Sharp lobes (α -> 0) have ``2α/cos²θ, 2α, -tan θ``, that is q = (2, 2, 1) at every θ; towards grazing views cos θ
    ceases to matter where it falls below α.
    """
    wide = cos_theta * cos_theta + alpha * alpha
    tangent = ((1 - cos_theta * cos_theta) / wide) ** 0.5
    return q[0] * alpha / wide, q[1] * alpha, -q[2] * tangent


def table():
    """The fitted table for the current variant: a flat Float of 8 numbers a cell (q11, q22, q13, a, b, zeros).

    Loaded at the first call for a variant. A function that is frozen (``dr.freeze``) needs it as an argument.
    """
    if mi.variant() not in _tables:
        with np.load(FILE) as file:
            cells = file["table"]
        padded = np.zeros((*cells.shape[:2], 8), np.float32)
        padded[..., : cells.shape[2]] = cells
        _tables[mi.variant()] = mi.Float(padded.ravel())
    return _tables[mi.variant()]


def lobe(alpha, wi, cells=None, active=True) -> Lobe:
    """The lobe of isotropic GGX with roughness `alpha` (of the distribution, not its square root) seen from `wi`.

    `wi`: unit Vector3f with z >= 0; `alpha` is clamped to [0.001, 1] (anisotropic: take the root of the product).
    `cells`: `table()`, which is the default. Look it up once, for all lights.
    Bilinear over sqrt(α) and sqrt(1 - cos θ).
    """
    cells = table() if cells is None else cells
    size = round((dr.width(cells) // 8) ** 0.5)
    cos_theta = dr.clip(wi.z, COS_MIN, 1)
    alpha = dr.clip(alpha, ALPHA_MIN, 1)
    low, high = ALPHA_MIN**0.5, (1 - COS_MIN) ** 0.5
    q, b = _bilinear(cells, size, (dr.sqrt(alpha) - low) / (1 - low), dr.sqrt(1 - cos_theta) / high, active)
    m11, m22, m13 = entries(q, alpha, cos_theta)

    across = dr.squared_norm(wi.xy)
    is_round = across < 1e-12
    scale = dr.rsqrt(dr.select(is_round, 1, across))
    cos_phi, sin_phi = dr.select(is_round, 1, wi.x * scale), dr.select(is_round, 0, wi.y * scale)
    return Lobe(mi.Vector3f(cos_phi, sin_phi, -m13) / m11, mi.Vector2f(-sin_phi, cos_phi) / m22, q.w, b.x)


def to_cosine(lobe: Lobe, v):
    """M^-1 v: the vector (vertex, centre or axis) where the lobe is a clamped cosine. Heights z are kept."""
    return mi.Vector3f(dr.dot(lobe.x, v), dr.dot(lobe.y, v.xy), v.z)


def reflected(shape, diffuse, f0, lobe: Lobe | None, integrate=integrate_polygon):
    """Unshadowed radiance reflected towards `wi` of a light of radiance 1: ``diffuse E(P) + albedo(F0) E(M^-1 P)``.

    `shape`: what `integrate` takes (the vertices of a polygon, or a disk's centre and axes). `diffuse`: albedo of the
    Lambert lobe; `f0`: Fresnel reflectance at the normal; each Float or Color3f. `lobe` None: Lambert only.
    Measured against GGX, over the largest value: 0.2 to 4 % in the mean, 1 to 11 % for nine polygons in ten; more where
    near lights meet grazing views (cos θ = 0.2: up to a third). It is good enough as a weight for sampling, but not as
    an image. Both terms see the light from either side: leave out lights that do not emit towards the origin. Heitz et
    al. 2016, section 5 (with a Schlick term in the albedo alone: the lobe's shape is that of Fresnel = 1).
    """
    value = diffuse * integrate(shape)
    if lobe is not None:
        value += (f0 * lobe.a + (1 - f0) * lobe.b) * integrate([to_cosine(lobe, v) for v in shape])
    return value


def _bilinear(cells, size: int, row, column, active):
    """The two Vector4f of a cell at `row`, `column` in [0, 1], interpolated."""
    row, column = row * (size - 1), column * (size - 1)
    i, j = dr.minimum(mi.UInt32(row), size - 2), dr.minimum(mi.UInt32(column), size - 2)
    u, v = row - mi.Float(i), column - mi.Float(j)
    values = []
    for half in range(2):
        corner = 2 * (i * size + j) + half
        at = [dr.gather(mi.Vector4f, cells, corner + k, active) for k in (0, 2, 2 * size, 2 * size + 2)]
        values.append(dr.lerp(dr.lerp(at[0], at[1], v), dr.lerp(at[2], at[3], v), u))
    return values
