"""Counterparts of the figures of Dereviannykh et al. 2025: Neural Two-Level Monte Carlo Real-Time Rendering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_neural.bench import budget, load
from mi_neural.bench.report import number
from mi_neural.explore import figures
from mi_neural.explore.views import Hemisphere
from mi_neural.image import metrics

from . import measures
from .entry import Entry, Outcome, Statement
from .work import Part, Work

#: Paths that train in place of one for each 8x8 pixels: a small film would give a few dozen.
PAPER = {"preset": "paper", "train_samples": 2048}
NOTE_PAPER = (
    "nirc has preset=paper, but trains with 2048 paths a frame; one for each 8x8 pixels is too few on this film."
)

# ------------------------------------------------------------------------------------------------------------------
# What a sample costs


@dataclass(frozen=True)
class Cost:
    """`counts`: samples a pixel, the first and the last of which give the cost of one more."""

    size: tuple[int, int]
    rounds: int
    train: int
    counts: tuple[int, ...] = (1, 4, 16)


def cost(work: Work) -> Outcome:
    """Time of a sample of the incident cache, of the outgoing cache, and of a path."""
    settings = work.choose(Cost((96, 54), 3, 8), Cost((640, 360), 6, 16))
    group = work.group("nirc-cost", settings)
    times = group.part("times", lambda bar: Part(_cost(settings, bar))).numbers
    first, last = (str(n) for n in (settings.counts[0], settings.counts[-1]))
    each = {m: (of[last] - of[first]) / (settings.counts[-1] - settings.counts[0]) for m, of in times.items()}
    table = [["ns of one more sample of a pixel", "ns", "path over it", "nrc over it"]]
    table += [[m, number(1e9 * v), number(each["path"] / v), number(each["nrc"] / v)] for m, v in each.items()]
    paper, own = each["path"] / each[PAPER_NET], each["path"] / each[OWN_NET]
    of_nrc = [each["nrc"] / each[m] for m in (PAPER_NET, OWN_NET)]
    reason = (
        "on tensor cores the network is nearly free and tracing dominates; on a CPU a network of 4 layers of 64 takes "
        "longer than tracing the short paths of a small scene"
    )
    statements = [
        Statement(
            "An evaluation takes 2 to 25 times less time than a path tracing sample", "abstract",
            f"{number(paper)} times less with the paper's network, {number(own)} times with the default one",
            bool(paper >= 2), f"{number(2 / paper)} times below the range" if paper < 2 else "", reason,
        ),
        Statement(
            "Where many samples are taken, one of NIRC is 5 to 10 times cheaper than one of NRC", "project page",
            f"{number(of_nrc[0])} times with the paper's network, {number(of_nrc[1])} times with the default one",
            bool(of_nrc[0] >= 5), f"{number(5 / of_nrc[0])} times below the range" if of_nrc[0] < 5 else "", reason,
        ),
    ]  # fmt: skip
    lines = {m: (settings.counts, [1e9 * of[str(n)] for n in settings.counts]) for m, of in times.items()}
    drawn = figures.curves(lines, x="samples of a pixel", y="ns a pixel", log="xy", marks="o")
    notes = [
        "Bistro is not shipped. path and nrc take N camera samples a pixel; nirc takes one, with direct light, and "
        "asks the cache in N directions. The cost of one more is taken between the least and the largest N, so that "
        "direct light of the one camera sample does not count.",
        "CPU seconds over the number of cores; nrc ends paths by its default rule, at the first wide vertex.",
    ]
    return Outcome(statements, {"Cost of a sample": table}, {"Time over samples": drawn.data()}, notes)


PAPER_NET, OWN_NET = "nirc, paper's network", "nirc, default network"


def _cost(settings: Cost, bar) -> dict[str, dict[str, float]]:
    """Seconds of a pixel, by method and number of samples."""
    loaded = load.load_scene("glossy_hall", settings.size)
    integrators = {("path", n): (measures.make(loaded, "path"), n) for n in settings.counts}
    nrc = measures.make(loaded, "nrc", train_steps=0)
    measures.train(loaded, nrc, settings.train)
    integrators |= {("nrc", n): (nrc, n) for n in settings.counts}
    for name, keys in ((PAPER_NET, PAPER), (OWN_NET, {})):
        common = {**keys, "termination": "primary", "spread_threshold": 0.0, "light_samples": 1, "train_steps": 0}
        for n in settings.counts:
            nirc = measures.make(loaded, "nirc", cache_samples=n, **common)
            measures.train(loaded, nirc, settings.train)
            integrators[name, n] = (nirc, 1)
    times = measures.seconds_of(loaded, {k: v[0] for k, v in integrators.items()},
                                {k: v[1] for k, v in integrators.items()}, settings.rounds, bar)  # fmt: skip
    found: dict[str, dict[str, float]] = {}
    for (m, n), seconds in times.items():
        found.setdefault(m, {})[str(n)] = seconds / budget.pixels(loaded.scene)
    return found


# ------------------------------------------------------------------------------------------------------------------
# Bias over bounces


@dataclass(frozen=True)
class Bounces:
    """`thresholds`: constants c of the spread test at which paths stop earlier or later; `chances`: values of
    ``cache_samples`` by which they do so with ``termination="balanced"``."""

    size: tuple[int, int]
    train: int
    spp: int
    reference_spp: int
    thresholds: tuple[float, ...] = (0.0, 1e-3, 0.1, 1.0, 10.0)
    chances: tuple[int, ...] = (64, 16, 4, 1)

    def stops(self) -> dict[str, tuple[str, list[dict]]]:
        """By name of a curve, a plugin and the keys of its points, from the earliest stop on."""
        spread = [{"spread_threshold": c} for c in self.thresholds]
        chance = [{"cache_samples": n, "termination": "balanced"} for n in self.chances]
        return {"nrc": ("nrc", spread), "nirc": ("nirc", spread), "nirc, balanced": ("nirc", chance)}


def bounces(work: Work) -> Outcome:
    """Squared bias over the number of rays before the cache is asked."""
    settings = work.choose(Bounces((64, 64), 200, 256, 8192), Bounces((256, 256), 1000, 256, 4096))
    loaded = load.load_scene("cornell_box", settings.size)
    reference = measures.reference(work, loaded, settings.reference_spp)
    group = work.group("nirc-bias", settings)
    curves, images = {}, {"reference": reference.rgb}
    for name, (plugin, keys) in settings.stops().items():
        part = group.part(f"stops_{name}", lambda bar, p=plugin, k=keys: _stops(group, loaded, settings, p, k, bar))
        bias = [metrics.bias_and_variance(list(pair), reference.rgb, reference.variance)[0]
                for pair in part.arrays["images"]]  # fmt: skip
        curves[name] = (part.numbers["depth"], bias)
        images[f"{name}, earliest"] = part.arrays["images"][0].mean(axis=0)
    base = curves["nrc"][0][0]  # the cache at the first surface: no ray of reflected light
    rays = {m: [max(0.0, d - base) for d in depth] for m, (depth, _) in curves.items()}
    first = {m: bias[0] for m, (_, bias) in curves.items()}
    needed = next((r for r, b in zip(rays["nrc"], curves["nrc"][1], strict=True) if b <= max(first["nirc"], 0)), None)
    text = "NRC does not reach it" if needed is None else f"NRC needs {needed:.2f} rays for that"
    statements = [
        Statement(
            "NIRC can be asked at the first surface, where NRC needs further rays for the same bias", "project page",
            f"squared bias at the first surface: nirc {number(first['nirc'])} at {rays['nirc'][0]:.2f} rays, nrc "
            f"{number(first['nrc'])} at none; {text}",
            bool(first["nirc"] < first["nrc"]), f"{number(first['nrc'] / max(first['nirc'], 1e-9))} times less bias",
            "a diffuse box without textures is the outgoing cache's best case: what leaves a wall is as smooth as what "
            "arrives, and no integral over directions is left to sample",
        ),
        *(
            Statement(
                f"The bias falls with the bounces before the cache is asked ({m})", "project page, bias plot",
                f"from {number(bias[0])} at {rays[m][0]:.2f} rays to {number(bias[-1])} at {rays[m][-1]:.2f}",
                bool(bias[-1] < bias[0]),
                f"{number(bias[-1] / bias[0])} times" if bias[-1] > 0 else "to below what the samples resolve",
                REASON_BIAS,
            )
            for m, (_, bias) in curves.items()
        ),
    ]  # fmt: skip
    table = [["", "keys", "rays of reflected light", "squared bias"]]
    for m, (_, bias) in curves.items():
        values = [", ".join(f"{k}={v}" for k, v in keys.items()) for keys in settings.stops()[m][1]]
        table += [[m, v, f"{r:.2f}", number(b)] for v, r, b in zip(values, rays[m], bias, strict=True)]
    lines = {m: (rays[m], np.maximum(bias, 1e-6)) for m, (_, bias) in curves.items()}
    return Outcome(
        statements, {"Bias": table},
        {"Bias over rays": figures.curves(lines, x="rays of reflected light a sample", y="squared bias (relMSE)",
                                          log="y", marks="o").data(),
         "Earliest stop": figures.pictures(images, columns=3).data()},
        ["Bias without the noise of the images, from products of two independent ones; it may come out negative where "
         "it is below what the samples resolve, and is then drawn at 1e-6."],
    )  # fmt: skip


REASON_BIAS = (
    "c makes nirc gather what is near, and far light stays with the cache. The cache blurs near and far directions "
    "into one another, and these errors cancel in the integral over directions; where the near part alone is replaced, "
    "the far part's error is left. With the paper's heuristic (termination=balanced), which follows directions by "
    "chance, the bias falls"
)


def _stops(group, loaded, settings: Bounces, plugin: str, keys: list[dict], bar) -> Part:
    common = {"channels": "depth", "train_steps": 0}
    trained = measures.make(loaded, plugin, **common)
    measures.train(loaded, trained, settings.train)
    images, depths = [], []
    for k, of in enumerate(keys):
        integrator = measures.frozen(trained, loaded, group.folder, plugin, **of, **common)
        integrator.plan_samples(1)  # so that what depends on the sample count stays at its most biased setting
        size, *more = budget.plan_passes(loaded.scene, settings.spp)
        pair, depth = [], []
        for j in range(2):
            passes = [budget.render_pass(loaded.scene, integrator, size, budget.pass_seed(2 * k + j, 0, i))
                      for i in range(1 + len(more))]  # fmt: skip
            rgb, channels = load.split_channels(np.mean(passes, axis=0), list(integrator.aov_names()))
            pair.append(rgb)
            depth.append(channels["depth"].mean())
        images.append(np.stack(pair))
        depths.append(float(np.mean(depth)))
        if bar:
            bar(k + 1, len(keys))
    return Part({"depth": depths}, {"images": np.stack(images).astype(np.float32)})


# ------------------------------------------------------------------------------------------------------------------
# Hemisphere


@dataclass(frozen=True)
class Sphere:
    """`pixels`: points (x, y) of the film, as shares of its width and height; `steps`: training frames."""

    size: tuple[int, int]
    disk: int
    spp: int
    steps: tuple[int, ...]
    pixels: tuple[tuple[float, float], ...] = ((0.3, 0.85), (0.5, 0.3))


def hemisphere(work: Work) -> Outcome:
    """What the cache says of all directions at a point."""
    settings = work.choose(Sphere((64, 64), 48, 256, (16, 200)), Sphere((256, 256), 96, 2048, (16, 200, 2000)))
    group = work.group("nirc-hemisphere", settings)
    part = group.part("hemispheres", lambda bar: _hemispheres(settings, bar))
    names = [f"{n} frames" for n in settings.steps] + [f"paper's, {settings.steps[-1]} frames"]
    inside = np.hypot(*np.mgrid[-1 : 1 : settings.disk * 1j, -1 : 1 : settings.disk * 1j]) < 1
    shown, notes, errors, means = {}, {}, {n: [] for n in names}, {n: [] for n in names}
    for k in range(len(settings.pixels)):
        truth = part.arrays[f"traced_{k}"]
        for j, n in enumerate(names):
            title = f"point {k + 1}, {n}"
            shown[title] = part.arrays[f"predicted_{k}_{j}"]
            wrong = (shown[title] - truth)[inside]
            errors[n].append(100 * float(np.sqrt(np.mean(wrong**2)) / truth[inside].mean()))
            means[n].append(100 * abs(float(wrong.mean() / truth[inside].mean())))
            notes[title] = f"rms error {errors[n][-1]:.0f} % of the mean"
        shown[f"point {k + 1}, traced"] = truth
    error, mean = ({n: float(np.mean(v)) for n, v in of.items()} for of in (errors, means))
    first, last, paper = names[0], names[-2], names[-1]
    statements = [
        Statement(
            "The cache learns the light that arrives from all directions", "project page, visualization",
            f"rms error over directions {error[last]:.0f} % of the mean, mean over all directions off by "
            f"{mean[last]:.0f} %, after {last}; with the paper's network {error[paper]:.0f} and {mean[paper]:.0f} %",
            None, "", "the page shows a picture without a number. Spherical harmonics of degree 3 or 4 blur the edges "
            "of what is seen from the point; what a diffuse surface needs, the mean, is nearer",
        ),
        Statement(
            "Reasonable cache quality in 10 to 20 frames", "project page",
            f"rms error {error[first]:.0f} % after {first}, {error[last]:.0f} % after {last}; mean off by "
            f"{mean[first]:.0f} and {mean[last]:.0f} %",
            bool(error[first] < 1.5 * error[last]), f"{number(error[first] / error[last])} times the later error",
            "a frame has 4096 training paths here; the paper's has one for each 8x8 pixels of 1920x1080, eight times "
            "as many",
        ),
    ]  # fmt: skip
    drawn = figures.pictures(shown, notes=notes, columns=len(names) + 1, disk=True)
    return Outcome(
        statements, {}, {"Hemispheres": drawn.data()},
        ["A disk holds the directions above a surface point of the Cornell box, seen along the normal, of equal areas "
         "for equal solid angles. Emission is left out, as in the cache; black is the open front.", NOTE_PAPER],
    )  # fmt: skip


def _hemispheres(settings: Sphere, bar) -> Part:
    loaded = load.load_scene("cornell_box", settings.size)
    points = [(x * settings.size[0], y * settings.size[1]) for x, y in settings.pixels]
    arrays, column = {}, 0
    for keys, steps in (({}, settings.steps), (PAPER, settings.steps[-1:])):
        nirc, trained = measures.make(loaded, "nirc", train_steps=0, **keys), 0
        views = [Hemisphere(loaded.scene, nirc, p, size=settings.disk) for p in points]
        for n in steps:
            measures.train(loaded, nirc, n - trained, bar)
            trained = n
            for k, view in enumerate(views):
                arrays[f"predicted_{k}_{column}"] = view.predicted()
            column += 1
    for k, view in enumerate(views):
        for _ in range(settings.spp // 16):
            view.add(16)
        arrays[f"traced_{k}"] = view.traced
    return Part({}, arrays)


# ------------------------------------------------------------------------------------------------------------------
# Two-level Monte Carlo


@dataclass(frozen=True)
class TwoLevel:
    """`images`: independent ones, of `spp` samples each, from which the variance comes."""

    size: tuple[int, int]
    train: int
    images: int
    spp: int = 4
    scenes: tuple[str, ...] = ("cornell_box", "glossy_hall")


def two_level(work: Work) -> Outcome:
    """Variance and time of the unbiased estimator against path tracing."""
    settings = work.choose(TwoLevel((64, 36), 150, 8), TwoLevel((256, 144), 1000, 16))
    group = work.group("nirc-two-level", settings)
    table = [["scene", "", "variance of a sample", "over path", "time over path", "efficiency"]]
    statements, pictures = [], {}
    for scene in settings.scenes:
        part = group.part(f"variance_{scene}", lambda bar, s=scene: variance(settings, s, bar))
        rows = part.numbers
        for label, row in rows.items():
            v, t = row["variance"] / rows["path"]["variance"], row["seconds"] / rows["path"]["seconds"]
            table.append([scene, label, number(row["variance"]), number(v), number(t), number(1 / (v * t))])
        v = rows[PAPER_TWO]["variance"] / rows["path"]["variance"]
        t = rows[PAPER_TWO]["seconds"] / rows["path"]["seconds"]
        statements.append(
            Statement(
                "Two-level Monte Carlo with NIRC reduces noise at equal time", "abstract",
                f"{scene}: variance {number(v)} times path's at equal samples, {number(t)} times its time: "
                f"{number(1 / (v * t))} times as efficient",
                bool(v * t < 1), f"{number(v * t)} times the time for equal noise",
                "with next-event estimation the noise lies in the light of single directions, which a smooth cache "
                "does not know; and queries cost more on a CPU, see nirc/cost",
            )
        )  # fmt: skip
        pictures[scene] = figures.pictures(
            {label: part.arrays[f"image_{k}"] for k, label in enumerate(rows)},
            notes={label: f"variance {number(row['variance'])}" for label, row in rows.items()},
        ).data()
    notes = [
        "nirc_two_level with preset=paper, trained before with 2048 paths a frame, and with our defaults. Variance is "
        "that of one camera sample over the squared brightness of its pixel, without the largest 0.1 %; time is CPU "
        "time of a pass of equal samples.",
    ]
    return Outcome(statements, {"Efficiency": table}, pictures, notes)


PAPER_TWO = "nirc_two_level, paper"


def variance(settings: TwoLevel, scene: str, bar) -> Part:
    """Variance and seconds of a sample by `path` and by the two-level estimators in a scene, and an image of each."""
    loaded = load.load_scene(scene, settings.size)
    integrators = {"path": measures.make(loaded, "path")}
    for label, keys in ((PAPER_TWO, PAPER), ("nirc_two_level", {})):
        integrators[label] = measures.make(loaded, "nirc_two_level", train_steps=0, **keys)
        measures.train(loaded, integrators[label], settings.train)
    rows, arrays, n = {}, {}, len(integrators)
    for k, (label, integrator) in enumerate(integrators.items()):
        seeds = range(1, settings.images + 1)
        images = [budget.render_pass(loaded.scene, integrator, settings.spp, s)[..., :3] for s in seeds]
        rows[label] = {"variance": measures.relative_variance(images, settings.spp)}
        arrays[f"image_{k}"] = images[0]
        if bar:
            bar(k + 1, n)
    for label, seconds in measures.seconds_of(loaded, integrators, dict.fromkeys(integrators, settings.spp), 3).items():
        rows[label]["seconds"] = seconds
    return Part(rows, arrays)


ENTRIES = (
    Entry("nirc/cost", "Performance comparison", "What a sample of the incident cache costs beside a path and nrc.",
          "glossy_hall", (20, 300), cost),
    Entry("nirc/bias", "Bias over indirect bounces", "How many rays the incident cache saves at equal bias.",
          "cornell_box", (30, 1200), bounces),
    Entry("nirc/hemisphere", "NIRC visualization", "Light from all directions at a point: predicted and traced.",
          "cornell_box", (10, 300), hemisphere),
    Entry("nirc/two_level", "Two-Level Monte Carlo", "Noise and time of the unbiased estimator against path tracing.",
          "cornell_box, glossy_hall", (25, 600), two_level),
)  # fmt: skip
