"""How a camera sample is divided between cache and tracing: chosen by measured variance and time."""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.caches.outlook import Outlook
from mi_neural.estimators import roulette, two_level
from mi_neural.render.film import Area
from mi_neural.render.kernels import work_seconds

#: α by place, as a number among the settings.
BY_PLACE = -1.0
#: Camera samples of one pass of the pilot, and passes for each candidate.
PILOT_SAMPLES, PILOT_PASSES = 2**14, 4
#: Camera samples that must be rendered with a division before it is worth while to look for the best.
WORTH = 2**22
#: Bands of rows that a pilot looks at, over the height of the film.
BANDS = 4
#: Share of the pixels with the largest variance that is left out when candidates are compared.
TRIM = 0.002
#: Pixels whose samples tell the level of one: the width of the film over this.
NEIGHBOURS = 16
#: How much better than path tracing a division must measure, twice, before it is taken: what chance alone may do.
MARGIN = 1.08
#: A first division that asks the cache and costs this many times path tracing's variance times time: the others of its
#: kind are not measured (in eight scenes none was ever the best then).
HOPELESS = 1.25
#: Share of directions from the guide that is compared with none.
GUIDED = 0.5
#: Frames of records that give α by place for a cache that was trained elsewhere.
LOOK_FRAMES = 32


@dataclass(frozen=True)
class Split:
    """How a camera sample is divided: `n_cache` directions in which the cache is queried, `n_traced` for direct light,
    of which each goes on with `probability`, the coefficient `alpha`, negative: by place, the strength of `roulette` by
    what lies ahead, 0: by throughput, and the share of directions from the `guide`."""

    n_cache: int = 0
    n_traced: int = 1
    probability: float = 1.0
    alpha: float = 0.0
    roulette: float = 0.0
    guide: float = 0.0

    def numbers(self) -> tuple:
        numbers = self.n_traced, self.n_cache, self.probability, self.alpha, self.roulette, self.guide
        return tuple(float(v) for v in numbers)

    def __str__(self):
        ends = f", roulette {self.roulette:.2g}" if self.roulette > 0 else ""
        ends += f", guide {self.guide:.2g}" if self.guide > 0 else ""
        if self.alpha == 0 and self.probability == 1:
            return f"path tracing, {self.n_traced} path{'s' * (self.n_traced > 1)}{ends}"
        alpha = "by place" if self.alpha < 0 else f"{self.alpha:g}"
        return f"Nc {self.n_cache}, Nr {self.n_traced * self.probability:g}, alpha {alpha}{ends}"


