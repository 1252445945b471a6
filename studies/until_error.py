"""How near `mi-neural render --until-error E` comes to E: ``python studies/until_error.py SCENE -i path -o DIR``.

The integrator is trained as by the command. Then it renders until the error that it estimates is at most E, for each E
given, and the image is compared with the reference beside the scene, or with another by ``--reference``. Reported are
the error that was estimated, the error that was found, the samples a pixel, and the samples that would have reached E
if the error that was found fell as one over the samples (`hindsight`). The estimate contains noise and no bias.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from mi_neural.bench import budget, environment, load, terminal
from mi_neural.bench import reference as references
from mi_neural.bench.reference import Reference
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.image import exr, metrics


@dataclass
class Image:
    """One image: the trimmed relMSE asked for, estimated and found, and its samples a pixel."""

    integrator: str
    asked: float
    estimated: float
    found: float
    samples: int
    hindsight: int


def rendered(scene, integrator: str, error: float, reference: Reference, keys: dict, seed: int) -> Image:
    """An image by an integrator that was trained for it alone."""
    ours, _ = build_integrator(parse_integrator(integrator), keys)
    budget.warm_up(scene, ours, budget.pass_sizes(scene))
    trained, _ = budget.train_first(scene, ours)
    image, estimate = budget.render_until(scene, ours, error, seed=seed, trained=trained)
    found = metrics.relmse_trimmed(image.rgb, reference.rgb, reference.variance)
    return Image(integrator, error, estimate.value, found, image.spp, round(image.spp * found / error))


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/until_error.py", description=__doc__)
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, metavar="TYPE[:K=V,...]")
    parser.add_argument("--errors", type=lambda s: [float(e) for e in s.split(",")], default=[0.03, 0.01])
    parser.add_argument("--reference", help="EXR, of the size that is rendered; default: the one beside the scene")
    parser.add_argument("--size", help="WxH; default: that of the reference, or of the scene")
    parser.add_argument("--max-depth", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for results.json")
    options = parser.parse_args(arguments)

    import mitsuba as mi

    mi.set_variant(options.variant)
    try:
        loaded, reference = references.with_scene(options.scene, options.reference, terminal.parse_size(options.size))
        parse_integrator(options.integrator[0])
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    images = []
    for integrator in options.integrator:
        for error in options.errors:
            image = rendered(loaded.scene, integrator, error, reference, {"max_depth": options.max_depth}, options.seed)
            images.append(image)
            print(f"{loaded.name}, {integrator}, {error:g}: estimated {image.estimated:.4g}, found {image.found:.4g}, "
                  f"{image.samples} samples, {image.hindsight} in hindsight", flush=True)  # fmt: skip
    options.output.mkdir(parents=True, exist_ok=True)
    results = {"scene": loaded.name, "size": loaded.size, "images": [asdict(i) for i in images],
               "environment": environment.describe()}  # fmt: skip
    exr.write_text(options.output / "results.json", json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
