"""Linearly transformed cosines: form factors and GGX against sums over the light's area in float64; their limits."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from load_study import load_study

from mi_neural.lights import ltc

fit_ltc = load_study("fit_ltc")

GRID = 160  # points of a brute-force sum along each axis of a light


def arrays(vertices) -> list:
    """Vertices of n polygons, (n, k, 3), as k Vector3f."""
    return [mi.Vector3f(np.ascontiguousarray(v, np.float32)) for v in np.transpose(np.asarray(vertices), (1, 2, 0))]


def form_factors(vertices) -> np.ndarray:
    return np.array(ltc.integrate_polygon(arrays(vertices)))


def random_parallelograms(rng, n, size, distance=(0.7, 3.0)) -> np.ndarray:
    """(n, 4, 3): in all directions, also below the horizon; half-axes of about `size`."""
    centre = rng.normal(size=(n, 3))
    centre *= rng.uniform(*distance, (n, 1)) / np.linalg.norm(centre, axis=1, keepdims=True)
    u, v = rng.normal(size=(2, n, 3)) * size
    return np.stack([centre - u - v, centre + u - v, centre + u + v, centre - u + v], 1)


def summable(polygons, distance) -> np.ndarray:
    """Those whose plane is farther than `distance` from the origin: cells of a sum must be small against it."""
    normal = np.cross(polygons[:, 1] - polygons[:, 0], polygons[:, 2] - polygons[:, 0])
    return polygons[np.abs((normal * polygons[:, 0]).sum(1)) > distance * np.linalg.norm(normal, axis=1)]


def points_on(polygon, n=GRID):
    """Midpoints (m, 3) and areas with signed normal (m, 3) of the cells of a triangle or convex quad, in float64."""
    s, t = ((a.ravel() + 0.5) / n for a in np.meshgrid(np.arange(n), np.arange(n)))
    parts = []
    for k in range(1, len(polygon) - 1):
        o, a, b = polygon[0], polygon[k] - polygon[0], polygon[k + 1] - polygon[0]
        # t = 0 is a vertex: the square folded onto the triangle, with Jacobian t
        p = o + t[:, None] * ((1 - s)[:, None] * a + s[:, None] * b)
        parts.append((p, t[:, None] * np.cross(a, b) / n**2))
    return tuple(np.concatenate(x) for x in zip(*parts, strict=True))


def solid_angles(p, area):
    """Directions (m, 3) and solid angles (m,) of the cells seen from the origin."""
    r2 = (p * p).sum(-1)
    return p / np.sqrt(r2)[:, None], np.abs((p * area).sum(-1)) / r2**1.5


def brute_force(p, area) -> float:
    """1/π ∫ max(cos θ, 0) dω."""
    d, solid = solid_angles(p, area)
    return float(np.maximum(d[:, 2], 0) @ solid / np.pi)


# ---------------------------------------------------------------- polygons


@pytest.mark.parametrize("size, n_vertices", sweep(
    [(size, n) for size in (1e-3, 0.1, 0.5, 1.5) for n in (3, 4)], [(1e-3, 4), (0.5, 3), (1.5, 4)]
))  # fmt: skip
def test_form_factor_is_that_of_brute_force(n_vertices, size, rng):
    polygons = summable(random_parallelograms(rng, 40, size), 0.05 * size)[:24, :n_vertices]
    clipped = ((polygons[..., 2] > 0).any(1) & (polygons[..., 2] < 0).any(1)).sum()
    expected = np.array([brute_force(*points_on(p)) for p in polygons])
    error = np.abs(form_factors(polygons) - expected)
    print(f"size {size}: {clipped} of {len(polygons)} cut, largest error {error.max():.1e} of {expected.max():.1e}")
    assert (error < 2e-4 * expected.max() + 1e-3 * expected).all()


def test_irregular_quads_and_other_polygons_are_summed_as_well(rng):
    """A convex n-gon is as much as its triangles."""
    frame = np.linalg.qr(rng.normal(size=(64, 3, 3)))[0]
    angles = np.sort(rng.uniform(0, 2 * np.pi, (64, 5)), axis=1)
    flat = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], -1)
    polygons = flat @ frame + rng.normal(size=(64, 1, 3))
    parts = [form_factors(polygons[:, [0, k, k + 1]]) for k in (1, 2, 3)]
    np.testing.assert_allclose(form_factors(polygons), sum(parts), atol=3e-6)
    np.testing.assert_allclose(form_factors(polygons[:, :4]), sum(parts[:2]), atol=3e-6)


def test_form_factors_of_the_handbook():
    """Parallel unit squares at distance 1: from a corner's and from the centre's axis (Howell's catalogue)."""
    square = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    corner = 1 / np.sqrt(2) * np.arctan(1 / np.sqrt(2)) / np.pi
    assert form_factors([square])[0] == pytest.approx(corner, rel=1e-5)
    assert form_factors([2 * square - [1, 1, 1]])[0] == pytest.approx(4 * corner, rel=1e-5)


def test_whole_hemisphere_is_one_and_a_wall_one_half():
    plane = [[-1e4, -1e4, 1], [1e4, -1e4, 1], [1e4, 1e4, 1], [-1e4, 1e4, 1]]
    wall = [[-1e4, 1, -1e4], [1e4, 1, -1e4], [1e4, 1, 1e4], [-1e4, 1, 1e4]]
    assert form_factors([plane, wall]) == pytest.approx([1, 0.5], abs=2e-4)


def test_order_of_vertices_and_scale_do_not_matter(rng):
    polygons = random_parallelograms(rng, 256, 0.5)
    expected = form_factors(polygons)
    turned = polygons @ [[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]
    for same in (polygons[:, ::-1], np.roll(polygons, 1, axis=1), turned, polygons * 1e5, polygons * 1e-3):
        np.testing.assert_allclose(form_factors(same), expected, atol=5e-6)


def test_small_polygons_are_a_solid_angle_times_cosine(rng):
    """From the size at which the centre stands for the polygon down to 1e-6 of its distance, no digits are lost."""
    for size in (1e-2, 2e-3, 1e-3, 1e-4, 1e-6):
        polygons = random_parallelograms(rng, 4096, size).astype("f4").astype(float)
        area = np.cross(polygons[:, 1] - polygons[:, 0], polygons[:, 3] - polygons[:, 0])
        d, solid = solid_angles(polygons.mean(1), area)
        expected = np.maximum(d[:, 2], 0) * solid / np.pi
        inside = d[:, 2] > 5 * size
        error = np.abs(form_factors(polygons) - expected)[inside]
        print(f"size {size}: largest error {error.max():.1e} of {expected.max():.1e}")
        # besides the centre's cosine: rounding of vertices, relative to their distance
        assert (error < (20 * size**2 + 5e-4 + 1e-7 / size) * expected.max()).all()


def test_polygons_below_the_horizon_give_nothing_and_those_above_something(rng):
    polygons = random_parallelograms(rng, 4096, 0.3)
    above, E = polygons[..., 2].max(1) > 1e-3, form_factors(polygons)
    assert (E[polygons[..., 2].max(1) <= 0] == 0).all()
    assert (E[above] > 0).all() and 0.3 < above.mean() < 0.9


def test_degenerate_polygons_are_finite():
    o, x, y, z = np.zeros(3), np.eye(3)[0], np.eye(3)[1], np.eye(3)[2]
    cases = {
        "one point": [z, z, z, z],
        "a point on the horizon": [x, x, x, x],
        "a line": [z, x + z, 2 * x + z, 3 * x + z],
        "two vertices in one": [x + z, y + z, y + z, z],
        "edge-on": [z, 2 * z, x + 2 * z, x + z],
        "all at the origin": [o, o, o, o],
        "a vertex at the origin": [o, x + z, x + y + 2 * z, y + z],
        "an edge through the origin": [-x - z, x + z, x + y + z, -x + y - z],
        "around the origin": [-x - y, x - y, x + y, -x + y],
        "on the horizon": [x, 2 * x, 2 * x + y, x + y],
        "an edge on the horizon": [y - x, y + x, y + x + z, y - x + z],
        "a vertex on the horizon": [x, x + y + z, x + 2 * z, x - y + z],
        "opposite vertices": [z, x, -z, -x],
        "denormal heights": [x + 1e-40 * z, y - 1e-40 * z, -x + 1e-40 * z, -y],
        "huge": [1e25 * (x + z), 1e25 * (y + z), 1e25 * (z - x), 1e25 * (z - y)],
        "tiny": [1e-25 * (x + z), 1e-25 * (y + z), 1e-25 * (z - x), 1e-25 * (z - y)],
    }
    vertices = np.array(list(cases.values()))
    lobe = ltc.lobe(mi.Float(1e-3), mi.Vector3f(0.6, 0, 0.8))
    for n in (4, 3):
        for E in (form_factors(vertices[:, :n]), np.array(ltc.reflected(arrays(vertices[:, :n]), 0.0, 1.0, lobe))):
            bad = [name for name, e in zip(cases, E, strict=True) if not 0 <= e <= 1]
            assert not bad, bad
    E = dict(zip(cases, form_factors(vertices), strict=True))
    assert max(E[name] for name in ("one point", "a line", "edge-on", "on the horizon", "all at the origin")) < 1e-6
    # a wall of 2 x 1 at distance 1 that stands on the horizon
    expected = brute_force(*points_on(np.array(cases["an edge on the horizon"])))
    assert E["an edge on the horizon"] == pytest.approx(expected, rel=1e-3)


# ---------------------------------------------------------------- disks


def test_disk_is_that_of_brute_force(rng):
    """Disks and ellipses at 1.5 to 4 radii, some cut by the horizon: the polygon is within 2/1000 of the largest."""
    n = 32
    centre, u, v = rng.normal(size=(3, n, 3))
    centre *= rng.uniform(1.5, 4, (n, 1)) / np.linalg.norm(centre, axis=1, keepdims=True)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, v)
    v *= rng.uniform(0.3, 1, (n, 1)) / np.linalg.norm(v, axis=1, keepdims=True)
    found = np.array(ltc.integrate_disk(arrays(np.stack([centre, u, v], 1))))
    r, t = ((a.ravel() + 0.5) / GRID for a in np.meshgrid(np.arange(GRID), np.arange(GRID)))
    x, y = (np.sqrt(r) * np.cos(2 * np.pi * t))[:, None], (np.sqrt(r) * np.sin(2 * np.pi * t))[:, None]
    area = np.pi * np.cross(u, v) / GRID**2
    expected = np.array([brute_force(c + x * a + y * b, s) for c, a, b, s in zip(centre, u, v, area, strict=True)])
    error = np.abs(found - expected)
    print(f"largest error {error.max():.1e} of {expected.max():.1e}, mean {error.mean():.1e}")
    assert error.max() < 2e-3 * expected.max() and error.mean() < 2e-4 * expected.max()


def test_disk_above_its_centre_is_the_textbook_one():
    height = np.array([0.1, 0.3, 1, 3, 10])
    zero, one = np.zeros(5), np.ones(5)
    disk = np.stack([[zero, zero, height], [one, zero, zero], [zero, one, zero]]).transpose(2, 0, 1)
    assert np.array(ltc.integrate_disk(arrays(disk))) == pytest.approx(1 / (1 + height**2), rel=1e-2)
    assert np.array(ltc.integrate_disk(arrays(disk), 64)) == pytest.approx(1 / (1 + height**2), rel=2e-4)


# ---------------------------------------------------------------- GGX


def test_ggx_is_that_of_mitsuba(rng):
    """Up to masking, which Mitsuba takes as independent for both directions."""
    wi, wo = fit_ltc.view(0.6), rng.normal(size=(256, 3))
    wo[:, 2] = np.abs(wo[:, 2]) + 0.1
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    si = dr.zeros(mi.SurfaceInteraction3f, 256)
    si.wi = mi.Vector3f(*wi.tolist())
    for alpha in (0.1, 0.5):
        bsdf = mi.load_dict({"type": "roughconductor", "distribution": "ggx", "alpha": alpha, "material": "none"})
        at = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(wo.T.astype("f4"))))[0]
        a, b = fit_ltc.smith_lambda(wi[2], alpha), fit_ltc.smith_lambda(wo[:, 2], alpha)
        expected = at * (1 + a) * (1 + b) / (1 + a + b)
        np.testing.assert_allclose(fit_ltc.ggx(wi, wo, alpha)[0], expected, rtol=2e-3, atol=1e-6)


