"""Errors of an image against a reference, and flicker between frames.

Every function takes linear RGB arrays of shape (height, width, 3), computes in float64 and returns plain floats.

Non-finite values never turn an error into NaN. In the *image* a pixel that holds one is treated as black, so it costs
what a missing pixel costs; :func:`count_nonfinite` counts them, and :class:`Errors` carries that count
beside the figures. In the *reference* they are an input error and raise ``ValueError``.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from math import ceil, log2, sqrt

import numpy as np

#: Rec. 709 luminance weights, as ``mi.luminance`` has them.
LUMINANCE = (0.212671, 0.715160, 0.072169)
#: Added to the squared luminance in the denominator of relMSE, for a reference of mean luminance 1.
RELMSE_EPSILON = 1e-2
#: Share of the largest values that trimmed relMSE leaves out: 0.1 %.
TRIM_FRACTION = 1e-3
#: Added to the denominator of SMAPE, relative to the mean magnitude of the two images.
SMAPE_EPSILON = 1e-2
#: Brightness at which FLIP's tone mapper counts as saturated (FLIP for HDR, section 4.2).
FLIP_SATURATION = 0.85
#: Coefficients of the ACES curve inside FLIP: (t0 x^2 + t1 x + t2) / (t3 x^2 + t4 x + t5).
FLIP_ACES = (0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.0, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14)


@dataclass(frozen=True)
class FlipExposures:
    """Exposures over which HDR-FLIP takes its maximum: `num` steps from `start` to `stop`, in stops (log2)."""

    start: float
    stop: float
    num: int


@dataclass(frozen=True)
class Flip:
    """Mean HDR-FLIP in [0, 1], its map of shape (height, width), and the exposures it was computed with."""

    mean: float
    map: np.ndarray
    exposures: FlipExposures


@dataclass(frozen=True)
class Errors:
    """What one image is worth against a reference. `nonfinite` counts the image's pixels that were treated as black."""

    relmse: float
    relmse_trimmed: float
    flip: float
    nonfinite: int


def luminance(image: np.ndarray) -> np.ndarray:
    """Rec. 709 luminance of linear RGB, shape (height, width)."""
    return np.asarray(image, np.float64) @ np.array(LUMINANCE)


def block_means(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """The image with the height and width that `shape` begins with: means over blocks of pixels, float64. One of that
    height and width is returned as it is.

    A block holds a NaN or an infinity if one of its pixels does. Raises ``ValueError`` where blocks would not be whole.
    """
    (h, w), (height, width) = image.shape[:2], shape[:2]
    if (h, w) == (height, width):
        return image
    if h % height or w % width:
        raise ValueError(f"{w}x{h} pixels are no whole blocks for {width}x{height}")
    blocks = image.reshape(height, h // height, width, w // width, *image.shape[2:])
    return blocks.mean(axis=(1, 3), dtype=np.float64)


def count_nonfinite(image: np.ndarray) -> int:
    """Number of pixels with a NaN or an infinity in any channel."""
    return int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))


def relmse(image: np.ndarray, reference: np.ndarray, variance: np.ndarray | None = None) -> float:
    """Relative mean squared error: mean of (I - R)^2 / (lum(R)^2 + 1e-2), both scaled so that the mean of lum(R) is 1.

    `variance` is the variance of the reference *mean*, per value, same shape. As E (I - R)^2 = (I - E R)^2 + Var R, it
    is subtracted from each squared error, and so the result estimates the error against the unknown exact image. Single
    values may become negative in this; a negative mean is returned as 0, which reads "below what this reference
    resolves".

    A black reference is not scaled. Raises ``ValueError`` for unequal shapes and for a non-finite reference.
    """
    raw, noise = relative_squared_errors(image, reference, variance)
    return max(0.0, float((raw - noise).mean()))


def relmse_trimmed(image: np.ndarray, reference: np.ndarray, variance: np.ndarray | None = None) -> float:
    """:func:`relmse` without the largest 0.1 % of its values (one value is one channel of one pixel).

    Values are ranked by the error as measured; the variance of the reference is then subtracted from those that are
    kept. Simulated with Gaussian and with firefly-like reference noise, this order lies nearer to the trimmed error
    against the exact image than subtracting first does. Both lie a little below it: by a few percent of the reference's
    own noise.
    """
    raw, noise = (values.ravel() for values in relative_squared_errors(image, reference, variance))
    n_kept = max(1, raw.size - ceil(TRIM_FRACTION * raw.size))
    kept = np.argpartition(raw, n_kept - 1)[:n_kept]
    return max(0.0, float((raw[kept] - noise[kept]).mean()))


