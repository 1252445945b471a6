"""The reference of `foggy_hall` that is shipped: ``python studies/foggy_hall_reference.py --minutes 30``.

Mitsuba's `volpath` chooses each lamp as often as any other; `plain_path` with `tree_lights` renders the same image with
less noise. Passes have seeds of their own, and the variance of the mean comes from their spread. The run prints the
noise that is left as relMSE, and compares the image with one of `volpath` by a z-test on blocks. It goes on where it
was interrupted.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from mi_neural import scenes
from mi_neural.image import exr
from mi_neural.image.metrics import relative_squared_errors

SCENE, DEPTH, SIZE, BLOCK = "foggy_hall", 64, (320, 180), 20
#: Samples a pixel of a pass; one pass of `volpath` after so many.
SPP, CHECK_EVERY = 16, 4
INTEGRATORS = {
    "plain_path": {"type": "plain_path", "max_depth": DEPTH, "light_sampler": {"type": "tree_lights"}},
    "volpath": {"type": "volpath", "max_depth": DEPTH},
}


def blocks_of(image: np.ndarray) -> np.ndarray:
    """Means of blocks of BLOCK x BLOCK pixels and all channels."""
    height, width = (n // BLOCK for n in image.shape[:2])
    return image.reshape(height, BLOCK, width, BLOCK, 3).mean((1, 3, 4))


def render(minutes: float, kept: Path) -> dict[str, np.ndarray]:
    """For each integrator, sums over passes in float64, and those kept before: [number, image, squares]."""
    import mitsuba as mi

    scene = mi.load_file(str(scenes.path(SCENE)), resx=SIZE[0], resy=SIZE[1])
    integrators = {name: mi.load_dict(keys) for name, keys in INTEGRATORS.items()}
    size, parts = (SIZE[1], SIZE[0], 3), ("image", "squares", "blocks", "block_squares")
    small = (SIZE[1] // BLOCK, SIZE[0] // BLOCK)
    sums = {f"{name}.{part}": np.zeros(small if "block" in part else size) for name in integrators for part in parts}
    sums |= {f"{name}.n": np.zeros(()) for name in integrators}
    if kept.exists():
        with np.load(kept) as file:
            sums = {key: file[key] for key in sums}
    end, saved = time.time() + 60 * minutes, time.time()
    while time.time() < end:
        count = int(sums["plain_path.n"])
        for stream, (name, integrator) in enumerate(integrators.items()):
            if stream and count % CHECK_EVERY:
                continue
            seed = 2 * count + stream
            image = np.array(mi.render(scene, integrator=integrator, spp=SPP, seed=seed), np.float64)[..., :3]
            blocks = blocks_of(image)
            for part, value in zip(parts, (image, image**2, blocks, blocks**2), strict=True):
                sums[f"{name}.{part}"] += value
            sums[f"{name}.n"] += 1
        if time.time() - saved > 30 or time.time() >= end:
            np.savez(kept, **sums)
            saved = time.time()
    return sums


def moments(sums: dict, name: str, part: str, squares: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean of the passes and the variance of that mean."""
    n = sums[f"{name}.n"]
    mean = sums[f"{name}.{part}"] / n
    return mean, np.maximum(sums[f"{name}.{squares}"] / n - mean**2, 0) / (n - 1)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("-o", "--out", default="out/foggy_hall_reference")
    asked = parser.parse_args(arguments)
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    out = Path(asked.out)
    out.mkdir(parents=True, exist_ok=True)
    sums = render(asked.minutes, out / "passes.npz")
    for name in INTEGRATORS:
        image, variance = moments(sums, name, "image", "squares")
        noise = float(relative_squared_errors(image, image, variance)[1].mean())
        print(f"{name}: {int(sums[f'{name}.n']) * SPP} samples a pixel, noise {noise:.5f}, mean {image.mean():.5f}")
    (ours, a), (theirs, b) = (moments(sums, name, "blocks", "block_squares") for name in INTEGRATORS)
    z = (ours - theirs) / np.sqrt(a + b)
    print(f"z-test against volpath, {z.size} blocks: largest {np.abs(z).max():.2f}, root mean square "
          f"{np.sqrt(np.mean(z**2)):.2f}")  # fmt: skip
    image, _ = moments(sums, "plain_path", "image", "squares")
    metadata = {"scene": SCENE, "integrator": "plain_path with tree_lights", "max_depth": str(DEPTH),
                "spp": str(int(sums["plain_path.n"]) * SPP), "mitsuba": mi.__version__}  # fmt: skip
    name = f"{SCENE}_reference_{SIZE[0]}x{SIZE[1]}"
    exr.write(out / f"{name}.exr", image, metadata=metadata, half=True)
    exr.write_png(out / f"{name}.png", image)


if __name__ == "__main__":
    main()
