"""Which spread threshold a denoised image of `neural_path` wants, by its samples a pixel.

    python studies/spread_threshold.py SCENE... [--frames 130,400] [--spp 16,64] [--thresholds 0.1,1,8,64] [-o DIR]

SCENE is a scene file with a reference image beside it, or a public scene. One cache is trained for so many frames. With
it, for each threshold c and number of samples, one image is rendered and denoised. A line says: the processor's seconds
of rendering, trimmed relMSE, FLIP against the reference, and FLIP against the denoised reference, which has less noise
of its own. `path` is the first line of each number of samples, then follow the threshold that `neural_path` chooses by
itself (`own`) and the same threshold at every place, however few training records lie there (`everywhere`).
DIR/spread_threshold.json has all records.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer


def main(scenes: list[str], frames: str = "400", spp: str = "16,64", thresholds: str = "0.1,1,8,64",
         max_depth: Annotated[int, typer.Option()] = 64, size: str = "640x360,256x256",
         output: Annotated[Path, typer.Option("-o")] = Path("out/spread_threshold")) -> None:  # fmt: skip
    import mitsuba as mi

    import mi_neural

    mi.set_variant("llvm_ad_rgb")
    from mi_neural.bench import environment, load, terminal
    from mi_neural.image import exr

    sys.path.append(str(Path(__file__).resolve().parent))
    from ablation import reference_of

    output.mkdir(parents=True, exist_ok=True)
    records = []
    for name in scenes:
        loaded = load.load_scene(name, terminal.parse_sizes(size), {"max_depth": max_depth})
        exact = reference_of(loaded, output, 1024, None, same_depth=True)
        guides = mi_neural.guides(loaded.scene)
        records += of_scene(loaded, exact, guides, *([int(n) for n in text.split(",")] for text in (frames, spp)),
                            [float(c) for c in thresholds.split(",") if c])  # fmt: skip
        exr.write_text(output / "spread_threshold.json", json.dumps(
            {"records": records, "environment": environment.describe()}, indent=1))  # fmt: skip


def of_scene(loaded, exact, guides, frames: list[int], spps: list[int], thresholds: list[float]):
    """The records of a scene."""
    import drjit as dr
    import mitsuba as mi

    from mi_neural.bench import budget
    from mi_neural.bench.specs import build_integrator, parse_integrator
    from mi_neural.image import metrics
    from mi_neural.integrators import neural_path

    smooth, records = np.array(guides.denoise(exact.rgb)), []

    def line(name: str, integrator, samples: int, steps: int, c: float | None = None) -> None:
        budget.warm_up(loaded.scene, integrator, sorted(set(budget.plan_passes(loaded.scene, samples))))
        start = time.process_time()
        noisy = budget.render_samples(loaded.scene, integrator, samples, 3).rgb
        seconds = time.process_time() - start
        clean = np.array(guides.denoise(noisy))
        error = metrics.relmse_trimmed(clean, exact.rgb, exact.variance)
        flips = [metrics.flip(clean, other).mean for other in (exact.rgb, smooth)]
        records.append({"scene": loaded.name, "frames": steps, "spp": samples, "label": name, "threshold": c,
                        "cpu_seconds": seconds, "relmse_trimmed": error, "flip": flips[0],
                        "flip_clean": flips[1]})  # fmt: skip
        print(f"{loaded.name}, {steps} frames, {samples} spp, {name:10} {seconds:5.1f} s  "
              f"{error:.5f} / {flips[0]:.4f} / {flips[1]:.4f}", flush=True)  # fmt: skip

    path, _ = build_integrator(parse_integrator("path"), loaded.carried)
    ours, _ = build_integrator(parse_integrator("neural_path:denoised=true"), loaded.carried)
    for steps in sorted(frames):
        ours.freeze_cache = False
        budget.train(loaded.scene, ours, steps - ours.cache.steps)
        ours.freeze_cache = True
        queried, chosen = ours.cache.queried, ours.settings
        bias, density, least = queried.grid.mean_bias, queried.field.density, neural_path.LEAST_BIAS
        own = [float(neural_path.denoised_threshold(bias[0], steps, n)) for n in spps]
        for samples, taken in zip(spps, own, strict=True):
            print(f"{loaded.name}, {samples} spp: neural_path takes c = {taken:.2g}")
            line("path", path, samples, steps)
            line("own", ours, samples, steps, taken)
            # As if records lay evenly; and no measured bias raises the thresholds that are given
            queried.field.density, queried.grid.mean_bias = dr.ones(mi.Float, dr.width(density)), mi.Float(0)
            dr.make_opaque(queried.field.density, queried.grid.mean_bias)
            neural_path.LEAST_BIAS = 0.0
            ours.film_state.passes.clear()  # they were recorded with the constant
            for name, c in [("everywhere", taken), *((f"c = {c:g}", c) for c in thresholds)]:
                ours.settings = lambda n, c=c, steps=steps: (n, c, steps)
                line(name, ours, samples, steps, c)
            queried.field.density, queried.grid.mean_bias, neural_path.LEAST_BIAS = density, bias, least
            ours.settings = chosen
            ours.film_state.passes.clear()
    return records


if __name__ == "__main__":
    typer.run(main)
