"""What a frame costs, and how near that is to what the cores can do: ``python studies/frame_profile.py SCENE``.

frame         wall time of a frame of a trained cache by :mod:`mi_neural.bench.split`: train, query, trace, film, Python
training      one training frame by kernels, medians: `records` (tracing them: kernels as wide as there are paths),
              `network` (encoding, forward, backward: as wide as there are records), `products` (weight gradients),
              `optimiser` (all else: Adam, averages, sums), `python` (wall time in which no kernel runs)
query         nanoseconds of a query, see ``measure_query``
network       nanoseconds of the MLP alone, in a kernel of its own; its arithmetic over the FMA peak of the cores, which
              is measured in the same run by NumPy's BLAS: the best of a large square product and of one of the MLP's
              shape
memory        high-water mark of the process during the frames, MiB
first image   seconds from the start of ``mi-neural render --spp 1`` until an image is on disk: with an empty kernel
              cache, and again with the cache that this left
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

import numpy as np

from mi_neural.bench import budget, environment, load, memory, split, terminal
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.image import exr
from mi_neural.render.frozen import undisturbed

#: Frames that are measured, after those in which functions are recorded.
FRAMES, WARM_FRAMES = 20, 3
#: Sides of the large product, rows of the one of the MLP's shape, evaluations of the MLP at each.
SQUARE, BATCH, REPEATS = 2048, 2**17, 8


def median_seconds(work, n: int = 7) -> float:
    """Median wall time of calling `work`, after a first call."""
    work()
    times = []
    for _ in range(n):
        start = budget.clock()
        work()
        times.append(budget.clock() - start)
    return median(times)


def blas_flops(rows: int, inner: int, columns: int) -> float:
    """Floating-point operations a second of NumPy's product of float32 matrices (rows, inner) x (inner, columns)."""
    rng = np.random.default_rng(0)
    a, b = (rng.random(s, np.float32) for s in ((rows, inner), (inner, columns)))
    out = np.empty((rows, columns), np.float32)
    return 2 * rows * inner * columns / median_seconds(lambda: np.matmul(a, b, out=out))


def trained_network(integrator):
    """The averaged weights of the network that the integrator's cache queries; None if it has none."""
    field = getattr(getattr(integrator, "cache", None), "field", None)
    return getattr(field, "averaged", None)


def network_seconds(weights) -> float:
    """Seconds of one evaluation of an MLP, all its inputs at once, in a kernel that does nothing else."""
    import drjit as dr
    import mitsuba as mi

    rng = np.random.default_rng(0)
    n_inputs = weights.mlp["layers.0.weights"].shape[1]
    inputs = [mi.Float(rng.random(BATCH, np.float32)) for _ in range(n_inputs)]

    @dr.freeze
    def run(weights, inputs, zero):
        def evaluate(i, total):
            return i + 1, total + sum(weights([v + total for v in inputs])) * zero

        return dr.while_loop((mi.UInt32(0), mi.Float(0) + zero), lambda i, _: i < REPEATS, evaluate)[1]

    def once():
        with undisturbed():
            dr.eval(run(weights, inputs, dr.opaque(mi.Float, 0)))
        dr.sync_thread()

    with dr.suspend_grad():
        dr.eval(inputs)
        once()
        return median_seconds(once) / (BATCH * REPEATS)


def network(weights) -> dict[str, float]:
    """Nanoseconds of the MLP, its and the machine's operations a second, the share of the one in the other."""
    shapes = [v.shape for k, v in weights.mlp.items() if k.endswith("weights")]
    macs = sum(int(np.prod(s)) for s in shapes)
    seconds = network_seconds(weights)
    widest = max(shapes, key=np.prod)
    shaped, square = blas_flops(BATCH, widest[1], widest[0]), blas_flops(SQUARE, SQUARE, SQUARE)
    return {
        "ns": 1e9 * seconds, "gflops": 2e-9 * macs / seconds, "blas_same_shape_gflops": 1e-9 * shaped,
        "blas_square_gflops": 1e-9 * square, "share_of_peak": 2 * macs / seconds / max(shaped, square),
    }  # fmt: skip


def stage(entry: dict, n_paths: int, n_records: int) -> str:
    """What a launch in Dr.Jit's kernel history is part of."""
    kind = str(entry["type"]).rpartition(".")[2]
    if kind == "BatchedGemm":
        return "products"
    if kind == "JIT" and entry["size"] == n_paths:
        return "records"
    return "network" if kind == "JIT" and entry["size"] == n_records else "optimiser"


def training(scene, integrator, frames: int = FRAMES) -> dict[str, float]:
    """Milliseconds of the parts of a training frame, and microseconds a record: of the step alone and with tracing."""
    import drjit as dr

    n_paths = integrator.cache.training.n_paths
    n_records = n_paths * (integrator.cache.training.n_vertices - 1)
    integrator.train(scene, WARM_FRAMES)
    rows, counted = [], []
    for _ in range(frames):
        before = integrator.statistics()["records"]
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            start = budget.clock()
            integrator.train(scene, 1)
            wall = budget.clock() - start
        row = dict.fromkeys(("records", "network", "products", "optimiser"), 0.0)
        for entry in dr.kernel_history():
            row[stage(entry, n_paths, n_records)] += entry["execution_time"]
        rows.append({**row, "python": max(0.0, 1e3 * wall - sum(row.values())), "total": 1e3 * wall})
        counted.append(integrator.statistics()["records"] - before)
    found = {name: median(row[name] for row in rows) for name in rows[0]}
    step = found["network"] + found["products"] + found["optimiser"]
    valid = max(median(counted), 1)
    return {**found, "n_records": n_records, "n_valid": valid, "us_per_record_step": 1e3 * step / n_records,
            "us_per_record": 1e3 * found["total"] / n_records}  # fmt: skip


