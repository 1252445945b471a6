"""How cost grows: ``python studies/scaling.py SCENE -i nirc --over pixels -o DIR``.

One quantity is varied, everything else stays as it is; at each value an integrator is built, warmed up and trained by
some frames, and then the medians over a few frames are taken of

image    rendering `--spp` samples a pixel, without training
train    one training frame
query    one cache query in a kernel of its own
memory   high-water mark of the process while this was done

What can be varied: `pixels` (sizes of the film), `samples` (a pixel), `lights` (small squares above a floor, scene
`lights`), `records` (training records a frame, by the key `train_samples`), `network` (key `width`), `cores` (Dr.Jit's
threads), or any key of the integrator, as in ``--over hidden_layers=1,2,4``. The exponent p of cost ~ x^p is fitted by
least squares to the logarithms, over all values and over the upper half of them, where constant parts count least.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np

from mi_neural.bench import budget, environment, load, memory, terminal
from mi_neural.bench.specs import IntegratorSpec, build_integrator, parse_integrator, parse_keys
from mi_neural.image import exr

#: Values that are varied by default.
DEFAULTS = {
    "pixels": ("64x64", "160x90", "320x180", "640x360", "1280x720", "1920x1080"),
    "samples": ("1", "2", "4", "8", "16", "32"),
    "lights": ("1", "4", "16", "64", "256", "1024"),
    "records": tuple(str(2**k) for k in range(12, 19)),
    "network": ("8", "16", "32", "64", "128"),
    "cores": (),  # 1, 2, 4, ... to as many as there are
}
#: Quantities with an exponent: name in `Point`, title, factor for the plot.
COSTS = (("image", "image, ms", 1e3), ("train", "training frame, ms", 1e3), ("query", "query, ns", 1e9),
         ("memory", "peak memory, MiB", 1.0))  # fmt: skip


@dataclass
class Point:
    """What one value of the varied quantity costs: seconds (`image`, `train`, `query`) and MiB; None: there is none."""

    x: float
    value: str
    image: float
    train: float | None
    query: float | None
    memory: float | None


@dataclass(frozen=True)
class Setting:
    """One value of the varied quantity, before anything is built."""

    value: str
    scene: str
    size: tuple[int, int] | None
    spp: int
    keys: dict[str, object]
    threads: int | None = None


def settings(over: str, values: tuple[str, ...], scene: str, size: tuple[int, int] | None, spp: int) -> list[Setting]:
    """The settings of a sweep. Raises :class:`~mi_neural.bench.load.InputError` for values that cannot be read."""
    if over == "pixels":
        return [Setting(v, scene, terminal.parse_size(v), spp, {}) for v in values]
    if over == "samples":
        return [Setting(v, scene, size, _count(over, v), {}) for v in values]
    if over == "lights":
        return [Setting(v, f"lights={_count(over, v)}", size, spp, {}) for v in values]
    if over == "records":  # a path of the default length makes 7 records
        return [Setting(v, scene, size, spp, {"train_samples": max(1, round(_count(over, v) / 7))}) for v in values]
    if over == "cores":
        return [Setting(v, scene, size, spp, {}, _count(over, v)) for v in values or _powers(environment.cores())]
    key = "width" if over == "network" else over
    return [Setting(v, scene, size, spp, parse_keys([f"{key}={v}"], "--over")) for v in values]


def _count(over: str, text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise load.InputError(f"--over {over} takes whole numbers from 1, got {text!r}")
    return int(text)


def _powers(n: int) -> tuple[str, ...]:
    return tuple(str(k) for k in sorted({*(2**k for k in range(n.bit_length()) if 2**k <= n), n}))


def lit_floor(n: int, size: tuple[int, int] | None):
    """A white floor under `n` small squares that shine, in a grid, and together always as much."""
    import mitsuba as mi

    T = mi.ScalarTransform4f
    side, (width, height) = math.ceil(math.sqrt(n)), size or (128, 128)
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 50, "to_world": T().look_at([0, -6, 4], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
        },
        "floor": {"type": "rectangle", "to_world": T().scale([4, 4, 1]), "bsdf": {"type": "diffuse"}},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse"},
                 "to_world": T().translate([0, 4, 2]).rotate([1, 0, 0], 90).scale([4, 2, 1])},
    }  # fmt: skip
    edge = 0.4 / side
    for k in range(n):
        x, y = (-3 + 6 * (i + 0.5) / side for i in (k % side, k // side))
        scene[f"light_{k}"] = {
            "type": "rectangle", "to_world": T().translate([x, y, 2]).rotate([1, 0, 0], 180).scale(edge),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.6 / (n * edge**2)] * 3}},
        }  # fmt: skip
    return mi.load_dict(scene)


def sweep(
    over: list[Setting], spec: IntegratorSpec, parameters: dict[str, str], rounds: int, frames: int
) -> Iterator[Point]:
    """Measure `spec` at each setting, in turn. `rounds` frames are timed, after `frames` of training."""
    import drjit as dr

    held: tuple = (None, None)
    threads = dr.thread_count()
    try:
        for setting in over:
            if held[0] != (setting.scene, setting.size):
                held = (setting.scene, setting.size), None  # the old scene goes before the new one comes
                held = held[0], _scene(setting, parameters)
            if setting.threads is not None:
                dr.set_thread_count(setting.threads)
            scene, carried = held[1]
            yield _point(setting, scene, carried, spec, rounds, frames)
    finally:
        if dr.thread_count() != threads:
            dr.set_thread_count(threads)


def _scene(setting: Setting, parameters: dict[str, str]) -> tuple[object, dict[str, object]]:
    if setting.scene.startswith("lights="):
        return lit_floor(int(setting.scene.partition("=")[2]), setting.size), {}
    loaded = load.load_scene(setting.scene, setting.size, parameters)
    return loaded.scene, loaded.carried


def _point(setting: Setting, scene, carried: dict, spec: IntegratorSpec, rounds: int, frames: int) -> Point:
    memory.start()
    own = IntegratorSpec(spec.type, {**spec.keys, **setting.keys})
    integrator, _ = build_integrator(own, carried)
    budget.warm_up(scene, integrator, [setting.spp])
    budget.train(scene, integrator, frames)
    before, trained = budget.statistics(integrator), []
    if hasattr(integrator, "train"):
        trained = [budget.train(scene, integrator, 1)[0] for _ in range(rounds)]
    after = budget.statistics(integrator)
    records = (after.get("records", 0) - before.get("records", 0)) / max(len(trained), 1)
    images = [budget.render_samples(scene, integrator, setting.spp, k).seconds_render for k in range(rounds + 1)][1:]
    width, height = scene.sensors()[0].film().crop_size()
    ns = after.get("ns_per_query")
    if setting.threads is not None:
        x = float(setting.threads)
    elif "train_samples" in setting.keys and records:
        x = float(records)
    elif setting.keys:
        x = float(next(iter(setting.keys.values())))
    elif setting.scene.startswith("lights="):
        x = float(setting.value)
    else:
        x = float(width * height * setting.spp)
    learned = after.get("seconds_train", 0.0) > before.get("seconds_train", 0.0)
    return Point(x, setting.value, median(images), median(trained) if learned else None,
                 None if ns is None else 1e-9 * ns, memory.peak_mib())  # fmt: skip


def exponent(points: list[Point], cost: str) -> tuple[float, float] | None:
    """p and its standard error in cost ~ x^p, by least squares on the logarithms; None with fewer than three points."""
    usable = [(p.x, getattr(p, cost)) for p in points if p.x > 0 and (getattr(p, cost) or 0.0) > 0]
    if len({x for x, _ in usable}) < 3:
        return None
    x, y = np.log(np.array(usable)).T
    x, y = x - x.mean(), y - y.mean()
    slope = float(x @ y / (x @ x))
    return slope, float(np.sqrt(((y - slope * x) ** 2).sum() / ((len(x) - 2) * (x @ x))))


def exponents(points: list[Point]) -> dict[str, dict[str, tuple[float, float] | None]]:
    """:func:`exponent` of each cost, over `all` points and over the `upper` half of them (at least three)."""
    ordered = sorted(points, key=lambda p: p.x)
    upper = ordered[min(len(ordered) // 2, max(0, len(ordered) - 3)) :]
    return {name: {"all": exponent(ordered, name), "upper": exponent(upper, name)} for name, _, _ in COSTS}


def plot(found: dict[str, list[Point]], title: str):
    """A panel for each cost that was measured, log-log, a line per integrator; a matplotlib figure."""
    from matplotlib.figure import Figure

    costs = [c for c in COSTS if any(getattr(p, c[0]) for points in found.values() for p in points)]
    figure = Figure(figsize=(3.8 * len(costs), 3.4), layout="constrained")
    for k, (name, label, factor) in enumerate(costs):
        axes = figure.add_subplot(1, len(costs), k + 1)
        shown = [factor * getattr(p, name) for points in found.values() for p in points if getattr(p, name)]
        axes.set(title=label, xlabel=title, ylim=(min(shown) / 2, max(shown) * 2))  # also where all are equal
        for integrator, points in found.items():
            line = [(p.x, factor * getattr(p, name)) for p in sorted(points, key=lambda p: p.x) if getattr(p, name)]
            if line:
                p = exponents(points)[name]["upper"]
                text = integrator + (f", p = {p[0]:.2f}" if p else "")
                axes.loglog(*zip(*line, strict=True), marker="o", markersize=4, label=text)
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(fontsize=8)
    return figure


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/scaling.py", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("scene", help="scene file or shipped scene; `lights` for --over lights")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...], repeatable")
    parser.add_argument("--over", required=True, metavar="WHAT[=V,V,...]",
                        help=f"{', '.join(DEFAULTS)}, or a key of the integrator with values")  # fmt: skip
    parser.add_argument("--size", help="WxH, where pixels are not what is varied")
    parser.add_argument("--spp", type=int, default=1, help="samples a pixel of an image")
    parser.add_argument("--rounds", type=int, default=5, help="frames that are timed")
    parser.add_argument("--frames", type=int, default=16, help="training frames before")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scene")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, help="folder for results.json and scaling.png")
    options = parser.parse_args(arguments)

    over, _, values = options.over.partition("=")
    found: dict[str, list[Point]] = {}
    try:
        terminal.set_variant(options.variant)
        values = tuple(values.split(",")) if values else DEFAULTS.get(over)
        if values is None:
            raise load.InputError(f"--over {over}: give values, as in --over {over}=1,2,4; or {', '.join(DEFAULTS)}")
        sweeping = settings(over, values, options.scene, terminal.parse_size(options.size), options.spp)
        for spec in (parse_integrator(text) for text in options.integrator):
            points = found.setdefault(spec.label, [])
            for point in sweep(sweeping, spec, terminal.parse_define(options.D), options.rounds, options.frames):
                points.append(point)
                costs = [f"{label} {factor * getattr(point, name):.4g}" for name, label, factor in COSTS
                         if getattr(point, name) is not None]  # fmt: skip
                print(f"{spec.label} {over} {point.value}: {'; '.join(costs)}", flush=True)
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    for label, points in found.items():
        for name, fits in exponents(points).items():
            if fits["all"]:
                texts = [f"{kind} {fit[0]:.3f} ± {fit[1]:.3f}" for kind, fit in fits.items() if fit]
                print(f"{label}: exponent of {name} in {over}: {', '.join(texts)}")
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        exr.write_text(options.output / "results.json", json.dumps({
            "scene": options.scene, "over": over, "size": options.size, "spp": options.spp, "rounds": options.rounds,
            "points": {label: [asdict(p) for p in points] for label, points in found.items()},
            "exponents": {label: exponents(points) for label, points in found.items()},
            "environment": environment.describe()}, indent=1) + "\n")  # fmt: skip
        plot(found, over).savefig(options.output / "scaling.png", dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main())