def test_table_is_finite_smooth_and_ordered():
    cells = np.load(ltc.FILE)["table"]
    assert cells.shape == (fit_ltc.SIZE, fit_ltc.SIZE, 5) and cells.dtype == np.float32
    assert np.isfinite(cells).all() and (cells[..., :2] > 0.5).all() and (cells[..., :2] < 2.5).all()
    assert (cells[..., 2] > -1e-3).all() and (cells[..., 2] < 1.001).all()
    a, b = cells[..., 3], cells[..., 4]
    assert (b >= 0).all() and (b <= a).all() and (a <= 1 + 1e-5).all()
    steps = max(np.abs(np.diff(cells, axis=k)).max() for k in (0, 1))
    assert steps < 0.9  # the last step to grazing views of sharp lobes; elsewhere far less
    assert np.abs(np.diff(cells[:, :-2], axis=1)).max() < 0.3


def test_fit_reproduces_cells_of_the_table():
    cells = np.load(ltc.FILE)["table"]
    for i, j in ((2, 20), (20, 0), (20, 40), (40, 55), (63, 10), (50, 62)):
        alpha, cos_theta = fit_ltc.roughness()[i], fit_ltc.cosines()[j]
        q, error = fit_ltc.fit_cell(alpha, cos_theta, [cells[i, max(j - 1, 0), :3] * [1.05, 0.95, 1]])
        np.testing.assert_allclose(q[:2], cells[i, j, :2], rtol=5e-3)
        assert j == 0 or q[2] == pytest.approx(cells[i, j, 2], abs=5e-3)
        np.testing.assert_allclose(fit_ltc.albedos(alpha, cos_theta), cells[i, j, 3:], atol=1e-5)
        assert error < 0.45


