"""Statistics over repeats: means with confidence intervals, and bias and variance as separate numbers.

Intervals are Student's t of level 95 % for the mean of independent repeats. They hold for means of values that are
about normally distributed. If errors have rare outliers, a few repeats contain too few of them, and the interval is too
narrow.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from mi_neural.image.metrics import bias_and_variance, block_means, relative_squared_errors

from .benchmark import Row
from .reference import Reference

LEVEL = 0.95
#: 97.5 % quantiles of Student's t with 1, 2, ... degrees of freedom; beyond them, an expansion around the normal one.
T_QUANTILES = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281,
               2.2010, 2.1788, 2.1604, 2.1448, 2.1314, 2.1199, 2.1098, 2.1009, 2.0930, 2.0860)  # fmt: skip


def half_width(values: Iterable[float]) -> float | None:
    """Half of the confidence interval of the mean of independent values; None for fewer than two."""
    values = np.asarray(list(values), np.float64)
    n = values.size
    if n < 2:
        return None
    dof = n - 1
    t = T_QUANTILES[dof - 1] if dof <= len(T_QUANTILES) else 1.95996 + 2.37225 / dof + 2.8224 / dof**2
    return float(t * values.std(ddof=1) / np.sqrt(n))


@dataclass
class Group:
    """Rows that differ in their repeat alone, at least one, and what follows from all their images.

    `squared_bias` and `variance` are those of one image, relative as in relMSE and trimmed alike; `squared_bias_error`
    is the standard error of the first: by the jackknife over the repeats, and for the reference as if its noise were
    normally distributed. None: fewer than two repeats (the error: three), no reference.
    """

    rows: list[Row]
    squared_bias: float | None = None
    squared_bias_error: float | None = None
    variance: float | None = None

    @property
    def first(self) -> Row:
        return self.rows[0]

    @property
    def key(self) -> tuple:
        """(label, mode, budget, denoised)"""
        return self.first.label, self.first.mode, self.first.budget_seconds, self.first.denoised

    def values(self, name: str) -> list[float]:
        """A field of all rows that have it."""
        return [value for row in self.rows if (value := getattr(row, name)) is not None]

    def mean(self, name: str) -> float | None:
        """Mean of a field over the repeats; None where no row has it."""
        values = self.values(name)
        return float(np.mean(values)) if values else None

    def half_width(self, name: str) -> float | None:
        """Half of the confidence interval of :meth:`mean`; None for fewer than two repeats."""
        return half_width(self.values(name))

    def to_json(self) -> dict[str, object]:
        """Its entry in `results.json`."""
        label, mode, budget, denoised = self.key
        entry = {"scene": self.first.scene, "label": label, "mode": mode, "budget_seconds": budget,
                 "denoised": denoised, "repeats": len(self.rows), "level": LEVEL}  # fmt: skip
        for name in ("relmse_trimmed", "relmse", "flip", "flip_clean", "flicker", "spp", "seconds_total", "peak_mib"):
            entry |= {name: self.mean(name), f"{name}_half_width": self.half_width(name)}
        return entry | {"squared_bias": self.squared_bias, "squared_bias_error": self.squared_bias_error,
                        "variance": self.variance}  # fmt: skip


def group(rows: Iterable[Row]) -> list[Group]:
    """Rows by scene and :attr:`Group.key`, in the order in which they come, images made elsewhere last; rows of a curve
    are left out."""
    groups: dict[tuple, Group] = {}
    for row in rows:
        if row.mode == "curve":
            continue
        key = (row.scene, row.label, row.mode, row.budget_seconds, row.denoised)
        groups.setdefault(key, Group([])).rows.append(row)
    return sorted(groups.values(), key=lambda g: g.first.made_elsewhere)


def tell_apart(found: Group, image: Callable[[Row], np.ndarray | None], reference: Reference) -> None:
    """Fill in bias and variance of a group by the images of its rows, one of each repeat."""
    images = [image(row) for row in found.rows]
    images = [block_means(rgb, reference.rgb.shape) for rgb in images if rgb is not None]
    n = len(images)
    if n < 2:
        return
    found.squared_bias, found.variance = bias_and_variance(images, reference.rgb, reference.variance)
    if n > 2:
        without = [
            bias_and_variance(images[:k] + images[k + 1 :], reference.rgb, reference.variance)[0] for k in range(n)
        ]
        noise = relative_squared_errors(reference.rgb, reference.rgb, reference.variance)[1]
        of_reference = 2 * np.sum(noise**2) / noise.size**2  # each squared deviation varies by twice its mean squared
        found.squared_bias_error = float(np.sqrt((n - 1) * np.var(without) + of_reference))
