"""``mode="progressive"`` of ``nirc_two_level``: the biased image first, corrected as the unbiased one allows."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from mi_neural.transport.correction import correction

#: Channels that the parts of an image must have.
BIASED, UNBIASED = ("cache", "residual"), ("cache", "residual", "variance_cache", "variance_residual",
                                           "variance_indirect")  # fmt: skip
#: Keys that the biased estimator has in common with the whole.
SHARED = ("max_depth", "rr_depth", "hide_emitters", "seed", "levels", "hashmap_size", "width", "hidden_layers")
#: Least and largest share of unbiased samples, and biased ones that come first.
SHARES, FIRST_BIASED = (1 / 16, 7 / 8), 4
#: Share of unbiased samples over the ratio of the squared bias found to the noise that it was found in.
PULL = 4.0

#: A correction is found anew once there are so many times its samples, and when so much of the image is there.
AGAIN, NEARLY = 1.5, 0.9


class Parts:
    """Sums over an image's samples: colour, weight, alpha and channels by name, shapes (height, width, ...)."""

    def __init__(self):
        self.weight: np.ndarray | float = 0.0
        self.rgb: np.ndarray | float = 0.0
        self.alpha: np.ndarray | float = 0.0
        self.channels: dict[str, np.ndarray] = {}

    @classmethod
    def of(cls, block, names, integrator) -> Parts:
        """The content of an image block with these channels of `integrator`."""
        parts, values = cls(), np.array(block.tensor(), dtype=np.float64)
        sizes = [integrator.CHANNELS[name] for name in names]
        first = values.shape[2] - sum(sizes)
        parts.rgb, parts.alpha = values[:, :, :3], values[:, :, 3 : first - 1]
        parts.weight = values[:, :, first - 1 : first]
        for name, size in zip(names, sizes, strict=True):
            parts.channels[name] = values[:, :, first : first + size]
            first += size
        return parts

    def add(self, other: Parts) -> None:
        self.weight = self.weight + other.weight
        self.rgb, self.alpha = self.rgb + other.rgb, self.alpha + other.alpha
        for name, value in other.channels.items():
            self.channels[name] = self.channels.get(name, 0.0) + value

    def mean(self, name: str) -> np.ndarray:
        """Mean of a channel."""
        return self.channels[name] / np.maximum(self.weight, 1e-30)

    @property
    def indirect(self) -> np.ndarray:
        """Mean indirect light."""
        return self.mean("cache") + self.mean("residual")

    @property
    def direct(self) -> np.ndarray:
        """Mean of the rest: direct light and emission."""
        return self.rgb / np.maximum(self.weight, 1e-30) - self.indirect

    def variance(self, name: str, n: int) -> np.ndarray:
        """Sample variance of one of `n` camera samples' ``cache``, ``residual`` or ``indirect`` part; 0 for n = 1."""
        mean = self.indirect if name == "indirect" else self.mean(name)
        return np.maximum(self.mean(f"variance_{name}") - mean**2, 0) * n / max(n - 1, 1) if n > 1 else 0 * mean

    def shown(self, names, n: int) -> np.ndarray:
        """Colour, alpha, weight 1 and the channels `names`, as an image block holds them."""
        w = np.maximum(self.weight, 1e-30)
        values = [self.rgb / w, self.alpha / w, np.where(self.weight > 0, 1.0, 0.0)]
        for name in names:
            kind, _, part = name.partition("_")
            values.append(self.variance(part, n) if kind == "variance" else self.mean(name))
        return np.concatenate(values, axis=-1)


class Mixed:
    """Samples of both estimators of one image, and the image that they give together.

    Some of an image's samples are those of ``nirc``, which shares the cache and the light sampler, the others those of
    the two-level estimator: half of them in an image of one call; in one of several calls each is of one kind, and the
    more unbiased ones the better the bias is seen in their noise. Direct light is the same in both, so that all samples
    count for it.
    """

    def __init__(self, integrator, props):
        self.integrator = integrator
        self.nirc = mi.load_dict({"type": "nirc", **{k: props[k] for k in SHARED if k in props}})
        self.nirc.channels = list(BIASED)
        self.nirc.cache = integrator.cache
        self.planned = False
        self.begin()

    def begin(self) -> None:
        """A new image."""
        self.n_biased = self.n_unbiased = 0
        self.biased, self.unbiased = Parts(), Parts()
        self.share = SHARES[0]
        self.found, self.found_at = None, 0  # the correction, and the number of samples that it was made of

    def reset(self) -> None:
        self.begin()

    def plan_samples(self, spp: int | None) -> None:
        """As ``CacheIntegrator.plan_samples``: until None, all calls of :meth:`add` are one image's."""
        if spp is None or not self.planned:
            self.begin()
        self.planned = spp is not None
        self.nirc.state.planned_spp = spp

    def add(self, scene, sensor, seed: int, spp: int, render) -> None:
        """Take `spp` more samples a pixel; ``render(seed, spp)`` gives a block of unbiased ones."""
        nirc = self.nirc
        nirc.state.lights = self.integrator.state.lights
        if not self.planned:
            self.begin()
        if not nirc.state.facts:
            nirc.settle(scene, sensor)
        if self.planned:
            wants = self.n_unbiased < self.share * (self.n_biased + self.n_unbiased)
            n_biased = 0 if wants and self.n_biased >= FIRST_BIASED else spp
        else:
            n_biased = spp - spp // 2
            nirc.state.planned_spp = n_biased
        if n_biased:
            self.biased.add(Parts.of(nirc._render(scene, sensor, seed, n_biased), BIASED, nirc))
            self.n_biased += n_biased
        if spp > n_biased:
            block = render(seed ^ 0x3C6EF372, spp - n_biased)
            self.unbiased.add(Parts.of(block, self.integrator.inner_channels, self.integrator))
            self.n_unbiased += spp - n_biased
        if not self.planned:
            nirc.state.planned_spp = None

    def _look(self, n: int) -> None:
        """Find the correction anew, of `n` samples; and the share of unbiased ones by how much of what they differ is
        bias, and how much noise."""
        biased, unbiased = self.biased.indirect, self.unbiased.indirect
        variance = self.unbiased.variance("indirect", self.n_unbiased) / self.n_unbiased
        self.found, self.found_at = correction(unbiased - biased, variance, biased), n
        bias = float(np.mean(self.found**2))
        self.share = float(np.clip(PULL * bias / max(float(np.mean(variance)), 1e-30), *SHARES))

    def parts(self) -> Parts:
        """The image so far: the unbiased part's channels with the colour of both."""
        out = Parts()
        n_light = self.nirc.n_light * self.n_biased, self.integrator.split.n_traced * self.n_unbiased
        if self.n_unbiased == 0:
            out.add(self.biased)
            out.channels = {k: 0 * self.biased.rgb for k in self.integrator.inner_channels} | out.channels
            return out
        out.add(self.unbiased)
        if self.n_biased == 0:
            return out
        direct = (n_light[0] * self.biased.direct + n_light[1] * self.unbiased.direct) / sum(n_light)
        out.rgb = out.weight * (direct + self.indirect())
        return out

    def indirect(self) -> np.ndarray:
        """Indirect light: the biased estimate, corrected by what stands out of the noise of the unbiased one."""
        n = self.n_biased + self.n_unbiased
        due = not self.planned or n >= AGAIN * self.found_at or n >= NEARLY * (self.nirc.state.planned_spp or 0)
        if self.n_unbiased > 1 and due:
            self._look(n)
        return self.biased.indirect + (0 if self.found is None else self.found)