def test_albedos_are_those_of_monte_carlo(rng):
    u, v = rng.random((2, 400_000))
    wo = np.stack([np.sqrt(1 - u * u) * np.cos(2 * np.pi * v), np.sqrt(1 - u * u) * np.sin(2 * np.pi * v), u], -1)
    for alpha, cos_theta in ((0.25, 0.8), (0.5, 0.3), (1.0, 0.6)):
        f_cos, _, schlick = fit_ltc.ggx(fit_ltc.view(cos_theta), wo, alpha)
        lobe = ltc.lobe(mi.Float(alpha), mi.Vector3f(*fit_ltc.view(cos_theta).tolist()))
        assert lobe.a[0] == pytest.approx(2 * np.pi * f_cos.mean(), rel=1.5e-2)
        assert lobe.b[0] == pytest.approx(2 * np.pi * (f_cos * schlick).mean(), rel=1.5e-2, abs=1e-4)


def test_lobe_at_a_node_is_the_cell():
    cells = np.load(ltc.FILE)["table"].astype(float)
    for i, j in ((0, 5), (10, 30), (63, 63), (40, 0)):
        alpha, cos_theta = fit_ltc.roughness()[i], fit_ltc.cosines()[j]
        m11, m22, m13 = ltc.entries(cells[i, j, :3], alpha, cos_theta)
        lobe = ltc.lobe(mi.Float(alpha), mi.Vector3f(*fit_ltc.view(cos_theta).tolist()))
        np.testing.assert_allclose(np.array(lobe.x).ravel() * m11, [1, 0, -m13], rtol=2e-3, atol=1e-6)
        np.testing.assert_allclose(np.array(lobe.y).ravel() * m22, [0, 1], rtol=2e-3, atol=1e-6)
        np.testing.assert_allclose([lobe.a[0], lobe.b[0]], cells[i, j, 3:], atol=2e-3)


