"""Noise times time, and bias, of gradients: ``python studies/gradients.py SCENE -i prb -i nirc -i nrc``.

The gradient is that of the mean of I / (I_0 + ε), I_0 being the image as it is: each pixel counts the same. It is taken
with respect to all colours, textures and other numbers of BSDFs and emitters that move nothing. Independent gradients
are made in turn by each integrator, and timed in seconds of the processors (on a GPU: of the clock), so that a change
in the machine's load affects all of them alike; those with a cache are trained before, and not in between. Of each
parameter (a texture is one) the variance of one gradient and the squared bias are taken relative to the squared norm of
the reference, gradients by ``prb`` of many samples, whose own noise is subtracted. The efficiency is 1 / (variance x
time), the first integrator's being 1: the geometric mean over the parameters of a kind. The error in a second is that
of all parameters together, bias and noise, over their norm.

``--memory`` measures memory in place of that, each integrator in a process of its own: how much more of it is resident
at the peak of a gradient than before, in MiB. The scene is loaded, the cache trained, an image rendered and a gradient
computed before, so that what stays and what compiling takes do not count. ``first`` is the same of the first gradient,
compiling included, ``image`` of an image.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from mi_neural.bench import environment, load, memory, terminal
from mi_neural.bench.specs import build_integrator, parse_integrator
from mi_neural.image import exr
from mi_neural.render.kernels import work_seconds

#: Added to a pixel, over the mean of the image.
EPSILON = 0.1
#: Kinds of parameters, by what their names end in; what is left are other numbers of BSDFs (roughness, for example).
KINDS = ("colours", "textures", "emitters", "others")
#: Parameters whose reference is noisier than this share of its norm say nothing.
NOISE_MAX = 0.1


@dataclass
class Row:
    """Of one integrator: seconds a gradient; per parameter the relative variance of a gradient and its relative squared
    bias; both of all parameters together."""

    integrator: str
    seconds: float
    variance: dict[str, float]
    bias2: dict[str, float]
    variance_total: float
    bias2_total: float

    def error(self, seconds: float) -> float:
        """Relative error of the gradients after so many seconds, training not counted."""
        return float((max(self.bias2_total, 0) + self.variance_total * self.seconds / seconds) ** 0.5)


def kind_of(key: str) -> str:
    """The kind of a parameter, by its name."""
    if any(word in key.lower() for word in ("radiance", "irradiance", "intensity", "emitter", "envmap")):
        return "emitters"
    if key.endswith(".data"):
        return "textures"
    return "colours" if "reflectance" in key or "color" in key else "others"


def enable(scene) -> tuple:
    """(parameters of `scene`, keys of those of BSDFs, textures and emitters; their gradients are enabled)."""
    import drjit as dr
    import mitsuba as mi

    params, keys = mi.traverse(scene), []
    for key, (_, _, owner, flags) in params.properties.items():
        value = params[key]
        fixed = isinstance(owner, mi.Shape | mi.Sensor | mi.Film) or int(flags) & int(mi.ParamFlags.NonDifferentiable)
        if fixed or not dr.is_array_v(value) or not dr.is_diff_v(value) or dr.is_matrix_v(value):
            continue
        if dr.type_v(value) in (dr.VarType.Float32, dr.VarType.Float64) and not key.endswith("to_uv"):
            dr.enable_grad(params[key])
            keys.append(key)
    params.update()
    return params, keys


def gradients(scene, params, keys, integrator, loss, spp: int, seed: int) -> tuple[list, float]:
    """(one gradient, an array for each of `keys`; seconds)."""
    import drjit as dr

    for key in keys:
        dr.set_grad(params[key], 0)
    dr.eval([dr.grad(params[key]) for key in keys])
    start = work_seconds()
    integrator.render_backward(scene, params, loss, scene.sensors()[0], seed, spp)
    found = [dr.grad(params[key]) for key in keys]
    dr.eval(found)
    seconds = work_seconds() - start
    return [np.array(v, np.float64).ravel() for v in found], seconds


def loss_gradient(scene, spp: int, carried: dict):
    """Derivative of the loss with respect to the image."""
    import drjit as dr
    import mitsuba as mi

    path, _ = build_integrator(parse_integrator("path"), carried)
    with dr.suspend_grad():
        image = np.array(mi.render(scene, integrator=path, spp=spp, seed=12345), np.float64)[..., :3]
    weight = 1 / (image + EPSILON * max(image.mean(), 1e-30)) / image.size
    n_channels = np.array(scene.sensors()[0].film().bitmap()).shape[-1]
    return mi.TensorXf(np.pad(weight, ((0, 0), (0, 0), (0, n_channels - 3))).astype(np.float32))


def moments(runs: list) -> tuple[list, list]:
    """(mean, variance of one run), each a list of arrays, from runs that are lists of arrays."""
    parts = [np.stack([run[k] for run in runs]) for k in range(len(runs[0]))]
    return [p.mean(0) for p in parts], [p.var(0, ddof=1) for p in parts]


def measure(scene, integrators: dict, carried: dict, spp: int, rounds: int, frames: int, reference: int) -> tuple:
    """(rows, keys that were measured, keys left out): gradients of `spp` samples a pixel against `rounds` by ``prb`` of
    `reference` samples each."""
    import drjit as dr

    params, keys = enable(scene)
    loss = loss_gradient(scene, 256, carried)
    prb, _ = build_integrator(parse_integrator("prb"), carried)
    true, noise = moments([gradients(scene, params, keys, prb, loss, reference, 10_000 + k)[0] for k in range(rounds)])
    noise = [v / rounds for v in noise]
    norm2 = {k: float(np.sum(t**2)) for k, t in zip(keys, true, strict=True)}
    clear = [float(n.sum()) < NOISE_MAX**2 * norm2[k] for k, n in zip(keys, noise, strict=True)]
    used = [k for k, c in zip(keys, clear, strict=True) if c]
    total = sum(norm2[k] for k in used)

    for integrator in integrators.values():
        if hasattr(integrator, "train"):
            with dr.suspend_grad():
                integrator.train(scene, frames)
                integrator.bind(scene, scene.sensors()[0], train=False)
        for k in range(2):
            gradients(scene, params, keys, integrator, loss, spp, k)
    runs: dict[str, list] = {label: [] for label in integrators}
    seconds: dict[str, list] = {label: [] for label in integrators}
    for k in range(rounds):
        for label, integrator in integrators.items():
            found, time = gradients(scene, params, keys, integrator, loss, spp, 100 + k)
            runs[label].append(found)
            seconds[label].append(time)
    rows = []
    for label in integrators:
        mean, variance = moments(runs[label])
        spread = {k: float(v.sum()) for k, v in zip(keys, variance, strict=True)}
        off = {k: float(np.sum((m - t) ** 2) - v.sum() / rounds - n.sum())
               for k, m, t, v, n in zip(keys, mean, true, variance, noise, strict=True)}  # fmt: skip
        rows.append(Row(label, float(np.median(seconds[label])), {k: spread[k] / norm2[k] for k in used},
                        {k: off[k] / norm2[k] for k in used}, sum(spread[k] for k in used) / total,
                        sum(off[k] for k in used) / total))  # fmt: skip
    return rows, used, [k for k in keys if k not in used]


def summary(rows: list[Row]) -> list[dict]:
    """A line for each integrator: efficiency by kind of parameter against the first, bias, error in a second."""
    lines = []
    for row in rows:
        line = {"integrator": row.integrator, "seconds": row.seconds, "noise": row.variance_total**0.5,
                "bias": max(row.bias2_total, 0) ** 0.5,
                "bias_median": max(float(np.median(list(row.bias2.values()))), 0) ** 0.5,
                "error_1s": row.error(1)}  # fmt: skip
        logs = {kind: [] for kind in KINDS}
        for k, v in row.variance.items():
            cost = rows[0].variance[k] * rows[0].seconds, v * row.seconds
            if min(cost) > 0:
                logs[kind_of(k)].append(np.log(cost[0] / cost[1]))
        every = [v for values in logs.values() for v in values]
        line["efficiency"] = {kind: float(np.exp(np.mean(v))) for kind, v in (*logs.items(), ("all", every)) if v}
        lines.append(line)
    return lines


def peak_over(work) -> float:
    """MiB that are resident at the peak of a call over those before it."""
    import drjit as dr

    memory.start()
    ctypes.CDLL(None).malloc_trim(0)  # what glibc keeps of freed memory would hide as much of the peak
    if not memory.start():
        raise load.InputError("this system does not count the peak of memory")
    before = memory.peak_mib()
    work()
    dr.sync_thread()
    return memory.peak_mib() - before


def peaks(scene, integrator, spp: int, frames: int) -> dict:
    """Of this process: MiB that an image, the first gradient and the third one take at their peak."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np

    def image():
        with dr.suspend_grad():
            dr.eval(mi.render(scene, integrator=integrator, spp=spp, seed=1))

    if hasattr(integrator, "train"):
        with dr.suspend_grad():
            integrator.train(scene, frames)
    image()
    found = {"image": peak_over(image)}
    params, keys = enable(scene)
    shape = np.array(scene.sensors()[0].film().bitmap()).shape
    loss = mi.TensorXf(np.full(shape, 1 / np.prod(shape), np.float32))
    seeds = iter(range(3))

    def gradient():
        gradients(scene, params, keys, integrator, loss, spp, next(seeds))

    found["first"] = peak_over(gradient)
    gradient()
    return {**found, "gradient": peak_over(gradient)}


