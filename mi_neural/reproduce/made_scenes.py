"""Counterparts on scenes that the entry makes itself: foliage, and a hall with 60,000 lights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_neural.bench import load
from mi_neural.bench.report import number
from mi_neural.explore import figures
from mi_neural.image import exr, metrics

from . import measures, nirc, scene_files
from .entry import Entry, Outcome, Statement
from .nvc_settings import Disocclusion, disoccluded
from .work import Part, Work

# ------------------------------------------------------------------------------------------------------------------
# Foliage


@dataclass(frozen=True)
class Foliage:
    """`spp`: of images whose bias is measured; see :class:`.nirc.TwoLevel`."""

    size: tuple[int, int]
    train: int
    images: int
    leaves: int
    spp: int
    reference_spp: int


CROWNS = {"leaves": "foliage", "a smooth ball in its place": "ball"}


def foliage(work: Work) -> Outcome:
    """The incident cache in a crown of leaves, and in front of a ball in its place."""
    settings = work.choose(Foliage((64, 36), 150, 8, 6000, 64, 1024), Foliage((256, 144), 1000, 16, 6000, 256, 4096))
    group = work.group("nirc-foliage", settings)
    table = [["", "", "variance over path", "time over path", "time for equal noise", "bias (trimmed relMSE)"]]
    found, pictures = {}, {}
    for label, name in CROWNS.items():
        file = scene_files.foliage(group.folder, settings.leaves if name == "foliage" else 0)
        two = nirc.TwoLevel(settings.size, settings.train, settings.images, scenes=(str(file),))
        rows = group.part(f"variance_{name}", lambda bar, t=two, f=file: nirc.variance(t, str(f), bar)).numbers
        biased = group.part(f"biased_{name}", lambda bar, f=file: _biased(work, settings, str(f), bar))
        found[label] = {m: (r["variance"] / rows["path"]["variance"], r["seconds"] / rows["path"]["seconds"])
                        for m, r in rows.items() if m != "path"}  # fmt: skip
        for m, (v, t) in found[label].items():
            table.append([label, m, number(v), number(t), number(v * t), ""])
        table.append([label, "nirc, first surface", "", "", "", number(biased.numbers["error"])])
        found[label]["bias"] = biased.numbers["error"]
        pictures[f"Path traced, and nirc: {label}"] = figures.pictures(
            {"path": biased.arrays["reference"], "nirc, first surface": biased.arrays["image"]},
            notes={"nirc, first surface": f"trimmed relMSE {number(biased.numbers['error'])}"},
        ).data()
    bias = [found[label]["bias"] for label in CROWNS]
    (v, t), (v_ball, t_ball) = (found[label][nirc.PAPER_TWO] for label in CROWNS)
    statements = [
        Statement(
            "In foliage the cache is poor: two-level Monte Carlo is less efficient than path tracing", "discussion",
            f"time for equal noise {number(v * t)} times path's among leaves, {number(v_ball * t_ball)} at a ball in "
            "their place", bool(v * t > 1), f"variance {number(v)} times path's; at the ball {number(v_ball)}",
            "the default of nirc_two_level weighs its cache by how good it was measured to be, so poor predictions "
            "cost no noise, only their time",
        ),
        Statement(
            "The cache does not resolve leaves", "discussion",
            f"bias of nirc at the first surface {number(bias[0])} among leaves, {number(bias[1])} at the ball "
            "(trimmed relMSE)", bool(bias[0] > 2 * bias[1]), f"{number(bias[0] / bias[1])} times as much",
        ),
    ]  # fmt: skip
    notes = [
        f"The entry makes both scenes: {settings.leaves} square leaves of 0.1 at random in a ball of radius 1.3 over a "
        "floor, in sun and sky; and the ball. Variance and time as in nirc/two_level."
    ]
    return Outcome(statements, {"Foliage": table}, pictures, notes)


def _biased(work: Work, settings: Foliage, scene: str, bar) -> Part:
    loaded = load.load_scene(scene, settings.size)
    reference = measures.reference(work, loaded, settings.reference_spp)
    integrator = measures.make(loaded, "nirc", termination="primary", spread_threshold=0.0, train_steps=0)
    measures.train(loaded, integrator, settings.train)
    image = measures.render(loaded, integrator, settings.spp, 1, bar).rgb
    error = metrics.relmse_trimmed(image, reference.rgb, reference.variance)
    return Part({"error": error}, {"image": image, "reference": reference.rgb})


# ------------------------------------------------------------------------------------------------------------------
# 60,000 lights


def lights(work: Work) -> Outcome:
    """ReSTIR where every pixel is disoccluded, among 60,000 emissive triangles in 32 clusters."""
    quick, full = Disocclusion((96, 54), 64, 8, 1024, "hall", 32), Disocclusion((320, 180), 512, 32, 8192, "hall", 32)
    settings = work.choose(quick, full)
    group = work.group("nvc-lights", settings)
    file = scene_files.hall_of_lamps(group.folder)
    loaded = load.load_scene(str(file), settings.size)
    reference = measures.direct_reference(group, loaded, settings.reference_spp, hide_emitters=True)
    kinds = {"ReSTIR": {}, "with NVC, paper": {"candidate_shadow_ray": False},
             "with NVC, shadow ray": {"candidate_shadow_ray": True}}  # fmt: skip
    parts = {m: group.part(f"frames_{k}", lambda bar, m=m: disoccluded(
                 loaded, settings, {**kinds[m], "hide_emitters": True}, m != "ReSTIR", bar))
             for k, m in enumerate(kinds)}  # fmt: skip
    exposures = metrics.flip_exposures(reference)
    flip = {m: float(np.mean([metrics.flip(i, reference, exposures).mean for i in p.arrays["images"]]))
            for m, p in parts.items()}  # fmt: skip
    error = {m: float(np.mean([metrics.relmse_trimmed(i, reference) for i in p.arrays["images"]]))
             for m, p in parts.items()}  # fmt: skip
    less = {m: 100 * (v / flip["ReSTIR"] - 1) for m, v in flip.items()}
    statements = [
        Statement(
            "Candidates of the clustered cache reduce noise significantly among 60,000 lights, every pixel disoccluded",
            "figure 7",
            f"FLIP {number(flip['ReSTIR'])} without, {number(flip['with NVC, paper'])} with "
            f"({less['with NVC, paper']:+.0f} %), {number(flip['with NVC, shadow ray'])} with and a shadow ray for the "
            f"candidate ({less['with NVC, shadow ray']:+.0f} %); trimmed relMSE {number(error['ReSTIR'])}, "
            f"{number(error['with NVC, paper'])}, {number(error['with NVC, shadow ray'])}",
            bool(less["with NVC, paper"] < -5), f"{less['with NVC, paper']:+.0f} % FLIP",
            "a cluster of 1,900 triangles reaches over several bays, so its mean visibility says little of one lamp",
        )
    ]  # fmt: skip
    shown = {m: p.arrays["images"][0] for m, p in parts.items()} | {"ground truth": reference}
    notes = {m: f"FLIP {number(v)}" for m, v in flip.items()}
    exposure = exr.automatic_exposure(reference)
    pictures = {"One frame": figures.pictures(shown, notes=notes, columns=2, exposure=exposure).data()}
    more = [
        "The entry makes the scene: 12 x 12 bays behind partitions, 30,000 square lamps (60,000 triangles) in them at "
        "random. Lamps themselves are hidden from the camera. preset=paper, 32 clusters, 49,152 training points.",
        "Before each frame all that ReSTIR kept is dropped; what the network has learned stays.",
    ]
    return Outcome(statements, {}, pictures, more)


ENTRIES = (
    Entry("nirc/foliage", "Limitations", "Foliage, the stated weak case: bias and noise among leaves and at a ball.",
          "made by the entry", (60, 1500), foliage),
    Entry("nvc/lights", "Figure 7", "ReSTIR among 60,000 lights where every pixel is disoccluded.",
          "made by the entry", (60, 1800), lights),
)  # fmt: skip