# (alpha, cos θ) -> tolerated error of nine polygons in ten, of all: what a cosine can do, over the largest integral
TOLERANCE = {
    (1.0, 0.9): (0.02, 0.05), (1.0, 0.5): (0.02, 0.10), (1.0, 0.2): (0.06, 0.25),
    (0.5, 0.9): (0.02, 0.08), (0.5, 0.5): (0.05, 0.20), (0.5, 0.2): (0.12, 0.50),
    (0.25, 0.9): (0.02, 0.05), (0.25, 0.5): (0.05, 0.15), (0.25, 0.2): (0.08, 0.20),
    (0.1, 0.9): (0.01, 0.03), (0.1, 0.5): (0.05, 0.10), (0.1, 0.2): (0.15, 0.20),
    (0.03, 0.7): (0.01, 0.02),
}  # fmt: skip


@pytest.mark.parametrize("alpha, cos_theta", sweep(TOLERANCE, [c for c in TOLERANCE if c[1] not in (0.5, 0.9)]))
def test_ggx_of_polygons_is_that_of_brute_force(alpha, cos_theta, rng):
    """Quads of three sizes around the mirror direction, some below the horizon; any azimuth of the view."""
    turn = rng.uniform(0, 2 * np.pi)
    rotation = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    wi = fit_ltc.view(cos_theta)
    lobe = ltc.lobe(mi.Float(alpha), mi.Vector3f(*(wi @ rotation).tolist()))
    errors = []
    for size in (0.1, 0.3, 1.0):
        polygons = random_parallelograms(rng, 40, size / 2, (0, 1.5 * min(alpha, 0.5) + size / 2))
        polygons = summable(polygons + 1.5 * wi * [-1, -1, 1], 0.1 * size)
        found = np.array(ltc.reflected(arrays(polygons @ rotation), 0.0, 1.0, lobe))
        cells = [solid_angles(*points_on(p, 64)) for p in polygons]
        expected = np.array([fit_ltc.ggx(wi, d, alpha)[0] @ solid for d, solid in cells])
        errors += (np.abs(found - expected) / expected.max()).tolist()
    most, worst = np.quantile(errors, 0.9), max(errors)
    print(f"alpha {alpha}, cos {cos_theta}: mean {np.mean(errors):.4f}, nine in ten {most:.3f}, worst {worst:.3f}")
    assert most < TOLERANCE[alpha, cos_theta][0] and worst < TOLERANCE[alpha, cos_theta][1]


