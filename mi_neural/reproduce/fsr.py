"""Counterparts of what the guide "AMD FSR Radiance Caching" says: its two overrides, and the training budget.

The renderer here is the smallest one that fits the guide: paths of a few vertices are traced through the whole scene,
each vertex is a record, the last one a query (self-training), and the picture is the cache at the first surface.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.bench import environment, load, sequence
from mi_neural.bench.changes import rotate
from mi_neural.bench.report import number
from mi_neural.caches.radiance_cache import DispatchFlags, RadianceCache, self_training_frame
from mi_neural.explore import figures
from mi_neural.image import metrics

from .entry import Entry, Outcome, Statement
from .work import Group, Part, Work

#: The guide's defaults.
RATE, SMOOTHING = 0.002, 0.99
RATES, SMOOTHINGS, BUDGETS = (0.0005, RATE, 0.01), (0.0, SMOOTHING, 0.999), (0.0025, 0.01, 0.02, 0.05)


@dataclass(frozen=True)
class Settings:
    """`before`, `after`: frames before and after the lamp moves; `share`: of the pixels that train; `vertices`: records
    of a training path; `truth`: samples of each pixel's radiance to compare with."""

    size: tuple[int, int]
    before: int
    after: int
    truth: int
    share: float = 0.05
    vertices: int = 3


QUICK, FULL = Settings((96, 96), 100, 60, 1024), Settings((256, 256), 600, 300, 4096)


