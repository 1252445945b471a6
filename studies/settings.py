"""Settings after equal training: ``python studies/settings.py SCENE ... -i TYPE:K=V,... -i ... -o DIR``.

Each integrator is trained with a number of frames (training steps) or, by ``--paths``, with a number of training paths.
Its cache or light sampler then stays as it is, and images of each number of samples are rendered. This is repeated with
other seeds, the same ones for all integrators. DIR/settings.json has a record for each scene, integrator, training and
number of samples: the mean of the image over that of the reference; trimmed relMSE and FLIP of the image and,
with ``--denoise``, of the denoised one; the CPU seconds of the training. All are means over seeds and images;
``deviations`` has the standard deviations over the seeds. Integrators without a cache are rendered once.

The reference is the image beside the scene where it has the same depth. Others are rendered and kept in DIR.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from mi_neural.bench import budget, denoise, environment, load, terminal
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.image import exr, metrics


@contextmanager
def untrained(integrator):
    """Inside, images train neither the cache of an integrator nor its light sampler."""
    parts = ((integrator, "freeze_cache"), (getattr(integrator, "light_sampler", None), "freeze"))
    before = [(part, name, getattr(part, name)) for part, name in parts if hasattr(part, name)]
    for part, name, _ in before:
        setattr(part, name, True)
    yield
    for part, name, value in before:
        setattr(part, name, value)


def steps_of(integrator, amount: int, paths: bool) -> int:
    """Training steps: `amount`, or as many as have that many training paths."""
    return round(amount / integrator.cache.training.n_paths) if paths else amount


class Judge:
    """Errors of images of one scene."""

    def __init__(self, scene, reference, with_denoiser: bool):
        self.reference, self.exposures = reference, metrics.flip_exposures(reference.rgb)
        self.guides = denoise.render_guides(scene)[0] if with_denoiser else None

    def errors(self, image: np.ndarray) -> dict[str, float]:
        """The figures of a record."""
        found = {"mean": float(image.mean() / self.reference.rgb.mean())} | self._of(image, "")
        if self.guides is not None:
            found |= self._of(denoise.denoise(image, self.guides)[0], "_denoised")
        return found

    def _of(self, image: np.ndarray, suffix: str) -> dict[str, float]:
        image = metrics.block_means(image, self.reference.rgb.shape)
        found = metrics.errors(image, self.reference.rgb, self.reference.variance, self.exposures)[0]
        return {f"relmse{suffix}": found.relmse_trimmed, f"flip{suffix}": found.flip}


def measure(scene, integrator, judge: Judge, trainings, spps, *, seeds: int, images: int, paths: bool) -> list[dict]:
    """The records of one integrator on one scene, without the names of both."""
    if not hasattr(integrator, "train"):  # Mitsuba's own
        trainings, seeds = [0], 1
    found: dict[tuple, list[dict]] = {(amount, spp): [] for amount in trainings for spp in spps}
    for seed in range(seeds):
        budget.reset(integrator, seed)
        done, seconds = 0, 0.0
        for amount in trainings:
            steps = steps_of(integrator, amount, paths) if amount else 0
            start = time.process_time()
            budget.train(scene, integrator, steps - done)
            seconds, done = seconds + time.process_time() - start, steps
            with untrained(integrator):
                for spp in spps:
                    own = [budget.pass_seed(seed, budget.STREAM_IMAGE, k) for k in range(images)]
                    rendered = [budget.render_samples(scene, integrator, spp, number).rgb for number in own]
                    of_images = [judge.errors(image) for image in rendered]
                    one = {name: float(np.mean([e[name] for e in of_images])) for name in of_images[0]}
                    found[amount, spp].append(one | {"train_cpu_seconds": seconds, "steps": done})
    kind = "paths" if paths else "frames"
    return [{kind: amount, "spp": spp, **_mean(of_seeds, np.mean), "deviations": _mean(of_seeds, np.std)}
            for (amount, spp), of_seeds in found.items()]  # fmt: skip


def numbers(text: str) -> list[int]:
    """`1,16,64` of the command line."""
    return [int(n) for n in text.split(",")]


def _mean(records: list[dict], statistic) -> dict[str, float]:
    return {name: float(statistic([r[name] for r in records])) for name in records[0]}


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/settings.py", description=__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="scene file, shipped or public scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...]; several")
    parser.add_argument("--size", default="160x90,144x144", help="each scene takes the one nearest in shape")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scenes")
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--frames", type=numbers, default=[300], help="training frames before each image: 100,300")
    amount.add_argument("--paths", type=numbers, help="training paths instead")
    parser.add_argument("--spp", type=numbers, default=[64], help="samples a pixel: 1,16,64")
    parser.add_argument("--seeds", type=int, default=1, help="trainings with other seeds")
    parser.add_argument("--images", type=int, default=1, help="images whose errors are averaged")
    parser.add_argument("--denoise", action="store_true", help="errors of the denoised image as well")
    parser.add_argument("--reference", action="append", default=[], metavar="NAME=REF.exr", help="of the scene NAME")
    parser.add_argument("--reference-spp", type=int, default=512, help="of references that are rendered")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for settings.json and references")
    options = parser.parse_args(arguments)

    import mitsuba as mi

    sys.path.append(str(Path(__file__).resolve().parent))
    from ablation import reference_of

    mi.set_variant(options.variant)
    options.output.mkdir(parents=True, exist_ok=True)
    records: list[dict] = []
    try:
        specs = [parse_integrator(text) for text in options.integrator]
        sizes = terminal.parse_sizes(options.size)
        named = terminal.parse_define(options.reference)
        for name in options.scenes:
            loaded = load.load_scene(name, sizes, terminal.parse_define(options.D))
            path, spp = named.get(loaded.name), options.reference_spp
            reference = reference_of(loaded, options.output, spp, path, same_depth=True)
            judge = Judge(loaded.scene, reference, options.denoise)
            for spec in specs:
                integrator, _ = build_integrator(spec, loaded.carried)
                found = measure(
                    loaded.scene, integrator, judge, sorted(options.paths or options.frames), options.spp,
                    seeds=options.seeds, images=options.images, paths=options.paths is not None,
                )  # fmt: skip
                records += [{"scene": loaded.name, "label": spec.label, **record} for record in found]
                for record in found:
                    print(loaded.name, spec.label, _shown(record), flush=True)
                exr.write_text(options.output / "settings.json", json.dumps(
                    {"records": records, "environment": environment.describe()}, indent=1))  # fmt: skip
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _shown(record: dict) -> str:
    return " ".join(f"{k}={v:.4g}" for k, v in record.items() if not isinstance(v, dict))


if __name__ == "__main__":
    sys.exit(main())
