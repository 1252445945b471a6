"""What the integrators cost on a GPU: ``python studies/gpu_figures.py [SCENE ...] -o out/gpu``; `make gpu` calls it.

A smoke render of each integrator comes first: its mean beside that of ``path``. The table then has, for each scene and
integrator, medians in one process:

first    seconds of the first image, kernels compiled or read from the kernel cache, training included
frame    milliseconds of an image of one sample a pixel, one training step included where a cache trains
sample   nanoseconds of one more sample of a pixel: images of 16 samples against images of one
step     milliseconds of a training step
query    nanoseconds of a query of the cache, 2^20 at once
mean     of the image against that of ``path``, 256 samples a pixel

All of it goes into ``figures.json`` and ``figures.md`` with the card's name, after each integrator anew.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path

import mi_neural  # isort: skip  (first: it chooses the LLVM library)
import drjit as dr
import mitsuba as mi
import numpy as np

from mi_neural.bench import environment, load

#: Integrators of the table: label and keys.
INTEGRATORS = {
    "path": {"type": "path", "max_depth": 64},
    "plain_path": {"type": "plain_path", "max_depth": 64},
    "nirc": {"type": "nirc"},
    "nrc": {"type": "nrc"},
    "nrc c=1": {"type": "nrc", "spread_threshold": 1.0},
    "neural_path": {"type": "neural_path"},
    "nirc_two_level": {"type": "nirc_two_level"},
}
COLUMNS = ("first", "frame", "sample", "step", "query", "mean")
SCENES = ("cornell_box", "ajar_door")


def clock() -> float:
    """Seconds, after all work that was given to Dr.Jit is done."""
    dr.sync_thread()
    return time.perf_counter()


def seconds(work, n: int) -> float:
    """Median wall time of `work(k)`, after three calls."""
    times = []
    for k in range(n + 3):
        start = clock()
        work(k)
        times.append(clock() - start)
    return float(np.median(times[3:]))


def measure(scene, keys: dict, reference: np.ndarray | None) -> tuple[dict, np.ndarray]:
    """(figures of one integrator, its mean image); a figure that makes no sense for it is left out."""
    integrator = mi.load_dict(keys)

    def render(spp):
        return lambda k: dr.eval(mi.render(scene, integrator=integrator, spp=spp, seed=k))

    width, height = (int(n) for n in scene.sensors()[0].film().crop_size())
    start = clock()
    render(16)(0)
    row = {"first": clock() - start}
    one, sixteen = seconds(render(1), 15), seconds(render(16), 8)
    row |= {"frame": 1e3 * one, "sample": 1e9 * (sixteen - one) / (15 * width * height)}
    if hasattr(integrator, "cache"):
        row["step"] = 1e3 * seconds(lambda _: integrator.train(scene, 1), 20)
        row["query"] = integrator.measure_query(2**20)
    images = [mi.render(scene, integrator=integrator, spp=64, seed=7 + k) for k in range(4)]
    image = np.mean([np.array(i)[..., :3] for i in images], axis=0)
    if reference is not None:
        row["mean"] = 100 * float(image.mean() / reference.mean() - 1)
    return row, image


def card(variant: str) -> str:
    """What the figures were measured on."""
    if not variant.startswith("cuda"):
        return "the CPU, not a GPU"
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    name, driver = subprocess.run(query, capture_output=True, text=True, check=True).stdout.splitlines()[0].split(", ")
    return f"one {name}, driver {driver}"


def table(rows: list[dict], machine: str) -> str:
    """The figures as Markdown."""
    lines = [f"Measured on {machine}, {time.strftime('%Y-%m-%d')}, Mitsuba {mi.__version__}.", "",
             "| scene | integrator | first image s | frame ms | ns a sample | training step ms | ns a query | mean % |",
             "|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for row in rows:
        values = [f"{row[c]:.3g}" if c in row else "" for c in COLUMNS]
        cells = [row["scene"], row["integrator"], row.get("error") or values[0], *values[1:]]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=SCENES, help="XML files, or names that mi-neural scenes lists")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/gpu"))
    parser.add_argument("--size", default="640x360", help="WIDTHxHEIGHT of the films")
    parser.add_argument("--variant", default="cuda_ad_rgb")
    args = parser.parse_args()
    if problem := mi_neural.variant_problem(args.variant):
        parser.error(problem)
    if args.variant.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        parser.error("there is no CUDA device here; to try the script on a CPU type: --variant llvm_ad_rgb")
    mi.set_variant(args.variant)
    try:
        files = [load.find_scene(name) for name in args.scenes]
    except load.InputError as error:
        parser.error(str(error))

    args.output.mkdir(parents=True, exist_ok=True)
    machine, rows = card(args.variant), []
    made_with = {**environment.describe(), "machine": machine}
    width, height = (int(n) for n in args.size.split("x"))
    for file in files:
        scene, reference = mi.load_file(str(file), resx=width, resy=height, parallel=False), None
        label = file.parent.name if file.stem == "scene" else file.stem
        for integrator, keys in INTEGRATORS.items():
            row = {"scene": f"{label} {args.size}", "integrator": integrator}
            try:
                figures, image = measure(scene, keys, reference)
                reference = image if reference is None else reference
                row |= figures
            except RuntimeError as e:
                while e.__cause__ is not None:
                    e = e.__cause__
                row["error"] = str(e).splitlines()[0][:200]
            rows.append(row)
            print(row, flush=True)
            found = {"machine": machine, "rows": rows, "environment": made_with}
            (args.output / "figures.json").write_text(json.dumps(found, indent=1))
            (args.output / "figures.md").write_text(table(rows, machine))
    print(table(rows, machine))


if __name__ == "__main__":
    main()
