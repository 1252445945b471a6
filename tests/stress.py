"""The matrix of hard cases: every case of `hard_cases` by every integrator, as a table. `make stress` runs it.

Each integrator runs in a process of its own, so that one that ends is a cell of the table and not the end of it.
What is done stands in DIR/results.jsonl, and the same command goes on from there; table.md is written at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

#: False alarms per cell.
ERROR_RATE = 1e-4
#: Bias that a biased integrator may have, relative to the image's mean.
BIAS = 0.1
#: The loss may rise to so many times what it was in the first steps (it is relative to the scene's radiance).
LOSS_GROWTH = 10.0
#: Means below this, and differences relative to the reference below that, count as equal.
SMALLEST, ROUNDING = 1e-18, 2e-5
#: Seconds after which a cell counts as hung.
TIMEOUT = 600


@dataclass(frozen=True)
class Entrant:
    """An integrator of the matrix: `keys` of its dictionary, the depth (2: direct light) of the `path` that it is
    compared with, whether it is `biased`, and whether it must start anew for each image (images are independent then).
    """

    keys: dict
    depth: int = -1
    biased: bool = False
    resets: bool = False

    def refusal(self, case) -> str | None:
        """What the error of a hard case must contain; None: an image is expected."""
        return None if case.media and self.keys["type"] in RENDER_MEDIA else case.refusal

    def reference(self, case) -> str:
        """The name of what it is compared with."""
        return "volpath" if case.media else "path, direct" if self.depth == 2 else "path"


#: Integrators that render participating media.
RENDER_MEDIA = ("plain_path", "nirc", "nrc", "neural_path", "volpath")
#: Lights that the camera sees are noise of a known kind: left out by all, what they light is measured the better.
PATH = {"hide_emitters": True}


def lit_by(sampler: str) -> dict:
    return {"type": "plain_path", "light_sampler": {"type": sampler}, **PATH}


SMALL = {**PATH, "train_samples": 1024, "train_frames": 64, "train_steps": 0}

#: One line adds an integrator.
ENTRANTS: dict[str, Entrant] = {
    "plain_path": Entrant({"type": "plain_path", **PATH}),
    "uniform_lights": Entrant(lit_by("uniform_lights")),
    "power_lights": Entrant(lit_by("power_lights")),
    "tree_lights": Entrant(lit_by("tree_lights")),
    "nvc_lights": Entrant(lit_by("nvc_lights")),
    "nvc_direct": Entrant({"type": "nvc_direct", "max_depth": 2, **PATH}, depth=2),
    "restir_di": Entrant({"type": "restir_di", **PATH}, depth=2, resets=True),
    "restir_di nvc": Entrant({"type": "restir_di", "candidates": "nvc", **PATH}, depth=2, resets=True),
    "nirc": Entrant({"type": "nirc", **SMALL}, biased=True),
    "nirc blend": Entrant({"type": "nirc", "blend": "reliability", **SMALL, "train_frames": 160}, biased=True),
    "nrc": Entrant({"type": "nrc", **SMALL}, biased=True),
    "nirc_two_level": Entrant({"type": "nirc_two_level", **SMALL}),
}
REFERENCES = {
    "path": Entrant({"type": "path", **PATH}),
    "path, direct": Entrant({"type": "path", "max_depth": 2, **PATH}, depth=2),
    "volpath": Entrant({"type": "volpath", **PATH}),
}


# ---------------------------------------------------------------------------------------------------------------------
# Measuring


def cell(case, entrant: Entrant, n_images: int, known: bool = False, integrator=None) -> dict:
    """Facts of one cell: means of `n_images` images for each sensor, or the error that was raised."""
    import mitsuba as mi

    scene = (case.known or case.build)() if known else case.build()
    try:
        integrator = integrator or mi.load_dict(entrant.keys)
        means, bad = [], 0
        for sensor in range(case.sensors):
            for k in range(n_images):
                if entrant.resets:
                    integrator.reset()
                image = np.array(integrator.render(scene, sensor, seed=1000 * sensor + k + 17 * known, spp=case.spp))
                bad += int((~np.isfinite(image)).any(axis=-1).sum())
                means.append(float(image.mean(dtype=np.float64)))
    except ValueError as error:
        return {"refused": str(error)}
    facts = integrator.statistics() if hasattr(integrator, "statistics") else {}
    means = np.reshape(means, (case.sensors, n_images)).mean(axis=0)
    history = list(getattr(getattr(integrator, "cache", None), "history", []))
    return {
        "means": means.tolist(), "bad_pixels": bad, "nonfinite": int(facts.get("nonfinite", 0)),
        "recoveries": int(facts.get("recoveries", 0)),
        "loss": [float(np.median(history[:16])), float(np.median(history[-16:]))] if history else None,
    }  # fmt: skip


def judge(found: dict, known: dict | None, entrant: Entrant, refusal: str | None) -> tuple[bool, str]:
    """(whether the cell is as it must be, what the table says)."""
    if "crashed" in found:
        return False, f"CRASH ({found['crashed']})"
    if "refused" in found:
        if refusal is None:
            return False, f"REFUSED: {found['refused'][:60]}"
        return refusal in found["refused"], "refused" if refusal in found["refused"] else "REFUSED FOR ANOTHER REASON"
    if refusal is not None:
        return False, "NOT REFUSED"
    if found["bad_pixels"]:
        return False, f"{found['bad_pixels']} BAD PIXELS"
    if found["loss"] and not found["loss"][1] <= LOSS_GROWTH * max(found["loss"][0], 1.0):
        return False, f"LOSS {found['loss'][1]:.2g}"
    a, b = np.array(found["means"]), np.array(known["means"])
    va, vb = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    dof = (va + vb) ** 2 / max(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-300)
    bound = stats.t.isf(ERROR_RATE / 2, max(dof, 1)) * np.sqrt(va + vb) + ROUNDING * abs(b.mean()) + SMALLEST
    error, level = a.mean() - b.mean(), max(abs(b.mean()), SMALLEST)
    if not a.any() and not b.any():
        return True, "black"
    if not entrant.biased:
        sigmas = abs(error) / max(np.sqrt(va + vb), 1e-300)
        ok = abs(error) <= bound
        return ok, f"{sigmas:.1f}σ ±{bound / level:.1%}" if ok else f"OFF BY {error / level:+.2%}, {sigmas:.1f}σ"
    ok = abs(error) <= bound + BIAS * level
    text = f"{error / level:+.1%}" if b.mean() else f"{a.mean():.0e}"
    return ok, text if ok else f"BIAS {text}"


# ---------------------------------------------------------------------------------------------------------------------
# Running


def work(name: str, cases: list[str]) -> None:
    """Measure cells of one entrant, a JSON line each. The process that `make stress` starts for each."""
    import mi_neural  # noqa: F401 (before mitsuba)

    import mitsuba as mi  # isort: skip

    mi.set_variant(os.environ.get("MI_NEURAL_TEST_VARIANT", "llvm_ad_rgb"))
    import hard_cases

    for key in cases:
        case = hard_cases.CASES[key]
        reference = name in REFERENCES
        entrant = (REFERENCES if reference else ENTRANTS)[name]
        n_images = 4 if key == "8192x16" else 8 if entrant.resets else 16
        found = cell(case, entrant, 2 * n_images if reference else n_images, reference)
        print(json.dumps({"integrator": name, "case": key, **found}), flush=True)


def run(name: str, cases: list[str], results: Path) -> None:
    """Measure all cells of one entrant, whatever happens to its process."""
    left = list(cases)
    while left:
        command = [sys.executable, __file__, "--worker", name, "--case", *left]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process, open(results, "a") as file:
            try:
                for line in process.stdout:
                    if line.startswith("{"):
                        file.write(line)
                        file.flush()
                        print(f"{name}: {left.pop(0)}", flush=True)
            except BaseException:
                process.kill()
                raise
        if process.returncode < 0 and left:  # ended by a signal: a crash of this cell, on with the next
            with open(results, "a") as file:
                cell = {"integrator": name, "case": left.pop(0), "crashed": f"signal {-process.returncode}"}
                file.write(json.dumps(cell) + "\n")
        elif process.returncode:
            raise SystemExit(f"{name}, {left[0] if left else 'at its end'}: exit status {process.returncode}")


def table(found: dict, of: dict, cases: list[str], entrants: list[str]) -> tuple[list[str], list[str]]:
    """(lines of the table in Markdown, lines that say what is not as it must be). `of`: the cases by name."""
    lines, wrong = ["| | " + " | ".join(f"`{e}`" for e in entrants) + " |", "|---" * (len(entrants) + 1) + "|"], []
    for case in cases:
        row = []
        for name in entrants:
            entrant = ENTRANTS[name]
            reference = found.get((entrant.reference(of[case]), case))
            if (name, case) not in found:
                row.append("")
                continue
            ok, text = judge(found[name, case], reference, entrant, entrant.refusal(of[case]))
            row.append(text)
            if not ok:
                wrong.append(f"{case}, {name}: {text}")
        lines.append(f"| {case} | " + " | ".join(row) + " |")
    return lines, wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("out/stress"))
    parser.add_argument("--integrator", nargs="*", help=f"some of: {', '.join(ENTRANTS)}")
    parser.add_argument("--case", nargs="*", help="some of the cases")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        work(arguments.worker, arguments.case)
        return

    os.environ["MI_NEURAL_STRESS"] = "1"
    import mi_neural  # noqa: F401 (before mitsuba)

    import mitsuba as mi  # isort: skip

    mi.set_variant(os.environ.get("MI_NEURAL_TEST_VARIANT", "llvm_ad_rgb"))
    import hard_cases

    cases = arguments.case or list(hard_cases.CASES)
    entrants = arguments.integrator or list(ENTRANTS)
    of = {name: hard_cases.CASES[name] for name in cases}
    arguments.output.mkdir(parents=True, exist_ok=True)
    results = arguments.output / "results.jsonl"
    results.touch()

    def done() -> dict:
        rows = (json.loads(line) for line in results.read_text().splitlines())
        return {(r["integrator"], r["case"]): r for r in rows}

    for name in [*REFERENCES, *entrants]:
        known = done()
        wanted = [c for c in cases if (name, c) not in known]
        if name in REFERENCES:
            media, depth = name == "volpath", REFERENCES[name].depth
            wanted = [c for c in wanted if of[c].media == media and (depth != 2 or not media)]
            wanted = [c for c in wanted if REFERENCES[name].refusal(of[c]) is None]
        run(name, wanted, results)
    lines, wrong = table(done(), of, cases, entrants)
    (arguments.output / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    print("\n".join(lines))
    print("\n".join(wrong) or "All cells are as they must be.")
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
