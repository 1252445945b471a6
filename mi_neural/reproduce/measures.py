"""What several entries measure: references, trained integrators, the time of passes, errors of images."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from mi_neural.bench import benchmark, budget, environment
from mi_neural.bench import reference as references
from mi_neural.bench.load import LoadedScene
from mi_neural.bench.specs import IntegratorSpec
from mi_neural.image.metrics import TRIM_FRACTION, luminance, relative_weights

from .work import Part, Work


def reference(work: Work, loaded: LoadedScene, spp: int) -> references.Reference:
    """The reference of a scene, path traced with at least `spp` samples a pixel; kept for all entries."""
    folder = work.folder / "measured" / "references"
    folder.mkdir(parents=True, exist_ok=True)
    return references.render_reference(loaded, spp, folder, work.progress(f"reference, {spp} samples a pixel"))


def make(loaded: LoadedScene, plugin: str, **keys):
    """An integrator at the scene's own depth."""
    (case,) = benchmark.make_cases(loaded, [IntegratorSpec(plugin, keys)])
    return case.integrator


def train(loaded: LoadedScene, integrator, frames: int, bar=None) -> None:
    """Train so many frames; ``KeyboardInterrupt`` passes through."""
    _, interrupted = budget.train(loaded.scene, integrator, frames, progress=bar)
    if interrupted:
        raise KeyboardInterrupt


def render(loaded: LoadedScene, integrator, spp: int, seed: int = 0, bar=None) -> budget.Rendered:
    """An image of `spp` samples a pixel; ``KeyboardInterrupt`` passes through."""
    found = budget.render_samples(loaded.scene, integrator, spp, seed, progress=bar)
    if found.interrupted:
        raise KeyboardInterrupt
    return found


def frozen(trained, loaded: LoadedScene, folder: Path, plugin: str, **keys):
    """Another integrator with the cache that `trained` has learned, which learns no more."""
    path = folder / "cache.npz"
    trained.save_cache(str(path))
    try:
        integrator = make(loaded, plugin, freeze_cache=True, **keys)
        integrator.load_cache(str(path), loaded.scene)
    finally:
        path.unlink()
    return integrator


def seconds_of(loaded: LoadedScene, integrators: dict[str, object], spps: dict[str, int], rounds: int, bar=None):
    """Seconds of one pass on all cores, by label: the least CPU time of `rounds` passes over the number of cores. The
    integrators take turns, kernels are compiled before, and other work on the machine does not count."""
    for label, integrator in integrators.items():
        budget.render_pass(loaded.scene, integrator, spps[label], 0)
    least = dict.fromkeys(integrators, float("inf"))
    for k in range(rounds):
        for label, integrator in integrators.items():
            budget.clock()
            start = time.process_time()
            budget.render_pass(loaded.scene, integrator, spps[label], k + 1)
            budget.clock()
            least[label] = min(least[label], (time.process_time() - start) / environment.cores())
        if bar:
            bar(k + 1, rounds)
    return least


def relative_variance(images: list[np.ndarray], spp: int) -> float:
    """Variance of one camera sample over the squared brightness of its pixel, as in relMSE, from independent images of
    `spp` samples a pixel; the largest 0.1 % of the values left out."""
    stack = np.stack(images).astype(np.float64)
    weights = relative_weights(luminance(stack.mean(axis=0)))[..., None]
    values = np.sort((stack.var(axis=0, ddof=1) * spp * weights).ravel())
    return float(values[: max(1, int(values.size * (1 - TRIM_FRACTION)))].mean())


def direct_reference(group, loaded: LoadedScene, spp: int, **more) -> np.ndarray:
    """Direct light alone, by a light tree, of `spp` samples a pixel, shape (height, width, 3); kept in the group.
    `more`: keys of the integrator."""

    def image(bar) -> Part:
        # The type of a light sampler cannot be nested in keywords: dots in names
        keys = {"max_depth": 2, "light_sampler.type": "tree_lights", **more}
        return Part({}, {"image": render(loaded, make(loaded, "plain_path", **keys), spp, 12345, bar).rgb})

    return group.part("reference", image).arrays["image"]


def chromaticity_error(image: np.ndarray, reference: np.ndarray) -> float:
    """Mean difference of chromaticity, sum of |r/(r+g+b) - r'/(r'+g'+b')| over the channels, over all pixels that are
    brighter in the reference than a hundredth of its mean."""
    sums = [np.maximum(i.sum(axis=-1, keepdims=True), 1e-12) for i in (image, reference)]
    lit = sums[1][..., 0] > 0.01 * sums[1].mean()
    return float(np.abs(image / sums[0] - reference / sums[1]).sum(axis=-1)[lit].mean())