class Choice:
    """The division in use. Keys that are given stay; the others are chosen by :meth:`measure`, if there are any.

    Raises ValueError for keys out of range.
    """

    #: Camera samples of the image that is being rendered.
    under_way = 0

    def __init__(self, cache_samples, residual_samples, residual_probability, alpha, roulette=None, guide=None):
        if cache_samples is not None and cache_samples < 0:
            raise ValueError(f"cache_samples is {cache_samples}; give 0 (path tracing) or more")
        if residual_samples is not None and residual_samples < 1:
            raise ValueError(f"residual_samples is {residual_samples}; it must be at least 1; for fewer paths set "
                             "residual_probability")  # fmt: skip
        if residual_probability is not None and not 0 < residual_probability <= 1:
            raise ValueError(f"residual_probability is {residual_probability}; it must lie in (0, 1]")
        number = isinstance(alpha, int | float) and not isinstance(alpha, bool) and 0 <= alpha <= 1
        if not (number or alpha in (None, "cell")):
            raise ValueError(f"alpha is {alpha!r}; give 'cell' or a number in [0, 1]")
        if roulette is not None and not (0 <= roulette < math.inf):
            raise ValueError(f"roulette is {roulette}; give 0 (by throughput) or a positive number")
        if guide is not None and not (0 <= guide < 1):
            raise ValueError(f"guide is {guide}; it must lie in [0, 1)")
        if cache_samples == 0:
            if alpha not in (None, 0):
                raise ValueError(f"alpha is {alpha}, but cache_samples is 0: there is no cache to weigh; leave one out")
            alpha, residual_probability = 0.0, 1.0 if residual_probability is None else residual_probability
        self.given = {
            "n_cache": cache_samples, "n_traced": residual_samples, "probability": residual_probability,
            "alpha": BY_PLACE if alpha == "cell" else alpha, "roulette": roulette,
            "guide": guide,
        }  # fmt: skip
        others = [v for k, v in self.given.items() if k not in ("roulette", "guide")]
        if roulette is None and (not self.may_ask or None not in others):
            self.given["roulette"] = 0.0
        if guide is None and self.given["roulette"] is not None:
            self.given["guide"] = 0.0
        self.reset()

    @property
    def fixed(self) -> bool:
        """Whether all of it was given."""
        return all(v is not None for v in self.given.values())

    @property
    def may_ask(self) -> bool:
        """Whether a division could ask the cache."""
        return self.given["alpha"] != 0 and self.given["n_cache"] != 0

    @property
    def must_look_ahead(self) -> bool:
        """Whether the division in use needs what is not known yet."""
        looks, guided = self.split.roulette > 0 or self.split.guide > 0, self.split.guide > 0
        return (looks and self.outlook is None) or (guided and self.outlook.guide is None)

    def look_ahead(self, integrator, scene, sensor, anew: bool = False) -> None:
        """See that there is an outlook, with a guide if the division has one."""
        given = scene, integrator._view(sensor), integrator.bound_lights, integrator.cache.seed ^ 0x6F75746C
        if self.outlook is None or anew:
            self.outlook = Outlook.learn(*given)
        if self.split.guide > 0:
            self.outlook.learn_guide(*given)

    def reset(self) -> None:
        self.outlook: Outlook | None = None
        known = {k: v for k, v in self.given.items() if v is not None}
        if self.may_ask and "n_cache" not in known:
            known["n_cache"] = 4
        self.split = Split(**known)
        self.table: list[dict] = []
        self.measured_at = -1
        self.rendered = 0  # camera samples of finished images
        self.seconds = 0.0

    def split_into(self, n_traced: int) -> None:
        """Trace so many directions, if their number was not given."""
        if self.given["n_traced"] is None:
            self.split = replace(self.split, n_traced=n_traced)

    def state(self) -> tuple:
        """All that measuring changes, for :meth:`restore`."""
        return self.split, self.table, self.measured_at, self.seconds, self.outlook

    def restore(self, state: tuple) -> None:
        self.split, self.table, self.measured_at, self.seconds, self.outlook = state

    def candidates(self) -> list[Split]:
        """Divisions to compare, path tracing first where it is one."""

        def options(name, choices):
            return choices if self.given[name] is None else [self.given[name]]

        alphas = options("alpha", [0.0, BY_PLACE] if self.may_ask else [0.0])
        found = []
        for a in alphas:
            # Without a cache nothing stands in for paths left out; with one, splitting was never worth more than twice
            paths = options("n_traced", [1, 2, 4] if a == 0 else [1, 2])
            shares = options("probability", [1.0] if a == 0 else [1.0, 0.5, 0.25])
            n_cache = options("n_cache", [4])[0] if a != 0 else 0
            found += [Split(n_cache, n, q, a) for n, q in itertools.product(paths, shares) if (n, q) != (2, 0.25)]
        given = {k: self.given[k] or 0.0 for k in ("roulette", "guide")}
        return [replace(s, **given) for s in found]

    def know_alpha(self, integrator, scene, sensor, by_place: bool) -> None:
        """See that there is an α by place, where one is asked for: a cache from elsewhere has none yet."""
        if by_place and self.may_ask and integrator.cache.statistics.get("alpha") is None:
            integrator.cache.compare(scene, sensor, integrator.state.lights, LOOK_FRAMES)

    def measure(self, integrator, scene, sensor) -> None:
        """Compare the candidates on `scene` and take the best; again whenever the cache is twice as old."""
        steps = integrator.cache.steps
        if self.measured_at >= 0 and steps < 2 * max(self.measured_at, 1):
            return
        start, before = time.perf_counter(), self.state()
        self.measured_at = steps
        try:
            if not self.fixed:
                self.know_alpha(integrator, scene, sensor, self.given["alpha"] in (None, BY_PLACE))
                self._compare(Pilot(integrator, scene, sensor))
        except BaseException:  # Ctrl-C: what stands then is a candidate, chosen by nothing
            self.restore(before)
            raise
        dr.sync_thread()
        self.seconds += time.perf_counter() - start

    def _compare(self, pilot) -> None:
        splits = self.candidates()
        pilot.run(splits[0], passes=1)  # kernels
        self.table = []
        for split in splits:
            asking = [t for t in self.table if t["alpha"] != 0]
            if asking and splits[0].alpha == 0 and asking[0]["cost"] > HOPELESS * self.table[0]["cost"]:
                break
            self.table.append(pilot.facts(split))
        asking = [t for t in self.table if t["alpha"] != 0] if split is splits[-1] else []
        if self.given["n_cache"] is None and asking:
            best = self.split_of(min(asking, key=lambda t: t["cost"]))
            eight = pilot.facts(replace(best, n_cache=8))
            self.table.append(eight)
            n_cache = self._n_cache(best, next(t for t in asking if self.split_of(t) == best), eight)
            if n_cache not in (4, 8):
                self.table.append(pilot.facts(replace(best, n_cache=n_cache)))
        if self.given["roulette"] is None:
            self._compare_roulettes(pilot)
        base = self.table[0]["cost"]
        for t in self.table:
            t["efficiency"] = base / t["cost"] if t["cost"] > 0 else math.inf
        best = max(self.table, key=lambda t: t["efficiency"])
        self.split = splits[0]
        if best["efficiency"] >= MARGIN:
            again = pilot.facts(splits[0], first_seed=1)["cost"], pilot.facts(self.split_of(best), first_seed=1)["cost"]
            if again[0] >= MARGIN * again[1]:
                self.split = self.split_of(best)
        if self.split.guide == 0 and self.outlook is not None:
            self.outlook.guide = None  # it would be asked for nothing

    def _compare_roulettes(self, pilot) -> None:
        """The best of the divisions by their number of paths, with roulette by what lies ahead; then half and twice its
        strength."""
        self.look_ahead(pilot.integrator, pilot.scene, pilot.sensor, anew=True)
        strength = roulette.strength_of(self.table[0]["variance"])
        if strength <= 0:
            return
        best = {}
        for t in sorted(self.table, key=lambda t: -t["cost"]):
            best[t["n_traced"]] = t
        tried = [pilot.facts(replace(self.split_of(t), roulette=strength)) for t in best.values()]
        first = self.split_of(min(tried, key=lambda t: t["cost"]))
        tried += [pilot.facts(replace(first, roulette=f * strength)) for f in (0.5, 2.0)]
        self.table += tried
        if self.given["guide"] is None:
            self.split = replace(self.split_of(min(tried, key=lambda t: t["cost"])), guide=GUIDED)
            self.look_ahead(pilot.integrator, pilot.scene, pilot.sensor)
            self.table.append(pilot.facts(self.split))

    @staticmethod
    def split_of(facts: dict) -> Split:
        return Split(**{k: facts[k] for k in ("n_cache", "n_traced", "probability", "alpha", "roulette", "guide")})

    @staticmethod
    def _n_cache(best: Split, four: dict, eight: dict) -> int:
        """Nc by `two_level.best_split`, from what 4 and 8 queries a sample gave."""
        var_cache = 8 * max(four["variance"] - eight["variance"], 0.0)
        cost_cache = max(eight["seconds"] - four["seconds"], 1e-12) / 4
        var_residual = max(four["variance"] - var_cache / 4, 1e-30)
        cost_residual = max(four["seconds"] - 4 * cost_cache, 1e-12)
        ratio = two_level.best_split(var_cache, cost_cache, var_residual, cost_residual)
        return round(min(max(ratio * best.n_traced * best.probability, 2), 16))

    def statistics(self) -> dict:
        facts = {"split": str(self.split), "seconds_pilot": self.seconds}
        return facts | ({"pilot": self.table} if self.table else {})