def each_alone(options) -> list[dict]:
    """What :func:`peaks` says of each integrator, in a process of its own."""
    lines = []
    given = [options.scene, "--memory", "--size", options.size, "--variant", options.variant]
    for name in ("spp", "frames", "max_depth"):
        given += ["--" + name.replace("_", "-"), str(getattr(options, name))]
    given += [word for text in options.D for word in ("-D", text)]
    for label in options.integrator:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "one.json"
            subprocess.run([sys.executable, *_flags(), __file__, *given, "-i", label, "-o", str(file)], check=True)
            lines += json.loads(file.read_text(encoding="utf-8"))["lines"]
    return lines


def _flags() -> list[str]:
    """The option of this interpreter that keeps the script's folder from being searched, where it was given."""
    return ["-P"] if sys.flags.safe_path else []


def main(arguments: list[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python studies/gradients.py", description=__doc__)
    parser.add_argument("scene", help="scene file or shipped scene")
    parser.add_argument("-i", "--integrator", action="append", required=True, help="TYPE[:K=V,...], repeatable")
    parser.add_argument("--size", default="96x54")
    parser.add_argument("--spp", type=int, default=8, help="samples a pixel of a gradient")
    parser.add_argument("--rounds", type=int, default=24, help="gradients by each integrator")
    parser.add_argument("--frames", type=int, default=300, help="training frames")
    parser.add_argument("--reference", type=int, default=256, help="samples a pixel of each gradient of the reference")
    parser.add_argument("--max-depth", type=int, default=-1, help="longest path; caches know no limit (default: -1)")
    parser.add_argument("-D", action="append", default=[], metavar="NAME=VALUE", help="parameters of the scene")
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--memory", action="store_true", help="measure memory in place of noise and time")
    parser.add_argument("-o", "--output", type=Path, help="JSON file")
    options = parser.parse_args(arguments)

    if options.memory and len(options.integrator) > 1:
        try:
            lines = each_alone(options)
        except subprocess.CalledProcessError as error:
            return error.returncode
        if options.output:
            _write(options, lines, scene=options.scene)
        return 0

    import mitsuba as mi

    mi.set_variant(options.variant)
    try:
        loaded = load.load_scene(options.scene, size=terminal.parse_size(options.size),
                                 parameters=terminal.parse_define(options.D))  # fmt: skip
        carried = {**loaded.carried, "max_depth": options.max_depth}
        specs = [parse_integrator(text) for text in options.integrator]
        integrators = {s.label: build_integrator(s, carried)[0] for s in specs}
        if options.memory:
            (label, integrator), *_ = integrators.items()
            line = {"integrator": label, **peaks(loaded.scene, integrator, options.spp, options.frames)}
    except load.InputError as error:
        print(error, file=sys.stderr)
        return 2
    if options.memory:
        print("{integrator}: gradient {gradient:.0f} MiB, first {first:.0f}, image {image:.0f}".format(**line),
              flush=True)  # fmt: skip
        if options.output:
            _write(options, [line], scene=loaded.name)
        return 0
    rows, used, left_out = measure(
        loaded.scene, integrators, carried, options.spp, options.rounds, options.frames, options.reference
    )
    lines = summary(rows)
    print(f"{loaded.name}: {len(used)} parameters; no clear reference for: {', '.join(left_out) or 'none'}")
    for line in lines:
        efficiency = ", ".join(f"{kind} {value:.2f}" for kind, value in line["efficiency"].items())
        print(f"{line['integrator']}: {line['seconds']:.3f} s, noise {line['noise']:.3f}, bias {line['bias']:.3f} "
              f"(median {line['bias_median']:.3f}), error in 1 s {line['error_1s']:.3f}; efficiency {efficiency}",
              flush=True)  # fmt: skip
    if options.output:
        _write(options, lines, scene=loaded.name, rounds=options.rounds, rows=[asdict(r) for r in rows],
               left_out=left_out)  # fmt: skip
    return 0


def _write(options, lines: list[dict], **more) -> None:
    """The JSON file."""
    keys = {name: getattr(options, name) for name in ("size", "spp", "frames", "max_depth")}
    exr.write_text(options.output, json.dumps(
        {**more, **keys, "lines": lines, "environment": environment.describe()}, indent=1, default=str))  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
