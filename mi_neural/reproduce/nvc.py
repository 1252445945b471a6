"""Counterparts of the figures of Bokšanský and Meister 2025: Neural Visibility Cache for Real-Time Light Sampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_neural.bench import budget, load
from mi_neural.bench.report import number
from mi_neural.explore import figures
from mi_neural.image import exr, metrics

from . import measures
from .entry import Entry, Outcome, Statement
from .work import Part, Work

#: The methods that are compared, as plugin and keys.
METHODS = {
    "ReSTIR": ("restir_di", {"preset": "paper"}),
    "NLS": ("nvc_direct", {"preset": "paper", "mode": "sampled"}),
    "Neural DI": ("nvc_direct", {"preset": "paper", "mode": "neural"}),
    "NRC-DI": ("nvc_direct", {"preset": "paper", "cache": "radiance"}),
}
NOTES = [
    "Kitchen, Sponza with lamps and Subway are not shipped. lamp_bays has 32 lamps, as the paper's scenes have, and "
    "any point sees few of them.",
    "One sample a pixel and one training step a frame, with preset=paper. NLS: neural light sampling; Neural DI: "
    "without shadow rays; NRC-DI: a radiance cache of direct light. Errors are those of direct light against many "
    "samples.",
]


@dataclass(frozen=True)
class Frames:
    """`frames` are rendered, one sample a pixel each; the last `averaged` of them count as converged."""

    size: tuple[int, int]
    frames: int
    reference_spp: int
    averaged: int = 16
    scene: str = "lamp_bays"


QUICK, FULL = Frames((96, 54), 128, 2048), Frames((320, 180), 1024, 8192)


def kept_frames(settings: Frames) -> list[int]:
    """Frames whose image is kept, counted from 1: the first four, powers of two, and the last."""
    powers = [1, 2, 3, *(2**k for k in range(2, 11))]
    return sorted({k for k in powers if k < settings.frames} | {settings.frames})


@dataclass
class Progress:
    """A run of each method: FLIP of each frame, kept images by frame, the mean of the last frames, seconds a frame."""

    settings: Frames
    reference: np.ndarray
    flip: dict[str, list[float]]
    images: dict[str, dict[int, np.ndarray]]
    mean: dict[str, np.ndarray]
    seconds: dict[str, float]

    def late(self, method: str) -> float:
        """Mean FLIP of the last frames."""
        return float(np.mean(self.flip[method][-self.settings.averaged :]))


def progress(work: Work, settings: Frames) -> Progress:
    """Frames of all methods from an empty cache on."""
    loaded = load.load_scene(settings.scene, settings.size)
    group = work.group(f"nvc-{settings.scene}", settings)
    reference = measures.direct_reference(group, loaded, settings.reference_spp)
    found = Progress(settings, reference, {}, {}, {}, {})
    for label, (plugin, keys) in METHODS.items():

        def run(bar, plugin=plugin, keys=keys) -> Part:
            return _frames(loaded, measures.make(loaded, plugin, **keys), settings, reference, bar)

        part = group.part(f"frames_{label}", run)
        found.flip[label], found.seconds[label] = part.numbers["flip"], part.numbers["seconds"]
        found.images[label] = {k: part.arrays[f"frame_{k}"] for k in kept_frames(settings)}
        found.mean[label] = part.arrays["mean"]
    return found


def _frames(loaded, integrator, settings: Frames, reference: np.ndarray, bar) -> Part:
    exposures, flips, arrays = metrics.flip_exposures(reference), [], {}
    total = np.zeros_like(reference, np.float64)
    for k in range(1, settings.frames + 1):
        image = budget.render_pass(loaded.scene, integrator, 1, k)[..., :3]
        flips.append(metrics.flip(image, reference, exposures).mean)
        if k in kept_frames(settings):
            arrays[f"frame_{k}"] = image
        if k > settings.frames - settings.averaged:
            total += image / settings.averaged
        if bar:
            bar(k, settings.frames)
    seconds = measures.seconds_of(loaded, {"": integrator}, {"": 1}, 6)[""]
    return Part({"flip": flips, "seconds": seconds}, arrays | {"mean": total.astype(np.float32)})


# ------------------------------------------------------------------------------------------------------------------
# Figures 1 and 9


def figure_1(work: Work) -> Outcome:
    """Converged frames of ReSTIR, neural light sampling and neural direct illumination."""
    found = progress(work, work.choose(QUICK, FULL))
    flip, last = {m: found.late(m) for m in METHODS}, found.settings.frames
    ms = {m: 1e3 * s for m, s in found.seconds.items()}
    less = 100 * (flip["NLS"] / flip["ReSTIR"] - 1)
    statements = [
        Statement(
            "FLIP of neural light sampling is about 20 % (Kitchen) and 45 % (Sponza) below ReSTIR's",
            "section 4.1",
            f"{number(flip['NLS'])} and {number(flip['ReSTIR'])}: {less:+.0f} %", bool(less <= -20),
            f"{less + 20:+.0f} percentage points from the smaller of both" if less > -20 else "",
            "our ReSTIR is unbiased and tests visibility wherever a sample goes, which costs rays and saves noise; and "
            "its 32 pixels of reuse are a larger part of a small film",
        ),
        Statement(
            "Neural DI has significantly less error than both", "section 4.1, figure 1",
            f"FLIP {number(flip['Neural DI'])}", bool(flip["Neural DI"] < min(flip["NLS"], flip["ReSTIR"])),
            f"{100 * (flip['Neural DI'] / flip['NLS'] - 1):+.0f} % against NLS",
            "its bias does not fall with training: shadows are as blurred as the grid, and with the squared error "
            "lamps that are seen from few points are predicted as hidden everywhere",
        ),
        Statement(
            "3.61, 3.95 and 4.41 ms a frame (ReSTIR, NLS, Neural DI)", "figure 1",
            ", ".join(f"{m} {ms[m]:.1f}" for m in METHODS)
            + f" ms at {found.settings.size[0]}x{found.settings.size[1]}",
            None, "", "another machine and film. A training step of 8192 points and 32 shadow rays each does not "
            "shrink with the film, so that it is most of a frame here",
        ),
    ]  # fmt: skip
    shown = {m: found.images[m][last] for m in METHODS} | {"ground truth": found.reference}
    notes = {m: f"FLIP {number(v)}" for m, v in flip.items()}
    maps = {m: metrics.flip(i, found.reference).map for m, i in shown.items() if m in METHODS}
    return Outcome(
        statements, {"Converged frames": _table(found, flip, ms)},
        {"Images": figures.pictures(shown, notes=notes, columns=3).data(),
         "FLIP": figures.maps(maps, notes=notes, low=0, high=0.8, label="FLIP", columns=2).data()}, NOTES,
    )  # fmt: skip


def _table(found: Progress, flip: dict[str, float], ms: dict[str, float]) -> list[list[str]]:
    head = [["", f"FLIP, last {found.settings.averaged} frames", "mean over the truth's", "ms a frame"]]
    level = found.reference.mean()
    return head + [[m, number(flip[m]), number(float(found.mean[m].mean() / level)), number(ms[m])] for m in METHODS]


# ------------------------------------------------------------------------------------------------------------------
# Figures 6 and 8


def figure_6(work: Work) -> Outcome:
    """FLIP over the frames from an empty cache on."""
    found = progress(work, work.choose(QUICK, FULL))
    n, smooth = found.settings.frames, {m: np.array(v) for m, v in found.flip.items()}
    ahead = next((k + 1 for k in range(n) if (smooth["NLS"][k:] < smooth["ReSTIR"][k:]).mean() > 0.95), None)
    four, early = min(4, n), float(smooth["NLS"][19:30].mean()) if n > 30 else float("nan")
    colour = {k: measures.chromaticity_error(found.images["NRC-DI"][k], found.reference) for k in (four, n)}
    statements = [
        Statement(
            "Lower error than ReSTIR after only three training steps", "figure 6",
            f"FLIP after frame 3: NLS {number(smooth['NLS'][min(2, n - 1)])}, ReSTIR "
            f"{number(smooth['ReSTIR'][min(2, n - 1)])}; "
            + ("NLS is never lastingly below ReSTIR" if ahead is None else f"NLS stays below from frame {ahead} on"),
            bool(ahead is not None and ahead <= 4), "" if ahead is None else f"{ahead - 3:+d} frames",
            "our ReSTIR falls at once, too. The untrained network predicts 1/2 for all lamps, that is a choice by "
            "unshadowed light; the first steps of rate 0.05 with the squared error drive all predictions towards 0, "
            "since a lamp is seen from few points, and the choice becomes worse before it becomes better",
        ),
        Statement(
            "FLIP is significantly reduced after 20 to 30 training steps", "section 4.1",
            f"NLS: {number(smooth['NLS'][0])} at first, {number(early)} in frames 20 to 30, "
            f"{number(found.late('NLS'))} at the end",
            bool(early < 0.5 * (smooth["NLS"][0] + found.late("NLS"))), f"{early - found.late('NLS'):+.3f} to the end",
            "the same: by then the network has recovered from its first steps, and not yet learned the rest",
        ),
        Statement(
            "NRC-DI suffers from wrong colours, above all at the beginning", "figure 6, section 4.2",
            f"FLIP of frame {four}: NRC-DI {number(smooth['NRC-DI'][four - 1])}, NLS "
            f"{number(smooth['NLS'][four - 1])}; chromaticity error of NRC-DI {number(colour[four])}, at the end "
            f"{number(colour[n])}",
            bool(smooth["NRC-DI"][four - 1] > smooth["NLS"][four - 1]), "",
            "our NRC-DI begins at the scene's mean radiance and is multiplied by the albedo, so that it is never black "
            "or of random colours",
        ),
    ]  # fmt: skip
    frames = [k for k in (1, 4, 16, n) if k in found.images["NLS"]]
    shown, notes = {}, {}
    for m in METHODS:
        for k in frames:
            shown[f"{m}, frame {k}"] = found.images[m][k]
            notes[f"{m}, frame {k}"] = f"FLIP {number(smooth[m][k - 1])}"
    lines = {m: (range(1, n + 1), v) for m, v in smooth.items()}
    return Outcome(
        statements, {},
        {"FLIP over frames": figures.curves(lines, x="frame", y="FLIP", log="x").data(),
         "Progression": figures.pictures(shown, notes=notes, columns=len(frames),
                                         exposure=exr.automatic_exposure(found.reference)).data()}, NOTES,
    )  # fmt: skip


def figure_8(work: Work) -> Outcome:
    """Colour shifts of the radiance cache, and the sampled light without."""
    found = progress(work, work.choose(QUICK, FULL))
    colour = {m: measures.chromaticity_error(i, found.reference) for m, i in found.mean.items()}
    bias = {m: metrics.relmse_trimmed(i, found.reference) for m, i in found.mean.items()}
    statements = [
        Statement(
            "NRC-DI shows blurry artifacts and colour shifts, neural light sampling none", "figure 8",
            f"means of the last {found.settings.averaged} frames: chromaticity error NRC-DI "
            f"{number(colour['NRC-DI'])}, NLS {number(colour['NLS'])}; relMSE "
            f"{number(bias['NRC-DI'])} and {number(bias['NLS'])}",
            bool(colour["NRC-DI"] > colour["NLS"]),
            f"{number(colour['NRC-DI'] / colour['NLS'])} times the colour error",
            "what is left of NLS is noise, which falls with the frames, and that of NRC-DI is not",
        )
    ]  # fmt: skip
    shown = found.mean | {"ground truth": found.reference}
    notes = {m: f"chromaticity error {number(v)}" for m, v in colour.items()}
    table = [["", "chromaticity error", "relMSE"], *([m, number(colour[m]), number(bias[m])] for m in METHODS)]
    pictures = {"Means of frames": figures.pictures(shown, notes=notes, columns=3).data()}
    return Outcome(statements, {"Means of frames": table}, pictures, NOTES)


ENTRIES = (
    Entry("nvc/fig1", "Figures 1 and 9", "ReSTIR, neural light sampling and neural direct illumination, converged.",
          "lamp_bays", (35, 2400), figure_1),
    Entry("nvc/fig6", "Figure 6", "Error over 128 frames from an empty cache: NRC-DI, neural sampling, ReSTIR.",
          "lamp_bays", (35, 2400), figure_6),
    Entry("nvc/fig8", "Figure 8", "Colour shifts of a radiance cache of direct light.",
          "lamp_bays", (35, 2400), figure_8),
)  # fmt: skip
