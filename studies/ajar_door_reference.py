"""The reference of `ajar_door` that is shipped: ``python studies/ajar_door_reference.py --minutes 30``.

Mitsuba's `path` finds the light of this room only by chance, because all of it comes through a narrow gap. Particles
that start at the lamp (`ptracer`) find the gap far more often. But `ptracer` shows nothing behind glass. So the image
is that of `ptracer`, and the window around the pixels that can see the glass ball is that of `path`. Both are unbiased,
and so is the image. All passes have seeds of their own; the variance of the mean comes from their spread.

The run prints the noise that is left as relMSE, and compares the new image with a `path` image of the whole film by a
z-test on blocks. It goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from mi_neural import scenes
from mi_neural.image import exr
from mi_neural.image.metrics import relative_squared_errors

SCENE, DEPTH, SIZE = "ajar_door", 64, (320, 180)
#: Samples a pixel of one pass: particles (times the pixels of the film), paths in the crop window, paths of the check.
PARTICLES, PATHS, CHECKS = 16, 512, 16
#: One pass in so many is one of the check.
CHECK_EVERY = 4
#: Pixels around those that can see glass that are traced by `path` as well.
BORDER = 2
BLOCK = 20


class Mean:
    """Sum and sum of squares of passes, as float64, of pixels and of the means of blocks."""

    KEPT = ("n", "total", "squares", "block_total", "block_squares")

    def __init__(self, *kept: np.ndarray):
        for name, value in zip(self.KEPT, kept or (0,) * len(self.KEPT), strict=True):
            setattr(self, name, value)

    def add(self, image: np.ndarray) -> None:
        image = np.asarray(image, np.float64)[..., :3]
        self.n, self.total, self.squares = self.n + 1, self.total + image, self.squares + image**2
        blocks = blocks_of(image)
        self.block_total, self.block_squares = self.block_total + blocks, self.block_squares + blocks**2

    def moments(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean of the passes and the variance of that mean, pixel by pixel."""
        mean = self.total / self.n
        return mean, np.maximum(self.squares / self.n - mean**2, 0) / (self.n - 1)

    def block_moments(self) -> tuple[np.ndarray, np.ndarray]:
        """The same of the blocks, all channels together. Particles shine on several pixels of a block."""
        mean = self.block_total / self.n
        return mean, np.maximum(self.block_squares / self.n - mean**2, 0) / (self.n - 1)


