"""Two estimators of one thing have one mean: a z-test over seeds, and the smallest bias it could have seen."""

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

from mi_neural.render.frozen import undisturbed

#: False alarms per test: a correct estimator fails one choice of seeds in ten thousand.
ERROR_RATE = 1e-4
MITSUBAS = ("path", "volpath", "volpathmis")


def renders(scene, integrator, n: int, spp: int, first_seed: int = 0, sensor=0, channels=slice(3)) -> np.ndarray:
    """`n` independent images, shape (n, height, width, 3). `integrator`: a dictionary or an integrator."""
    if isinstance(integrator, dict):
        kind, integrator = integrator["type"], mi.load_dict(integrator)
        if kind in MITSUBAS and mi.variant().endswith("_rgb"):
            try:
                return _recorded(scene, integrator, n, spp, first_seed, sensor)[..., channels]
            except RuntimeError as error:
                if "recording" not in str(error):  # some scenes cannot be recorded: "a virtual function call"
                    raise
    images = [np.array(mi.render(scene, integrator=integrator, sensor=sensor, spp=spp, seed=first_seed + k))
              for k in range(n)]  # fmt: skip
    return np.stack(images).astype(np.float64)[..., channels]


def _recorded(scene, integrator, n: int, spp: int, first_seed: int, sensor) -> np.ndarray:
    """The same images. Ours record themselves; Mitsuba's are traced anew for every image, which takes 20 ms. In mono
    and spectral variants they cannot be recorded: "a virtual function call involving variable"."""
    sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
    frame = dr.freeze(lambda scene, integrator, sensor, seed: integrator.render(scene, sensor, seed, spp))
    with undisturbed():
        images = [np.array(frame(scene, integrator, sensor, mi.UInt32(first_seed + k))) for k in range(n)]
    return np.stack(images).astype(np.float64)


def assert_mean(samples, known, what: str = "", relative: float = 1e-6) -> None:
    """The mean of independent `samples` is `known`. `relative`: rounding that does not count."""
    samples = np.asarray(samples, np.float64).ravel()
    error = samples.std(ddof=1) / np.sqrt(samples.size)
    bound = stats.t.isf(ERROR_RATE / 2, samples.size - 1) * error + relative * abs(known)
    print(f"{what}: {samples.mean():.6g}, known {known:.6g}; smallest visible bias {bound:.1e}")
    assert abs(samples.mean() - known) <= bound


def assert_same_mean(
    a: np.ndarray, b: np.ndarray, what: str = "", blocks: int = 4, relative: float = 1e-6, tests: int = 1
) -> float:  # fmt: skip
    """Two stacks of independent images (n, h, w, 3) have the same mean: as a whole, and in blocks x blocks parts.

    Welch's test on the mean of the channels, Šidák's correction over all parts and this many `tests` for `ERROR_RATE`
    in total. Returns the smallest bias of the whole image that it could have seen, over the mean.
    """

    def parts(images):
        grey = images.mean(axis=-1)
        rows = [np.array_split(r, blocks, axis=2) for r in np.array_split(grey, blocks, axis=1)]
        return np.stack([grey.mean(axis=(1, 2)), *(p.mean(axis=(1, 2)) for row in rows for p in row)])

    a, b = parts(a), parts(b)
    va, vb = (v.var(axis=1, ddof=1) / v.shape[1] for v in (a, b))
    dof = (va + vb) ** 2 / np.maximum(va**2 / (a.shape[1] - 1) + vb**2 / (b.shape[1] - 1), 1e-300)
    each = 1 - (1 - ERROR_RATE) ** (1 / (len(a) * tests))
    mean = b.mean(axis=1)
    bound = stats.t.isf(each / 2, np.maximum(dof, 1)) * np.sqrt(va + vb) + relative * np.abs(mean)
    error = np.abs(a.mean(axis=1) - mean)
    worst = np.argmax(error - bound)
    visible = bound / np.maximum(np.abs(mean), 1e-30)
    print(
        f"{what}: {a.mean(axis=1)[0]:.5g} and {mean[0]:.5g}; smallest visible bias {visible[0]:.1e} of the image, "
        f"{visible.max():.1e} of a block; worst part {worst}: off by {error[worst]:.1e} of {bound[worst]:.1e}"
    )
    assert (error <= bound).all()
    return float(visible[0])
