"""What a plan saves: ``python studies/ablation.py SCENE ... -o DIR``.

Each scene is rendered by one integrator twice over, with the parts that its plan chooses and with everything built
(``plan=everything``): frames of a trained cache, training step included, in turn, so that a change in the machine's
load affects both. The training is repeated with other seeds. Reported are the time of a frame and its error at equal
samples, and the error of the planned one with as many samples as fit into the time of the other. Intervals are of 95 %,
over the repeats, by Student's t; of ratios of times and of differences, those within a repeat.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mi_neural.bench import budget, environment, load, terminal
from mi_neural.bench import reference as references
from mi_neural.bench.reference import Reference
from mi_neural.bench.repeats import half_width
from mi_neural.bench.specs import IntegratorSpec, build_integrator, parse_integrator
from mi_neural.image import exr, metrics

#: What is compared, and in which mode of the plan each is.
PLANNED, EVERYTHING, EQUAL_TIME = "planned", "everything", "planned, equal time"
#: Renders references: the scene's own choice of lights is wrong for emitters with attributes of a mesh (README).
REFERENCE = "plain_path:light_sampler.type=nvc_lights"


@dataclass
class Estimate:
    """A mean over repeats and half of its interval."""

    mean: float
    half: float

    @classmethod
    def of(cls, values) -> Estimate:
        values = np.asarray(values, np.float64)
        half = half_width(values)
        return cls(float(values.mean()), float("inf") if half is None else half)

    def __str__(self):
        return f"{self.mean:.4g} ± {self.half:.2g}"


@dataclass
class Result:
    """One scene. Errors are trimmed relMSE and FLIP; `higher`: planned minus everything, at equal samples and in equal
    time."""

    scene: str
    integrator: str
    ms: dict[str, float]
    faster: Estimate
    spp: dict[str, float]
    relmse: dict[str, Estimate]
    flip: dict[str, Estimate]
    higher: dict[str, Estimate]
    left_out: list[str]

    def line(self) -> list[str]:
        """A row of the table."""
        shown = [f"{self.relmse[k]}, {self.flip[k].mean:.3f}" for k in (EVERYTHING, PLANNED, EQUAL_TIME)]
        return [self.scene, f"{self.ms[EVERYTHING]:.0f}", f"{self.ms[PLANNED]:.0f}", str(self.faster), *shown,
                str(self.higher["flip"]), ", ".join(self.left_out)]  # fmt: skip


HEAD = ["scene", "everything, ms", "planned, ms", "times faster", "everything: relMSE, FLIP", "planned, equal samples",
        "planned, equal time", "FLIP higher by, equal samples", "left out"]  # fmt: skip


def measure(
    loaded: load.LoadedScene, spec: IntegratorSpec, reference: Reference, *, frames: int, repeats: int, spp: int,
    images: int, progress=None,
) -> Result:  # fmt: skip
    """Compare the two modes of the plan; `frames` of training, then `images` frames of `spp` samples, `repeats` times
    over. Both learn at one rate, that of the planned one: the default of `nrc` depends on `blend`, which is a part."""
    planned, _ = build_integrator(IntegratorSpec(spec.type, {**spec.keys, "plan": "scene"}), loaded.carried)
    rate = planned.cache.training.learning_rate
    keys = {"learning_rate": rate, **spec.keys, "plan": "everything"}
    everything, _ = build_integrator(IntegratorSpec(spec.type, keys), loaded.carried)
    integrators = {EVERYTHING: everything, PLANNED: planned}
    for integrator in integrators.values():
        integrator.prepare(loaded.scene, spp=spp)
    exposures = metrics.flip_exposures(reference.rgb)
    seconds: dict[str, list] = {EVERYTHING: [], PLANNED: []}
    errors: dict[str, list] = {EVERYTHING: [], PLANNED: [], EQUAL_TIME: []}
    more = []

    def frame(name: str, n: int, seed: int) -> tuple[float, np.ndarray]:
        start = budget.clock()
        image = budget.render_pass(loaded.scene, integrators[name], n, seed)
        return budget.clock() - start, np.asarray(image[..., :3], np.float64)

    def judged(images_) -> np.ndarray:
        target = reference.rgb, reference.variance, exposures
        found = [metrics.errors(metrics.block_means(image, reference.rgb.shape), *target)[0] for image in images_]
        return np.mean([(e.relmse_trimmed, e.flip) for e in found], axis=0)

    for r in range(repeats):
        for integrator in integrators.values():
            _begin_anew(integrator, r)
            integrator.train(loaded.scene, frames)
        for name in integrators:
            frame(name, spp, 1)
        taken: dict[str, list] = {EVERYTHING: [], PLANNED: []}
        for k in range(images):
            for name in integrators:
                taken[name].append(frame(name, spp, budget.pass_seed(r, budget.STREAM_IMAGE, k)))
        for name, found in taken.items():
            seconds[name].append(float(np.median([t for t, _ in found])))
            errors[name].append(judged([image for _, image in found]))
        fits = max(1, round(spp * seconds[EVERYTHING][-1] / seconds[PLANNED][-1]))
        more.append(fits)
        seeds = [budget.pass_seed(r, budget.STREAM_IMAGE, images + k) for k in range(images)]
        errors[EQUAL_TIME].append(judged([frame(PLANNED, fits, seed)[1] for seed in seeds]))
        if progress:
            progress(r + 1, repeats)

    table = {name: np.array(found) for name, found in errors.items()}
    plan = integrators[PLANNED].state.plan
    everything = integrators[EVERYTHING].state.plan
    return Result(
        scene=loaded.name, integrator=spec.label, ms={k: 1e3 * float(np.median(v)) for k, v in seconds.items()},
        faster=Estimate.of(np.array(seconds[EVERYTHING]) / np.array(seconds[PLANNED])),
        spp={PLANNED: spp, EVERYTHING: spp, EQUAL_TIME: float(np.mean(more))},
        relmse={k: Estimate.of(v[:, 0]) for k, v in table.items()},
        flip={k: Estimate.of(v[:, 1]) for k, v in table.items()},
        higher={
            "relmse": Estimate.of(table[PLANNED][:, 0] - table[EVERYTHING][:, 0]),
            "flip": Estimate.of(table[PLANNED][:, 1] - table[EVERYTHING][:, 1]),
            "relmse, equal time": Estimate.of(table[EQUAL_TIME][:, 0] - table[EVERYTHING][:, 0]),
            "flip, equal time": Estimate.of(table[EQUAL_TIME][:, 1] - table[EVERYTHING][:, 1]),
        },
        left_out=[part for part in everything.decisions if everything.modelled(part) and not plan.modelled(part)],
    )  # fmt: skip


def _begin_anew(integrator, seed: int) -> None:
    """Forget what was learned, and learn by other numbers from now on."""
    integrator.reset()
    for part in (integrator, getattr(integrator, "light_sampler", None)):
        if hasattr(part, "cache") and hasattr(part.cache, "seed"):
            part.cache.seed = seed


def reference_of(
    loaded: load.LoadedScene, folder: Path, spp: int, path: str | None, progress=None, same_depth: bool = False
) -> Reference:
    """The reference in the file `path`, or the one beside the scene, or one of `spp` samples, kept in `folder`. With
    `same_depth`, the one beside the scene counts only if it has the scene's depth."""
    if path := path or references.beside(loaded.path, loaded.size, loaded.box_filter):
        found = references.of_film(path, loaded)
        if not (same_depth and references.depth_warning(found, loaded.carried.get("max_depth"))):
            return found
    width, height = loaded.size
    path = folder / f"reference_{loaded.name}_{width}x{height}_{spp}.exr"
    if not path.is_file():
        integrator, _ = build_integrator(parse_integrator(REFERENCE), loaded.carried)
        integrator.train(loaded.scene, 100)
        n = max(8, spp // 16)
        images = []
        for k in range(n):
            seed = budget.pass_seed(0, budget.STREAM_REFERENCE, k)
            images.append(budget.render_pass(loaded.scene, integrator, max(1, spp // n), seed)[..., :3].astype(float))
            if progress:
                progress(k + 1, n)
        variance = np.var(images, axis=0, ddof=1) / n
        metadata = {"integrator": REFERENCE, "spp": str(max(1, spp // n) * n)}
        exr.write(path, np.mean(images, axis=0), exr.layer_channels("variance", variance), metadata)
    return references.load_reference(path, loaded.size)


def markdown(results: list[Result]) -> str:
    """The table."""
    rows = [HEAD, ["---"] * len(HEAD), *(r.line() for r in results)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/ablation.py", description=__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="scene file or shipped scene")
    parser.add_argument("-i", "--integrator", default="nirc", help="TYPE[:K=V,...] of a cached integrator")
    parser.add_argument("--size", default="160x90")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scenes")
    parser.add_argument("--frames", type=int, default=150, help="training frames before the clock starts")
    parser.add_argument("--repeats", type=int, default=5, help="trainings with other seeds")
    parser.add_argument("--images", type=int, default=3, help="frames of each after a training")
    parser.add_argument("--spp", type=int, default=4, help="samples a pixel of a frame")
    parser.add_argument("--reference", action="append", default=[], metavar="NAME=REF.exr", help="of the scene NAME")
    parser.add_argument("--reference-spp", type=int, default=512, help="of references that are rendered")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for ablation.md, .json, references")
    options = parser.parse_args(arguments)

    import mitsuba as mi

    mi.set_variant(options.variant)
    options.output.mkdir(parents=True, exist_ok=True)
    results: list[Result] = []
    try:
        spec = parse_integrator(options.integrator)
        named = terminal.parse_define(options.reference)
        for name in options.scenes:
            loaded = load.load_scene(name, terminal.parse_size(options.size), terminal.parse_define(options.D))
            reference = reference_of(loaded, options.output, options.reference_spp, named.get(loaded.name))
            results.append(measure(
                loaded, spec, reference, frames=options.frames, repeats=options.repeats, spp=options.spp,
                images=options.images,
            ))  # fmt: skip
            print(" | ".join(results[-1].line()), flush=True)
            exr.write_text(options.output / "ablation.md", markdown(results))
            rows = [asdict(r) for r in results]
            exr.write_text(options.output / "ablation.json", json.dumps(
                {"arguments": vars(options) | {"output": str(options.output)}, "rows": rows,
                 "environment": environment.describe()}, indent=1, default=str))  # fmt: skip
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(markdown(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