def first_image(scene: str, integrator: str, options: list[str]) -> dict[str, dict[str, float]]:
    """Seconds until ``mi-neural render`` has a first image on disk, and until it ends: ``cold`` and ``warm``."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / "row.json"
        command = [sys.executable, "-m", "mi_neural.cli", "render", scene, "-i", integrator, "--spp", "1", *options,
                   "-o", str(Path(folder) / "image.exr"), "--json", str(written)]  # fmt: skip
        kernels = {**os.environ, "DRJIT_CACHE_DIR": str(Path(folder) / "kernels")}
        for name in ("cold", "warm"):
            start = budget.clock()
            subprocess.run(command, check=True, env=kernels, capture_output=True)
            row = json.loads(written.read_text())
            found[name] = {"first": row["seconds_to_first_image"], "done": budget.clock() - start,
                           "compile": row["seconds_compile"], "train": row["seconds_train"]}  # fmt: skip
    return found


def profile(scene, integrator, spp: int, frames: int) -> dict[str, object]:
    """All but the first image, of an integrator that is trained for `frames` frames before."""
    budget.warm_up(scene, integrator, [spp])
    budget.train(scene, integrator, frames)
    counts = memory.start()
    found: dict[str, object] = {"frame": split.measure(scene, integrator, spp).to_json()}
    found["memory"] = memory.peak_mib() if counts else None
    if (weights := trained_network(integrator)) is not None:
        found["query"] = integrator.measure_query()
        found["network"] = network(weights)
        found["training"] = training(scene, integrator)
    return found


def shown(found: dict) -> dict[str, float]:
    """The numbers of the manual's table in its units: ms, percent of the frame or of the product, MiB."""
    total = found["frame"]["total"]
    numbers = {"frame": 1e3 * total, "python": 1e3 * found["frame"]["python"], "memory": found["memory"]}
    numbers |= {f"{name}_percent": 100 * seconds / total for name, seconds in found["frame"].items()
                if name not in ("spp", "total") and seconds is not None}  # fmt: skip
    if (network := found.get("network")) is not None:
        for name in ("same_shape", "square"):
            numbers[f"blas_{name}_percent"] = 100 * network["gflops"] / network[f"blas_{name}_gflops"]
    return numbers


def table(found: dict) -> list[tuple[str, str]]:
    """Rows (what, how much) of a printed table."""
    total = found["frame"]["total"]
    rows = [("frame", f"{1e3 * total:.1f} ms")]
    for name, seconds in found["frame"].items():
        if name not in ("spp", "total") and seconds is not None:
            rows.append((f"  {name}", f"{1e3 * seconds:.2f} ms, {100 * seconds / total:.1f} %"))
    if found.get("memory"):
        rows.append(("peak memory", f"{found['memory']:.0f} MiB"))
    if "network" in found:
        n, t = found["network"], found["training"]
        rows.append(("query", f"{found['query']:.1f} ns"))
        share = f"{100 * n['share_of_peak']:.0f} % of the FMA peak"
        rows.append(("MLP alone", f"{n['ns']:.1f} ns, {n['gflops']:.0f} GFLOP/s, {share}"))
        rows.append(("BLAS, large and same shape",
                     f"{n['blas_square_gflops']:.0f} and {n['blas_same_shape_gflops']:.0f} GFLOP/s"))  # fmt: skip
        rows.append(("training frame", f"{t['total']:.1f} ms, {t['n_valid']:.0f} of {t['n_records']} records valid"))
        rows += [(f"  {k}", f"{t[k]:.2f} ms") for k in ("records", "network", "products", "optimiser", "python")]
        step, whole = t["us_per_record_step"], t["us_per_record"]
        rows.append(("a record", f"{step:.2f} us in the step alone, {whole:.2f} us with tracing"))
    for name, s in found.get("first_image", {}).items():
        rows.append((f"first image, {name}", f"{s['first']:.1f} s; all done after {s['done']:.1f} s"))
    return rows


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/frame_profile.py", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("-i", "--integrator", default="nirc", help="TYPE[:K=V,...]")
    parser.add_argument("--size", help="WxH")
    parser.add_argument("--spp", type=int, default=1, help="samples a pixel of a frame")
    parser.add_argument("--frames", type=int, default=100, help="training frames before")
    parser.add_argument("--no-first-image", action="store_true", help="leave that out: it starts two processes")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scene")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)

    try:
        terminal.set_variant(options.variant)
        loaded = load.load_scene(options.scene, terminal.parse_size(options.size), terminal.parse_define(options.D))
        spec = parse_integrator(options.integrator)
        integrator, _ = build_integrator(spec, loaded.carried)
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    found = profile(loaded.scene, integrator, options.spp, options.frames)
    if not options.no_first_image:
        passed = [*(["--size", options.size] if options.size else []), "--variant", options.variant]
        passed += [part for pair in options.D for part in ("-D", pair)]
        found["first_image"] = first_image(options.scene, options.integrator, passed)
    print(f"{loaded.name} {loaded.size[0]}x{loaded.size[1]}, {spec.label}")
    for name, value in table(found):
        print(f"{name:<28}{value}", flush=True)
    if options.output:
        row = {"scene": loaded.name, "size": list(loaded.size), "width": loaded.size[0], "integrator": spec.label,
               "shown": shown(found), **found}  # fmt: skip
        exr.write_text(options.output, json.dumps({**row, "environment": environment.describe()}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
