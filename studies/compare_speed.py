"""Compare the times of two checkouts, in alternation: ratios of medians.

    python studies/compare_speed.py speed /path/to/old /path/to/new

A checkout is named by what PYTHONPATH must be to import it. One copy of this file serves both. Of each integrator and
scene are measured: a camera sample, a training step, and the first image of a process, with and without kernels that
were compiled before.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]


def new_integrator(name: str):
    import mitsuba as mi

    return mi.load_dict({"type": name, **({} if "path" in name else {"train_frames": 64, "train_steps": 0})})


def load_sized(path: str, size: str):
    """A scene file with a film of this size, "WxH", where the file has parameters for it."""
    import mi_neural  # noqa: F401 (before mitsuba)

    import mitsuba as mi  # isort: skip

    mi.set_variant("llvm_ad_rgb")
    has_size = "$resx" in Path(path).read_text(errors="replace")
    return mi.load_file(path, **(dict(zip(("resx", "resy"), size.split("x"), strict=True)) if has_size else {}))


def seconds(work, n: int = 7, warm_up: int = 3) -> float:
    """Median wall time of ``work(k)``."""
    import drjit as dr

    times = []
    for k in range(n + warm_up):
        dr.sync_thread()
        start = time.perf_counter()
        work(k)
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return float(np.median(times[warm_up:]))


def first_image(path: str, name: str, size: str) -> dict[str, float]:
    """Seconds from the start of a process until it has an image of one sample, its cache trained by 64 steps: with an
    empty kernel cache, and with what this left."""
    found, command = {}, [sys.executable, __file__, "first", path, name, size]
    with tempfile.TemporaryDirectory() as kernels:
        for kind in ("cold", "warm"):
            start, env = time.time(), {**os.environ, "DRJIT_CACHE_DIR": kernels}
            done = subprocess.run(command, check=True, text=True, stdout=subprocess.PIPE, env=env)
            found[f"first image {kind} [s]"] = float(done.stdout.split()[-1]) - start
    return found


def record_speed(options) -> None:
    """Write OUT/speed.json: "INTEGRATOR, TIME" -> scene -> value."""
    found: dict[str, dict] = {}
    for path in options.scenes.split(","):
        scene = load_sized(path, options.size)
        samples = 16 * int(np.prod(np.array(scene.sensors()[0].film().crop_size())))
        for name in options.integrators.split(","):
            integrator = new_integrator(name)
            image = seconds(lambda k, i=integrator, s=scene: np.array(i.render(s, seed=k, spp=16)))
            times = {"camera sample [ns]": 1e9 * image / samples}
            if hasattr(integrator, "train"):
                times["training step [s]"] = seconds(lambda k, i=integrator, s=scene: i.train(s, 8)) / 8
            if not options.no_first_image:
                times |= first_image(path, name, options.size)
            for what, value in times.items():
                found.setdefault(f"{name}, {what}", {})[path] = value
                print(f"{path} {name}, {what}: {value:.4g}", flush=True)
            del integrator
            gc.collect()
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "speed.json").write_text(json.dumps(found, indent=1))


def speed(options) -> None:
    """Run `record` with either import root in alternation and print ratios of medians."""
    roots = [re.search(r"PYTHONPATH=([^\s:]+)", Path(r).read_text())[1] if r.endswith(".env") else r
             for r in (options.a, options.b)]  # fmt: skip
    passed = ["--scenes", options.scenes, "--size", options.size, "--integrators", options.integrators]
    passed += ["--no-first-image"] if options.no_first_image else []
    runs: tuple[list, list] = ([], [])
    with tempfile.TemporaryDirectory() as folder:
        for k in range(options.alternations):
            for side in ((0, 1), (1, 0))[k % 2]:
                command = [sys.executable, __file__, "record", folder, *passed]
                env = {**os.environ, "PYTHONPATH": roots[side]}
                subprocess.run(command, check=True, env=env, stdout=subprocess.DEVNULL)
                runs[side].append(json.loads((Path(folder) / "speed.json").read_text()))
                print(f"alternation {k + 1} of {options.alternations}, {roots[side]}: done", flush=True)
    print(f"{'integrator, time':<42}{'scene':<20}{'A':>12}{'B':>12}{'B / A':>8}")
    for what, scenes in runs[0][0].items():
        ratios = []
        for path in scenes:
            a, b = (float(np.median([r.get(what, {}).get(path, np.nan) for r in side])) for side in runs)
            ratios.append(b / a)
            scene = Path(path).parent.name if Path(path).stem == "scene" else Path(path).stem
            print(f"{what:<42}{scene:<20}{a:12.4g}{b:12.4g}{b / a:8.3f}")
        print(f"{what:<42}{'geometric mean':<44}{np.exp(np.mean(np.log(ratios))):8.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    times = argparse.ArgumentParser(add_help=False)
    times.add_argument("--scenes", default=f"{ROOT}/scenes/cornell_box.xml,{ROOT}/scenes/ajar_door.xml")
    times.add_argument("--size", default="128x128", help="WxH, for scene files with parameters resx and resy")
    times.add_argument("--integrators", default="path,plain_path,nirc,nrc,nirc_two_level")
    times.add_argument("--no-first-image", action="store_true", help="leave out what starts two processes each")
    command = commands.add_parser("speed", parents=[times], help="times of two checkouts, in alternation")
    command.add_argument("a", help="import root of a checkout (PYTHONPATH), or a file NAME.env that exports it")
    command.add_argument("b")
    command.add_argument("--alternations", type=int, default=3)
    command = commands.add_parser("record", parents=[times], help="times of what is imported, into OUT/speed.json")
    command.add_argument("out", type=Path)
    command = commands.add_parser("first", help="what `record` starts: one image in a fresh process")
    for name in ("scene", "integrator", "size"):
        command.add_argument(name)
    options = parser.parse_args()
    if options.command == "first":
        scene = load_sized(options.scene, options.size)
        np.array(new_integrator(options.integrator).render(scene, spp=1))
        print(time.time())
    else:
        (record_speed if options.command == "record" else speed)(options)


if __name__ == "__main__":
    main()
