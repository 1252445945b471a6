"""What the denoiser's guides are worth: Mitsuba's `aov` against ours, by samples a pixel and with and without a filter.

    python studies/guides.py SCENE.xml REFERENCE.exr [--spp 4,32] [--integrator path]

For each number of samples a line: trimmed relMSE and FLIP of one image, denoised with

aov         albedo and shading normal of Mitsuba's `aov`, 16 samples a pixel
rendered    ours (mi_neural/bench/guides.py), with their noise
filtered    ours, as they are used
64          ours of 64 samples a pixel, filtered
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer


def main(scene: Path, reference: Path, spp: str = "4,32", integrator: str = "path",
         max_depth: Annotated[int, typer.Option()] = 64) -> None:  # fmt: skip
    import mitsuba as mi

    import mi_neural  # noqa: F401

    mi.set_variant("llvm_ad_rgb")
    from mi_neural.bench import budget, guides, load
    from mi_neural.bench.specs import build_integrator, parse_integrator
    from mi_neural.image import denoise, exr, metrics

    exact = exr.read(reference)
    loaded = load.load_scene(str(scene), [exact.size], {})

    def rendered(renderer, samples: int) -> tuple[np.ndarray, np.ndarray]:
        image = np.nan_to_num(budget.render_pass(loaded.scene, renderer, samples, 7)[..., -6:].astype(np.float32))
        return tuple(np.ascontiguousarray(part) for part in (image[..., :3].clip(0, 1), image[..., 3:].clip(-1, 1)))

    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    own = rendered(guides._integrator(), guides.GUIDE_SPP)
    kinds = {
        "aov": (*rendered(aov, guides.GUIDE_SPP), False),
        "rendered": (*own, True),
        "filtered": (*denoise.prefilter(*own), True),
        "64": (*denoise.prefilter(*rendered(guides._integrator(), 64)), True),
    }
    spec = parse_integrator(integrator)
    built, _ = build_integrator(spec, {"max_depth": max_depth})
    budget.train(loaded.scene, built, 150)
    for samples in map(int, spp.split(",")):
        noisy = budget.render_samples(loaded.scene, built, samples, 3).rgb
        for name, guide in kinds.items():
            clean = denoise.denoise(noisy, *guide)
            error = metrics.relmse_trimmed(clean, exact.rgb, exact.layer("variance"))
            flip = metrics.flip(clean, exact.rgb).mean
            print(f"{loaded.name}, {integrator}, {samples} spp, {name:10} {error:.5f} / {flip:.4f}", flush=True)


if __name__ == "__main__":
    typer.run(main)
