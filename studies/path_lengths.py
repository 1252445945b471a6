"""How many rays the caches save at equal bias: ``python studies/path_lengths.py SCENE -o DIR``.

Both caches are trained once; then images are made for a row of spread thresholds, from stopping as early as possible to
hardly ever, and the squared bias of each is drawn over its mean path length, as on the project page of the incident
cache (Dereviannykh et al. 2025). The length is the number of rays that carry reflected light to the first surface that
is neither mirror nor glass (channel ``depth``, less what ``nrc`` has with c = 0). Rays that find direct light alone
(shadow rays, the BSDF ray that shares the work with them) do not count: both integrators trace them at each vertex that
does not query the outgoing cache. The reference is the image beside the scene, or another with ``--reference``.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mi_neural.bench import environment, load, terminal
from mi_neural.bench import reference as references
from mi_neural.bench.reference import Reference
from mi_neural.bench.specs import IntegratorSpec, build_integrator
from mi_neural.image import exr
from mi_neural.image.metrics import bias_and_variance

#: Constants c of the spread test a > c a_0.
THRESHOLDS = (0.0, 1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0)
#: What is compared: far light of ``nirc`` comes from the cache whatever the sample count, see `bias_of`.
INTEGRATORS = ("nrc", "nirc")


@dataclass
class Point:
    """One image: its squared bias (relMSE without noise, trimmed) and its rays of reflected light a sample."""

    integrator: str
    threshold: float
    rays: float
    bias: float


def bias_of(scene, integrator, reference: Reference, samples: int) -> tuple[float, float]:
    """(squared bias, mean depth) of a trained integrator that is not trained on. Each image is planned as one of a
    single sample, so that what depends on the sample count (`adaptive`) stays at its most biased setting."""
    import mitsuba as mi

    integrator.plan_samples(1)
    images = [np.array(mi.render(scene, integrator=integrator, spp=samples, seed=k + 1)) for k in range(2)]
    integrator.plan_samples(None)
    names = integrator.aov_names()
    rgb = [np.asarray(i[..., :3], np.float64) for i in images]
    depth = np.mean([i[..., i.shape[-1] - len(names) + names.index("depth")] for i in images], axis=0)
    return bias_and_variance(rgb, reference.rgb, reference.variance)[0], float(depth.mean())


def curve(scene, name: str, keys: dict, thresholds, reference: Reference, samples: int, frames: int) -> list[Point]:
    """The points of one integrator, its cache trained once by `frames` frames; `rays` is the depth as yet."""
    keys = {"channels": "depth", **keys}
    trained, _ = build_integrator(IntegratorSpec(name), keys)
    trained.train(scene, frames)
    points = []
    with tempfile.TemporaryDirectory() as folder:
        trained.save_cache(Path(folder) / "cache")
        for threshold in thresholds:
            integrator, _ = build_integrator(
                IntegratorSpec(name), {**keys, "freeze_cache": True, "spread_threshold": threshold}
            )
            integrator.load_cache(Path(folder) / "cache", scene)
            bias, depth = bias_of(scene, integrator, reference, samples)
            points.append(Point(name, threshold, depth, bias))
            print(f"{name:5s} c = {threshold:<8g} depth {depth:7.3f}, squared bias {bias:.5f}", flush=True)
    return points


def factors(points: list[Point]) -> list[dict]:
    """For each point of ``nirc``: the rays that ``nrc`` needs for the same squared bias, and the ratio.

    `rays_nrc`: along the lower envelope of its points, log of the bias linear in the rays; `rays_nrc_measured`: of that
    point with fewest rays whose bias is no larger. None: it does not reach that bias. `factor`: ratio of the first to
    the rays of ``nirc``, `factor_measured` of the second; None where either is missing or ``nirc`` traces none.
    `rays_first`, `bias_first` are the point of ``nrc`` with fewest rays, `rays_second`, `bias_second` the next one.
    """
    nrc = sorted((p for p in points if p.integrator == "nrc"), key=lambda p: p.rays)
    rays = [p.rays for p in nrc]
    bias = np.minimum.accumulate([max(p.bias, 1e-12) for p in nrc])
    out = []
    for p in (p for p in points if p.integrator == "nirc"):
        target, needed, measured = max(p.bias, 1e-12), None, None
        if target >= bias[-1]:
            k = int(np.argmax(bias <= target))
            needed = measured = rays[k]
        if measured is not None and k > 0:
            t = math.log(bias[k - 1] / target) / math.log(bias[k - 1] / bias[k])
            needed = rays[k - 1] + t * (rays[k] - rays[k - 1])
        ratios = [n / p.rays if n is not None and p.rays > 0 else None for n in (needed, measured)]
        row = {"threshold": p.threshold, "bias": p.bias, "rays": p.rays, "rays_nrc": needed,
               "rays_nrc_measured": measured, "factor": ratios[0], "factor_measured": ratios[1]}  # fmt: skip
        for name, q in zip(("first", "second"), nrc, strict=False):
            row |= {f"rays_{name}": q.rays, f"bias_{name}": q.bias}
        out.append(row)
    return out


def plot(points: list[Point], title: str):
    """Squared bias over rays a sample, a line per integrator; a matplotlib figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 3.6), layout="constrained")
    axes = figure.add_subplot()
    for name in INTEGRATORS:
        line = sorted((p.rays, p.bias) for p in points if p.integrator == name and p.bias > 0)
        if line:
            axes.plot(*zip(*line, strict=True), marker="o", markersize=4, label=name)
    axes.set(yscale="log", title=title, xlabel="rays of reflected light a sample", ylabel="relative squared bias")
    axes.set_xscale("symlog", linthresh=0.1)
    axes.grid(True, which="both", alpha=0.25)
    axes.legend()
    return figure


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/path_lengths.py", description=__doc__)
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("--reference", help="EXR, of the size that is rendered; default: the one beside the scene")
    parser.add_argument("--size", help="WxH; default: that of the reference, or of the scene")
    parser.add_argument("--frames", type=int, default=300, help="training frames")
    parser.add_argument("--samples", type=int, default=64, help="samples a pixel of each of two images")
    parser.add_argument("--max-depth", type=int, default=64)
    parser.add_argument("--thresholds", type=lambda s: [float(t) for t in s.split(",")], default=list(THRESHOLDS))
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for results.json and curves.png")
    options = parser.parse_args(arguments)

    import mitsuba as mi

    mi.set_variant(options.variant)
    try:
        loaded, reference = references.with_scene(options.scene, options.reference, terminal.parse_size(options.size))
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    points: list[Point] = []
    keys, thresholds = {"max_depth": options.max_depth}, sorted({0.0, *options.thresholds})
    for name in INTEGRATORS:
        points += curve(loaded.scene, name, keys, thresholds, reference, options.samples, options.frames)
    first = points[0].rays  # of nrc with c = 0: the rays up to the first surface that is neither mirror nor glass
    for p in points:
        p.rays = max(p.rays - first, 0.0)
    found = factors(points)
    options.output.mkdir(parents=True, exist_ok=True)
    results = {
        "scene": loaded.name, "frames": options.frames, "samples": options.samples,
        "points": [asdict(p) for p in points], "factors": found, "environment": environment.describe(),
    }  # fmt: skip
    exr.write_text(options.output / "results.json", json.dumps(results, indent=1))
    plot(points, loaded.name).savefig(options.output / "curves.png", dpi=120)
    for f in found:
        needed = "out of reach"
        if f["rays_nrc"] is not None:
            needed = f"{f['rays_nrc']:.3f} rays ({f['rays_nrc_measured']:.3f} the next point measured)"
        ratio = "" if f["factor"] is None else f", {f['factor']:.1f} times as many"
        print(f"nirc, {f['rays']:.3f} rays, squared bias {f['bias']:.5f}: nrc {needed}{ratio}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
