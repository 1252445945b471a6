"""Noise of `volpath` and of `plain_path` in halls of fog with many lamps: ``python studies/fog_lamps.py -o DIR``.

The halls are those of ``studies/many_lamps.py``, most lamps hidden by partitions: 32 lamps with an extinction of 0.1 a
metre, 1,000 lamps in 40 m with 0.03. Paths have up to 64 segments. The methods take turns, image after image, on one
thread; CPU time counts, so that other programs disturb little. The gain of a method is the relative variance of an
image, ``var(I) / (mean² + 0.01 mean of the image²)`` over its pixels, times the CPU seconds of a sample, of `volpath`
over its own: how many times less squared error it has in equal time. ``trimmed`` leaves out the hundredth of the pixels
with the most. Networks are trained before and stay as they are; ``seconds_train`` is what that took, kernels compiled.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import many_lamps
import numpy as np

from mi_neural.bench import environment
from mi_neural.image import exr

EXTINCTION = {32: 0.1, 1000: 0.03}
DEPTH = 64


def methods() -> dict[str, dict]:
    """The integrators that are compared, by name; `volpath` is the first."""

    def plain(sampler: dict) -> dict:
        return {"type": "plain_path", "max_depth": DEPTH, "light_sampler": sampler}

    nvc = {"type": "nvc_lights", "train_steps": 0}
    return {
        "volpath": {"type": "volpath", "max_depth": DEPTH},
        "nvc_lights": plain(nvc),
        'nvc_lights, in_media="network"': plain(nvc | {"in_media": "network"}),
        "nvc_lights, visibility=false": plain({"type": "nvc_lights", "visibility": False}),
        "tree_lights": plain({"type": "tree_lights"}),
    }


def timed(function) -> tuple:
    """(what it returns, CPU seconds)."""
    import drjit as dr

    start = time.process_time()
    found = function()
    dr.sync_thread()
    return found, time.process_time() - start


def measure(scene, names: list[str], spp: int, repeats: int) -> list[dict]:
    """A record for each method."""
    import mitsuba as mi

    made = {name: mi.load_dict(methods()[name]) for name in names}
    images, seconds, training = {n: [] for n in names}, {n: [] for n in names}, {}

    def render(name, seed):
        return np.array(mi.render(scene, integrator=made[name], spp=spp, seed=seed), np.float64)[..., :3]

    for name in names:
        for k in range(2):
            render(name, 10_000 + k)
        training[name] = 0.0
        if hasattr(made[name], "reset"):
            made[name].reset()
            training[name] = timed(lambda name=name: render(name, 10_002))[1]
    for k in range(repeats):
        for name in names:
            image, took = timed(lambda name=name, k=k: render(name, k))
            images[name].append(image)
            seconds[name].append(took)
    mean = np.mean([np.mean(images[name], axis=0) for name in names], axis=0)
    records = []
    for name in names:
        variance = spp * (np.var(images[name], axis=0, ddof=1) / (mean**2 + 0.01 * mean.mean() ** 2)).mean(-1).ravel()
        took = float(np.median(seconds[name]) / spp)
        records.append({
            "label": name, "variance": float(variance.mean()), "seconds_sample": took,
            "milliseconds": 1000 * took,
            "trimmed": float(np.sort(variance)[: int(0.99 * variance.size)].mean()),
            "seconds_train": max(0.0, training[name] - took * spp), "mean": float(np.mean(images[name])),
            "nonfinite": int((~np.isfinite(images[name])).sum()),
        })  # fmt: skip
        for key in ("variance", "trimmed"):
            records[-1][f"gain_{key}"] = records[0][key] * records[0]["seconds_sample"] / (records[-1][key] * took)
    return records


def main(arguments: list[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--lamps", type=int, nargs="*", default=list(EXTINCTION), help="how many, hall by hall")
    parser.add_argument("--method", action="append", choices=list(methods()), help="beside volpath; default: all")
    parser.add_argument("--size", type=int, nargs=2, default=(160, 90))
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for fog_lamps.json and the scenes")
    asked = parser.parse_args(arguments)
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    asked.output.mkdir(parents=True, exist_ok=True)
    names = ["volpath", *[name for name in methods() if name in (asked.method or methods()) and name != "volpath"]]
    records = []
    for lamps in asked.lamps:
        file = asked.output / f"hall_{lamps}.xml"
        many_lamps.main([str(lamps), str(file), "--fog", str(EXTINCTION.get(lamps, 0.1))])
        scene = mi.load_file(str(file), resx=asked.size[0], resy=asked.size[1])
        for record in measure(scene, names, asked.spp, asked.repeats):
            records.append({"lamps": lamps, **record})
            print({k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in records[-1].items()}, flush=True)
    result = {"methods": records, "environment": environment.describe()}
    exr.write_text(asked.output / "fog_lamps.json", json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
