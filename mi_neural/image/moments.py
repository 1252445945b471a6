"""Mean and variance of an image from its passes, wherever they were rendered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import metrics


class Accumulator:
    """Sample-weighted mean of passes. A pixel that is not finite in a pass is left out of that pass and counted."""

    def __init__(self) -> None:
        self.total: np.ndarray | None = None
        self.weight: np.ndarray | None = None
        self.spp = 0
        self.nonfinite = 0

    def add(self, image: np.ndarray, spp: int) -> None:
        """Add a developed film of shape (height, width, channels) that was rendered with `spp` samples a pixel."""
        image = np.asarray(image, np.float64)
        if self.total is None:
            self.total = np.zeros_like(image)
            self.weight = np.zeros((*image.shape[:2], 1))
        finite = np.isfinite(image).all(axis=-1, keepdims=True)
        n_bad = finite.size - np.count_nonzero(finite)
        self.total += spp * (np.where(finite, image, 0.0) if n_bad else image)
        self.weight += spp * finite
        self.nonfinite += n_bad
        self.spp += spp

    def sequence(self) -> tuple[int, int] | None:
        """The number of the sequence of stratified random numbers that the next pass goes on with, and how many samples
        of it there are. None: the pass must be independent of all others."""
        return 0, self.spp

    def replace(self, image: np.ndarray, spp: int) -> None:
        """Add a film that already stands for all passes so far, `spp` more samples a pixel included."""
        spp, nonfinite = spp + self.spp, self.nonfinite
        self.__init__()
        self.add(image, spp)
        self.nonfinite += nonfinite

    def mean(self) -> np.ndarray:
        """The mean so far, float32; black where no pass was finite."""
        return (self.total / np.maximum(self.weight, 1.0)).astype(np.float32)


class Moments(Accumulator):
    """Sample-weighted mean of passes, and the variance *of that mean* from the spread between the passes.

    Passes are independent, and a pass of n samples a pixel has variance σ²/n. With K passes and N samples in all,

        E[ Σ n (pass - mean)² ] = (K - 1) σ²,        variance of the mean = σ²/N,

    so that passes of different sizes count as they should. Two sets of passes are merged by :meth:`merge` (Chan, Golub,
    LeVeque 1983): whichever way passes are divided among workers, mean and variance are the same. A sampler that
    stratifies the samples of a pass is allowed for, since only whole passes are compared. A pixel that is not finite in
    a pass is left out of that pass.

    n_passes  number of passes that count, shape (height, width, 1)
    squares   Σ n (pass - mean)², shape (height, width, channels)
    """

    def __init__(self) -> None:
        super().__init__()
        self.n_passes: np.ndarray | None = None
        self.squares: np.ndarray | None = None

    def add(self, image: np.ndarray, spp: int) -> None:
        one = Moments()
        Accumulator.add(one, image, spp)
        one.n_passes, one.squares = (one.weight > 0).astype(np.float64), np.zeros_like(one.total)
        self.merge(one)

    def sequence(self) -> None:
        return None

    def replace(self, image: np.ndarray, spp: int) -> None:
        raise TypeError("the spread of passes cannot be taken from an image that stands for all of them")

    def merge(self, other: Moments) -> None:
        """Add the passes of `other`, which were rendered with other random numbers."""
        if other.total is None:
            return
        if self.total is None:
            self.total, self.weight = other.total.copy(), other.weight.copy()
            self.n_passes, self.squares = other.n_passes.copy(), other.squares.copy()
        else:
            weight = self.weight + other.weight
            between = other.total / np.maximum(other.weight, 1.0) - self.total / np.maximum(self.weight, 1.0)
            self.squares += other.squares + between**2 * (self.weight * other.weight / np.maximum(weight, 1.0))
            self.total += other.total
            self.weight, self.n_passes = weight, self.n_passes + other.n_passes
        self.spp += other.spp
        self.nonfinite += other.nonfinite

    def variance(self) -> np.ndarray | None:
        """Variance of :meth:`mean`, float32; None after fewer than two passes, infinite in pixels that had fewer."""
        if self.n_passes is None or self.n_passes.max() < 2:
            return None
        scale = np.maximum(self.n_passes - 1.0, 1.0) * np.maximum(self.weight, 1.0)
        return np.where(self.n_passes > 1, self.squares / scale, np.inf).astype(np.float32)


@dataclass(frozen=True)
class ErrorEstimate:
    """Trimmed relMSE of an image against the limit of ever more samples, estimated from its own noise; and the ends of
    an interval of confidence `CONFIDENCE`. All three contain the squared `bias`, as far as one is known."""

    value: float
    low: float
    high: float
    bias: float = 0.0

    def with_bias(self, bias: float) -> ErrorEstimate:
        """The same noise and a squared relative bias of an image that was thought to have none."""
        return ErrorEstimate(self.value + bias, self.low + bias, self.high + bias, bias)


#: Of the interval of an :class:`ErrorEstimate`.
CONFIDENCE = 0.9


class Groups(Accumulator):
    """Sample-weighted mean of passes, kept in groups of passes whose spread says how noisy the mean is.

    A pass goes to the group that has the fewest samples. Groups are independent of each other; the passes of one may
    go on with the stratified numbers of the one before. With G groups of n_g samples each, N in all,
    ``Σ n_g (x_g - mean)² / ((G - 1) N)`` is the variance of the mean of a pixel, without bias. Each group's share of
    the sum over all pixels is one sample of the image's error; their spread gives the interval for the error of this
    image (Student).
    """

    #: Most groups.
    MOST = 8

    def __init__(self) -> None:
        super().__init__()
        self.groups: list[tuple[np.ndarray, int]] = []

    def add(self, image: np.ndarray, spp: int) -> None:
        super().add(image, spp)
        image = np.where(np.isfinite(image).all(axis=-1, keepdims=True), image, 0.0)[..., :3].astype(np.float32)
        g, n = self.sequence()
        if n == 0:
            self.groups.append((image, spp))
        else:
            self.groups[g] = (self.groups[g][0] * n + image * spp) / np.float32(n + spp), n + spp

    def sequence(self) -> tuple[int, int]:
        if len(self.groups) < self.MOST:
            return len(self.groups), 0
        return min(((g, n) for g, (_, n) in enumerate(self.groups)), key=lambda group: group[1])

    def replace(self, image: np.ndarray, spp: int) -> None:
        raise TypeError("the spread of passes cannot be taken from an image that stands for all of them")

    def error(self) -> ErrorEstimate | None:
        """The estimate; None after fewer than four groups."""
        if len(self.groups) < 4:
            return None
        mean = self.mean()[..., :3]
        # The noise of a group must not choose its own weight: the others do
        whole = sum(np.float32(n) * image for image, n in self.groups)
        squares = []
        for image, n in self.groups:
            others = metrics.luminance((whole - np.float32(n) * image) * np.float32(1 / max(self.spp - n, 1)))
            weight = metrics.relative_weights(others)[..., None].astype(np.float32)
            squares.append(np.float32(n) * (image - mean) ** 2 * weight)
        total = sum(squares)
        kept = total <= np.partition(total, k := int((1 - metrics.TRIM_FRACTION) * (total.size - 1)), axis=None)[k]
        each = np.array([s.sum(where=kept, dtype=np.float64) / kept.size for s in squares])
        G, N = len(each), self.spp
        # 1 / m² of a noisy m is too large by three times its relative variance
        brightness = metrics.luminance(mean)
        spread = sum(n * (metrics.luminance(image) - brightness) ** 2 for image, n in self.groups)
        each /= 1 + 3 * (spread * metrics.relative_weights(brightness)).mean() / ((G - 1) * N)
        value = each.sum() / ((G - 1) * N)
        # The error of this very image is one more such sample, and not their mean
        half = _student(G - 1) * each.std(ddof=1) * np.sqrt(1 + G / (G - 1) ** 2) / N
        return ErrorEstimate(float(value), float(max(value - half, 0.0)), float(value + half))


def _student(n: int, z: float = 1.6449) -> float:
    """95 % quantile of Student's t with n degrees of freedom, by its expansion around the normal one, `z`: within 2 %
    from n = 3 on."""
    return z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
