"""Counterparts of the figures of Klepikov, Hanika, Dachsbacher: Reliability-Weighted Averaging."""

from __future__ import annotations

import numpy as np

from mi_neural.bench.changes import rotate, rotated
from mi_neural.bench.report import number
from mi_neural.explore import figures

from . import changed
from .changed import CHANGE, Change, Measured, Settings
from .entry import Entry, Outcome, Statement
from .work import Work

QUICK = Settings(size=(64, 64), frames=60, pretrain=200, spp=8, reference_spp=2048, cache_samples=4)
FULL = Settings(size=(192, 192), frames=80, pretrain=5000, spp=8, reference_spp=4096, cache_samples=4)


def _lamp(frame: int, value: np.ndarray) -> np.ndarray:
    """The panel under the ceiling of the Cornell box, from the change on before its red wall."""
    return rotate([0, 0, 1], 90, [0, 1.1, 0]) @ value if frame >= CHANGE else value


def _sun(frame: int, value: np.ndarray) -> np.ndarray:
    return rotated(value, [0, 1, 0], -60.0) if frame >= CHANGE else value


LAMP = Change("cornell_box", "the lamp moves from the ceiling to the red wall", {"lamp_panel.to_world": _lamp})
SUN = Change("glossy_hall", "the sun turns by 60 degrees", {"sun.direction": _sun})

NOTES = [
    "The paper's scenes (Sponza, Bistro, San Miguel) are not shipped; the scene here is one of the package's own, and "
    f"its light changes at frame {CHANGE}, as in the paper.",
    "Direct light of each frame is replaced by its mean over many samples before errors are measured: its noise is "
    "the same for all methods and larger than what they differ in.",
    "The paper prints neither network nor learning rate. Here they are the defaults of nirc; λ = 0.9, K = 128 and "
    "κ = 4 are the paper's. High-LR and EMA are nirc with blend=fast and blend=ema, last_rate=1; the blend is "
    "blend=reliability, reliability=correlation; by evidence is the default rule of this package.",
]


#: A change of the mean weight that counts as a shift.
SHIFT = 0.1
WEAK_SHIFT = (
    "the two mean reliabilities are at most {largest:.3f} apart, and with κ = 4 that moves the weight by no more than "
    "that. Targets are single paths, whose noise bounds both correlations from above alike. So the paper's rule is "
    "nearly the plain mean of both predictors here, before the change and after it; a weight of 0.8 would need "
    "reliabilities that are 0.35 apart. The cache is also not yet steady at the end: it has seen fewer records by then "
    "than the paper's."
)


def _measured(work: Work) -> Measured:
    return changed.measure(work, work.choose(QUICK, FULL), LAMP)


def _triple(values: list[float]) -> str:
    return ", ".join(number(v) for v in values)


def _curve(found: Measured, name: str, label: str) -> bytes:
    frames = range(found.settings.frames)
    lines = {m: zip(*[(k, v) for k, v in zip(frames, c[name], strict=True) if v is not None], strict=True)
             for m, c in found.curves.items()}  # fmt: skip
    return figures.curves({m: tuple(line) for m, line in lines.items()}, x="frame", y=label,
                          vertical={"change": CHANGE}, log="y" if name == "smape" else "").data("png")  # fmt: skip


def _windows(found: Measured) -> list[list[str]]:
    late = found.late
    head = ["", *(f"{n} {w}" for n in ("FLIP", "SMAPE") for w in ("before", f"frames {CHANGE}-{CHANGE + changed.FIRST}",
                                                                 f"from {late}"))]  # fmt: skip
    return [head, *([m, *(number(v) for n in ("flip", "smape") for v in found.windows(m, n))] for m in found.curves)]


# ------------------------------------------------------------------------------------------------------------------
# Figure 1