class Pilot:
    """Variance and time of divisions of a camera sample, on bands of rows of the film."""

    def __init__(self, integrator, scene, sensor):
        self.integrator, self.scene, self.sensor = integrator, scene, sensor
        area = Area.of(sensor)
        self.rows = max(1, min(area.height // BANDS, PILOT_SAMPLES // (2 * BANDS * area.width)))
        bands = BANDS if area.height >= BANDS else 1
        self.first = [int((k + 0.5) * area.height / BANDS - self.rows / 2) for k in range(bands)]
        self.spp = max(1, min(16, PILOT_SAMPLES // (area.width * self.rows * bands)))
        self.level, self.compiled = None, {(False, False)}  # the first is compiled by whoever measures
        self.samples = area.width * self.rows * self.spp * bands

    def run(self, split: Split, passes: int = PILOT_PASSES, first_seed: int = 0):
        """(luminance by pass and pixel, seconds of each pass)."""
        images, seconds, choice = [], [], self.integrator.choice
        before, choice.split = choice.split, split  # what is bound depends on it
        try:
            for k in range(first_seed * passes, (first_seed + 1) * passes):
                t0 = work_seconds()
                bands = []
                for y in self.first:
                    _, values = self.integrator.render_rows(
                        self.scene, self.sensor, 0x9107 + k, (self.rows, self.spp), y, settings=split.numbers(),
                        sums=True,
                    )
                    bands.append(mi.luminance(mi.Color3f(*values[:3])) / self.spp)
                dr.eval(bands)
                seconds.append(work_seconds() - t0)
                images.append(np.concatenate([np.array(b) for b in bands]))
        finally:
            choice.split = before
        return np.stack(images).astype(np.float64), seconds  # squares of what is dim are 0 in single precision

    def _level(self, mean):
        """The squared luminance of pixels, from few samples: means over neighbours. That of a pixel alone would be high
        where a rare bright path is among its samples, and hide it."""
        width = mean.size // (self.rows * len(self.first))
        rows = mean.reshape(-1, self.rows, width).mean(axis=1)
        reach = width // (2 * NEIGHBOURS)
        wide = np.pad(rows, ((0, 0), (reach, reach)), mode="edge")
        smooth = np.lib.stride_tricks.sliding_window_view(wide, 2 * reach + 1, axis=1).mean(axis=2)
        level = np.broadcast_to(smooth[:, None], (len(rows), self.rows, width)).ravel()
        return level**2 + 0.01 * max(float(mean.mean()), 1e-30) ** 2

    def facts(self, split: Split, first_seed: int = 0) -> dict:
        """A division with its mean relative variance of one camera sample, seconds a sample, and their product."""
        kind = split.roulette > 0, split.guide > 0
        if kind not in self.compiled:
            self.run(split, passes=1)
            self.compiled.add(kind)
        images, seconds = self.run(split, first_seed=first_seed)
        if self.level is None:
            self.level = self._level(images.mean(axis=0))
        relative = np.sort(images.var(axis=0, ddof=1) * self.spp / self.level)
        relative = float(relative[: max(1, int(relative.size * (1 - TRIM)))].mean())
        each = float(np.median(seconds)) / self.samples
        return asdict(split) | {"variance": relative, "seconds": each, "cost": relative * each}
