"""Compare what two checkouts render, before and after a large change.

``record`` renders small scenes with every integrator of the ``mi_neural`` that is imported (PYTHONPATH chooses the
checkout) and keeps images, variances and statistics; minutes. ``compare`` tests two such recordings against each other.
One copy of this file serves both checkouts. Their times are compared by ``compare_speed.py``::

    PYTHONPATH=/path/to/old python studies/compare_checkouts.py record OLD
    PYTHONPATH=/path/to/new python studies/compare_checkouts.py record NEW --seed 1
    python studies/compare_checkouts.py compare OLD NEW

Unbiased integrators: the means of independent images are compared by Welch's t-test, for the whole image and for 3x3
blocks of it, in each channel. Biased integrators are trained several times with different seeds. The means of their
images, and the logarithm of relMSE against `path`, may differ by what trainings differ among themselves. This is a
t-test too, but few trainings say little about their own spread: the variance of a value is averaged with the mean over
all parts of the image or, where that is larger, the median over the cases of the scene. Both use Šidák's correction.
Two correct checkouts fail with probability :data:`ERROR_RATE` in all, as far as values are about normal. Statistics are
compared by fixed factors.
"""

from __future__ import annotations

import argparse
import gc
import json
import re
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
#: Probability that the comparison of two correct checkouts fails: one half each for unbiased and biased integrators.
ERROR_RATE = 1e-2
#: Independent images of an unbiased integrator, and their samples a pixel; ReSTIR renders a frame for each sample.
IMAGES, SPP, RESTIR_SPP = 24, 64, 8
#: Trainings of a biased integrator, images that are averaged after each, and their samples a pixel.
TRAININGS, TRAINED_IMAGES, TRAINED_SPP = 4, 4, 32
#: Samples a pixel of the reference images.
REFERENCE_SPP = 4096
#: Blocks along each side of an image.
BLOCKS = 3
#: Relative differences that never count: rounding, of means of trained images, of the logarithm of relMSE.
ROUNDING, FLOOR, FLOOR_ERROR = 1e-5, 1e-3, 0.02
#: Degrees of freedom that the variance of other values is worth, beside a value's own.
PRIOR_DOF = 18
#: Statistics that are kept: the larger value may be FACTOR times the smaller one, plus SLACK. Losses are kept to read.
STATISTICS = {"parameters": (1, 0), "lights": (1, 0), "light_groups": (1, 0), "images": (1, 0), "steps": (1, 0),
              "visibility_steps": (1, 0), "records": (1.2, 0), "queries": (1.5, 0), "scale": (4, 0),
              "nonfinite": (4, 20), "recoveries": (2, 1), "loss": (np.inf, 0), "visibility_loss": (np.inf, 0),
              }  # fmt: skip
#: Keys of all integrators that train; a quick training is enough to compare.
QUICK = {"train_frames": 32, "train_samples": 1024}

#: Integrators as "TYPE KEY=VALUE ...", or "WRAPPER of TYPE ...".
UNBIASED = (
    "plain_path", "plain_path max_depth=4 hide_emitters=true", "plain_path light_sampler=nvc_lights",
    "plain_path light_sampler=power_lights", "plain_path light_sampler=tree_lights", "moment of plain_path",
    "nirc cache_samples=0",
    "nrc spread_threshold=Infinity", "nirc_two_level", "nirc_two_level cache_samples=4 alpha=1.0",
    "nirc_two_level every_vertex=true cache_samples=4", "nirc_two_level ris=true cache_samples=4",
    "nirc_two_level cache_samples=4 channels=cache,residual", "nvc_direct", "restir_di",
    "restir_di light_sampler=nvc_lights",
)  # fmt: skip
BIASED = (
    *(f"nirc termination={t}" for t in ("adaptive", "primary", "spread", "balanced", "auto")),
    "nirc light_sampler=nvc_lights", "nirc blend=reliability", "nirc cache=spatial_hash",
    "nirc channels=cache,residual,depth,share", "aov of nirc", "nrc", "nrc cache_content=indirect",
    "nrc spread_threshold=1.0", "nrc train_suffix=full", "nrc channels=traced,cached,depth", "aov of nrc",
    "nirc_two_level mode=progressive", "nvc_direct mode=neural",
)  # fmt: skip
#: Scenes for nested light samplers, for wrappers and extra channels, and for all other integrators. All other scenes
#: are rendered with the integrators `FEW` only.
LIGHTS, WRAPPED = ("glossy_hall", "lamp_bays", "masks", "sky_glass"), ("cornell_box", "masks_crop")
ALL = ("cornell_box", "glossy_hall", "masks")
FEW = ("plain_path", "nirc_two_level cache_samples=4 alpha=1.0", "nvc_direct", "restir_di", "nirc termination=adaptive",
       "nirc termination=auto", "nrc")  # fmt: skip
