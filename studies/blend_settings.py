"""Where the blend of two predictors earns its place: ``python studies/blend_settings.py -o DIR``.

The sun of a scene turns at frame 20 of 50. ``nirc`` renders each frame by its trained weights (``blend=fast``), by
their average (``ema``) and by the blend of both after the paper's rule (``reliability=correlation``), in the first
setting also after this package's (``evidence``). One setting at a time differs from the first one: learning rate, decay
of the average, steps a frame, training paths, training before the first frame, where paths end, how the sun turns, and
of the blend alone κ (0.001: the plain mean of both).
Direct light is measured with 1, 4 and 16 samples a pixel and without noise: the layers ``direct.*`` of other frames of
the same state are further samples.

DIR/results.json has a record for each setting and method: the sum of FLIP from the change on (``flip_N`` with N samples
of direct light, ``flip`` without its noise), SMAPE to the frame before in frames 45 to 49 and before the change, both
without direct light's noise, and the mean weight of the trained weights before the change and in frames 45 to 49; and
what the blend has over the better one of ``fast`` and ``ema``. Interrupted, the same command goes on.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from mi_neural.bench import environment, terminal
from mi_neural.bench.changes import rotated
from mi_neural.image import exr, metrics
from mi_neural.reproduce import changed
from mi_neural.reproduce.changed import CHANGE, Change, Measured, Settings
from mi_neural.reproduce.work import Part, Work

#: Degrees about the vertical: in all, and in every third frame of the slow turn.
TURN, SLOWLY = 150.0, 15.0
#: Samples of direct light in a frame.
DIRECT = (1, 4, 16)
#: Setting -> keys of all methods, changes of `Settings`. "" is the one that the others differ from.
VARIANTS: dict[str, tuple[dict, dict]] = {
    "": ({}, {}),  # measured first: others take records from it
    "train_samples=1024": ({"train_samples": 1024}, {}),
    "learning_rate=0.04": ({"learning_rate": 0.04}, {}),
    "1000 frames before, train_samples=1024": ({"train_samples": 1024}, {"pretrain": 1000}),
    "train_steps=4": ({"train_steps": 4}, {}),
    "learning_rate=0.0025": ({"learning_rate": 0.0025}, {}),
    "ema_decay=0.9": ({"ema_decay": 0.9}, {}),
    "reliability_kappa=0.001": ({"reliability_kappa": 0.001}, {"methods": ("blend",)}),
    "reliability_kappa=32": ({"reliability_kappa": 32.0}, {"methods": ("blend",)}),
    "turns by 15 degrees in every third frame": ({}, {}),
    "ends by default": ({"termination": None, "spread_threshold": None}, {}),
}
SLOW = "turns by 15 degrees in every third frame"


def change_of(scene: str, key: str, slow: bool) -> Change:
    """The turn of the sun at `key`, at once or slowly."""

    def turn(frame: int, value: np.ndarray) -> np.ndarray:
        parts = max(0, min((frame - CHANGE) // 3 + 1, TURN / SLOWLY))
        angle = SLOWLY * parts if slow else TURN * (frame >= CHANGE)
        return rotated(value, [0, 1, 0], angle) if angle else value

    return Change(scene, f"the sun turns by {TURN:g} degrees{', slowly' if slow else ''}", {key: turn})


def direct_samples(found: Measured, method: str, frame: int, n: int) -> np.ndarray:
    """Direct light of a frame as `n` samples a pixel give it: its own, and those of the next frames in its state."""
    states = found.run.sequence.states
    same = [k for k, state in enumerate(states) if state == states[frame]]
    at = same.index(frame)
    chosen = [same[(at + k) % len(same)] for k in range(n)]
    return np.mean([found.results[method].image(k).layer("direct") for k in chosen], axis=0)


def flip_sums(found: Measured, method: str, samples: tuple[int, ...], bar) -> dict[str, float]:
    """Sums of FLIP from the change on, by the number of samples of direct light."""
    sums, exposures = dict.fromkeys(samples, 0.0), found.run.references.exposures
    for frame in range(CHANGE, found.settings.frames):
        image = found.results[method].image(frame)
        for n in samples:
            shown = changed.clean(image, direct_samples(found, method, frame, n))
            sums[n] += metrics.flip(shown, found.reference(frame), exposures).mean
        if bar:
            bar(frame + 1 - CHANGE, found.settings.frames - CHANGE)
    return {f"flip_{n}": float(value) for n, value in sums.items()}


def records_of(work: Work, found: Measured, name: str, slow: bool, before: list[dict]) -> list[dict]:
    """A record for each method of one setting. Those of the first setting, in `before`, stand for methods that were not
    rendered, as κ says nothing to them."""
    group = work.group("blend", {"setting": name, **asdict(found.settings)})
    samples = DIRECT[:1] if slow else DIRECT  # a state of the slow turn has three frames
    first = [record for record in before if not record["setting"] and record["method"] in ("High-LR", "EMA")]
    records = {record["method"]: {**record, "setting": name} for record in first}
    for method in found.settings.methods:
        numbers = group.part(method.replace(" ", "_"), lambda bar, m=method: Part(flip_sums(found, m, samples, bar)))
        numbers = {"flip": float(np.sum(found.curves[method]["flip"][CHANGE:])), **numbers.numbers}
        _, weights = found.statistic(method, "reliability")
        steady, _, late = found.windows(method, "smape")
        records[method] = {"setting": name, "method": method, **numbers}
        records[method] |= {"smape_before": steady, "smape_late": late}
        if weights:
            records[method] |= {"weight_before": float(np.mean(weights[:CHANGE])),
                                "weight_late": float(np.mean(weights[found.late :]))}  # fmt: skip
    both, compared = [records["High-LR"], records["EMA"]], ("flip", *(f"flip_{n}" for n in samples), "smape_late")
    better = {key: min(record[key] for record in both) for key in compared}
    for record in records.values():
        record["over_better"] = {key: 100 * (record[key] / value - 1) for key, value in better.items()}
    return list(records.values())


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="sponza-gray/sun")
    parser.add_argument("--key", default="sun.direction", help="parameter that is the sun's direction")
    parser.add_argument("--only", action="append", choices=list(VARIANTS), help="one setting; may be repeated")
    parser.add_argument("--size", default="80x45")
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    terminal.set_variant(options.variant)
    settings = Settings(terminal.parse_size(options.size), 50, 200, 1, options.reference_spp, 1)
    records = []
    with terminal.Bars() as bars:
        for name in options.only or VARIANTS:
            keys, more = VARIANTS[name]
            common = {k: v for k, v in (changed.COMMON | keys).items() if v is not None}
            work = Work(options.output, progress=bars)
            change = change_of(options.scene, options.key, name == SLOW)
            more = {"methods": tuple(changed.METHODS)[: 3 if name else 4], **more}
            found = changed.measure(work, replace(settings, **more), change, common)
            records += records_of(work, found, name, name == SLOW, records)
            for record in (record for record in records if record["setting"] == name):
                print({k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in record.items()}, flush=True)
            report = {"environment": environment.describe(), "scene": options.scene, "records": records}
            exr.write_text(options.output / "results.json", json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
