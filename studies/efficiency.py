"""Efficiency of unbiased integrators, 1 / (variance x time): ``python studies/efficiency.py SCENE -i path``.

Independent images of a few samples a pixel are rendered in turn by each integrator, so that a change in the machine's
load affects all of them. The variance is that of one camera sample, relative to the squared luminance of its pixel as
in relMSE, averaged over pixels and channels, plain and without the largest 0.1 %; the time is the median of the render
calls, over their samples: on a CPU the seconds of its cores, which other programs change little. Integrators that learn
are trained before. The first integrator has efficiency 1.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from mi_neural.bench import budget, environment, load, terminal
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.image import exr
from mi_neural.image.metrics import TRIM_FRACTION
from mi_neural.render.kernels import work_seconds

#: Added to the squared luminance of a pixel, over the squared mean luminance: as in relMSE.
EPSILON = 1e-2
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def relative_variance(images: np.ndarray, spp: int) -> tuple[float, float]:
    """Mean relative variance of one camera sample, plain and trimmed, from images (n, height, width, 3) of `spp`
    samples a pixel each."""
    mean = images.mean(axis=0)
    variance = images.var(axis=0, ddof=1) * spp
    level = mean @ LUMINANCE
    relative = np.sort((variance / (level**2 + EPSILON * max(level.mean(), 1e-30) ** 2)[..., None]).ravel())
    kept = relative[: max(1, int(relative.size * (1 - TRIM_FRACTION)))]
    return float(relative.mean()), float(kept.mean())


def measure(scene, integrators: dict, spp: int, rounds: int, frames: int) -> list[dict]:
    """A row of results for each of the `integrators` (label -> integrator), trained for `frames` frames before."""
    for integrator in integrators.values():
        budget.warm_up(scene, integrator, [spp])
        budget.reset(integrator)
        budget.train(scene, integrator, frames)
        budget.render_pass(scene, integrator, spp, 0)
        if hasattr(integrator, "measure"):
            integrator.measure(scene)
    images: dict[str, list] = {label: [] for label in integrators}
    seconds: dict[str, list] = {label: [] for label in integrators}
    for k in range(rounds):
        for label, integrator in integrators.items():
            start = work_seconds()
            image = budget.render_pass(scene, integrator, spp, budget.pass_seed(0, budget.STREAM_IMAGE, k))
            seconds[label].append(work_seconds() - start)
            images[label].append(image[..., :3])
    rows: list[dict] = []
    for label, integrator in integrators.items():
        stack = np.stack(images[label]).astype(np.float64)
        variance, trimmed = relative_variance(stack, spp)
        ns = 1e9 * float(np.median(seconds[label])) / (spp * budget.pixels(scene))
        row = {
            "integrator": label, "mean": float(stack.mean()), "ns_per_sample": ns, "variance": variance,
            "variance_trimmed": trimmed, "statistics": budget.statistics(integrator),
        }  # fmt: skip
        first = rows[0] if rows else row
        for name in ("variance", "variance_trimmed"):
            cost = first[name] * first["ns_per_sample"], row[name] * ns
            row[name.replace("variance", "efficiency")] = cost[0] / cost[1] if cost[1] > 0 else float("inf")
        rows.append(row)
    return rows


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/efficiency.py", description=__doc__)
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...], repeatable")
    parser.add_argument("--size", default="128x72")
    parser.add_argument("--spp", type=int, default=16, help="samples a pixel of an image")
    parser.add_argument("--rounds", type=int, default=10, help="images by each integrator")
    parser.add_argument("--frames", type=int, default=200, help="training frames")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scene")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)

    import mitsuba as mi

    mi.set_variant(options.variant)
    try:
        loaded = load.load_scene(options.scene, size=terminal.parse_size(options.size),
                                 parameters=terminal.parse_define(options.D))  # fmt: skip
        specs = [parse_integrator(text) for text in options.integrator]
        integrators = {s.label: build_integrator(s, loaded.carried)[0] for s in specs}
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    rows = measure(loaded.scene, integrators, options.spp, options.rounds, options.frames)
    for r in rows:
        print(f"{loaded.name} {r['integrator']}: mean {r['mean']:.4g}, {r['ns_per_sample']:.0f} ns, "
              f"variance {r['variance']:.3g} ({r['variance_trimmed']:.3g}), "
              f"efficiency {r['efficiency']:.2f} ({r['efficiency_trimmed']:.2f}) {r['statistics'].get('split', '')}",
              flush=True)  # fmt: skip
    if options.output:
        exr.write_text(options.output, json.dumps({
            "scene": loaded.name, "size": options.size, "spp": options.spp, "rounds": options.rounds,
            "rows": rows, "environment": environment.describe()}, indent=1, default=str))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
