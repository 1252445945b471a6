"""Other networks for the incident cache in equal CPU seconds: ``python studies/cache_variants.py SCENE ... -o DIR``.

Each variant changes one thing of ``nirc``: how the direction is encoded, what the network gets of the surface, its
sizes, or its optimiser. It is trained for so many CPU seconds (``--seconds``), kernels being compiled before, by one
thread, as threads that wait for work count as work. Then the cache is seen directly (``termination=primary``) in an
image of ``--spp`` samples. Variants take turns, one seed after another. DIR/results.json has a record for each scene,
variant and time: training steps, trimmed relMSE, FLIP, the mean of the image over that of the reference and the CPU
seconds of the image; means over the seeds, and ``times``, the geometric mean over the seeds of the trimmed relMSE over
that of the first variant. The scene ``all`` has the geometric means over the scenes.

What is no key of ``nirc`` is put in its place here, while a variant is built and trained.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import numpy as np

from mi_neural.bench import budget, environment, load, terminal
from mi_neural.bench.specs import IntegratorSpec, build_integrator
from mi_neural.image import exr, metrics


@dataclass
class Variant:
    """Keys of ``nirc``, and what is put in the place of functions of the caches, by module and name."""

    keys: dict = field(default_factory=dict)
    replaced: dict = field(default_factory=dict)


def blobs(n: int):
    """Directions as one-blob of both octahedral coordinates, `n` bins each."""
    from mi_neural.caches import encoding

    def encode(w, degree):
        uv = encoding.octahedral(w)
        return [*encoding.one_blob(uv.x, n), *encoding.one_blob(uv.y, n)]

    return encode, 2 * n


def harmonics_and_blobs(degree: int, n: int):
    """Spherical harmonics, and one-blob of `n` bins an axis."""
    import drjit as dr
    import mitsuba as mi

    encode, count = blobs(n)
    return lambda w, _: [*dr.sh_eval(mi.Vector3f(w), degree), *encode(w, degree)], count + (degree + 1) ** 2


def grid(n: int):
    """Hat functions of a grid of `n` x `n` octahedral cells; the first layer's weights are the values at its nodes."""
    import drjit as dr

    from mi_neural.caches import encoding

    def encode(w, degree):
        uv = encoding.octahedral(w)
        hats = [[dr.maximum(0, 1 - dr.abs(c * (n - 1) - k)) for k in range(n)] for c in uv]
        return [a * b for a in hats[0] for b in hats[1]]

    return encode, n * n


def with_direction(made) -> dict:
    """Replacements for an encoding of directions: (function of direction and degree, number of its values)."""
    encode, count = made
    return {
        "mi_neural.caches.encoding.direction": encode,
        "mi_neural.caches.weights.FieldShape.n_inputs": property(lambda shape: shape.n_first + count),
    }


def muon(factor: float) -> dict:
    """Replacements for Muon (Jordan 2024): steps of the network's matrices are orthogonalised, as ``drjit.opt.Muon``
    does; grid and biases keep Adam. The rate is `factor` times Adam's times the root of the matrix's width, which for
    1 gives a step with the same mean square."""
    import drjit as dr
    from drjit.opt import Adam, _newton_schulz

    from mi_neural.caches.optimizer import attach_adam

    class AdamMuon(Adam):
        def _step(self, cache, value, grad, lr, extra):
            shape = self.shapes.get(dr.width(value))
            if shape is None:
                return super()._step(cache, value, grad, lr, extra)
            t, momentum, second, largest = extra
            momentum = dr.fma(0.95, momentum, grad)
            tensor = dr.tensor_t(type(value))
            straight = _newton_schulz(tensor(dr.fma(0.95, momentum, grad), shape), 5).array
            scale = cache.product(dr.leaf_t(grad), lr, -factor * max(shape) ** 0.5)
            return dr.fma(straight, scale, value), (t + 1, momentum, second, largest)

    def attach(parameters: dict):
        optimizer = attach_adam(parameters, AdamMuon)
        optimizer.shapes = {int(np.prod(v.shape)): v.shape for k, v in parameters.items() if len(v.shape) == 2}
        return optimizer

    return {"mi_neural.caches.field.attach_adam": attach}


def variants() -> dict[str, Variant]:
    """All of them by name; the first is the default."""
    return {
        "default": Variant(),
        "degree 2": Variant({"direction_degree": 2}),
        "degree 4": Variant({"direction_degree": 4}),
        "one-blob 2x4": Variant(replaced=with_direction(blobs(4))),
        "degree 3 and one-blob 2x8": Variant(replaced=with_direction(harmonics_and_blobs(3, 8))),
        "direction grid 6x6": Variant(replaced=with_direction(grid(6))),
        "normal": Variant({"inputs": "normal"}),
        "normal, albedo, roughness": Variant({"inputs": "normal, albedo, roughness"}),
        "width 32": Variant({"width": 32}),
        "width 64": Variant({"width": 64}),
        "1 layer": Variant({"hidden_layers": 1}),
        "4 layers": Variant({"hidden_layers": 4}),
        "6 levels": Variant({"levels": 6}),
        "12 levels": Variant({"levels": 12}),
        "2^18 entries a level": Variant({"hashmap_size": 2**18}),
        "Muon, rate x 1": Variant(replaced=muon(1.0)),
        "Muon, rate x 2": Variant(replaced=muon(2.0)),
    }


