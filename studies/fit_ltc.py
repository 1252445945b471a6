"""Fit the table of linearly transformed cosines for GGX and write `ltc_ggx.npz` in the folder of `mi_neural.lights`.

``python studies/fit_ltc.py`` (needs SciPy; half a minute on one core). Heitz, Dupuy, Hill, Neubelt 2016,
"Real-time polygonal-light shading with linearly transformed cosines", section 5.

The BRDF is isotropic GGX with Smith's height-correlated masking and Fresnel = 1, times the cosine of the outgoing
direction. The view direction lies in the xz-plane, ``wi = (sin θ, 0, cos θ)``; z is the normal.

A cell's lobe is ``M = [[m11, 0, m13], [0, m22, 0], [0, 0, 1]]`` in the frame of the *normal*. The paper turns the frame
to the mean direction of the lobe; here the shear m13 does that work. The fits are closer where they are worst (relative
L3 error 0.15 against 0.19 at α = 0.5, θ = 60°; 0.15 against 0.28 at α = 0.1, θ = 84°) and a little less so where they
are good (0.03 against 0.01 at α = 0.1, θ = 45°). In return M keeps the horizon: no light is lost below it, and whatever
is above it reflects more than nothing.

Stored are the numbers of O(1) that `mi_neural.lights.ltc.entries` turns into m11, m22 and m13.
"""

from __future__ import annotations

import time

import numpy as np

from mi_neural.lights.ltc import ALPHA_MIN, COS_MIN, FILE, entries

#: Cells along each axis.
SIZE = 64


def roughness(size: int = SIZE) -> np.ndarray:
    """α of each row: uniform in sqrt(α), shape (size,)."""
    return np.linspace(np.sqrt(ALPHA_MIN), 1, size) ** 2


def cosines(size: int = SIZE) -> np.ndarray:
    """cos θ of each column: uniform in sqrt(1 - cos θ), shape (size,)."""
    return 1 - np.linspace(0, np.sqrt(1 - COS_MIN), size) ** 2


def view(cos_theta: float) -> np.ndarray:
    """View direction in the xz-plane, shape (3,)."""
    return np.array([np.sqrt(1 - cos_theta**2), 0, cos_theta])


def smith_lambda(z, alpha: float):
    """Smith's Λ of unit directions with normal component `z` (Heitz 2014, eq. 72)."""
    z2 = np.clip(z * z, 1e-12, 1)
    return (np.sqrt(1 + alpha**2 * (1 - z2) / z2) - 1) / 2


def ggx(wi, wo, alpha: float):
    """BRDF x cosine, its density under sampling of visible normals, and Schlick's ``(1 - cos)^5``; each of shape (n,).

    `wi` (3,), `wo` (n, 3): unit vectors, `wo` over the whole sphere; BRDF x cosine is 0 below the horizon, the density
    (over solid angle) is not. Walter et al. 2007, eq. 20 and 33; Heitz 2014, eq. 99 (height-correlated).
    """
    h = wi + wo
    h = h / np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-12)
    t = (h[:, 0] ** 2 + h[:, 1] ** 2) / alpha**2 + h[:, 2] ** 2
    D = np.where(h[:, 2] > 0, 1 / (np.pi * alpha**2 * t**2), 0)
    at_wi, at_wo = smith_lambda(wi[2], alpha), smith_lambda(wo[:, 2], alpha)
    f_cos = np.where(wo[:, 2] > 0, D / (1 + at_wi + at_wo), 0) / (4 * wi[2])
    return f_cos, D / (1 + at_wi) / (4 * wi[2]), (1 - np.clip(h @ wi, 0, 1)) ** 5


def stratified(n: int):
    """Midpoints of n x n cells of the unit square: two arrays of shape (n²,)."""
    u = (np.arange(n) + 0.5) / n
    return tuple(a.ravel() for a in np.meshgrid(u, u))


def sample_visible(wi, alpha: float, n: int) -> np.ndarray:
    """n² stratified directions reflected by visible normals, those with y > 0 only, shape (n², 3).

    Spherical caps: Dupuy and Benyoub 2023. Directions below the horizon are kept.
    """
    u, v = stratified(n)
    stretched = wi * [alpha, alpha, 1]
    stretched /= np.linalg.norm(stretched)
    z = (1 - v) * (1 + stretched[2]) - stretched[2]
    r = np.sqrt(np.clip(1 - z * z, 0, 1))
    h = (np.stack([r * np.cos(np.pi * u), r * np.sin(np.pi * u), z], -1) + stretched) * [alpha, alpha, 1]
    h /= np.maximum(np.linalg.norm(h, axis=-1, keepdims=True), 1e-12)
    return 2 * (h @ wi)[:, None] * h - wi


def uniform_hemisphere(n: int) -> np.ndarray:
    """n² stratified directions, those with y > 0 only, shape (n², 3)."""
    u, z = stratified(n)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(np.pi * u), r * np.sin(np.pi * u), z], -1)


