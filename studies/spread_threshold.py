"""Which spread threshold a denoised image of `neural_path` wants, by its samples a pixel.

    python studies/spread_threshold.py SCENE.xml REFERENCE.exr [--frames 400] [--spp 16,64] [--thresholds 0.1,1,8,64]

One cache is trained for so many frames. With it, for each threshold c and number of samples, one image is rendered and
denoised. A line says: the processor's seconds of rendering, trimmed relMSE, FLIP against the reference, and FLIP
against the denoised reference, which has less noise of its own. `path` is the first line of each number of samples.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import typer


def main(scene: Path, reference: Path, frames: int = 400, spp: str = "16,64", thresholds: str = "0.1,1,8,64",
         max_depth: Annotated[int, typer.Option()] = 64) -> None:  # fmt: skip
    import mitsuba as mi

    import mi_neural

    mi.set_variant("llvm_ad_rgb")
    from mi_neural.bench import budget, load
    from mi_neural.bench.specs import build_integrator, parse_integrator
    from mi_neural.image import exr, metrics
    from mi_neural.integrators import neural_path

    exact = exr.read(reference)
    loaded = load.load_scene(str(scene), [exact.size], {})
    guides = mi_neural.guides(loaded.scene)
    smooth = np.array(guides.denoise(exact.rgb))

    def line(name: str, integrator, samples: int) -> None:
        budget.warm_up(loaded.scene, integrator, sorted(set(budget.plan_passes(loaded.scene, samples))))
        start = time.process_time()
        noisy = budget.render_samples(loaded.scene, integrator, samples, 3).rgb
        seconds = time.process_time() - start
        clean = np.array(guides.denoise(noisy))
        error = metrics.relmse_trimmed(clean, exact.rgb, exact.layer("variance"))
        flips = [metrics.flip(clean, other).mean for other in (exact.rgb, smooth)]
        print(f"{loaded.name}, {samples} spp, {name:8} {seconds:5.1f} s  {error:.5f} / {flips[0]:.4f} / {flips[1]:.4f}",
              flush=True)  # fmt: skip

    path, _ = build_integrator(parse_integrator("path"), {"max_depth": max_depth})
    ours, _ = build_integrator(parse_integrator("neural_path:denoised=true"), {"max_depth": max_depth})
    budget.train(loaded.scene, ours, frames)
    ours.freeze_cache = True
    bias, spps = ours.cache.queried.grid.mean_bias[0], [int(n) for n in spp.split(",")]
    own = [neural_path.denoised_threshold(bias, frames, n) for n in spps]
    # Or it would raise the thresholds that are given
    ours.cache.queried.grid.mean_bias, neural_path.LEAST_BIAS = mi.Float(0), 0.0
    for samples, taken in zip(spps, own, strict=True):
        print(f"{loaded.name}, {samples} spp: neural_path takes c = {taken:.2g}")
        line("path", path, samples)
        for c in map(float, thresholds.split(",")):
            ours.settings = lambda n, c=c: (n, c, frames)
            line(f"c = {c:g}", ours, samples)


if __name__ == "__main__":
    typer.run(main)
