"""A cache after a change of the light: frames of all predictors, measured where error and flicker are the cache's.

A frame of one sample a pixel flickers by the noise of direct light far more than by the cache. That noise is the same
for all predictors and hides what they differ in. So in each frame direct light is replaced by its mean over many
samples in that state of the scene before anything is measured; all that the cache says stays as it is. References and
direct light of a scene are rendered once for all settings of the integrators.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mi_neural.bench import benchmark, budget, load, sequence, sequence_pictures
from mi_neural.bench.specs import IntegratorSpec
from mi_neural.caches.reliability import correlation, covariance, variance
from mi_neural.image import exr, metrics

from .work import Group, Part, Work

#: The frame of the change, as in the paper (section 4), frames after it that count as the first response, and from
#: which errors should be steady again.
CHANGE, FIRST, LATE = 20, 10, 25
#: The paper's three methods, and this package's own rule for the blend, by the keys of `nirc`.
METHODS = {
    "High-LR": {"blend": "fast"},
    "EMA": {"blend": "ema", "last_rate": 1.0},
    "blend": {"blend": "reliability", "reliability": "correlation"},
    "blend by evidence": {"blend": "reliability"},
}
#: The network's share of light alone: no gathered light where surfaces are near.
COMMON = {"termination": "primary", "spread_threshold": 0.0, "channels": "direct,sigma"}
#: As `nirc` renders by default: what lies near the first surface is traced, and the cache is asked beyond it.
GATHERED = {"channels": "direct,sigma"}


@dataclass(frozen=True)
class Settings:
    """Sizes of the experiment; `pretrain` counts training frames before the first image, `spp` samples of a frame."""

    size: tuple[int, int]
    frames: int
    pretrain: int
    spp: int
    reference_spp: int
    cache_samples: int
    methods: tuple[str, ...] = tuple(METHODS)


@dataclass(frozen=True)
class Change:
    """A scene and what changes in it: `functions` as :class:`~mi_neural.bench.sequence.Sequence` takes them."""

    scene: str
    what: str
    functions: dict[str, Callable[[int, np.ndarray], np.ndarray]]


class Watched(sequence.Run):
    """A run that also notes the mean reliability of both predictors after each frame."""

    def _frames(self, case, frames):
        for found in super()._frames(case, frames):
            found.rendered.statistics.update(mean_reliabilities(case.integrator))
            yield found


def mean_reliabilities(integrator) -> dict[str, float]:
    """Mean reliability (equation 3 of the paper, mean over the channels) of the trained and of the averaged weights,
    over the records of the frames so far; empty for an integrator whose blend does not go by correlation."""
    grid = getattr(integrator.cache.queried, "grid", None)
    if grid is None or grid.constants.measure != "correlation":
        return {}
    m, weight = grid.means(), np.array(grid.records)
    found = {}
    for name, p in (("reliability_trained", "f"), ("reliability_averaged", "e")):
        total = 0.0
        for k in range(3):
            s = [variance(m[v][k], m[v + v][k]) for v in ("y", p)]
            c = covariance(m["y" + p][k], m["y"][k], m[p][k])
            total = total + np.array(correlation(c, *s, grid.constants.epsilon)) / 3
        found[name] = float((total * weight).sum() / max(weight.sum(), 1e-30))
    return found


@dataclass
class Measured:
    """Frames of all methods, as :func:`measure` found them.

    direct  state of the scene (as `Sequence.states` has it) -> mean direct light, shape (height, width, 3)
    curves  method -> "flip" and "smape" -> a value for each frame (SMAPE of frame 0 is None); "flip 0" of crop 0
    crops   (x, y, width, height): where the change is strongest, and where it is weakest
    """

    settings: Settings
    run: sequence.Run
    results: dict[str, sequence.Result]
    direct: dict[str, np.ndarray]
    curves: dict[str, dict[str, list[float | None]]]
    crops: list[sequence_pictures.Crop]

    def clean(self, method: str, frame: int) -> np.ndarray:
        """A frame with the mean of direct light in place of its sample, shape (height, width, 3)."""
        return clean(self.results[method].image(frame), self.direct[self.run.sequence.states[frame]])

    def reference(self, frame: int) -> np.ndarray:
        """The reference of a frame."""
        return self.run.references.of(frame).rgb

    def statistic(self, method: str, name: str) -> tuple[list[int], list[float]]:
        """Frames and values of one statistic."""
        rows = [row for row in self.results[method].rows if row["statistics"].get(name) is not None]
        return [row["frame"] for row in rows], [row["statistics"][name] for row in rows]

    def mean(self, method: str, name: str, first: int, last: int | None = None) -> float:
        """Mean of a curve over frames first..last, both included."""
        values = self.curves[method][name][first : None if last is None else last + 1]
        return float(np.mean([v for v in values if v is not None]))

    def windows(self, method: str, name: str) -> list[float]:
        """Means of a curve before the change, over the first response, and from LATE frames after it; the frame of the
        change itself does not count for SMAPE, which would contain the change."""
        after = CHANGE + name.startswith("smape")
        return [self.mean(method, name, 0, CHANGE - 1), self.mean(method, name, after, CHANGE + FIRST),
                self.mean(method, name, self.late)]  # fmt: skip

    @property
    def late(self) -> int:
        """The frame from which errors should be steady; the last quarter of a run too short for LATE."""
        return min(CHANGE + LATE, self.settings.frames - max(1, self.settings.frames // 4))


def clean(image: exr.Image, direct: np.ndarray) -> np.ndarray:
    """An image whose direct light, in channels ``direct.*``, is replaced."""
    return image.rgb - image.layer("direct") + direct


def measure(work: Work, settings: Settings, change: Change, common: dict[str, object] = COMMON) -> Measured:
    """All methods over the frames of one scene; goes on where an earlier call was interrupted. `common`: keys of all
    methods."""
    facts = asdict(settings) | {"scene": change.scene, "change": change.what}
    name = Path(change.scene).name
    group = work.group(f"change-{name}", facts if common == COMMON else facts | {"common": common})
    of_scene = ("scene", "change", "size", "frames", "reference_spp")
    still = work.group(f"states-{name}", {key: facts[key] for key in of_scene})
    loaded = load.load_scene(change.scene, settings.size, merge=False)
    over_time = sequence.Sequence(loaded.scene, change.functions, settings.frames, CHANGE)
    plan = sequence.Plan(settings.spp, settings.pretrain)
    run = Watched(loaded, over_time, plan, group.folder / "frames", progress=work.progress)
    run.references = sequence.References(loaded, over_time, settings.reference_spp, still.folder / "references")
    keys = {**common, "cache_samples": settings.cache_samples}
    specs = [IntegratorSpec("nirc", {**keys, **METHODS[m]}) for m in settings.methods]
    results = dict(zip(settings.methods, run.run(benchmark.make_cases(loaded, specs)), strict=True))
    direct = {state: direct_light(still, loaded, over_time, settings, frame)
              for state, frame in run.references.first.items()}  # fmt: skip
    found = Measured(settings, run, results, direct, {}, [])
    found.crops = sequence_pictures.choose_crops(found.reference(CHANGE - 1), found.reference(CHANGE))
    found.curves = {m: group.part(f"errors_{m}", lambda bar, m=m: Part(_errors(found, m, bar))).numbers
                    for m in settings.methods}  # fmt: skip
    return found


def direct_light(group: Group, loaded, over_time: sequence.Sequence, settings: Settings, frame: int) -> np.ndarray:
    """Mean direct light at the first rough surface in the state of a frame, shape (height, width, 3)."""

    def render(bar) -> Part:
        over_time.apply(frame)
        spec = IntegratorSpec("nirc", {"max_depth": 2, "channels": "direct"})
        (case,) = benchmark.make_cases(loaded, [spec])
        found = budget.render_samples(loaded.scene, case.integrator, settings.reference_spp, frame + 1, progress=bar)
        if found.interrupted:
            raise KeyboardInterrupt
        return Part({}, {"direct": np.stack([found.channels[f"direct.{c}"] for c in "RGB"], axis=-1)})

    try:
        return group.part(f"direct_light_{frame}", render).arrays["direct"]
    finally:
        over_time.restore()


def _errors(found: Measured, method: str, bar) -> dict[str, list[float | None]]:
    """FLIP to the reference and SMAPE to the frame before, of all frames of one method, as `flip` and `smape`; and of
    the crops, as `flip 0`, `smape 0` and so on."""
    exposures, previous, n = found.run.references.exposures, None, len(found.crops)
    errors = {name + end: [] for name in ("flip", "smape") for end in ("", *(f" {k}" for k in range(n)))}
    for frame in range(found.settings.frames):
        image = found.clean(method, frame)
        maps = {"flip": metrics.flip(image, found.reference(frame), exposures).map}
        maps["smape"] = None if previous is None else metrics.smape_map(image, previous)
        for name, values in maps.items():
            errors[name].append(None if values is None else values.mean())
            for k, crop in enumerate(found.crops):
                errors[f"{name} {k}"].append(None if values is None else cut(values, crop).mean())
        previous = image
        if bar:
            bar(frame + 1, found.settings.frames)
    return errors


def cut(image: np.ndarray, crop: sequence_pictures.Crop) -> np.ndarray:
    """The part of an image or map that a crop (x, y, width, height) names."""
    x, y, w, h = crop
    return image[y : y + h, x : x + w]
