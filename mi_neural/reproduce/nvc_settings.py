"""Counterparts of figures of Bokšanský and Meister 2025 that compare settings of the cache, and its timings."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from mi_neural.bench import budget, environment, load
from mi_neural.bench.report import number
from mi_neural.explore import figures
from mi_neural.explore.views import VisibilityMap
from mi_neural.image import exr, metrics

from . import measures
from .entry import Entry, Outcome, Statement
from .nvc import NOTES
from .work import Part, Work

# ------------------------------------------------------------------------------------------------------------------
# Figures 4 and 5


@dataclass(frozen=True)
class Variants:
    """`train` steps, then frames of one sample a pixel, and one image of `spp`."""

    size: tuple[int, int]
    train: int
    spp: int
    reference_spp: int
    scene: str = "lamp_bays"


def figure_4(work: Work) -> Outcome:
    """Training points in the air alone, on surfaces alone, and both."""
    settings = work.choose(Variants((96, 54), 96, 16, 2048), Variants((320, 180), 512, 64, 8192))
    kinds = {"world space alone": (1.0, "squared"), "both": (0.5, "squared"), "screen space alone": (0.0, "squared"),
             "both, by cross-entropy": (0.5, "cross_entropy")}  # fmt: skip
    reference, parts = _variants(work, settings, "points", kinds, lambda kind: {
        "mode": "neural", "light_sampler.world_points": kind[0], "light_sampler.loss": kind[1]})  # fmt: skip
    errors = {m: metrics.relmse_trimmed(p.arrays["image"], reference) for m, p in parts.items()}
    dark = {m: float((p.arrays["image"].mean(-1) < 0.5 * reference.mean(-1)).mean()) for m, p in parts.items()}
    world, both, screen, _ = kinds
    statements = [
        Statement(
            "World-space training alone causes dark blobs; screen-space data fixes them", "figure 4",
            "share of pixels of Neural DI below half the true radiance: "
            + ", ".join(f"{m} {100 * v:.1f} %" for m, v in dark.items()),
            bool(dark[world] > 1.2 * dark[both]), f"{number(dark[world] / max(dark[both], 1e-9))} times as many",
            "points in the air and points on surfaces see nearly the same lamps here",
        ),
        Statement(
            "Screen-space data alone is best for a given view", "section 3.3",
            ", ".join(f"relMSE {m} {number(v)}" for m, v in errors.items()),
            bool(errors[screen] <= min(errors[world], errors[both])),
            f"{100 * (errors[screen] / errors[both] - 1):+.0f} % against both",
            "at the sides of the picture, where the camera sees little of a bay, outputs have fallen to 0 by the same "
            "squared error",
        ),
    ]  # fmt: skip
    shown = {m: p.arrays["image"] for m, p in parts.items()} | {"ground truth": reference}
    notes = {m: f"relMSE {number(v)}" for m, v in errors.items()}
    pictures = {"Neural DI": figures.pictures(shown, notes=notes, columns=2).data()}
    return Outcome(statements, {}, pictures, [*NOTES, PATCH])


PATCH = (
    "With points in the air, half of them or all, the upper part of the rear wall is black: from most of the air in "
    "front of it, above the shelves, each lamp is hidden, and the squared error pulls the outputs to 0, where the "
    "gradient of the sigmoid vanishes. With points on surfaces alone, or by cross-entropy, the default of nvc_lights, "
    "it is gone. So it comes neither of the network's size nor of the lights' evaluation."
)


def figure_5(work: Work) -> Outcome:
    """Visibility clamped to nearly 0 and to 0.001."""
    settings = work.choose(Variants((96, 54), 96, 1024, 2048), Variants((320, 180), 512, 2048, 8192))
    floors = {"not clamped (1e-6)": 1e-6, "0.001": 0.001, "0.06, our default": 0.06}
    reference, parts = _variants(work, settings, "clamp", floors, lambda f: {
        "mode": "sampled", "light_sampler.floor": f})  # fmt: skip
    level = reference.mean()
    means = {m: 100 * (p.arrays["image"].mean() / level - 1) for m, p in parts.items()}
    flip = {m: metrics.flip(p.arrays["image"], reference).mean for m, p in parts.items()}
    noise = {m: metrics.relmse_trimmed(p.arrays["first"], reference) for m, p in parts.items()}
    free, clamped, _ = floors
    statements = [
        Statement(
            "Without the clamp the result is biased around heavily shadowed areas", "figure 5, top",
            f"mean of {settings.spp} samples off by {means[free]:+.1f} %, FLIP {number(flip[free])}",
            bool(flip[free] > 1.5 * flip[clamped]),
            f"{number(flip[free] / flip[clamped])} times FLIP of the clamped one",
            "the key's least value is 1e-6, not 0, and BSDF rays, which the paper does not send, find lamps that are "
            "never chosen",
        ),
        Statement(
            "Clamped to 0.001 it converges to the ground truth", "figure 5, bottom",
            f"mean of {settings.spp} samples off by {means[clamped]:+.1f} %, FLIP {number(flip[clamped])}",
            bool(abs(means[clamped]) < 1), f"{means[clamped]:+.1f} %",
            "rare bright samples, of lamps predicted as hidden, are not all found yet",
        ),
        Statement(
            "at the cost of slightly higher variance", "figure 5",
            "relMSE of one sample, without the largest 0.1 %: "
            + ", ".join(f"{m} {number(v)}" for m, v in noise.items()),
            bool(noise[clamped] >= noise[free]), f"{100 * (noise[clamped] / noise[free] - 1):+.0f} %",
            "a rare bright sample counts as noise here and as bias there",
        ),
    ]  # fmt: skip
    shown = {f"{m}, 1 sample": p.arrays["first"] for m, p in parts.items()}
    shown |= {f"{m}, {settings.spp} samples": p.arrays["image"] for m, p in parts.items()}
    maps = {m: metrics.flip(p.arrays["image"], reference).map for m, p in parts.items()}
    notes = {m: f"FLIP {number(v)}" for m, v in flip.items()}
    table = [["clamp", "mean, off by", f"FLIP of {settings.spp} samples", "relMSE of 1 sample"]]
    table += [[m, f"{means[m]:+.1f} %", number(flip[m]), number(noise[m])] for m in floors]
    exposure = exr.automatic_exposure(reference)
    pictures = {
        "Images": figures.pictures(shown, columns=len(floors), exposure=exposure).data(),
        "FLIP of the long images": figures.maps(maps, notes=notes, low=0, high=0.3, label="FLIP").data(),
    }
    return Outcome(statements, {"Clamp": table}, pictures, NOTES)


def _variants(work: Work, settings: Variants, name: str, values: dict, keys_of):
    """Images of variants of the light sampler: `first` of one sample, `image` of many, after equal training."""
    loaded = load.load_scene(settings.scene, settings.size)
    group = work.group(f"nvc-{name}", settings)
    reference = measures.direct_reference(group, loaded, settings.reference_spp)
    parts = {}
    for k, (label, value) in enumerate(values.items()):

        def run(bar, value=value) -> Part:
            keys = {"light_sampler.type": "nvc_lights", "light_sampler.preset": "paper", "light_sampler.train_steps": 0,
                    "light_sampler.train_frames": settings.train, **keys_of(value)}  # fmt: skip
            integrator = measures.make(loaded, "nvc_direct", **keys)
            first = budget.render_pass(loaded.scene, integrator, 1, 1)[..., :3]
            image = measures.render(loaded, integrator, settings.spp, 2, bar).rgb
            return Part({}, {"first": first, "image": image})

        parts[label] = group.part(f"variant_{k}", run)
    return reference, parts


# ------------------------------------------------------------------------------------------------------------------
# Figure 7


@dataclass(frozen=True)
class Disocclusion:
    """`frames` of one sample a pixel, each without anything to reuse; the visibility is trained by `train` steps."""

    size: tuple[int, int]
    train: int
    frames: int
    reference_spp: int
    scene: str = "lamp_bays"
    outputs: int = 8


def figure_7(work: Work) -> Outcome:
    """ReSTIR where every pixel is disoccluded, with light candidates of its own and of clustered visibility."""
    settings = work.choose(Disocclusion((96, 54), 64, 8, 2048), Disocclusion((320, 180), 512, 32, 8192))
    loaded = load.load_scene(settings.scene, settings.size)
    group = work.group("nvc-disocclusion", settings)
    reference = measures.direct_reference(group, loaded, settings.reference_spp)
    kinds = {"ReSTIR": {}, "with NVC, paper": {"candidate_shadow_ray": False},
             "with NVC, shadow ray": {"candidate_shadow_ray": True}}  # fmt: skip
    parts = {m: group.part(f"frames_{k}", lambda bar, m=m: disoccluded(loaded, settings, kinds[m], m != "ReSTIR", bar))
             for k, m in enumerate(kinds)}  # fmt: skip
    exposures = metrics.flip_exposures(reference)
    flip = {m: float(np.mean([metrics.flip(i, reference, exposures).mean for i in p.arrays["images"]]))
            for m, p in parts.items()}  # fmt: skip
    less = {m: 100 * (v / flip["ReSTIR"] - 1) for m, v in flip.items()}
    statements = [
        Statement(
            "Candidates of the clustered cache reduce noise significantly where every pixel is disoccluded",
            "figure 7",
            f"FLIP {number(flip['ReSTIR'])} without, {number(flip['with NVC, paper'])} with "
            f"({less['with NVC, paper']:+.0f} %), {number(flip['with NVC, shadow ray'])} with and a shadow ray for the "
            f"candidate ({less['with NVC, shadow ray']:+.0f} %)",
            bool(less["with NVC, paper"] < -5), f"{less['with NVC, paper']:+.0f} %",
            "a cluster's visibility is the mean of its lamps', and without a shadow ray what is in shadow is kept for "
            "the neighbours; 32 lamps in 8 clusters are far from 60,000 in 32",
        )
    ]  # fmt: skip
    shown = {m: p.arrays["images"][0] for m, p in parts.items()} | {"ground truth": reference}
    notes = {m: f"FLIP {number(v)}" for m, v in flip.items()}
    exposure = exr.automatic_exposure(reference)
    pictures = {"One frame": figures.pictures(shown, notes=notes, columns=2, exposure=exposure).data()}
    more = (
        f"32 lamps in {settings.outputs} clusters stand for 60,000 in 32. Before each frame all that ReSTIR kept is "
        "dropped; what the network has learned stays."
    )
    return Outcome(statements, {}, pictures, [*NOTES, more])


def disoccluded(loaded, settings: Disocclusion, keys: dict, neural: bool, bar) -> Part:
    """Frames of ReSTIR that reuses no earlier frame, with light candidates by power or (`neural`) by visibility."""
    sampler = {"light_sampler.type": "nvc_lights", "light_sampler.preset": "paper", "light_sampler.train_steps": 0,
               "light_sampler.outputs": settings.outputs, "light_sampler.train_frames": settings.train}  # fmt: skip
    restir = measures.make(loaded, "restir_di", preset="paper", **keys, **(sampler if neural else {}))
    images = []
    for k in range(settings.frames):
        restir.state.reset()
        images.append(budget.render_pass(loaded.scene, restir, 1, k + 1)[..., :3])
        if bar:
            bar(k + 1, settings.frames)
    return Part({}, {"images": np.stack(images)})


# ------------------------------------------------------------------------------------------------------------------
# Timings


@dataclass(frozen=True)
class Times:
    """`rounds`: of passes that take turns."""

    size: tuple[int, int]
    rounds: int


def times(work: Work) -> Outcome:
    """One query of all visibilities against a shadow ray to every light, and a training step."""
    settings = work.choose(Times((640, 360), 4), Times((1920, 1080), 8))
    group = work.group("nvc-times", settings)
    ns = group.part("times", lambda bar: Part(_times(settings, bar))).numbers
    ratio = ns["rays"] / ns["query"]
    statements = [
        Statement(
            "Inference takes 1.32 ms at 1920x1080; 32 shadow rays a pixel take about 7 ms: 5.3 times as long",
            "section 4.3",
            f"a query {ns['query']:.0f} ns a pixel, 32 shadow rays {ns['rays']:.0f} ns: {number(ratio)} times",
            bool(ratio > 2), f"{100 * (ratio / 5.3 - 1):+.0f} %",
            "there rays run on ray tracing hardware and networks on matrix units, here both on the same cores",
        ),
        Statement(
            "Training data take 0.34 to 0.50 ms and the step 0.75 ms: 0.8 to 0.95 times the inference of 1920x1080",
            "section 4.3", f"both {ns['step'] / 1e6:.1f} ms; a query of 1920x1080 pixels would take "
            f"{ns['query'] * 1920 * 1080 / 1e6:.0f} ms: {number(ns['step'] / (ns['query'] * 1920 * 1080))} times",
            bool(0.4 < ns["step"] / (ns["query"] * 1920 * 1080) < 1.9), "",
            "as many points and rays as there. On a GPU 8192 points fill a small part of the machine, and a step of "
            "them takes longer than their share of the work",
        ),
    ]  # fmt: skip
    more = "CPU seconds over the number of cores. Shadow rays go to 8 of the 32 lamps; the choice of a point counts."
    return Outcome(statements, {}, {}, [*NOTES, more])


def _times(settings: Times, bar) -> dict[str, float]:
    """Nanoseconds: of a query and of 32 shadow rays for one pixel, of a training step. What a call costs whatever the
    film is left out: it is the same for a film of a quarter of the pixels."""
    large = _seconds(settings, settings.size, bar)
    small = _seconds(settings, tuple(n // 2 for n in settings.size), bar)
    pixels = 0.75 * settings.size[0] * settings.size[1]
    ns = {name: 1e9 * (large[name] - small[name]) / pixels for name in ("camera", "rays", "query")}
    ray = (ns["rays"] - ns["camera"]) / 8
    camera = max(ns["camera"] - ray, 0.0)  # rays from the camera and their surfaces, which a query has as well
    return {"rays": 32 * ray, "query": max(ns["query"] - camera, 1e-3), "step": 1e9 * large["step"] / 4}


def _seconds(settings: Times, size: tuple[int, int], bar) -> dict[str, float]:
    """Least CPU seconds over the number of cores: one and nine shadow rays a pixel, a query, four steps."""
    loaded = load.load_scene("lamp_bays", size)
    nls = measures.make(loaded, "nvc_direct", preset="paper")
    budget.train(loaded.scene, nls, 4)
    views = [VisibilityMap(loaded.scene, nls, light=k) for k in range(0, 32, 4)]
    actions = {"camera": lambda: [v.add(1) for v in views], "rays": lambda: [v.add(9) for v in views],
               "query": views[0].predicted, "step": lambda: budget.train(loaded.scene, nls, 4)}  # fmt: skip
    least = {}
    for turn in range(settings.rounds + 1):  # the first compiles
        for name, action in actions.items():
            budget.clock()
            start = time.process_time()
            action()
            budget.clock()
            seconds = (time.process_time() - start) / environment.cores()
            if turn:
                least[name] = min(least.get(name, np.inf), seconds)
        if bar:
            bar(turn, settings.rounds)
    least.update({name: least[name] / len(views) for name in ("camera", "rays")})
    return least


ENTRIES = (
    Entry("nvc/fig4", "Figures 3 and 4", "Neural direct light; training points in the air, on surfaces, or both.",
          "lamp_bays", (10, 600), figure_4),
    Entry("nvc/fig5", "Figure 5", "Predicted visibility clamped to nearly 0 and to 0.001: bias and noise.",
          "lamp_bays", (15, 1200), figure_5),
    Entry("nvc/fig7", "Figure 7", "ReSTIR where every pixel is disoccluded, with clustered visibility.",
          "lamp_bays", (10, 600), figure_7),
    Entry("nvc/times", "Section 4.3", "A query of 32 visibilities against 32 shadow rays, and a training step.",
          "lamp_bays", (5, 90), times),
)  # fmt: skip