#: Shipped scenes with their sizes, then films of `masks`; the last scene is `sky_glass`.
SHIPPED = {"cornell_box": (24, 24), "glossy_hall": (32, 18), "lamp_bays": (32, 18), "lit_cube": (24, 24),
           "point_lit_sphere": (24, 24)}  # fmt: skip
FILMS = {"masks": {}, "masks_crop": {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 20, "crop_height": 18},
         "masks_gaussian": {"rfilter": {"type": "gaussian"}, "sample_border": True}}  # fmt: skip


def renders(scene: str, name: str) -> bool:
    """Whether a scene is rendered by this integrator."""
    if "channels" in name or " of " in name:
        return scene in WRAPPED
    return scene in LIGHTS if "light_sampler" in name else scene in ALL or name in FEW


def integrator_keys(name: str, seed: int) -> dict:
    """The dictionary of an integrator, with this seed in all plugins that have one."""
    *wrapper, plain = name.split(" of ")
    plugin, *pairs = plain.split()
    keys = {"type": plugin, **(QUICK if re.match("nirc|nrc", plugin) else {})}
    for key, text in (pair.split("=") for pair in pairs):
        is_json = re.fullmatch(r"true|false|Infinity|-?[\d.]+", text)
        keys[key] = {"type": text} if key == "light_sampler" else json.loads(text) if is_json else text
    for part in (keys, keys.get("light_sampler", {})):
        part |= {"seed": seed} if re.match("nirc|nrc|nvc", part.get("type", "")) else {}
    return {"type": wrapper[0], **({"aovs": "d:depth"} if wrapper[0] == "aov" else {}), "a": keys} if wrapper else keys


def load_scene(name: str):
    import mitsuba as mi

    if name in SHIPPED:
        width, height = SHIPPED[name]
        return mi.load_file(str(ROOT / "scenes" / f"{name}.xml"), resx=width, resy=height)
    return mi.load_dict(sky_glass() if name == "sky_glass" else masks(FILMS[name]))


def rgb(*values: float) -> dict:
    return {"type": "rgb", "value": [*values] * (3 // len(values))}


def placed(kind: str, at: tuple, axis: tuple, degrees: float, scale: float, **parts) -> dict:
    """A shape that is scaled, turned and moved."""
    import mitsuba as mi

    return {"type": kind, "to_world": mi.ScalarTransform4f().translate(at).rotate(axis, degrees).scale(scale), **parts}


def camera(origin: tuple, film: dict) -> dict:
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}, **film}
    look = mi.ScalarTransform4f().look_at(origin, [0, 0.5, 0], [0, 1, 0])
    return {"type": "perspective", "to_world": look, "fov": 42, "film": film}