def blocks_of(image: np.ndarray) -> np.ndarray:
    """Means of whole blocks of BLOCK x BLOCK pixels and all channels; of what is left of the image at its end, none."""
    height, width = (n // BLOCK for n in image.shape[:2])
    kept = image[: height * BLOCK, : width * BLOCK].mean(-1)
    return kept.reshape(height, BLOCK, width, BLOCK).mean((1, 3))


def glass_pixels(scene, samples: int = 256) -> np.ndarray:
    """Whether a pixel can see a material with a delta lobe, shape (height, width)."""
    import drjit as dr
    import mitsuba as mi

    width, height = SIZE
    seen = np.zeros((height, width), bool)
    for seed in range(samples // 64):
        pixel = dr.arange(mi.UInt32, width * height * 64) // 64
        random = mi.PCG32(width * height * 64, initstate=seed)
        x, y = random.next_float32(), random.next_float32()
        at = mi.Point2f((pixel % width + x) / width, (pixel // width + y) / height)
        ray, _ = scene.sensors()[0].sample_ray(0, 0, at, mi.Point2f(0.5))
        delta = mi.has_flag(scene.ray_intersect(ray).bsdf(ray).flags(), mi.BSDFFlags.Delta)
        seen |= np.array(dr.block_sum(dr.select(delta, mi.Float(1), 0), 64)).reshape(height, width) > 0
    return seen


def window(mask: np.ndarray) -> tuple[int, int, int, int]:
    """x, y, width and height of the smallest window that holds `mask` and BORDER pixels around it."""
    ys, xs = np.nonzero(mask)
    x, y = xs.min() - BORDER, ys.min() - BORDER
    return int(x), int(y), int(xs.max() + BORDER + 1 - x), int(ys.max() + BORDER + 1 - y)


def render(minutes: float, kept: Path) -> tuple[dict[str, Mean], np.ndarray]:
    """Passes of the three kinds for so many minutes, and those kept before; where the crop window is."""
    import mitsuba as mi

    whole, part = (mi.load_file(str(scenes.path(SCENE)), resx=SIZE[0], resy=SIZE[1]) for _ in range(2))
    mask = glass_pixels(whole)
    x, y, width, height = window(mask)
    params = mi.traverse(part)
    params["camera.film.crop_offset"], params["camera.film.crop_size"] = [x, y], [width, height]
    params.update()
    particles, path = (mi.load_dict({"type": name, "max_depth": DEPTH}) for name in ("ptracer", "path"))
    passes = {"particles": (whole, particles, PARTICLES, 1), "paths": (part, path, PATHS, 1),
              "check": (whole, path, CHECKS, CHECK_EVERY)}  # fmt: skip
    means = {name: Mean() for name in passes}
    if kept.exists():
        with np.load(kept) as file:
            means = {name: Mean(*(file[f"{name}.{k}"] for k in Mean.KEPT)) for name in passes}
    end, saved = time.time() + 60 * minutes, time.time()
    while time.time() < end:
        count = int(means["particles"].n)
        for stream, (name, (scene, integrator, spp, every)) in enumerate(passes.items()):
            if count % every == 0:
                means[name].add(np.array(mi.render(scene, integrator=integrator, spp=spp, seed=3 * count + stream)))
        if time.time() - saved > 60 or time.time() >= end:
            np.savez(kept, **{f"{n}.{k}": getattr(m, k) for n, m in means.items() for k in Mean.KEPT})
            saved = time.time()
    return means, np.s_[y : y + height, x : x + width]


def noise(image: np.ndarray, variance: np.ndarray) -> float:
    """What noise of this variance adds to relMSE."""
    return float(relative_squared_errors(image, image, variance)[1].mean())


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("-o", "--out", default="out/ajar_door_reference")
    asked = parser.parse_args(arguments)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    out = Path(asked.out)
    out.mkdir(parents=True, exist_ok=True)
    means, place = render(asked.minutes, out / "passes.npz")
    (image, variance), (check, check_variance) = means["particles"].moments(), means["check"].moments()
    image[place], variance[place] = means["paths"].moments()
    print(f"{means['particles'].n * PARTICLES} particles and, in the window, {means['paths'].n * PATHS} paths a pixel: "
          f"noise {noise(image, variance):.5f}")  # fmt: skip
    print(f"check by path, {means['check'].n * CHECKS} samples a pixel: noise {noise(image, check_variance):.5f}")
    (ours, a), (theirs, b) = means["particles"].block_moments(), means["check"].block_moments()
    outside = np.ones(SIZE[::-1])
    outside[place] = 0
    z = ((ours - theirs) / np.sqrt(a + b))[blocks_of(outside[..., None]) == 1]
    print(f"z-test against path, {z.size} blocks without the window: largest {np.abs(z).max():.2f}, root mean square "
          f"{np.sqrt(np.mean(z**2)):.2f}; mean {image.mean():.5f}, of path {check.mean():.5f}")  # fmt: skip
    metadata = {"scene": SCENE, "integrator": "ptracer, path behind glass", "max_depth": str(DEPTH),
                "spp": str(means["particles"].n * PARTICLES), "mitsuba": mi.__version__}  # fmt: skip
    name = f"{SCENE}_reference_{SIZE[0]}x{SIZE[1]}"
    exr.write(out / f"{name}.exr", image, metadata=metadata, half=True)
    exr.write_png(out / f"{name}.png", image)


if __name__ == "__main__":
    main()
