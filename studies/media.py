"""Denoised images of scenes with participating media, in equal time: ``python studies/media.py -o DIR``.

A cloud under sky and sun, a courtyard full of fog in the sun, and wax inside of rough glass, by Mitsuba's `volpath` and
by integrators with a cache (`neural_path`; others by `--integrators`), with `denoised=true` where they have that.
Frames have 2 seconds of CPU time (1 s on two cores), a training step included, after 300 steps of training; shots have
20 seconds, 7 of them training. How many samples fit in is found by a render beforehand, kernels compiled. All runs on
one thread and counts its CPU time, so that other programs disturb little.

The error is the relative squared error ``(I - R)²/(R² + 0.01 mean(R)²)`` of the denoised image I. In the numerator the
two factors have references with noise of their own, so that the noise of neither counts; in the denominator stands
their mean, denoised. The standard error is that of the means of blocks. References are kept in DIR and made once:
`plain_path`, which for the wax plays no roulette before 400 bounces (a tenth of the variance of a sample, 2.6 times the
time).
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_neural.bench import environment
from mi_neural.bench.denoise import denoise, render_guides, warm_up
from mi_neural.image import exr

SIZE, BLOCK = (320, 180), 20
#: CPU seconds of a frame and of a shot, and of the latter's training; training steps before the frames.
FRAME, SHOT, TRAINING, STEPS = 2.0, 20.0, 7.0, 300
#: Images whose errors are averaged.
FRAMES, SHOTS = 3, 1


def rgb(*values) -> dict:
    return {"type": "rgb", "value": list(values)}


def matte(*values) -> dict:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(*values)}}


def sensor(origin, target, fov, **keys) -> dict:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": view, "film": film, **keys}


def rectangle(at, angle, size, **keys) -> dict:
    import mitsuba as mi

    place = mi.ScalarTransform4f().translate(at).rotate([1, 0, 0], angle).scale([size, size, 1])
    return {"type": "rectangle", "to_world": place, **keys}


def box(at, size, **keys) -> dict:
    import mitsuba as mi

    return {"type": "cube", "to_world": mi.ScalarTransform4f().translate(at).scale(size), **keys}


def cloud() -> dict:
    """Balls of smoke in 32^3 voxels; of a hundred scatterings one absorbs."""
    import mitsuba as mi

    rng, n = np.random.default_rng(1), 32
    points = np.stack(np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij"), -1)
    density = np.zeros((n, n, n))
    for _ in range(24):
        centre, radius = rng.normal(size=3) * [0.22, 0.18, 0.35], rng.uniform(0.18, 0.4)
        density = np.maximum(density, np.clip(1.5 * (1 - ((points - centre) ** 2).sum(-1) / radius**2), 0, 1))
    density *= 0.6 + 0.4 * rng.random((n, n, n))
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(density.astype(np.float32)[..., None]),
            "to_world": mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)}  # fmt: skip
    smoke = {"type": "heterogeneous", "sigma_t": grid, "albedo": rgb(0.99, 0.99, 0.99), "scale": 25.0,
             "phase": {"type": "hg", "g": 0.6}}  # fmt: skip
    return {
        "sensor": sensor([0, 0.2, 4], [0, -0.1, 0], 38),
        "cloud": {"type": "cube", "bsdf": {"type": "null"}, "interior": smoke},
        "floor": rectangle([0, -1.3, 0], -90, 6, bsdf=matte(0.4, 0.35, 0.3)),
        "sky": {"type": "constant", "radiance": rgb(0.3, 0.45, 0.8)},
        "sun": {"type": "directional", "direction": [0.6, -1, -0.5], "irradiance": rgb(4, 3.6, 3)},
    }


def courtyard() -> dict:
    """Walls and pillars in the sun; the fog is outside of them, too, and the camera is in it."""
    fog = {"type": "homogeneous", "id": "fog", "sigma_t": rgb(1, 1, 1), "scale": 0.12, "albedo": rgb(0.95, 0.95, 0.95),
           "phase": {"type": "hg", "g": 0.5}}  # fmt: skip
    wall = matte(0.6, 0.5, 0.4)
    scene = {
        "sensor": sensor([0, 1.6, 5.6], [0, 1.6, 0], 60, medium=fog),
        "hull": {**box([0, 4, 0], 12), "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "fog"}},
        "floor": rectangle([0, 0, 0], -90, 8, bsdf=matte(0.5, 0.5, 0.5)),
        "back": box([0, 2.5, -6.2], [6.2, 2.5, 0.2], bsdf=wall),
        "front": box([0, 2.5, 6.2], [6.2, 2.5, 0.2], bsdf=wall),
        "left": box([-6.2, 2.5, 0], [0.2, 2.5, 6.2], bsdf=matte(0.6, 0.3, 0.2)),
        "right": box([6.2, 2.5, 0], [0.2, 2.5, 6.2], bsdf=wall),
        "sky": {"type": "constant", "radiance": rgb(0.2, 0.3, 0.5)},
        "sun": {"type": "directional", "direction": [0.7, -1, -0.3], "irradiance": rgb(6, 5.2, 4.2)},
    }
    for i, x in enumerate((-3.5, -1.2, 1.2, 3.5)):
        scene[f"pillar{i}"] = box([x, 2, -3], [0.3, 2, 0.3], bsdf=wall)
    return scene | {"beam": box([0, 4.2, -3], [4.2, 0.2, 0.4], bsdf=wall)}


def wax() -> dict:
    """A ball and a block of wax, of which red light leaves the most; a lamp behind them, grey sky."""
    inside = {"type": "homogeneous", "sigma_t": rgb(1, 1, 1), "scale": 14.0, "albedo": rgb(0.995, 0.98, 0.93),
              "phase": {"type": "isotropic"}}  # fmt: skip
    skin = {"type": "roughdielectric", "int_ior": 1.4, "alpha": 0.2}
    return {
        "sensor": sensor([0, 0.9, 3.6], [0, 0.35, 0], 36),
        "floor": rectangle([0, 0, 0], -90, 5, bsdf=matte(0.4, 0.4, 0.45)),
        "ball": {"type": "sphere", "center": [-0.7, 0.6, 0], "radius": 0.6, "bsdf": skin, "interior": inside},
        "block": box([0.65, 0.5, 0], [0.4, 0.499, 0.4], bsdf=skin, interior=inside),
        "sky": {"type": "constant", "radiance": rgb(0.15, 0.15, 0.2)},
        "lamp": rectangle([1.5, 2.6, -1], 90, 0.6, emitter={"type": "area", "radiance": rgb(14, 12, 9)}),
    }


@dataclass(frozen=True)
class Case:
    """A scene, and how each half of its reference is made: passes, samples of a pass, first seed, `rr_depth`."""

    make: object
    passes: int
    spp: int
    seed: int
    rr_depth: int = 5


CASES = {"cloud": Case(cloud, 16, 16, 1000), "courtyard": Case(courtyard, 8, 64, 1000),
         "wax": Case(wax, 24, 32, 5000, 400)}  # fmt: skip


def halves(scene, case: Case, kept: Path) -> np.ndarray:
    """Two independent references, shape (2, height, width, 3); read where they were made before."""
    import mitsuba as mi

    if kept.exists():
        return np.load(kept).astype(np.float64)
    path, total = mi.load_dict({"type": "plain_path", "rr_depth": case.rr_depth}), np.zeros((2, *SIZE[::-1], 3))
    for k in range(case.passes):
        for half in range(2):
            seed = case.seed + k + 100_000 * half
            total[half] += np.array(mi.render(scene, integrator=path, spp=case.spp, seed=seed), np.float64)[..., :3]
    found = (total / case.passes).astype(np.float32)
    np.save(kept, found)
    return found.astype(np.float64)


class Judge:
    """Errors of images of one scene."""

    def __init__(self, scene, references: np.ndarray):
        self.guides, _ = render_guides(scene)
        warm_up(self.guides)
        self.references = references
        self.shown = self.clean(references.mean(0))
        self.scale = self.shown**2 + 0.01 * self.shown.mean() ** 2

    def clean(self, image: np.ndarray) -> np.ndarray:
        return denoise(image.astype(np.float32), self.guides)[0].astype(np.float64)

    def error(self, image: np.ndarray) -> tuple[float, float]:
        """(relative squared error, its standard error)."""
        error = ((image - self.references[0]) * (image - self.references[1]) / self.scale).mean(-1)
        height, width = (n // BLOCK for n in error.shape)
        blocks = error.reshape(height, BLOCK, width, BLOCK).mean((1, 3)).ravel()
        return float(error.mean()), float(blocks.std(ddof=1) / blocks.size**0.5)


def timed(function, *arguments) -> tuple:
    """(what it returns, CPU seconds)."""
    import drjit as dr

    start = time.process_time()
    found = function(*arguments)
    dr.sync_thread()
    return found, time.process_time() - start


def renderer(scene, integrator):
    """A function of (samples, seed) that renders."""
    import mitsuba as mi

    return lambda spp, seed: np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed), np.float64)[..., :3]


def samples_in(render, seconds: float, spp: int) -> int:
    """Samples a pixel that take so long, by an image of `spp`; kernels are compiled first."""
    render(spp, 5)
    return max(1, round(seconds / timed(render, spp, 6)[1] * spp))


def images_of(scene, name: str) -> list[tuple]:
    """(mode, samples a pixel, CPU seconds of an image, images) of one integrator."""
    import mitsuba as mi

    if name == "volpath":
        render, step, trained = renderer(scene, mi.load_dict({"type": name, "max_depth": -1})), 0.0, 0.0
        shot = n = samples_in(render, SHOT, 16)
        frame = max(1, round(n * FRAME / SHOT))
        found = [("shot", shot, *timed(lambda: [render(shot, 2)]))]
    else:
        integrator = mi.load_dict({"type": name} | ({} if name == "nrc" else {"denoised": True}))
        render = renderer(scene, integrator)
        integrator.train(scene, 8)
        shot = samples_in(render, SHOT - TRAINING, 32)
        integrator.reset()
        step = timed(integrator.train, scene, 48)[1] / 48
        integrator.reset()
        steps = round(TRAINING / step)
        _, trained = timed(integrator.train, scene, steps)
        found = [("shot", shot, *timed(lambda: [render(shot, 2)]))]
        integrator.train(scene, max(0, STEPS - steps))
        frame = samples_in(render, FRAME - step, 16)
    found.append(("frame", frame, *timed(lambda: [render(frame, 50 + k) for k in range(FRAMES)])))
    return [(mode, spp, seconds / len(images) + (trained if mode == "shot" else 0), images)
            for mode, spp, images, seconds in found]  # fmt: skip


def measure(name: str, out: Path, integrators: tuple[str, ...]) -> list[dict]:
    """The records of one scene, and PNG files: reference, `volpath`, the other `integrators` (shots)."""
    import mitsuba as mi

    scene = mi.load_dict({"type": "scene", **CASES[name].make()})
    judge = Judge(scene, halves(scene, CASES[name], out / f"reference_{name}.npy"))
    records, pictures, before = [], [judge.shown], {}
    for integrator in ("volpath", *integrators):
        for mode, spp, seconds, images in images_of(scene, integrator):
            clean = [judge.clean(image) for image in images]
            error, deviation = np.mean([judge.error(image) for image in clean], axis=0)
            before.setdefault(mode, error)
            pictures += [clean[0]] if mode == "shot" else []
            records.append({
                "scene": name, "mode": mode, "integrator": integrator, "spp": spp, "cpu_seconds": seconds,
                "raw": float(np.mean([judge.error(image)[0] for image in images])), "denoised": float(error),
                "standard_error": float(deviation), "ratio": float(error / before[mode]),
                "mean": float(np.mean(images) / judge.references.mean()),
            })  # fmt: skip
            print({k: float(f"{v:.3g}") if isinstance(v, float) else v for k, v in records[-1].items()}, flush=True)
    exr.write_png(out / f"{name}.png", np.concatenate(pictures, axis=1))
    return records


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenes", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for media.json and pictures")
    parser.add_argument("--integrators", nargs="+", default=["neural_path"], choices=["neural_path", "nrc", "nirc"],
                        help="beside volpath (default: neural_path)")  # fmt: skip
    asked = parser.parse_args(arguments)
    if unknown := set(asked.scenes) - set(CASES):
        parser.error(f"unknown scenes: {', '.join(sorted(unknown))}; give some of: {', '.join(CASES)}")
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    asked.output.mkdir(parents=True, exist_ok=True)
    records = [record for name in asked.scenes for record in measure(name, asked.output, asked.integrators)]
    result = {"images": records, "environment": environment.describe()}
    exr.write_text(asked.output / "media.json", json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
