"""How wrong `path` is under lamps that Mitsuba samples wrong: ``python studies/inexact_lights.py -o DIR``.

The lamps of ``tests/test_inexact_lights.py`` over a floor, one at a time. The error is that of the image's mean, direct
light alone, in percent of the light that rays find (``direct`` with ``emitter_samples=0``). DIR/lamps.json has a record
for each reason: the least and the most error of its lamps, and the largest standard error. ``ours`` is the largest
error of `plain_path`. Lamps that do not shine on the floor are left out. Needs the extra ``test``.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from mi_neural.bench import environment
from mi_neural.image import exr

#: Images, and samples a pixel of each.
IMAGES, SPP = 8, 1024
REFERENCE = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 16}


def measure(images: int = IMAGES, spp: int = SPP) -> list[dict]:
    """The records."""
    import mitsuba as mi

    sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
    from test_inexact_lights import CAMERA, WRONG, scene_with

    def means(scene, keys: dict, spp: int) -> np.ndarray:
        integrator = mi.load_dict(keys)
        return np.array([np.array(mi.render(scene, integrator=integrator, spp=spp, seed=k)).mean(dtype=np.float64)
                         for k in range(images)])  # fmt: skip

    found: dict[str, list] = {}
    for name, (lamp, why) in WRONG.items():
        scene = scene_with(lamp, floor={"type": "rectangle"}, camera=CAMERA)
        known = means(scene, REFERENCE, spp)
        if not known.any():
            continue
        path, ours = (means(scene, {"type": kind, "max_depth": 2}, spp) for kind in ("path", "plain_path"))
        errors = [100 * (a.mean() / known.mean() - 1) for a in (path, ours)]
        spread = 100 * np.hypot(path.std(ddof=1), known.std(ddof=1)) / len(known) ** 0.5 / known.mean()
        print(f"{name}: path {errors[0]:+.2f} %, plain_path {errors[1]:+.2f} %, ± {spread:.2f} %", flush=True)
        found.setdefault(why, []).append((*errors, spread))
    return [{"why": why, "least": min(e[0] for e in errors), "most": max(e[0] for e in errors), "lamps": len(errors),
             "ours": max(abs(e[1]) for e in errors), "standard_error": max(e[2] for e in errors)}
            for why, errors in found.items()]  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python studies/inexact_lights.py", description=__doc__)
    parser.add_argument("--spp", type=int, default=SPP)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for lamps.json")
    options = parser.parse_args(arguments)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    options.output.mkdir(parents=True, exist_ok=True)
    result = {"reasons": measure(spp=options.spp), "environment": environment.describe()}
    exr.write_text(options.output / "lamps.json", json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
