"""Where the variance of path tracing comes from: ``python studies/variance_budget.py SCENE``.

Pairs of paths share all random numbers up to vertex k, and have their own from there on. Half of the mean squared
difference of such a pair is the variance that is made at vertex k and behind it: what an exact cache of outgoing
radiance, asked at vertex k, would take away. It is divided into next-event estimation at k, emitters that the BSDF
sample of k meets, and what lies behind: light of later vertices. Shares are of the relative variance of one camera
sample, averaged over the pixels but the 0.1 % with the largest total. Where rare bright paths make the variance, it
takes hundreds of pairs.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from mi_neural.bench import budget, environment, load, terminal
from mi_neural.image import exr
from mi_neural.image.metrics import TRIM_FRACTION

#: As in relMSE, and of luminance.
EPSILON, LUMINANCE = 1e-2, np.array([0.2126, 0.7152, 0.0722])
#: Parts of what is made from vertex k on.
PARTS = ("all", "nee", "hit", "behind")


def pairs_of(max_depth: int, rr_depth: int):
    """A recorded function that traces a pair of paths a pixel: ``f(scene, sensor, seed, k)`` gives, for each of both,
    (radiance, next-event estimation at k, emission met by its BSDF sample, light of later vertices, segments)."""
    import drjit as dr
    import mitsuba as mi

    from mi_neural.render import path as paths
    from mi_neural.render.film import Area, camera_rays
    from mi_neural.render.sampling import PathSampler
    from mi_neural.render.walk import Unlimited

    def trace(scene, sensor, seed, k):
        area = Area.of(sensor)
        pixel = dr.arange(mi.UInt32, area.n_pixels)
        out = []
        for own in (1, 2):
            sampler = PathSampler.make(pixel, seed)
            ray, _, _, sampler = camera_rays(sensor, area, pixel, sampler)
            path = paths.camera_vertex(Unlimited(max_depth), scene, mi.Ray3f(ray), mi.Bool(True))
            other = PathSampler.make(pixel, seed ^ mi.UInt32(0x9E3779B9 * own & 0xFFFFFFFF)).pcg

            def step(path, sampler, other, nee, hit, behind):
                here = path.depth == k
                for name in ("state", "inc"):
                    setattr(sampler.pcg, name, dr.select(here, getattr(other, name), getattr(sampler.pcg, name)))
                found, sampler = paths.bounce(scene, None, path, sampler)
                L_nee, Le = path.β * found.L_nee, path.β * found.weight * found.Le
                nee, hit = dr.select(here, L_nee, nee), dr.select(here, Le, hit)
                behind += dr.select(path.depth > k, L_nee + Le, 0)
                path, sampler = paths.roulette(paths.advance(path, found, max_depth), sampler, rr_depth)
                return path, sampler, other, nee, hit, behind

            none = (mi.Color3f(0) for _ in range(3))
            path, *_, nee, hit, behind = dr.while_loop(
                (path, sampler, other, *none), lambda path, *_: path.active, step, label="pairs of paths"
            )
            out.append((path.L, nee, hit, behind, mi.Float(path.depth)))
        dr.eval(out)
        return out

    return dr.freeze(trace)


def measure(scene, vertices: int, pairs: int, max_depth: int = 64, rr_depth: int = 5) -> dict:
    """The budget of `scene`: the variance of a camera sample, and a row of shares for each vertex."""
    import drjit as dr
    import mitsuba as mi

    sensor, trace = scene.sensors()[0], pairs_of(max_depth, rr_depth)
    sums, rows, total, squares = [], [], 0.0, 0.0
    with dr.suspend_grad():
        for k in range(1, vertices + 1):
            found = dict.fromkeys((*PARTS, "light_nee", "light_hit", "light_behind", "segments"), 0.0)
            for n in range(pairs):
                seed = budget.pass_seed(k, budget.STREAM_IMAGE, n)
                a, b = trace(scene, sensor, dr.opaque(mi.UInt32, seed), dr.opaque(mi.UInt32, k))
                a, b = ([np.array(v, np.float64) for v in one] for one in (a, b))
                for name, x, y in zip(PARTS, a, b, strict=False):
                    found[name] = found[name] + 0.5 * (x - y) ** 2 / pairs
                for name, x, y in zip(("nee", "hit", "behind"), a[1:], b[1:], strict=False):
                    found[f"light_{name}"] += float((x + y).mean()) / (2 * pairs)
                found["segments"] += float((a[4] + b[4]).mean()) / (2 * pairs)
                total, squares = total + a[0] + b[0], squares + a[0] ** 2 + b[0] ** 2
            sums.append(found)
    count = 2 * pairs * vertices
    mean = total / count
    level = LUMINANCE @ mean
    scale = 1 / (level**2 + EPSILON * max(level.mean(), 1e-30) ** 2)
    variance = ((squares / count - mean**2) * scale).mean(axis=0)
    kept = np.argsort(variance)[: max(1, int(variance.size * (1 - TRIM_FRACTION)))]
    whole = max(float(variance[kept].mean()), 1e-30)
    for k, found in enumerate(sums, 1):
        shares = {name: float((found[name] * scale).mean(axis=0)[kept].mean()) / whole for name in PARTS}
        light = {n: found[n] / max(float(mean.mean()), 1e-30) for n in ("light_nee", "light_hit", "light_behind")}
        rows.append({"vertex": k, **shares, **light, "segments": found["segments"]})
    return {"mean": float(mean.mean()), "variance": whole, "rows": rows}


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/variance_budget.py", description=__doc__)
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("--size", default="128x72")
    parser.add_argument("--vertices", type=int, default=8)
    parser.add_argument("--pairs", type=int, default=64, help="pairs of paths a pixel, for each vertex")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)

    import mitsuba as mi

    mi.set_variant(options.variant)
    try:
        loaded = load.load_scene(options.scene, size=terminal.parse_size(options.size))
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    found = measure(loaded.scene, options.vertices, options.pairs)
    print(f"{loaded.name}: mean {found['mean']:.4g}, relative variance of a sample {found['variance']:.3g}")
    for r in found["rows"]:
        print(f"vertex {r['vertex']} and behind {r['all']:.3f}: next-event {r['nee']:.3f}, emitters met "
              f"{r['hit']:.3f}, behind {r['behind']:.3f}")  # fmt: skip
    if options.output:
        exr.write_text(options.output, json.dumps(
            {"scene": loaded.name, "size": options.size, "pairs": options.pairs, **found,
             "environment": environment.describe()}, indent=1))  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())