def figure_1(work: Work) -> Outcome:
    """Mean reliability of both predictors by frame."""
    found = _measured(work)
    lines = {"trained weights (High-LR)": found.statistic("blend", "reliability_trained"),
             "averaged weights (EMA)": found.statistic("blend", "reliability_averaged")}  # fmt: skip
    trained, averaged = (np.array(values) for _, values in lines.values())
    before, drop = slice(0, CHANGE), CHANGE + 5
    drops = [1 - v[CHANGE:drop].min() / v[before].mean() for v in (trained, averaged)]
    _, sigma = found.statistic("blend", "reliability")
    sigma = np.array(sigma)
    weights = [sigma[before].mean(), sigma[CHANGE:].max(), sigma[found.late :].mean()]
    statements = [
        Statement(
            "Before the change the averaged predictor has the higher mean reliability", "section 4.1",
            f"mean reliability {averaged[before].mean():.3f} (averaged) and {trained[before].mean():.3f} (trained)",
            bool(averaged[before].mean() > trained[before].mean()),
            f"{100 * (averaged[before].mean() / trained[before].mean() - 1):+.1f} %",
        ),
        Statement(
            "After the change the averaged predictor's reliability drops more sharply", "section 4.1",
            f"within 5 frames by {100 * drops[1]:.0f} % (averaged) and {100 * drops[0]:.0f} % (trained)",
            bool(drops[1] > drops[0]),
        ),
        Statement(
            "The blend shifts to the trained weights, then gradually returns", "section 4.1",
            f"mean weight of the trained ones {_triple(weights)}: before, largest after the change, at the end",
            bool(weights[1] > weights[0] + SHIFT and weights[2] < weights[1] - SHIFT),
            f"{weights[1] - weights[0]:+.3f} after the change, {weights[2] - weights[1]:+.3f} from there to the end",
            WEAK_SHIFT.format(largest=np.abs(trained - averaged).max()),
        ),
    ]  # fmt: skip
    after = min(CHANGE + 5, found.settings.frames - 1)
    maps = {f"frame {k}": found.results["blend"].image(k).channels["sigma"] for k in (CHANGE - 1, after)}
    drawn = figures.curves(lines, x="frame", y="mean reliability", vertical={"change": CHANGE})
    where = figures.maps(maps, low=0, high=1, colours="RdYlGn", label="weight of the trained ones")
    return Outcome(
        statements,
        {"Means over the frames": _windows(found)},
        {
            "Mean reliability": drawn.data(),
            "Preference": where.data(),
            "FLIP": _curve(found, "flip", "HDR-FLIP to the reference"),
        },
        NOTES,
    )


# ------------------------------------------------------------------------------------------------------------------
# Figure 4


def figure_4(work: Work) -> Outcome:
    """FLIP and SMAPE after a change."""
    found = _measured(work)
    smape = {m: found.windows(m, "smape") for m in found.curves}
    area = {m: float(np.sum(found.curves[m]["flip"][CHANGE:])) for m in found.curves}
    statements = [
        Statement(
            "After the change High-LR and the blend reduce FLIP faster than EMA", "section 4.2, figure 4 left",
            "sum of FLIP from the change on: " + ", ".join(f"{m} {number(v)}" for m, v in area.items()),
            max(area["High-LR"], area["blend"]) < area["EMA"],
            f"High-LR {_percent(area['High-LR'], area['EMA'])}, blend {_percent(area['blend'], area['EMA'])} of EMA's",
        ),
        Statement(
            "The blend returns to low flicker faster than High-LR", "section 4.2, figure 4 right",
            f"SMAPE from frame {found.late}: blend {number(smape['blend'][2])}, High-LR {number(smape['High-LR'][2])}",
            smape["blend"][2] < smape["High-LR"][2], _percent(smape["blend"][2], smape["High-LR"][2]),
        ),
        Statement(
            "and remains near EMA", "section 4.2, figure 4 right",
            f"SMAPE before the change: blend {number(smape['blend'][0])}, EMA {number(smape['EMA'][0])}; from frame "
            f"{found.late}: {number(smape['blend'][2])}, {number(smape['EMA'][2])}",
            smape["blend"][0] < 1.25 * smape["EMA"][0], _percent(smape["blend"][0], smape["EMA"][0]) + " before",
        ),
    ]  # fmt: skip
    last = found.settings.frames - 1
    frames = list(dict.fromkeys(min(k, last) for k in (CHANGE - 1, CHANGE, CHANGE + 5, last)))
    shown = {f"reference, frame {k}": found.reference(k) for k in frames}
    for m in found.curves:
        shown |= {f"{m}, frame {k}": found.clean(m, k) for k in frames}
    return Outcome(
        statements,
        {"Means over the frames": _windows(found)},
        {
            "FLIP": _curve(found, "flip", "HDR-FLIP to the reference"),
            "SMAPE": _curve(found, "smape", "SMAPE to the frame before"),
            "Frames": figures.pictures(shown, columns=len(frames)).data(),
        },
        NOTES,
    )


def _percent(value: float, other: float) -> str:
    return f"{100 * (value / other - 1):+.0f} %"


ENTRIES = (
    Entry("reliability/fig1", "Figure 1", "Mean reliability of both predictors by frame, and where which is used.",
          LAMP.scene, (60, 1800), figure_1),
    Entry("reliability/fig4", "Figure 4", "Error (FLIP) and flicker (SMAPE) by frame when the light changes.",
          LAMP.scene, (60, 1800), figure_4),
)  # fmt: skip
