"""A biased image, corrected scale by scale by what an unbiased one says.

With B a biased image of little noise and D an estimate of E[U - B], whose mean is minus the bias and whose variance is
known,

    I = B + g Σ_s w_s h_s,     D / g = Σ_s h_s,     w_s = (1 - 1/e_s)_+ ramp(e_s; κ, 2κ),     e_s = <h_s² / Var[h_s]>

h_s are differences of the relative correction D/g between neighbouring scales, the coarsest being its mean over the
image, and e_s the energy at a place over that of its noise. What stands out of the noise is corrected: a cache that is
everywhere too dark after a few samples a pixel, fine detail after many. All w_s tend to 1, and I to the unbiased image,
as the variance falls (shrinkage of James and Stein by scale and place, with a threshold, since the noise of paths can
be a hundred times the bias). Where B is noisy, too, a share v_B / (v_B + v_U) of D counts beforehand
(:func:`share_of_noise`). Pure NumPy: nothing here knows a renderer.
"""

from __future__ import annotations

import numpy as np

#: κ: by how much the energy at a scale must exceed that of its noise, which is known but roughly, to count at all.
#: Staircase and ajar door, 160x90, 8 to 128 samples: 1.5 to 6 differ by less than a fifth.
CAUTION = 1.5
#: Ratio of neighbouring scales. 2: the same within 1 % for 7 scales instead of 5; 4: errors up to 15 % larger.
STEP = 3
#: Radius over which g is smoothed: the noise of B in it would make the mean of D/g too large.
LEVEL_RADIUS = 2
#: Part of the image's mean level that g has everywhere, so that dark places are not divided by nothing.
FLOOR = 0.02
#: Part of the image's mean level that is added to the level where noise is compared, and share of the largest values
#: that is left out of such means.
FLOOR_OF_NOISE, TRIM = 0.1, 0.002


def box_mean(values: np.ndarray, radius: int) -> np.ndarray:
    """Means over squares of ``2 radius + 1`` pixels, cut at the borders; shape (..., height, width)."""
    if radius <= 0:
        return values
    for axis in (-2, -1):
        n = values.shape[axis]
        shape = list(values.shape)
        shape[axis] += 1
        sums = np.zeros(shape)
        if axis == -1:
            np.cumsum(values, axis=axis, out=sums[..., 1:])
        else:  # several times as fast as NumPy's sums over rows
            for y in range(n):
                np.add(sums[..., y, :], values[..., y, :], out=sums[..., y + 1, :])
        i = np.arange(n)
        high, low = np.minimum(i + radius + 1, n), np.maximum(i - radius, 0)
        values = sums.take(high, axis) - sums.take(low, axis)
        values *= (1 / (high - low)).reshape((-1, 1) if axis == -2 else (-1,))
    return values


def smooth(values: np.ndarray, radius: int) -> np.ndarray:
    """Two box means, which have no edges to be seen; shape (..., height, width)."""
    return box_mean(box_mean(values, radius), radius)


def trimmed_mean(values: np.ndarray) -> float:
    """Mean without the largest of the values."""
    flat = values.ravel()
    n = max(1, round(flat.size * (1 - TRIM)))
    return float((np.partition(flat, n - 1)[:n] if n < flat.size else flat).mean())


def scale_of(level: np.ndarray) -> np.ndarray:
    """What noise is compared relative to: the smoothed `level` of an image, shapes (height, width, channels), and a
    part of its mean."""
    mean = np.maximum(level, 0).mean(axis=-1)
    return smooth(mean, LEVEL_RADIUS)[..., None] + max(FLOOR_OF_NOISE * float(mean.mean()), 1e-30)


def share_of_noise(variance_biased: np.ndarray, variance_unbiased: np.ndarray, level: np.ndarray) -> float:
    """Weight of the unbiased image in the mean of both that has the least variance, one number for all pixels, since
    weights that go with a pixel's own noise make the mean wrong. Shapes (height, width, channels)."""
    g2 = scale_of(level) ** 2
    biased, unbiased = trimmed_mean(variance_biased / g2), trimmed_mean(variance_unbiased / g2)
    return biased / (biased + unbiased) if np.isfinite(biased) and biased > 0 and np.isfinite(unbiased) else 0.0


def correction(difference: np.ndarray, variance: np.ndarray, level: np.ndarray, caution: float = CAUTION) -> np.ndarray:
    """The part of `difference` that stands out of its noise.

    `difference` and its `variance`: shape (height, width, channels); `level`: positive, of the same shape, what the
    correction is thought relative to. Returns `difference` itself where the variance is 0, and 0 where it is not
    finite.
    """
    ok = np.isfinite(difference) & np.isfinite(variance)
    planes = np.ascontiguousarray(np.moveaxis(np.maximum(level, 0), -1, 0))
    g = np.moveaxis(smooth(planes, LEVEL_RADIUS), 0, -1) + max(FLOOR * float(level.mean()), 1e-30)
    # Plain means: weights by the noise that is seen favour places which rare bright paths have not yet met
    v = np.mean(np.where(ok, variance, 0) / g**2, axis=-1)
    r = np.ascontiguousarray(np.moveaxis(np.where(ok, difference, 0) / g, -1, 0))
    weight = None if ok.all() else 1.0 * ok.all(axis=-1)
    if weight is not None:
        r, v = r * weight, v * weight

    def average(radius):
        mean, variance = smooth(r, radius), smooth(v, radius)
        if weight is not None:
            w = np.maximum(smooth(weight, radius), 1e-100)
            mean, variance = mean / w, variance / w**2
        # Two box means of radius R weigh as one square of (2R + 1)² * 9/4 pixels
        n = min((2 * radius + 1) ** 2 * 2.25 if radius else 1.0, v.size)
        return mean, variance / n

    scales = [0]
    while (radius := max(STEP * scales[-1], 1)) < min(v.shape) // 4:
        scales.append(radius)
    means = [average(s) for s in scales]
    total_weight = v.size if weight is None else max(weight.sum(), 1e-300)
    total = np.sum(r, axis=(1, 2), keepdims=True) / total_weight
    means.append((np.broadcast_to(total, r.shape), np.full_like(v, v.sum() / total_weight**2)))
    out = means[-1][0] * _weight(_square(means[-1][0]) / np.maximum(means[-1][1], 1e-30), caution)
    for k in range(len(scales)):
        (fine, var_fine), (coarse, var_coarse) = means[k], means[k + 1]
        h = fine - coarse
        # Both over a window: a single bright path is in the differences of all its neighbours
        radius = 2 * max(scales[k], 1)
        noise = smooth(np.maximum(var_fine - var_coarse, 0), radius)
        out = out + h * _weight(smooth(_square(h) / np.maximum(noise, 1e-30), radius), caution)
    return np.where(ok, np.moveaxis(out, 0, -1) * g, 0)


def _square(h):
    return np.mean(h**2, axis=0)


def _weight(energy, caution):
    return np.maximum(1 - 1 / np.maximum(energy, 1), 0) * np.clip(energy / caution - 1, 0, 1)