def masks(film: dict) -> dict:
    """Surfaces that are half transparent, or not there at all, on an open stage, and a film with an alpha channel."""
    import mitsuba as mi

    x, y, tiles = (1, 0, 0), (0, 1, 0), mi.ScalarTransform4f().scale([4, 4, 1])
    red = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": rgb(0.7, 0.3, 0.2)}}
    half = {"type": "mask", "opacity": 0.4, "nested": red}
    opacity = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "to_uv": tiles}
    plastic = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": rgb(0.2, 0.4, 0.6)}
    return {
        "type": "scene",
        "sensor": camera((0, 1.5, 4), {"pixel_format": "rgba", **film}),
        "floor": placed("rectangle", (0, 0, 0), x, -90, 1.6, bsdf={"type": "diffuse", "reflectance": rgb(0.6)}),
        "back": placed("rectangle", (-0.4, 0.8, -1.2), x, 0, 0.9, bsdf={"type": "diffuse", "reflectance": rgb(0.7)}),
        "sheet": placed("rectangle", (0.7, 0.6, 0.4), y, -20, 0.5, bsdf=half),
        "grid": placed("rectangle", (-0.7, 0.5, 0.3), y, 30, 0.5, bsdf={**half, "opacity": opacity}),
        "air": placed("sphere", (0, 0.5, 0), x, 0, 0.45, bsdf={"type": "null"}),
        "ball": placed("sphere", (0, 0.45, 0), x, 0, 0.25, bsdf=plastic),
        "lamp": placed("rectangle", (0, 2.2, 0), x, 90, 0.5, emitter={"type": "area", "radiance": rgb(8, 7, 5)}),
        "glow": placed("sphere", (1.2, 0.2, -0.6), x, 0, 0.15, emitter={"type": "area", "radiance": rgb(2, 4, 9)}),
        "spark": {"type": "point", "position": [-1.2, 1.4, 1.0], "intensity": rgb(1.5)},
    }


def sky_glass() -> dict:
    """Glass, metal and plastic under an environment map with a bright spot."""
    import mitsuba as mi

    y, x = np.mgrid[0:16, 0:32]
    pixels = np.stack([0.2 + 0.02 * x, 0.3 + 0.02 * y, 1.0 - 0.04 * y], axis=-1).astype(np.float32)
    pixels[4:6, 20:22] = 40.0
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.15}
    plastic = {"type": "plastic", "diffuse_reflectance": rgb(0.2, 0.5, 0.3)}
    up, bulb = (0, 1, 0), {"type": "area", "radiance": rgb(20, 12, 6)}
    return {
        "type": "scene",
        "sensor": camera((0.5, 1.6, 4), {}),
        "floor": placed("rectangle", (0, 0, 0), (1, 0, 0), -90, 2.5, bsdf={"type": "diffuse", "reflectance": rgb(0.5)}),
        "glass": placed("sphere", (-0.6, 0.5, 0.2), up, 0, 0.5, bsdf={"type": "dielectric"}),
        "gold": placed("sphere", (0.6, 0.4, -0.2), up, 0, 0.4, bsdf=gold),
        "box": placed("cube", (0.1, 0.25, 0.9), up, 30, 0.2, bsdf=plastic),
        "bulb": placed("sphere", (-1.4, 0.9, 0.8), up, 0, 0.1, emitter=bulb),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)},
    }


# ---------------------------------------------------------------------------------------------------------------------
# Recording


def measure(scene, name: str, offset: int) -> tuple[np.ndarray, dict]:
    """Independent images (n, height, width, channels) and the mean statistics."""
    import mitsuba as mi

    images, facts, integrator, biased, restir = [], [], None, name in BIASED, name.startswith("restir")
    spp = TRAINED_SPP if biased else RESTIR_SPP if restir else SPP
    for k in range(TRAININGS if biased else IMAGES):
        if integrator is None or biased:
            integrator = mi.load_dict(integrator_keys(name, 1000 * offset + k))
        elif restir:
            integrator.reset()  # images would depend on one another
        seeds = 10 * (1000 * offset + k) + np.arange(TRAINED_IMAGES if biased else 1)
        same = [np.array(mi.render(scene, integrator=integrator, spp=spp, seed=int(seed))) for seed in seeds]
        images.append(np.mean(same, axis=0, dtype=np.float64))
        facts.append(integrator.statistics() if hasattr(integrator, "statistics") else {})
    facts = facts if biased else facts[-1:]
    kept = {key: float(np.mean([f[key] for f in facts])) for key in STATISTICS if all(key in f for f in facts)}
    return np.stack(images), kept


