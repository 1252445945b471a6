"""How long a user waits: seconds from the start of `mi-neural render` to its file, with and without compiled kernels.

    python studies/start_to_file.py SCENE -i path -i neural_path [--seconds 2] [--size 640x360] [--repeats 3] -o DIR

Each command runs by itself, in a fresh process. The first of a repeat finds no compiled kernels (`empty`), the second
those of the first (`warm`). Medians over the repeats go into DIR/results.json, the images stay beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from mi_neural.bench import environment, terminal
from mi_neural.image import exr

#: States of the kernel cache, in the order in which they are there.
KERNELS = "empty", "warm"


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...]")
    parser.add_argument("--seconds", default="2", help="the budget that is asked for")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    records = []
    for text in options.integrator:
        waits = {kernels: [] for kernels in KERNELS}
        for repeat in range(options.repeats):
            kept = options.output / "kernels" / f"{len(records)}_{repeat}_{time.time_ns()}"
            for kernels, found in waits.items():
                found.append(wait(text, options, kept))
                print(f"{text}, {kernels}: {found[-1]:.2f} s", flush=True)
        records += [{"label": text, "kernels": kernels, "seconds": float(np.median(found))}
                    for kernels, found in waits.items()]  # fmt: skip
    terminal.set_variant(options.variant)
    report = {"environment": environment.describe(), "scene": options.scene, "records": records}
    exr.write_text(options.output / "results.json", json.dumps(report, indent=1) + "\n")
    return 0


def wait(text: str, options: argparse.Namespace, kernels: Path) -> float:
    """Seconds until the file of one command is there; it keeps its kernels in the folder `kernels`."""
    kernels.mkdir(parents=True, exist_ok=True)
    words = [sys.executable, "-m", "mi_neural", "render", options.scene, "-i", text, "--seconds", options.seconds,
             "--size", options.size, "--variant", options.variant, "-o", str(options.output / "image.exr")]  # fmt: skip
    start = time.perf_counter()
    subprocess.run(words, env={**os.environ, "DRJIT_CACHE_DIR": str(kernels)}, check=True, capture_output=True)
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
