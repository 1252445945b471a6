"""Light samplers at equal time on scenes of many lamps: ``python studies/light_choice.py -o DIR``.

``plain_path`` with each of them, and ``path``, on `lamp_bays` (32 lamps) and on the hall that ``studies/many_lamps.py``
writes, with direct light alone (depth 2) and with all light. The methods take turns, one repeat after another, so that
a change in the machine's load affects all of them. The references are rendered with ``tree_lights``. DIR/results.json
has means and intervals (95 %, over the repeats), as `mi-neural compare` writes them, and the trimmed relMSE over that
of ``tree_lights`` in the same repeat (geometric mean, least, most), which a changing load moves less. The same command
goes on from where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from mi_neural import scenes
from mi_neural.bench import benchmark, budget, environment, load, repeats, suite, terminal
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.image import exr

SAMPLERS = ("uniform_lights", "power_lights", "tree_lights", "nvc_lights")
INTEGRATORS = ("path", *(f"plain_path:light_sampler.type={name}" for name in SAMPLERS))
#: What the others are compared with; renders the references, too.
CONTROL = "plain_path:light_sampler.type=tree_lights"
#: Passes of a reference, whose variance is taken over them.
PASSES = 16
DEPTHS = {"direct": 2, "all": 64}
DEPTH = re.compile(r'(<default name="max_depth" value=")\d+(")')


def write_scenes(folder: Path, lamps: int) -> list[Path]:
    """The scene files that are compared: each scene at each depth."""
    folder.mkdir(parents=True, exist_ok=True)
    hall = folder / f"hall_{lamps}.xml"
    subprocess.run([sys.executable, str(Path(__file__).with_name("many_lamps.py")), str(lamps), str(hall)], check=True)
    files = []
    for source in (scenes.path("lamp_bays"), hall):
        text = source.read_text(encoding="utf-8")
        for name, depth in DEPTHS.items():
            file = folder / f"{source.stem}_{name}.xml"
            file.write_text(DEPTH.sub(rf"\g<1>{depth}\2", text), encoding="utf-8")
            files.append(file)
    hall.unlink()
    return files


def write_reference(file: Path, size: tuple[int, int], spp: int) -> None:
    """Render the reference of a scene file beside it, where it is not there yet."""
    out = file.with_name(f"{file.stem}_reference_{size[0]}x{size[1]}.exr")
    if out.is_file():
        return
    loaded = load.load_scene(str(file), size)
    integrator, _ = build_integrator(parse_integrator(CONTROL), loaded.carried)
    images = []
    for k in range(PASSES):
        seed = budget.pass_seed(0, budget.STREAM_REFERENCE, k)
        image = budget.render_pass(loaded.scene, integrator, max(1, spp // PASSES), seed)
        images.append(image[..., :3].astype(np.float64))
        print(f"reference of {file.stem}: {k + 1} of {PASSES}", flush=True)
    metadata = {"integrator": CONTROL, "max_depth": str(loaded.carried["max_depth"]), "spp": str(spp)}
    exr.write(out, np.mean(images, axis=0), exr.layer_channels("variance", np.var(images, axis=0, ddof=1) / PASSES),
              metadata)  # fmt: skip


def measure(files: list[Path], output: Path, options, bars) -> list[repeats.Group]:
    """Compare all methods on all scenes, then all again, and take the repeats together."""
    rows, done = [], []
    for repeat in range(options.repeats):
        plan = benchmark.Plan(
            seconds=terminal.parse_seconds("--seconds", options.seconds), steady_frames=options.steady,
            frame_seconds=terminal.parse_seconds("--frame-seconds", options.frame_seconds) if options.steady else [],
            seed=options.seed + repeat, repeats=1,
        )  # fmt: skip
        settings = suite.Settings(
            specs=[parse_integrator(text) for text in options.integrator or INTEGRATORS], plan=plan,
            sizes=[terminal.parse_size(options.size)],
        )  # fmt: skip
        comparison = suite.Suite(files, settings, output / f"repeat_{repeat}", bars)
        comparison.run()
        if comparison.interrupted or comparison.notes:
            raise load.InputError("; ".join(comparison.notes) or "interrupted: the same command goes on from here")
        rows += [row for found in comparison.results for row in found.rows]
        done.append(comparison)
    groups = repeats.group(rows)
    found = {"environment": environment.describe(), "groups": entries(groups)}
    exr.write_text(output / "results.json", json.dumps(found, indent=1) + "\n")
    for comparison in done:
        comparison.finish()
    return groups


def entries(groups: list[repeats.Group]) -> list[dict]:
    """The groups for `results.json`, each with its errors over those of `CONTROL`."""

    def errors(group: repeats.Group, label: str) -> list[float]:
        key = (group.first.scene, label, *group.key[1:])
        return next((g.values("relmse_trimmed") for g in groups if (g.first.scene, *g.key) == key), [])

    found = []
    for group in groups:
        own, known = errors(group, group.first.label), errors(group, CONTROL)
        entry = group.to_json()
        if own and len(own) == len(known):
            over = np.array(own) / np.array(known)
            entry |= {"over_tree": float(np.exp(np.log(over).mean())), "over_tree_least": float(over.min()),
                      "over_tree_most": float(over.max())}  # fmt: skip
        found.append(entry)
    return found


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/light_choice.py", description=__doc__)
    parser.add_argument("-i", "--integrator", action="append", help="TYPE[:K=V,...]; default: all of them")
    parser.add_argument("--lamps", type=int, default=1000, help="of the hall")
    parser.add_argument("--size", default="320x180")
    parser.add_argument("--seconds", default="4", help="budgets of one shot, training included")
    parser.add_argument("--steady", type=int, default=128, help="training frames before frames are timed; 0: none are")
    parser.add_argument("--frame-seconds", default="0.5", help="budgets of a frame")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reference-spp", type=int, default=2048)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for scenes and results")
    options = parser.parse_args(arguments)
    terminal.set_variant(options.variant)
    try:
        files = write_scenes(options.output / "scenes", options.lamps)
        for file in files:
            write_reference(file, terminal.parse_size(options.size), options.reference_spp)
        with terminal.Bars() as bars:
            groups = measure(files, options.output, options, bars)
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    terminal.print_rows(groups)
    return 0


if __name__ == "__main__":
    sys.exit(main())
