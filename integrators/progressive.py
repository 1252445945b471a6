"""``mode="progressive"`` of ``nirc_two_level``: the biased image first, corrected as the unbiased one allows."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.estimators.combine import correction, scale_of, share_of_noise, trimmed_mean
from mi_neural.render.film import Area, kind_of

#: Channels that the parts of an image must have.
BIASED, UNBIASED = ("cache", "residual"), ("cache", "residual", "variance_cache", "variance_residual",
                                           "variance_indirect")  # fmt: skip
#: Keys that the biased estimator has in common with the whole.
SHARED = ("max_depth", "rr_depth", "hide_emitters", "seed", "levels", "hashmap_size", "width", "hidden_layers")
#: Unbiased samples that each image of FEW or more begins with, to see a cache that is wrong everywhere.
FIRST_UNBIASED, FEW = 2, 8
#: Least and largest share of the time that unbiased samples get, and what it is over the square root of the ratio of
#: the bias found to the noise of the biased part (both squared). Best shares for Cornell box, Sponza in the sun,
#: staircase and ajar door, 2 to 10 s, over that root: 0.4 to 0.9.
SHARES, PULL = (1 / 16, 7 / 8), 0.5
#: A call has none unless they are one of so many of its samples: smaller blocks take more time a sample.
WHOLE = 8
#: Blocks that an image of one call consists of, at least.
BLOCKS = 8
#: A correction is found anew once there are so many times its samples; near the image's end, so many times.
AGAIN, NEARLY, AGAIN_NEARLY = 2.0, 0.9, 1.25
#: Time of a biased sample over an unbiased one with as many light samples (0.4 to 1 measured). A number of its own,
#: since measured times would make the image depend on them.
COST = 0.8


def pieces(n: int, largest: int) -> list[int]:
    """`n` as a sum of as few as possible of the sizes `largest`, a quarter of it, ..., 1."""
    sizes = []
    while n > 0:
        k, n = divmod(n, largest)
        sizes += [largest] * k
        largest = max(largest // 4, 1)
    return sizes


def power_of_four(n: float) -> int:
    """The largest power of four up to `n`; 0 for n < 1."""
    return 4 ** int(math.log2(n) / 2 + 1e-9) if n >= 1 else 0


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
    the two-level estimator: the more, the larger the bias that was found is in the noise of the biased samples. Direct
    light is the same in both, so that all samples count for it.
    """

    def __init__(self, integrator, props):
        self.integrator = integrator
        self.nirc = mi.load_dict({"type": "nirc", **{k: props[k] for k in SHARED if k in props}})
        self.nirc.channels = list(BIASED)
        self.nirc.cache = integrator.cache
        self.planned = False
        self.compiled: set[tuple] = set()
        self.begin()

    def begin(self) -> None:
        """A new image."""
        self.n_biased = self.n_unbiased = self.n_blocks = 0
        self.biased, self.unbiased = Parts(), Parts()
        self.squares: np.ndarray | float = 0.0  # of the indirect light of biased blocks, weighted by their samples
        self.share = SHARES[0]  # of the time
        # Of the difference of both: what all of it counts, what the rest is corrected by, samples that it was made of
        self.all, self.found, self.found_at = 0.0, None, 0

    def reset(self) -> None:
        self.begin()

    def forget_scene(self) -> None:
        """Forget what was compiled for the scene that was bound."""
        self.nirc.forget_scene()
        self.compiled.clear()

    def plan_samples(self, spp: int | None) -> None:
        """As ``CacheIntegrator.plan_samples``: until None, all calls of :meth:`add` are one image's."""
        if spp is None or not self.planned:
            self.begin()
        self.planned = spp is not None
        self.nirc.plan_samples(spp)

    @property
    def sample_share(self) -> float:
        """The share of unbiased samples that takes `share` of the time."""
        return self.share * COST / (self.share * COST + 1 - self.share)

    def wanted(self, total: int) -> float:
        """Unbiased samples among `total`."""
        return max(self.sample_share * total, FIRST_UNBIASED if total >= FEW else 0)

    def blocks(self, spp: int):
        """Sizes of the blocks of `spp` more samples, as (samples, whether they are unbiased).

        Few different sizes, since each is recorded once.
        """
        total = self.n_biased + self.n_unbiased
        if not self.planned:
            for n in pieces(spp, max(power_of_four(spp / BLOCKS), 1)):
                total += n
                wanted, first = self.wanted(total), self.n_unbiased == 0 and total >= FEW
                yield n, self.n_biased > 0 and (first or self.n_unbiased + n / 2 <= wanted)
            return
        missing = min(self.wanted(total + spp) - self.n_unbiased, spp)
        largest = max(power_of_four(spp), 1)
        size = min(power_of_four(missing), largest)
        n_unbiased = int(missing / size) if size and self.n_biased and WHOLE * missing >= spp else 0
        for n in pieces(spp - n_unbiased * size, largest):
            yield n, False
        for _ in range(n_unbiased):
            yield size, True

    def _measure_scene(self, scene, sensor) -> None:
        """The biased part's lights, and its number of light samples for the unbiased part, too: splitting there pays
        where direct light is noisy (Sponza 1.3, staircase 1.2, Cornell box 1.2 times less variance in equal time)."""
        self.nirc.follow(self.integrator, scene, sensor)
        self.integrator.choice.split_into(self.nirc.n_light)

    def add(self, scene, sensor, seed: int, spp: int, render) -> None:
        """Take `spp` more samples a pixel; ``render(seed, spp)`` gives a block of unbiased ones."""
        nirc = self.nirc
        self._measure_scene(scene, sensor)
        if not self.planned:
            self.begin()
            nirc.plan_samples(spp)
        for n, unbiased in self.blocks(spp):
            if unbiased:
                block = render(seed ^ 0x3C6EF372, n)
                self.unbiased.add(Parts.of(block, self.integrator.inner_channels, self.integrator))
                self.n_unbiased += n
            else:
                queries = nirc.state.queries
                block = Parts.of(nirc.render_block(scene, sensor, seed, n), BIASED, nirc)
                self.integrator.state.queries += nirc.state.queries - queries
                self.biased.add(block)
                self.squares = self.squares + n * np.square(block.indirect)
                self.n_biased, self.n_blocks = self.n_biased + n, self.n_blocks + 1
            seed = (seed + 0x9E3779B9) & 0xFFFFFFFF
            if not self.planned:
                self.look()
        self.look()
        if not self.planned:
            nirc.plan_samples(None)

    def compile(self, scene, sensor, seed: int, spp: int, render) -> None:
        """Compile what images of one call or several calls of `spp` samples need; ``render(seed, spp)`` as above."""
        nirc = self.nirc
        self._measure_scene(scene, sensor)
        sizes = pieces(spp, max(power_of_four(spp / BLOCKS), 1)) + pieces(spp, power_of_four(spp))
        for n in sorted(set(sizes)):
            key = kind_of(sensor), Area.of(sensor), n
            if key not in self.compiled:
                for _ in range(2):  # the first recording of a frozen function differs from what it then replays
                    dr.eval(nirc.render_block(scene, sensor, seed, n).tensor(), render(seed, n).tensor())
                self.compiled.add(key)

    def look(self) -> None:
        """Find the correction anew, and the share of unbiased samples, if there are enough new samples."""
        n = self.n_biased + self.n_unbiased
        nearly = n >= NEARLY * (self.nirc.planned_spp or 0)
        if self.n_unbiased < 2 or self.n_biased < 1 or n < (AGAIN_NEARLY if nearly else AGAIN) * self.found_at:
            return
        biased, unbiased = self.biased.indirect, self.unbiased.indirect
        noise = self.unbiased.variance("indirect", self.n_unbiased) / self.n_unbiased
        level = self.biased.rgb / np.maximum(self.biased.weight, 1e-30)
        self.all, spread = 0.0, None
        if self.n_blocks > 1:
            spread = np.maximum(self.squares / self.n_biased - biased**2, 0) / (self.n_blocks - 1)
            self.all = share_of_noise(spread, noise, level)
        rest = 1 - self.all
        self.found, self.found_at = correction(rest * (unbiased - biased), rest**2 * noise, biased), n
        if spread is not None:
            g = scale_of(level)
            bias = trimmed_mean((self.found / max(rest, 1e-3) / g) ** 2)
            ratio = bias / max(trimmed_mean(spread / g**2), 1e-30)
            self.share = float(np.clip(PULL * math.sqrt(ratio), *SHARES))

    def parts(self) -> Parts:
        """The image so far: the unbiased part's channels with the colour of both."""
        out = Parts()
        n_light = self.nirc.n_light * self.n_biased, self.integrator.split.n_traced * self.n_unbiased
        if self.n_unbiased == 0:
            out.add(self.biased)
            sizes = self.integrator.CHANNELS
            missing = {k: 0 * self.biased.rgb[..., : sizes[k]] for k in self.integrator.inner_channels}
            out.channels = missing | out.channels
            return out
        out.add(self.unbiased)
        if self.n_biased == 0:
            return out
        direct = (n_light[0] * self.biased.direct + n_light[1] * self.unbiased.direct) / sum(n_light)
        out.rgb = out.weight * (direct + self.indirect())
        return out

    def indirect(self) -> np.ndarray:
        """Indirect light: the biased estimate, moved to the unbiased one as far as noise alone would say, and corrected
        by what stands out of the noise of the rest."""
        biased = self.biased.indirect
        if self.found is None:
            return biased
        return biased + self.all * (self.unbiased.indirect - biased) + self.found
