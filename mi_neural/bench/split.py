"""Where the time of a frame goes: ``python -m mi_neural.bench.split SCENE -i nirc``.

Frames of a trained cache, with Dr.Jit's kernel history, which times each kernel by itself; medians over a few frames.

train    kernels of the training steps, each as long as one that is taken alone: in a frame they are queued and not
         waited for, so that the integrator's own clock does not see them
film     developing the film and copying it to NumPy, done once more after the frame
query    number of queries of an image x what one costs in a kernel of its own (`ns_per_query`). An estimate: one fused
         kernel traces and queries, and no clock can be read inside of it
trace    all other kernels of the image: camera rays, materials, lights, splats
python   wall time in which no kernel runs: Python, Dr.Jit's own work, launches; of the training step too

The command also estimates queries by ablation, from what further `cache_samples` cost, which trace no rays: a query
there includes the BSDF sample that it needs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

import numpy as np

from . import budget, load
from .specs import IntegratorSpec, build_integrator, parse_integrator

#: Frames that are measured, after those in which functions are recorded.
FRAMES, WARM_FRAMES = 5, 2
#: Cache samples that the ablation adds.
MORE_SAMPLES = 8


@dataclass(frozen=True)
class Split:
    """Seconds of one frame of `spp` samples a pixel; `query` is None without queries or where their cost is unknown.

    `total` is the wall time and the sum of the others.
    """

    spp: int
    total: float
    train: float
    query: float | None
    trace: float
    film: float
    python: float

    def to_json(self) -> dict[str, float | None]:
        """As a dictionary of plain values."""
        return asdict(self)


def kernels(work) -> tuple[float, float]:
    """(wall seconds, seconds in kernels) of calling `work`."""
    import drjit as dr

    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        start = budget.clock()
        work()
        wall = budget.clock() - start
    return wall, min(wall, 1e-3 * sum(entry["execution_time"] for entry in dr.kernel_history()))


def measure(scene, integrator, spp: int = 1, frames: int = FRAMES) -> Split:
    """Split a frame of an integrator that is warm and, if it learns, trained. It goes on learning by some frames."""
    film = scene.sensors()[0].film()
    found = []
    for k in range(WARM_FRAMES + frames):
        before = budget.statistics(integrator)
        seed = budget.pass_seed(k, budget.STREAM_WARM_UP, spp)
        wall, busy = kernels(lambda seed=seed: budget.render_pass(scene, integrator, spp, seed))
        after = budget.statistics(integrator)
        develop, develop_busy = kernels(lambda: np.array(film.develop()))
        gone = {name: after.get(name, 0) - before.get(name, 0) for name in ("steps", "seconds_train")}
        train = 0.0
        if any(v > 0 for v in gone.values()):  # a light sampler counts no steps
            train = min(busy, max(gone["steps"], 1) * kernels(lambda: integrator.train(scene, 1))[1])
        develop = min(develop, wall - train)
        image = max(0.0, busy - train - min(develop_busy, develop))
        queries = after.get("queries", 0) - before.get("queries", 0)
        query = min(image, 1e-9 * queries * after.get("ns_per_query", 0.0))
        found.append((wall, train, query, image - query, develop, max(0.0, wall - train - image - develop)))
    total, train, query, trace, developed, python = (median(f[k] for f in found[WARM_FRAMES:]) for k in range(6))
    # Medians of parts need not add up to the median of the whole; the least exactly measured part takes the difference
    python = max(0.0, total - train - query - trace - developed)
    return Split(spp, total, train, query or None, trace, developed, python)


def ablated_query(scene, spec: IntegratorSpec, keys: dict, integrator, spp: int = 1) -> float | None:
    """Nanoseconds of a query within the image's own kernel; None for an integrator without a number `cache_samples`.

    `integrator`, built from `spec` and `keys`, is trained and warm. Another with MORE_SAMPLES more takes over its
    cache; both render by turns, and the difference of their times is that of the added queries.
    """
    few = getattr(integrator, "cache_samples", None)
    if not isinstance(few, int) or few < 1:
        return None
    more, _ = build_integrator(IntegratorSpec(spec.type, {**spec.keys, "cache_samples": few + MORE_SAMPLES}),
                                    {k: v for k, v in keys.items() if k not in spec.keys})  # fmt: skip
    budget.warm_up(scene, more, [spp])
    with tempfile.TemporaryDirectory() as folder:
        integrator.save_cache(Path(folder) / "cache")
        more.load_cache(Path(folder) / "cache", scene)
    seconds: dict[object, list[float]] = {integrator: [], more: []}
    counted = {it: budget.statistics(it).get("queries", 0) for it in seconds}
    for k in range(WARM_FRAMES + FRAMES):
        for it, times in seconds.items():
            times.append(budget.render_samples(scene, it, spp, k).seconds_render)
    counted = {it: budget.statistics(it).get("queries", 0) - n for it, n in counted.items()}
    added = (counted[more] - counted[integrator]) / (WARM_FRAMES + FRAMES)
    gained = median(seconds[more][WARM_FRAMES:]) - median(seconds[integrator][WARM_FRAMES:])
    return 1e9 * gained / added if added > 0 else None


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m mi_neural.bench.split", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...], repeatable")
    parser.add_argument("--size", help="WxH")
    parser.add_argument("--spp", type=int, default=1, help="samples a pixel of a frame")
    parser.add_argument("--frames", type=int, default=100, help="training frames before")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scene")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    options = parser.parse_args(arguments)

    from . import terminal

    try:
        terminal.set_variant(options.variant)
        loaded = load.load_scene(options.scene, terminal.parse_size(options.size), terminal.parse_define(options.D))
        specs = [parse_integrator(text) for text in options.integrator]
        built = [(spec, *build_integrator(spec, loaded.carried)) for spec in specs]
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    for spec, integrator, keys in built:
        budget.warm_up(loaded.scene, integrator, [options.spp])
        budget.train(loaded.scene, integrator, options.frames)
        parts = measure(loaded.scene, integrator, options.spp).to_json()
        text = ", ".join(f"{k} {1e3 * v:.2f} ms ({100 * v / parts['total']:.1f} %)"
                         for k, v in parts.items() if k not in ("spp", "total") and v is not None)  # fmt: skip
        print(f"{loaded.name} {spec.label}: frame {1e3 * parts['total']:.2f} ms: {text}", flush=True)
        if (ns := ablated_query(loaded.scene, spec, keys, integrator, options.spp)) is not None:
            own = budget.statistics(integrator).get("ns_per_query", float("nan"))
            print(f"  query, ablated: {ns:.0f} ns; in a kernel of its own {own:.0f} ns", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
