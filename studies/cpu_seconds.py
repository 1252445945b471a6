"""One-shot images in equal CPU seconds, training included: ``python studies/cpu_seconds.py SCENE -i A -i B -o DIR``.

For machines that other programs share: what they take does not count. Kernels are compiled before; Dr.Jit works with
one thread, as threads that wait for work count as work. Integrators take turns, one repeat after another. The
reference is rendered by ``--reference``, an unbiased integrator, with the keys that ``-D`` gives, and kept in DIR; its
own noise is measured and taken off the squared errors. ``noise`` in DIR/results.json says how much that is.
Prints and writes to DIR/results.json, a record for each, medians over the repeats, and how many times less trimmed
relMSE each has than the first one: geometric mean, least and most of the repeats.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from mi_neural.bench import budget, environment, load, terminal
from mi_neural.bench.specs import IntegratorSpec, build_integrator, parse_integrator, parse_keys
from mi_neural.image import exr, metrics

SAMPLES = (1, 4, 16, 64)
#: Samples a pixel of one pass of a reference.
PASS = 64


def one_shot(scene, integrator, seconds: float, seed: int) -> tuple[np.ndarray, dict[str, float]]:
    """An image from nothing in so many CPU seconds: (mean of its passes, samples a pixel, seconds until the first)."""
    import drjit as dr

    budget.reset(integrator, seed)
    dr.sync_thread()
    begun, total, n, times, first = time.process_time(), 0.0, 0, {}, 0.0
    for k in range(10**6):
        left = seconds - (time.process_time() - begun)
        larger = next((s for s in SAMPLES if s not in times), None)
        if not times:
            spp = SAMPLES[0]
        elif larger and 1.2 * times[max(times)] * larger / max(times) < left:
            spp = larger
        else:
            spp = max((s for s in times if times[s] < left), default=0)
        if not spp:
            break
        before = time.process_time()
        image = budget.render_pass(scene, integrator, spp, budget.pass_seed(seed, budget.STREAM_IMAGE, k))
        times[spp] = time.process_time() - before
        total, n, first = total + spp * image[..., :3].astype(np.float64), n + spp, first or times[spp]
    return total / n, {"spp": n, "first_pass": first}


def reference(loaded, text: str, keys: dict, spp: int, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The reference image and the variance of each of its values, read where they are there."""
    if not path.is_file() or exr.read(path).layer("variance") is None:
        spec = parse_integrator(text)
        integrator, _ = build_integrator(IntegratorSpec(spec.type, {**keys, **spec.keys}), loaded.carried)
        seeds = [budget.pass_seed(0, budget.STREAM_REFERENCE, k) for k in range(max(2, spp // PASS))]
        images = [budget.render_pass(loaded.scene, integrator, PASS, s)[..., :3].astype(np.float64) for s in seeds]
        variance = np.var(images, axis=0, ddof=1) / len(images)
        exr.write(path, np.mean(images, axis=0), exr.layer_channels("variance", variance))
    found = exr.read(path)
    return found.rgb, found.layer("variance")


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...]")
    parser.add_argument("-D", "--define", action="append", default=[], help="K=V, a key of all integrators")
    parser.add_argument("--size", default="160x90")
    parser.add_argument("--seconds", type=float, default=20.0, help="CPU seconds of an image")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--reference", default="plain_path:light_sampler.type=tree_lights", help="TYPE[:K=V,...]")
    parser.add_argument("--reference-spp", type=int, default=4096)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    terminal.set_variant(options.variant)
    import drjit as dr

    options.output.mkdir(parents=True, exist_ok=True)
    keys = parse_keys(options.define, "-D")
    loaded = load.load_scene(options.scene, terminal.parse_size(options.size))
    path = options.output / "reference.exr"
    known, variance = reference(loaded, options.reference, keys, options.reference_spp, path)
    noise = float(metrics.relative_squared_errors(known, known, variance)[1].mean())
    dr.set_thread_count(1)
    cases = {}
    for text in options.integrator:
        spec = parse_integrator(text)
        cases[text], _ = build_integrator(IntegratorSpec(spec.type, {**keys, **spec.keys}), loaded.carried)
        budget.warm_up(loaded.scene, cases[text], list(SAMPLES))
    rows = {text: [] for text in cases}
    for repeat in range(options.repeats):
        for text, integrator in cases.items():
            image, facts = one_shot(loaded.scene, integrator, options.seconds, repeat + 1)
            error = metrics.relmse_trimmed(image, known, variance)
            facts |= {"relmse_trimmed": error, "flip": metrics.flip(image, known).mean}
            rows[text].append(facts)
            print(repeat, text, {k: float(f"{v:.4g}") for k, v in facts.items()}, flush=True)
    first, records = rows[options.integrator[0]], []
    for text, own in rows.items():
        found = {k: float(np.median([row[k] for row in own])) for k in own[0]}
        # What the reference cannot tell from 0 counts as a hundredth of its noise
        errors = [[max(row["relmse_trimmed"], 0.01 * noise) for row in repeats] for repeats in (first, own)]
        ratios = [a / b for a, b in zip(*errors, strict=True)]
        found |= {"times_less": float(np.exp(np.mean(np.log(ratios)))), "least": min(ratios), "most": max(ratios)}
        print(text, {k: float(f"{v:.4g}") for k, v in found.items()})
        records.append({"label": text, "scene": loaded.name, **found})
    report = {"environment": environment.describe(), "seconds": options.seconds, "noise": noise, "records": records}
    exr.write_text(options.output / "results.json", json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