def quadrature(alpha: float, cos_theta: float, n: int):
    """Directions (m, 3), BRDF x cosine (m,) and weights (m,) such that ``sum(weights g)`` is ∫ g dω.

    Over the hemisphere, for `g` even in y. Three techniques in balance: visible normals of this lobe and of one twice
    as wide, and uniform directions, since a transformed cosine can be wider than the lobe.
    """
    wi, wide = view(cos_theta), min(2 * alpha, 1.5)
    parts = [sample_visible(wi, alpha, n), sample_visible(wi, wide, n), uniform_hemisphere(n // 2)]
    wo = np.concatenate(parts)
    f_cos, pdf, _ = ggx(wi, wo, alpha)
    total = len(parts[0]) * pdf + len(parts[1]) * ggx(wi, wo, wide)[1] + len(parts[2]) / (2 * np.pi)
    return wo, f_cos, np.where(wo[:, 2] > 0, 1 / total, 0)


def albedos(alpha: float, cos_theta: float, n: int = 96):
    """(a, b): reflected share of unit radiance at Fresnel 1, and with Schlick's ``(1 - cos)^5``: F0 a + (1 - F0) b."""
    wi = view(cos_theta)
    f_cos, pdf, schlick = ggx(wi, sample_visible(wi, alpha, n), alpha)
    weight = f_cos / np.maximum(pdf, 1e-30)
    return weight.mean(), (weight * schlick).mean()


def density(wo, m11, m22, m13):
    """Transformed cosine ``cos(M^-1 ω)/π |M^-1| / |M^-1 ω|³`` over solid angle, shape (n,). Heitz et al., eq. 1."""
    x, y, z = (wo[:, 0] - m13 * wo[:, 2]) / m11, wo[:, 1] / m22, np.maximum(wo[:, 2], 0)
    return z / (np.pi * m11 * m22 * (x * x + y * y + z * z) ** 2)


def unpack(x) -> np.ndarray:
    """Parameters of the search, ``log q11, log q22, q13``, as (q11, q22, q13)."""
    return np.array([np.exp(x[0]), np.exp(x[1]), x[2]])


def fit_cell(alpha: float, cos_theta: float, starts, n: int = 32):
    """(q11, q22, q13) that minimise ∫ |f cos - a ltc|³ dω, and the cube root of that over ∫ (f cos)³ dω.

    Nelder-Mead from the best of `starts` (each a triple q). At cos θ = 1 the lobe is round: q22 follows from q11.
    """
    from scipy.optimize import minimize

    wo, f_cos, weight = quadrature(alpha, cos_theta, n)
    weight = weight / (weight @ f_cos**3)
    a = albedos(alpha, cos_theta)[0]
    is_round = cos_theta == 1

    def q_of(x):
        return unpack([x[0], x[0] - np.log(1 + alpha**2), 1.0] if is_round else x)

    def error(x):
        if np.abs(x).max() > 6:
            return 1e6
        return weight @ np.abs(f_cos - a * density(wo, *entries(q_of(x), alpha, cos_theta))) ** 3

    starts = [np.array([np.log(q[0]), np.log(q[1]), q[2]])[: 1 if is_round else 3] for q in starts]
    start = min(starts, key=error)
    simplex = np.vstack([start, start + 0.1 * np.eye(len(start))])
    options = {"initial_simplex": simplex, "maxiter": 400, "xatol": 1e-5, "fatol": 1e-9}
    found = minimize(error, start, method="Nelder-Mead", options=options)
    return q_of(found.x), found.fun ** (1 / 3)


def fit(size: int = SIZE, report=print) -> tuple[np.ndarray, np.ndarray]:
    """The table (size, size, 5) of ``q11, q22, q13, a, b`` over (α, θ), and each cell's relative error."""
    table, error = np.zeros((size, size, 5)), np.zeros((size, size))
    above = [np.array([1.0, 1.0, 0.0])] * size  # row of the next larger roughness; first rough lobes, almost cosines
    for i in reversed(range(size)):
        alpha, left = roughness(size)[i], None
        for j, cos_theta in enumerate(cosines(size)):
            q, error[i, j] = fit_cell(alpha, cos_theta, [s for s in (left, above[j]) if s is not None])
            left = above[j] = q
            table[i, j] = *q, *albedos(alpha, cos_theta)
        table[i, 0, 2] = table[i, 1, 2]  # there is no shear at cos θ = 1: the neighbour's, to interpolate with
        report(f"alpha {alpha:.4f}: relative error mean {error[i].mean():.3f}, worst {error[i].max():.3f}")
    return table, error


def main() -> None:
    start = time.perf_counter()
    table, error = fit()
    np.savez_compressed(FILE, table=table.astype(np.float32), alpha_min=np.float32(ALPHA_MIN))
    print(f"{FILE}: mean error {error.mean():.3f}, worst {error.max():.3f}, {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