def relative_weights(brightness: np.ndarray) -> np.ndarray:
    """What relMSE multiplies squared errors with, by the luminance of the reference; same shape."""
    scale = 1.0 / brightness.mean() if brightness.mean() > 0.0 else 1.0
    return scale**2 / ((scale * brightness) ** 2 + RELMSE_EPSILON)


def relative_squared_errors(
    image: np.ndarray, reference: np.ndarray, variance: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The values that :func:`relmse` averages, and the part of each that the reference's variance explains.

    Two arrays of shape (height, width, 3); the second is 0 without a `variance`.
    """
    image, reference = _checked_pair(image, reference)
    weight = relative_weights(luminance(reference))[..., None]

    if variance is None:
        variance = np.zeros_like(reference)
    variance = np.asarray(variance, np.float64)
    if variance.shape != reference.shape:
        raise ValueError(f"variance has shape {variance.shape}, its reference {reference.shape}: they must be equal")
    if not np.isfinite(variance).all() or (variance < 0.0).any():
        raise ValueError("the variance of the reference has negative or non-finite values: render the reference anew")
    return weight * (image - reference) ** 2, weight * variance


def bias_and_variance(
    images: list[np.ndarray], reference: np.ndarray, variance: np.ndarray | None = None
) -> tuple[float, float]:
    """Relative squared bias and variance of one image, from two or more independent images of an estimator.

    Their sum is the images' mean trimmed relMSE. The bias is estimated without the noise of the images, from products
    of different ones: E[(I_j - R)(I_k - R)] = (E I - R)^2 for all pairs, which is the mean over all ways to halve the
    images and multiply; what the noise of the reference adds to it (`variance`, as in :func:`relmse`) is subtracted. It
    may come out negative where it is below what the samples resolve. Values are ranked for trimming by their mean
    squared error, from which the products' sign does not follow. Raises ``ValueError`` for fewer than two images.
    """
    n = len(images)
    if n < 2:
        raise ValueError(f"bias and variance need two images or more, got {n}")
    total = np.mean([relative_squared_errors(image, reference)[0] for image in images], axis=0)
    mean = np.mean([_black_where_nonfinite(_as_image(image, "image")) for image in images], axis=0)
    of_mean, noise = relative_squared_errors(mean, reference, variance)
    order = np.argsort(total, axis=None)[: max(1, total.size - ceil(TRIM_FRACTION * total.size))]
    squared = (n * of_mean - total) / (n - 1) - noise
    spread = n * (total - of_mean) / (n - 1)
    return float(squared.ravel()[order].mean()), float(spread.ravel()[order].mean())


def smape(image: np.ndarray, previous: np.ndarray, epsilon: float = SMAPE_EPSILON) -> float:
    """Symmetric mean absolute percentage error with the factor 2: mean of 2 |a - b| / (|a| + |b| + eps), in [0, 2].

    eps is `epsilon` times the mean of (|a| + |b|) / 2, so that the figure does not depend on the images' unit. Two
    black images have 0. Raises ``ValueError`` for unequal shapes; non-finite pixels count as black in either image.
    """
    return float(smape_map(image, previous, epsilon).mean())


def smape_map(image: np.ndarray, previous: np.ndarray, epsilon: float = SMAPE_EPSILON) -> np.ndarray:
    """What :func:`smape` averages, as the mean of the channels: shape (height, width), values in [0, 2]."""
    a, b = _as_image(image, "image"), _as_image(previous, "previous image")
    _check_same_shape(a, b, "previous image")
    a, b = _black_where_nonfinite(a), _black_where_nonfinite(b)

    magnitude = np.abs(a) + np.abs(b)
    if magnitude.max() == 0.0:
        return np.zeros(a.shape[:2])
    return (2.0 * np.abs(a - b) / (magnitude + epsilon * 0.5 * magnitude.mean())).mean(axis=-1)


def flip_exposures(reference: np.ndarray) -> FlipExposures:
    """The exposures that HDR-FLIP chooses for this reference; hold them fixed over the frames of a sequence.

    start and stop put the brightest and the median pixel at 85 % of the tone curve: log2(x / max), log2(x / median).
    Computed here as `flip_evaluator` ends the process on a black reference. Where the median is 0 (an object before
    nothing) the median of the lit pixels is used instead; a black reference gets the single exposure 0.
    """
    reference = _as_reference(reference)
    lum = luminance(np.maximum(reference, 0.0))
    lit = lum[lum > 0.0]
    if lit.size == 0:
        return FlipExposures(0.0, 0.0, 1)
    median = _upper_median(lum) or _upper_median(lit)

    # Solve tonemap(x) = saturation for the larger root
    t, (t0, t1, t2, t3, t4, t5) = FLIP_SATURATION, FLIP_ACES
    a, b, c = t0 - t * t3, t1 - t * t4, t2 - t * t5
    root = sqrt(b * b - 4.0 * a * c)
    x = max((-b + root) / (2.0 * a), (-b - root) / (2.0 * a))

    start, stop = log2(x / lit.max()), log2(x / median)
    return FlipExposures(start, stop, max(2, ceil(stop - start)))


def flip(image: np.ndarray, reference: np.ndarray, exposures: FlipExposures | None = None) -> Flip:
    """HDR-FLIP by `flip_evaluator` at its default viewing distance (67 pixels a degree).

    Without `exposures` those of :func:`flip_exposures` for this reference are used. Negative values count as 0. Raises
    ``ValueError`` for unequal shapes, a non-finite reference, or exposures that run backwards.

    Source: Andersson et al. 2021, Visualizing Errors in Rendered High Dynamic Range Images.
    """
    image, reference = _checked_pair(image, reference)
    exposures = exposures or flip_exposures(reference)
    if exposures.start > exposures.stop or exposures.num < 1:
        raise ValueError(f"FLIP exposures must rise from start to stop in at least one step, got {exposures}")

    largest = np.finfo(np.float32).max
    error_map, mean, _ = _flip_evaluator().evaluate(
        np.ascontiguousarray(np.clip(reference, 0.0, largest), np.float32),
        np.ascontiguousarray(np.clip(image, 0.0, largest), np.float32),
        "HDR",
        applyMagma=False,
        parameters={
            "startExposure": exposures.start,
            "stopExposure": exposures.stop,
            "numExposures": exposures.num,
        },
    )
    return Flip(float(mean), np.array(error_map, np.float32).reshape(reference.shape[:2]), exposures)


def errors(
    image: np.ndarray,
    reference: np.ndarray,
    variance: np.ndarray | None = None,
    exposures: FlipExposures | None = None,
) -> tuple[Errors, Flip]:
    """All errors of one image at once, with the FLIP map for pictures; arguments and raises as of the parts."""
    flip_result = flip(image, reference, exposures)
    return (
        Errors(
            relmse=relmse(image, reference, variance),
            relmse_trimmed=relmse_trimmed(image, reference, variance),
            flip=flip_result.mean,
            nonfinite=count_nonfinite(image),
        ),
        flip_result,
    )


# ------------------------------------------------------------------------------------------------------------------


@cache
def _flip_evaluator():
    """`flip_evaluator`, whose OpenMP threads sleep while they wait.

    By default they spin: with Dr.Jit's own threads on the same cores FLIP then took 0.7 s instead of 1 ms, and what is
    timed right after it would share the cores with them. OpenMP reads the variable once, when its library is loaded.
    """
    chosen = os.environ.get("OMP_WAIT_POLICY")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    try:
        import flip_evaluator
    finally:
        if chosen is None:
            del os.environ["OMP_WAIT_POLICY"]
    return flip_evaluator


def _upper_median(values: np.ndarray) -> float:
    """The middle value; of two the larger, as FLIP takes it."""
    return float(np.partition(values.ravel(), values.size // 2)[values.size // 2])


def _as_image(image: np.ndarray, name: str) -> np.ndarray:
    image = np.asarray(image, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"{name} has shape {image.shape}, expected (height, width, 3) with at least one pixel")
    return image


def _as_reference(reference: np.ndarray) -> np.ndarray:
    reference = _as_image(reference, "reference")
    if n := count_nonfinite(reference):
        raise ValueError(f"the reference has {n} non-finite pixels and cannot be compared with: render it anew")
    return reference


def _black_where_nonfinite(image: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(image).all(axis=-1, keepdims=True), image, 0.0)


def _check_same_shape(image: np.ndarray, other: np.ndarray, name: str) -> None:
    if image.shape != other.shape:
        (h, w), (other_h, other_w) = image.shape[:2], other.shape[:2]
        raise ValueError(f"the image is {w}x{h}, the {name} {other_w}x{other_h}: they must be equal")


def _checked_pair(image: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    image, reference = _as_image(image, "image"), _as_reference(reference)
    _check_same_shape(image, reference, "reference")
    return _black_where_nonfinite(image), reference