def test_uniform_light_is_reflected_as_the_albedo(rng):
    plane = arrays([[[-1e5, -1e5, 1], [1e5, -1e5, 1], [1e5, 1e5, 1], [-1e5, 1e5, 1]]])
    for alpha, cos_theta, f0 in ((0.05, 0.9, 0.04), (0.3, 0.5, 0.5), (1.0, 0.1, 1.0)):
        lobe = ltc.lobe(mi.Float(alpha), mi.Vector3f(*fit_ltc.view(cos_theta).tolist()))
        expected = 0.25 + f0 * lobe.a[0] + (1 - f0) * lobe.b[0]
        assert ltc.reflected(plane, 0.25, f0, lobe)[0] == pytest.approx(expected, abs=1e-3)
        assert ltc.reflected(plane, 0.25, f0, None)[0] == pytest.approx(0.25, abs=1e-3)


def test_lobe_sees_whatever_is_above_the_horizon(rng):
    """M keeps the horizon: rough or sharp, a light that reaches the surface has a weight, one below it has none."""
    polygons = arrays(random_parallelograms(rng, 2048, 0.3))
    heights = np.max([np.array(v.z) for v in polygons], axis=0)
    for alpha in (0.05, 0.3, 1.0):
        lobe = ltc.lobe(mi.Float(alpha), dr.normalize(mi.Vector3f(0.7, -0.3, 0.5)))
        E = np.array(ltc.reflected(polygons, 0.0, 1.0, lobe))
        assert (E[heights > 1e-2] > 0).all() and (E[heights <= 0] == 0).all()


def test_extreme_roughness_and_views_are_finite(rng):
    polygons = arrays(random_parallelograms(rng, 512, 0.5))
    for alpha in (0.0, 1e-8, 1e-3, 0.5, 1.0, 7.0):
        for z in (1.0, 1e-4, 0.0, -0.5):
            wi = mi.Vector3f((1 - z * z) ** 0.5, 0, z)
            E = np.array(ltc.reflected(polygons, 0.0, 1.0, ltc.lobe(mi.Float(alpha), wi)))
            assert np.isfinite(E).all() and (E >= 0).all() and (E <= 1).all()


def test_colours_disks_loops_and_frozen_functions():
    """What a light sampler does: one lobe, a recorded loop over lights; the table is an argument."""

    def one(shift, lobe):
        disk = [mi.Vector3f(shift, 0, 1), mi.Vector3f(0.5, 0, 0), mi.Vector3f(0, 0.5, 0)]
        return ltc.reflected(disk, mi.Color3f(0.1, 0.5, 0.9), mi.Color3f(0.04), lobe, ltc.integrate_disk)

    @dr.freeze
    def frozen(cells, alpha, wi):
        lobe = ltc.lobe(alpha, wi, cells)
        _, total, _ = dr.while_loop(
            (mi.UInt32(0), mi.Color3f(0), lobe),
            lambda k, total, lobe: k < 3,
            lambda k, total, lobe: (k + 1, total + one(mi.Float(k), lobe), lobe),
        )
        return total

    for seed in range(3):
        alpha, wi = mi.Float([0.1 + 0.2 * seed, 0.5]), dr.normalize(mi.Vector3f([-0.5, 0.1 * seed], 0, 1))
        expected = sum(one(mi.Float(k), ltc.lobe(alpha, wi)) for k in range(3))
        np.testing.assert_allclose(np.array(frozen(ltc.table(), alpha, wi)), np.array(expected), rtol=1e-4)
    assert frozen.n_recordings <= 2