class Renderer:
    """A renderer of one's own around a :class:`RadianceCache`, in NumPy but for the rays."""

    def __init__(self, scene, n_training: int, vertices: int) -> None:
        self.scene, self.n_training, self.vertices = scene, n_training, vertices
        self.direct = mi.load_dict({"type": "path", "max_depth": 2})
        width, height = scene.sensors()[0].film().crop_size()
        self.shape = int(height), int(width)
        box, n = scene.bbox(), self.shape[0] * self.shape[1]
        self.cache = RadianceCache(n, n_training * vertices, box.min, box.max, preset="paper")
        self.centres = self._camera_rays(self.pixel_centres())

    def pixel_centres(self):
        """Film positions of all pixels, in [0, 1]²."""
        index = dr.arange(mi.UInt32, self.shape[0] * self.shape[1])
        return mi.Point2f((index % self.shape[1] + 0.5) / self.shape[1], (index // self.shape[1] + 0.5) / self.shape[0])

    def _camera_rays(self, position):
        ray, _ = self.scene.sensors()[0].sample_ray_differential(0.0, 0.5, position, mi.Point2f(0.5))
        return mi.RayDifferential3f(ray)

    def _points(self, si):
        """Inputs of the cache at surfaces, and where there are any that reflect."""
        bsdf = si.bsdf()
        valid = si.is_valid() & (si.emitter(self.scene) == None)  # noqa: E711 (a Dr.Jit comparison)
        albedo = np.array(bsdf.eval_diffuse_reflectance(si, valid)).T
        n = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -1, 1) * si.sh_frame.n
        arrays = (np.array(v, np.float32).T for v in (si.p, n, si.to_world(si.wi)))
        valid = np.array(valid)
        packed = self.cache.pack(*arrays, albedo.astype(np.float32), np.ones(len(valid), np.float32))
        return np.where(valid[:, None], packed, 0.5).astype(np.float32), valid

    def training_paths(self, seed: int):
        """Records of one frame as :func:`self_training_frame` takes them."""
        n = self.n_training
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed, n)
        ray = self._camera_rays(sampler.next_2d())
        active = mi.Bool(True)
        points, gathered, factors, valid = [], [], [], []
        for _ in range(self.vertices):
            si = self.scene.ray_intersect(ray, active)
            radiance = self.direct.sample(self.scene, sampler, ray, None, active)[0]
            emitted = dr.select(si.is_valid(), si.emitter(self.scene).eval(si, active), 0)
            sample, value = si.bsdf().sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d(), active)
            found, there = self._points(si)
            points.append(found)
            valid.append(there & np.array(active))
            gathered.append(np.array(radiance - emitted).T)
            active &= si.is_valid() & dr.any(value > 0)
            factors.append(np.array(dr.select(active, value, 0)).T)
            ray = mi.RayDifferential3f(si.spawn_ray(si.to_world(sample.wo)))
            dr.eval(ray, active)
        tails, there = self._points(self.scene.ray_intersect(ray, active))
        return points, gathered, factors, valid, tails, there & np.array(active)

    def frame(self, seed: int, rate: float, smoothing: float) -> np.ndarray:
        """Trace training paths, query all pixels, train: one frame of the guide. Returns the picture (h, w, 3)."""
        points, gathered, factors, valid, tails, ends = self.training_paths(seed)
        targets, weights, rest, throughput = [], [], np.zeros_like(gathered[0]), ends[:, None].astype(np.float32)
        for direct, factor in zip(gathered[::-1], factors[::-1], strict=True):  # from the path's end to the camera
            rest, throughput = direct + factor * rest, factor * throughput
            targets.insert(0, rest)
            weights.insert(0, throughput)
        used = np.concatenate(valid)
        inputs, targets, weights = (np.concatenate(v)[used] for v in (points, targets, weights))
        index = np.tile(np.arange(self.n_training), self.vertices)[used]
        pixels, there = self._points(self.scene.ray_intersect(self.centres))
        override = DispatchFlags.OVERRIDE_LEARNING_RATE | DispatchFlags.OVERRIDE_WEIGHT_SMOOTHING
        found = self_training_frame(
            self.cache, inputs, targets.astype(np.float32), tails, weights.astype(np.float32), index, pixels,
            DispatchFlags.TRAINING | override, learning_rate=rate, weight_smoothing=smoothing,
        )  # fmt: skip
        return np.where(there[:, None], found, 0).reshape(*self.shape, 3)

    def truth(self, samples: int) -> np.ndarray:
        """Reflected radiance at the pixels' centres, path traced (h, w, 3)."""
        path, total = mi.load_dict({"type": "path", "max_depth": 64}), 0.0
        each = 64
        for k in range(samples // each):
            sampler = mi.load_dict({"type": "independent"})
            n = self.shape[0] * self.shape[1]
            sampler.seed(k, n * each)
            index = dr.arange(mi.UInt32, n * each) // each
            position = mi.Point2f((index % self.shape[1] + 0.5) / self.shape[1],
                                  (index // self.shape[1] + 0.5) / self.shape[0])  # fmt: skip
            radiance = path.sample(self.scene, sampler, self._camera_rays(position))[0]
            total = total + np.stack([np.array(dr.block_sum(c, each)) for c in radiance], axis=-1) / each
        si = self.scene.ray_intersect(self.centres)
        reflects = self._points(si)[1]
        return np.where(reflects[:, None], total / (samples // each), 0).reshape(*self.shape, 3)


def run(group: Group, settings: Settings, rate: float, smoothing: float, share: float) -> Part:
    """Errors and flicker by frame for one setting of the cache; the lamp moves after `before` frames."""

    def measure(bar) -> Part:
        loaded, over_time = _scene(settings)
        truths = [group.part(f"truth_{k}", lambda b, k=k: _truth(settings, k)).arrays["image"] for k in range(2)]
        renderer = Renderer(loaded.scene, max(8, round(share * settings.size[0] * settings.size[1])), settings.vertices)
        found, n_frames = Frames(renderer), settings.before + settings.after
        unfinished, folder = group.unfinished(name), group.folder
        if (kept := unfinished.read()) is not None:
            found.go_on(kept, folder)
        try:
            for frame in range(len(found.errors), n_frames):
                over_time.apply(int(frame >= settings.before))
                image = found.render(frame, rate, smoothing, truths[frame >= settings.before])
                if frame in (settings.before - 1, settings.before + min(10, settings.after - 1)):
                    found.shown[f"image_{len(found.shown)}"] = image.astype(np.float32)
                unfinished.keep(partial(found.so_far, folder))
                if bar:
                    bar(frame + 1, n_frames)
        except KeyboardInterrupt:
            if found.between_frames:
                unfinished.keep(partial(found.so_far, folder), now=True)
            raise
        over_time.restore()
        return Part({"error": found.errors, "flicker": found.flicker, "seconds": float(np.median(found.seconds))},
                    found.shown)  # fmt: skip

    name = f"rate_{rate:g}_smoothing_{smoothing:g}_share_{share:g}"
    return group.part(name, measure)


class Frames:
    """Frames of a renderer so far: error, flicker (None for the first) and seconds of each, and the images to show."""

    LISTS = ("errors", "flicker", "seconds")

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self.shown, self.previous = renderer, {}, None
        self.errors: list[float] = []
        self.flicker: list[float | None] = []
        self.seconds: list[float] = []

    def render(self, frame: int, rate: float, smoothing: float, truth: np.ndarray) -> np.ndarray:
        """The next frame, measured against `truth`."""
        start = time.process_time()
        image = self.renderer.frame(frame + 1, rate, smoothing)
        self.seconds.append((time.process_time() - start) / environment.cores())
        self.flicker.append(None if self.previous is None else metrics.smape(image, self.previous))
        self.errors.append(metrics.relmse_trimmed(image, truth))  # last: it says that the frame is done
        self.previous = image
        return image

    @property
    def between_frames(self) -> bool:
        """Whether the cache has learned from the frames that are noted and from no other: one step each."""
        return self.renderer.cache.field.steps == len(self.errors) > 0

    def so_far(self, folder: Path) -> Part:
        """All of this, to be kept. A file for a moment in `folder`."""
        path = folder / "cache.npz"
        self.renderer.cache.save(str(path))
        cache = np.frombuffer(path.read_bytes(), np.uint8)
        path.unlink()
        numbers = {name: getattr(self, name) for name in self.LISTS}
        return Part(numbers, {"cache": cache, "previous": self.previous, **self.shown})

    def go_on(self, kept: Part, folder: Path) -> None:
        """Go on from what :meth:`so_far` gave."""
        for name in self.LISTS:
            setattr(self, name, list(kept.numbers[name]))
        path = folder / "cache.npz"
        path.write_bytes(kept.arrays["cache"].tobytes())
        self.renderer.cache = RadianceCache.load(str(path))
        path.unlink()
        self.previous = kept.arrays["previous"]
        self.shown = {k: v for k, v in kept.arrays.items() if k.startswith("image_")}


def _scene(settings: Settings):
    loaded = load.load_scene("cornell_box", settings.size, merge=False)
    move = {"lamp_panel.to_world": lambda k, value: rotate([0, 0, 1], 90, [0, 1.1, 0]) @ value if k else value}
    return loaded, sequence.Sequence(loaded.scene, move, 2, 1)


def _truth(settings: Settings, state: int) -> Part:
    loaded, over_time = _scene(settings)
    over_time.apply(state)
    return Part({}, {"image": Renderer(loaded.scene, 8, settings.vertices).truth(settings.truth)})


def _measures(settings: Settings, part: Part) -> tuple[float, float, float]:
    """Error before the change, flicker before it (both over the last 20 frames), and mean error of all frames after."""
    error, flicker = part.numbers["error"], part.numbers["flicker"]
    last = slice(max(1, settings.before - 20), settings.before)
    return float(np.mean(error[last])), float(np.mean(flicker[last])), float(np.mean(error[settings.before :]))


NOTES = [
    "The picture is the cache at the first surface, at pixel centres, so that nothing but the cache flickers. After "
    "some frames the lamp of the Cornell box moves from the ceiling to a wall. RadianceCache with preset=paper.",
    "Error: trimmed relMSE against path-traced radiance at the same points. Flicker: SMAPE to the frame before.",
]


def overrides(work: Work) -> Outcome:
    """Learning rate and weight smoothing: flicker against response."""
    settings = work.choose(QUICK, FULL)
    group = work.group("fsr", settings)
    pairs = dict.fromkeys([*((r, s) for s in (SMOOTHING, 0.0) for r in RATES), *((RATE, s) for s in SMOOTHINGS)])
    name = "rate {:g}, smoothing {:g}".format
    parts = {name(*pair): run(group, settings, *pair, settings.share) for pair in pairs}
    found = {label: _measures(settings, p) for label, p in parts.items()}
    statements, lower = [], "A lower learning rate gives less flicker and a slower response"
    for paper, labels in (
        (lower, [name(r, SMOOTHING) for r in RATES]),
        (f"{lower}, without smoothing", [name(r, 0.0) for r in RATES]),
        ("A larger smoothing gives less flicker and a slower response", [name(RATE, s) for s in SMOOTHINGS[::-1]]),
    ):
        flicker, lag = ([found[m][k] for m in labels] for k in (1, 2))
        statements.append(
            Statement(
                paper, "tuning and optimization",
                "; ".join(f"{m}: flicker {number(f)}, error after the change {number(e)}"
                          for m, f, e in zip(labels, flicker, lag, strict=True)),
                bool(flicker == sorted(flicker) and lag == sorted(lag, reverse=True)),
                f"flicker {number(flicker[-1] / flicker[0])} times, error after the change {number(lag[-1] / lag[0])} "
                "times from the first to the last",
                f"after {settings.before} frames a cache of a low rate is still on its way, and its pictures move for "
                "that reason; with smoothing that is more than what flickers. After the change a high rate has to undo "
                "more, and its noise is part of the error",
            )
        )  # fmt: skip
    frames = range(settings.before + settings.after)
    change = {"change": settings.before}
    errors = {m: (frames, p.numbers["error"]) for m, p in parts.items()}
    flickers = {m: (frames[1:], p.numbers["flicker"][1:]) for m, p in parts.items()}
    pictures = [figures.pictures({m: p.arrays[f"image_{k}"] for m, p in parts.items()}, columns=4).data()
                for k in range(2)]  # fmt: skip
    table = [["", "error before", "flicker before", "error after"]]
    table += [[m, *(number(v) for v in of)] for m, of in found.items()]
    return Outcome(
        statements, {"Overrides": table},
        {"Error": figures.curves(errors, x="frame", y="trimmed relMSE", log="y", vertical=change).data(),
         "Flicker": figures.curves(flickers, x="frame", y="SMAPE", log="y", vertical=change).data(),
         "Before the change": pictures[0], "10 frames after": pictures[1]}, NOTES,
    )  # fmt: skip


def training_budget(work: Work) -> Outcome:
    """Share of the pixels that train: error against time."""
    settings = work.choose(QUICK, FULL)
    group = work.group("fsr", settings)
    parts = {b: run(group, settings, RATE, SMOOTHING, b) for b in BUDGETS}
    found = {b: _measures(settings, p) for b, p in parts.items()}
    ms = {b: 1e3 * p.numbers["seconds"] for b, p in parts.items()}
    gain = found[0.01][0] / found[0.05][0]
    statements = [
        Statement(
            "Typically 1 to 5 % of the pixels train", "context creation",
            "; ".join(f"{100 * b:g} %: error {number(found[b][0])}, {ms[b]:.1f} ms a frame" for b in BUDGETS)
            + f" on {settings.size[0]}x{settings.size[1]} pixels",
            bool(found[0.0025][0] > 1.2 * found[0.01][0] and gain < 4),
            f"with 5 % instead of 1 % {number(gain)} times less error, with a quarter of 1 % "
            f"{number(found[0.0025][0] / found[0.01][0])} times more",
            "a share of a small film is few paths: 5 % of it are fewer than 0.1 % of 1920x1080",
        )
    ]  # fmt: skip
    frames = range(settings.before + settings.after)
    lines = {f"{100 * b:g} %": (frames, p.numbers["error"]) for b, p in parts.items()}
    table = [["pixels that train", "paths", "error before", "flicker before", "error after", "ms a frame"]]
    table += [[f"{100 * b:g} %", str(max(8, round(b * settings.size[0] * settings.size[1]))),
               *(number(v) for v in found[b]), f"{ms[b]:.1f}"] for b in BUDGETS]  # fmt: skip
    shown = {f"{100 * b:g} %": p.arrays["image_0"] for b, p in parts.items()}
    drawn = figures.curves(lines, x="frame", y="trimmed relMSE", log="y", vertical={"change": settings.before})
    return Outcome(statements, {"Budget": table},
                   {"Error": drawn.data(), "Before the change": figures.pictures(shown).data()}, NOTES)  # fmt: skip


ENTRIES = (
    Entry("fsr/overrides", "Tuning and Optimization", "Learning rate and weight smoothing: flicker against response.",
          "cornell_box", (50, 1800), overrides),
    Entry("fsr/budget", "Context Creation", "Share of the pixels that train: error against time.",
          "cornell_box", (40, 1200), training_budget),
)  # fmt: skip