@contextmanager
def in_place(variant: Variant):
    """Inside, the functions of a variant replace those of the package."""
    patches = [mock.patch(name, new) for name, new in variant.replaced.items()]
    for patch in patches:
        patch.start()
    try:
        yield
    finally:
        for patch in patches:
            patch.stop()


def measure(scene, integrator, seconds: list[float], seed: int, spp: int, judge) -> list[dict]:
    """A record for each time, of one training."""
    import drjit as dr

    budget.reset(integrator, seed)
    found, spent, steps = [], 0.0, 0
    for goal in seconds:
        while spent < goal:
            dr.sync_thread()
            begun = time.process_time()
            integrator.train(scene, 1)
            dr.sync_thread()
            spent, steps = spent + time.process_time() - begun, steps + 1
        begun = time.process_time()
        image = budget.render_pass(scene, integrator, spp, budget.pass_seed(seed, budget.STREAM_IMAGE, 0))
        taken = time.process_time() - begun
        found.append({"seconds": goal, "steps": steps, "image_seconds": taken, **judge(image[..., :3])})
    return found


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/cache_variants.py", description=__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="scene file, shipped or public scene")
    parser.add_argument("--only", action="append", metavar="NAME", help="these variants beside the default")
    parser.add_argument("--size", default="160x90,128x128", help="each scene takes the one nearest in shape")
    parser.add_argument("--seconds", default="2,8", help="CPU seconds of training: 2,8")
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel of the images")
    parser.add_argument("--seeds", type=int, default=2, help="trainings with other seeds")
    parser.add_argument("--reference-spp", type=int, default=512, help="of references that are rendered")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for results.json and references")
    options = parser.parse_args(arguments)

    import drjit as dr
    import mitsuba as mi

    sys.path.append(str(Path(__file__).resolve().parent))
    from ablation import reference_of

    mi.set_variant("llvm_ad_rgb")
    threads = dr.thread_count()
    options.output.mkdir(parents=True, exist_ok=True)
    seconds, records = sorted(float(s) for s in options.seconds.split(",")), []
    try:
        chosen = {name: v for name, v in variants().items()
                  if not options.only or name in ("default", *options.only)}  # fmt: skip
        if unknown := set(options.only or ()) - set(chosen):
            raise load.InputError(f"there is no variant {', '.join(unknown)}; there are {', '.join(variants())}")
        for name in options.scenes:
            dr.set_thread_count(threads)  # with one, Mitsuba 3.9.1 waits forever for an EXR file
            loaded = load.load_scene(name, terminal.parse_sizes(options.size), {"max_depth": "64"})
            reference = reference_of(loaded, options.output, options.reference_spp, None, same_depth=True)
            exposures = metrics.flip_exposures(reference.rgb)
            dr.set_thread_count(1)

            def judge(image, reference=reference, exposures=exposures):
                image = metrics.block_means(image, reference.rgb.shape)
                found = metrics.errors(image, reference.rgb, reference.variance, exposures)[0]
                mean = float(image.mean() / reference.rgb.mean())
                return {"mean": mean, "relmse": found.relmse_trimmed, "flip": found.flip}

            measured: dict[str, list] = {}
            for seed in range(options.seeds):
                for label, variant in chosen.items():
                    with in_place(variant):
                        spec = IntegratorSpec("nirc", {"termination": "primary", **variant.keys})
                        integrator, _ = build_integrator(spec, loaded.carried)
                        measure(loaded.scene, integrator, [1e-3], 12345, options.spp, judge)  # compiles all kernels
                        measure(loaded.scene, integrator, [1e-3], 12346, options.spp, judge)
                        measured.setdefault(label, []).append(
                            measure(loaded.scene, integrator, seconds, seed, options.spp, judge)
                        )
                        print(loaded.name, label, *measured[label][-1], flush=True)
            records += _records(loaded.name, measured)
            _write(options.output, records)
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    _write(options.output, records + _over_scenes(records))
    return 0


def _records(scene: str, measured: dict[str, list]) -> list[dict]:
    """Means over seeds, and errors over those of the first variant."""
    found, first = [], next(iter(measured.values()))
    for label, of_seeds in measured.items():
        for k in range(len(of_seeds[0])):
            rows, firsts = [s[k] for s in of_seeds], [s[k] for s in first]
            ratios = [r["relmse"] / f["relmse"] for r, f in zip(rows, firsts, strict=True)]
            found.append({"scene": scene, "label": label, **{n: float(np.mean([r[n] for r in rows])) for n in rows[0]},
                          "times": float(np.exp(np.mean(np.log(ratios)))),
                          "image_times": float(np.mean([r["image_seconds"] for r in rows])
                                               / np.mean([f["image_seconds"] for f in firsts]))})  # fmt: skip
    return found


def _over_scenes(records: list[dict]) -> list[dict]:
    """Geometric means over the scenes, by variant and time."""
    groups: dict[tuple, list] = {}
    for record in records:
        groups.setdefault((record["label"], record["seconds"]), []).append(record)
    return [{"scene": "all", "label": label, "seconds": seconds,
             **{n: float(np.exp(np.mean([np.log(r[n]) for r in rows]))) for n in ("times", "image_times", "steps")}}
            for (label, seconds), rows in groups.items()]  # fmt: skip


def _write(folder: Path, records: list[dict]) -> None:
    exr.write_text(folder / "results.json", json.dumps(
        {"records": records, "environment": environment.describe()}, indent=1))  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