def parts(images: np.ndarray) -> np.ndarray:
    """Means of the whole images and of their blocks, shape (n, 1 + blocks, channels)."""
    rows = [np.array_split(r, BLOCKS, axis=2) for r in np.array_split(images, BLOCKS, axis=1)]
    return np.stack([p.mean(axis=(1, 2)) for p in (images, *(b for row in rows for b in row))], axis=1)


def record(out: Path, only: list[str], offset: int) -> None:
    """Render the cases into `out`; a case that raises an error is kept as its text."""
    sys.path.insert(0, str(ROOT / "tests"))
    import quick_kernels  # noqa: F401 (first: LLVM skips its optimisation, which would take most of the time)

    import mi_neural  # isort: skip
    import mitsuba as mi  # isort: skip

    mi.set_variant("llvm_ad_rgb")
    out.mkdir(parents=True, exist_ok=True)
    planned = [f"{s}/{n}" for s in (*SHIPPED, *FILMS, "sky_glass") for n in (*UNBIASED, *BIASED) if renders(s, n)]
    planned = [case for case in planned if not only or any(text in case for text in only)]
    facts = {"code": str(Path(mi_neural.__file__).resolve().parent), "planned": planned, "cases": {}}
    start, arrays = time.perf_counter(), {}
    for scene_name in dict.fromkeys(case.split("/")[0] for case in planned):
        scene = load_scene(scene_name)
        for depth in (-1, 2):
            path = mi.load_dict({"type": "path", "max_depth": depth})
            image = np.array(mi.render(scene, integrator=path, spp=REFERENCE_SPP, seed=77))
            arrays[f"{scene_name}/reference{depth}"] = image[..., :3]
        for case in (c for c in planned if c.split("/")[0] == scene_name):
            began, name = time.perf_counter(), case.split("/")[1]
            row = facts["cases"][case] = {}
            try:
                images, row["statistics"] = measure(scene, name, offset)
                row["bad_values"] = int((~np.isfinite(images)).sum())
                images = np.nan_to_num(images, nan=0.0, posinf=0.0, neginf=0.0)
                arrays[f"{case}/mean"], arrays[f"{case}/parts"] = images.mean(axis=0), parts(images)
                arrays[f"{case}/variance"] = images.var(axis=0, ddof=1) / len(images)
                if name in BIASED:
                    arrays[f"{case}/images"] = images.astype(np.float32)
            except Exception as error:
                row["error"] = f"{type(error).__name__}: {error}"
            gc.collect()  # integrators that are left over would be compiled into the next kernels
            row["seconds"] = time.perf_counter() - began
            print(f"{case}: {row['seconds']:.1f} s {row.get('error', '')[:200]}", flush=True)
        facts["seconds"] = time.perf_counter() - start
        np.savez_compressed(out / "images.npz", **arrays)
        (out / "facts.json").write_text(json.dumps(facts, indent=1))
        del scene
        gc.collect()
    errors = sum("error" in row for row in facts["cases"].values())
    print(f"{len(facts['cases'])} cases in {time.perf_counter() - start:.0f} s, {errors} with an error")


# ---------------------------------------------------------------------------------------------------------------------
# Comparing


def log_error(images: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Logarithm of relMSE of each image, without the largest hundredth of the squared errors."""
    luminance = reference @ np.array([0.2126, 0.7152, 0.0722])
    level = luminance**2 + 1e-2 * max(luminance.mean(), 1e-30) ** 2
    squared = np.sort(((images[..., :3] - reference) ** 2 / level[..., None]).reshape(len(images), -1))
    return np.log(np.maximum(squared[:, : int(0.99 * squared.shape[1])].mean(axis=1), 1e-12))


def unbiased_bound(a: np.ndarray, b: np.ndarray, rate: float) -> np.ndarray:
    """The largest difference of the means that chance explains, with this rate of false alarms for each (Welch)."""
    from scipy import stats

    va, vb = (v.var(axis=0, ddof=1) / len(v) for v in (a, b))
    dof = (va + vb) ** 2 / np.maximum(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-300)
    size = np.maximum(np.abs(a.mean(axis=0)), np.abs(b.mean(axis=0)))
    return stats.t.isf(rate / 2, np.maximum(dof, 1)) * np.sqrt(va + vb) + ROUNDING * size + 1e-9


def pooled(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Variance within two groups of values."""
    return (a.var(axis=0, ddof=1) * (len(a) - 1) + b.var(axis=0, ddof=1) * (len(b) - 1)) / (len(a) + len(b) - 2)


def trained_bound(a: np.ndarray, b: np.ndarray, prior: np.ndarray, rate: float) -> np.ndarray:
    """The same for values of trainings; `prior` is the variance of other values."""
    from scipy import stats

    dof = len(a) + len(b) - 2
    variance = (dof * pooled(a, b) + PRIOR_DOF * prior) / (dof + PRIOR_DOF)
    return stats.t.isf(rate / 2, dof + PRIOR_DOF) * np.sqrt(variance * (1 / len(a) + 1 / len(b)))


def statistics_notes(a: dict, b: dict) -> str:
    """Which statistics differ by more than they may."""
    notes = []
    for name in (n for n in STATISTICS if n in a and n in b):
        (factor, slack), low, high = STATISTICS[name], *sorted((a[name], b[name]))
        if high > factor * (low + 1e-9 * high) + slack:
            notes.append(f"{name} {a[name]:.4g} -> {b[name]:.4g}")
    return ", ".join(notes)


def problem(a: dict | None, b: dict | None, images: list) -> str | None:
    """Why two rows of facts, or their mean images, cannot be compared."""
    if a is None or b is None:
        return f"{'A' if a is None else 'B'} did not come so far, its process ended before"
    if ("error" in a) != ("error" in b):
        return f"{'A' if 'error' in a else 'B'} raises {(a if 'error' in a else b)['error'][:150]}"
    if images and images[0].shape != images[1].shape:
        return f"the image has shape {images[1].shape}, not {images[0].shape}"
    if b.get("bad_values", 0) and not a["bad_values"]:
        return f"{b['bad_values']} values are not finite"
    return None


def compare(folders: tuple[Path, Path], ignore_statistics: bool) -> int:
    """Print a table of all cases that both recordings have; 1 if one of them fails, else 0."""
    facts = [json.loads((f / "facts.json").read_text()) for f in folders]
    arrays = [dict(np.load(f / "images.npz")) for f in folders]
    names = [c for c in facts[0]["planned"] if c in facts[1]["planned"]]
    rows = {c: [f["cases"].get(c) for f in facts] for c in names}

    def both(case: str, what: str) -> list[np.ndarray]:
        return [x[f"{case}/{what}"].astype(np.float64) for x in arrays if f"{case}/{what}" in x]

    wrong = {c: text for c in names if (text := problem(*rows[c], both(c, "mean")))}
    exact = {c: both(c, "parts") for c in names if c not in wrong and both(c, "mean") and not both(c, "images")}
    trained, errors = {}, {}
    for case in (c for c in names if c not in wrong and both(c, "images")):
        # Parts relative to their size, and errors against the reference of A
        images, values, (scene, name) = both(case, "images"), both(case, "parts"), case.split("/")
        size = np.abs(np.concatenate(values).mean(axis=0)) + 1e-9
        size += 0.1 * np.sqrt(np.mean(np.concatenate(images) ** 2, axis=(0, 1, 2)))
        reference = arrays[0][f"{scene}/reference{2 if name.startswith('nvc_direct') else -1}"].astype(np.float64)
        trained[case], errors[case] = [v / size for v in values], [log_error(v, reference) for v in images]
    n_tests = sum(a.size // len(a) for a, _ in exact.values()), sum(a.size // len(a) + 1 for a, _ in trained.values())
    rates = [1 - (1 - ERROR_RATE / 2) ** (1 / max(n, 1)) for n in n_tests]

    visible = {"unbiased": [], "biased": []}
    print(f"{'case':<66}{'mean A':>10}{'mean B':>10}{'worst':>7}{'visible':>9}{'block':>8}{'relMSE A':>10}{'B':>9}")
    for case in names:
        if case in exact:
            (a, b), end = exact[case], ""
            bound = unbiased_bound(a, b, rates[0])
            worst = (np.abs(a.mean(axis=0) - b.mean(axis=0)) / bound).max()
            relative = bound / np.maximum(np.abs(a.mean(axis=0)), bound)
        elif case in trained:
            (a, b), (ea, eb) = trained[case], errors[case]
            same = [c for c in trained if c.split("/")[0] == case.split("/")[0]]
            prior = np.median([pooled(*trained[c])[:, :3].mean() for c in same])
            prior = np.maximum(prior, pooled(a, b).mean(axis=0))
            relative = trained_bound(a, b, prior, rates[1]) + FLOOR
            prior = max(pooled(ea, eb), np.median([pooled(*errors[c]) for c in same]))
            bound = trained_bound(ea, eb, prior, rates[1]) + FLOOR_ERROR
            worst = max((np.abs(a.mean(axis=0) - b.mean(axis=0)) / relative).max(), abs(ea.mean() - eb.mean()) / bound)
            end = f"{np.exp(ea.mean()):10.3g}{np.exp(eb.mean()):9.3g}, visible x{np.exp(bound):.2f}"
        else:
            print(f"{case:<66} {wrong.get(case) or 'both raise ' + rows[case][1]['error'][:100]}")
            continue
        seen = float(relative[0, :3].max()), float(np.median(relative[1:, :3]))
        visible["unbiased" if case in exact else "biased"].append(seen)
        means = "".join(f"{image[..., :3].mean():10.4g}" for image in both(case, "mean"))
        print(f"{case:<66}{means}{worst:7.2f}{seen[0]:9.2%}{seen[1]:8.1%}{end}")
        notes = "" if ignore_statistics else statistics_notes(*(row["statistics"] for row in rows[case]))
        if worst > 1 or notes:
            wrong[case] = f"{worst:.2f} times the largest difference that chance explains. {notes}"
    for kind, values in visible.items():
        image, block = np.median(values, axis=0) if values else (np.nan, np.nan)
        print(f"{len(values)} {kind} cases; the smallest difference that fails is {image:.2%} of an image's mean, "
              f"{block:.1%} of a block's (medians of the cases).")  # fmt: skip
    print(f"worst: the largest difference over its bound; above 1 a case fails. visible, block: the smallest relative "
          f"difference that fails.\nTwo correct checkouts fail with probability {ERROR_RATE:g}, statistics apart. "
          f"A took {facts[0]['seconds']:.0f} s, B {facts[1]['seconds']:.0f} s. Cases planned in one recording only: "
          f"{len(set(facts[0]['planned']) ^ set(facts[1]['planned']))}.")  # fmt: skip
    print("\n".join(["FAILED:", *(f"  {c}: {t}" for c, t in wrong.items())]) if wrong else "No case fails.")
    return 1 if wrong or not names else 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("record", help="render all cases with the imported mi_neural")
    command.add_argument("out", type=Path)
    command.add_argument("--cases", default="", help="parts of names SCENE/INTEGRATOR, separated by commas")
    command.add_argument("--seed", type=int, default=0, help="which random numbers")
    command = commands.add_parser("compare", help="compare two recordings; exit status 1 if a case fails")
    command.add_argument("folders", type=Path, nargs=2, metavar="DIR")
    command.add_argument("--ignore-statistics", action="store_true")
    options = parser.parse_args()
    if options.command == "compare":
        return compare(options.folders, options.ignore_statistics)
    record(options.out, [c for c in options.cases.split(",") if c], options.seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
