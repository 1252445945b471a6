"""What the tests of ``nirc_two_level`` share: a small integrator, caches as accidents might leave them, and scenes with
images of `path` and trained integrators."""

import importlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cheap import NETWORK
from expectation import assert_same_mean, renders

from mi_neural import scenes

SLOW = pytest.mark.slow
#: A cache that is trained in half a second, and a division that is all given, so that nothing is measured.
SMALL = {"type": "nirc_two_level", "train_samples": 512, "train_frames": 60, "train_steps": 0, "hide_emitters": True,
         **NETWORK}  # fmt: skip
GIVEN = {"cache_samples": 4, "residual_samples": 1, "residual_probability": 1.0, "alpha": "cell"}
N_RENDERS, SPP = 64, 16
#: z-tests of this module that are corrected for, the slow ones included.
N_TESTS = 160
#: Divisions (n_cache, n_traced, probability, alpha; negative: by place).
SPLITS = {"paper": (4, 1, 1.0, 1.0), "cell": (4, 1, 1.0, -1.0), "quarter": (4, 1, 0.25, -1.0),
          "several": (6, 3, 0.5, 1.0)}  # fmt: skip
CACHES = ("trained", "untrained", "nonsense", "broken")


def chosen(*names) -> dict:
    return {name: SPLITS[name] for name in names}


def split_of(numbers):
    return importlib.import_module("mi_neural.integrators.pilot").Split(*numbers)


def two_level(**keys):
    return mi.load_dict({**SMALL, **GIVEN, **keys})


def render(scene, integrator, spp=16, seed=0, **kw) -> np.ndarray:
    image = np.array(integrator.render(scene, spp=spp, seed=seed, **kw), dtype=np.float64)
    assert np.isfinite(image).all()
    return image


def fill(integrator, kind: str, trained: dict) -> None:
    """Give the cache the `trained` weights, or such as an accident might. α is then any number, place by place."""
    field, rng = integrator.cache.field, np.random.default_rng(5)
    weights = dict(trained["weights"])
    if kind == "untrained":
        field.reset()
        weights = field.snapshot()
    if kind == "nonsense":
        weights = {k: 0.4 * rng.normal(size=v.shape).astype(v.dtype) for k, v in weights.items()}
    if kind == "broken":  # a tenth of the grid answers with infinities and NaN, or with far too much
        for k, v in weights.items():
            if v.ndim == 1:
                bad = rng.random(v.shape) < 0.01
                weights[k] = np.where(bad, rng.choice([np.nan, np.inf, -np.inf], v.shape), v).astype(v.dtype)
    field.restore(weights)
    asked = integrator.cache.queried
    n = dr.width(asked.alpha)
    asked.alpha = mi.Float(trained["alpha"] if kind == "trained" else rng.random(n).astype(np.float32))
    dr.make_opaque(asked.alpha)


def channels_of(integrator, image) -> dict:
    """Channels by name; RGB under ''."""
    found, first = {"": image[..., :3]}, 3
    for name in integrator.channels:
        size = integrator.CHANNELS[name]
        found[name] = image[..., first : first + size]
        first += size
    assert first == image.shape[-1] == 3 + len(integrator.aov_names())
    return found


class Bench:
    """Scenes, images of `path` and trained integrators, made when they are first asked for."""

    def __init__(self):
        self.scenes, self.references, self.integrators = {}, {}, {}

    def scene(self, name):
        if name not in self.scenes:
            size = (16, 16) if name in ("cornell_box", *scenes.ANSWERS) else (16, 12)
            self.scenes[name] = mi.load_file(str(scenes.path(name)), resx=size[0], resy=size[1])
        return self.scenes[name]

    def reference(self, name, depth=-1):
        if (name, depth) not in self.references:
            keys = {"type": "path", "max_depth": depth, "hide_emitters": True}
            self.references[name, depth] = renders(self.scene(name), keys, N_RENDERS, 4 * SPP, first_seed=100_000)
        return self.references[name, depth]

    def integrator(self, name, **keys):
        """(one trained in the scene, what it learned)"""
        key = (name, *sorted((k, str(v)) for k, v in keys.items()))
        if key not in self.integrators:
            integrator = two_level(**keys)
            integrator.train(self.scene(name), 60)
            learned = {"weights": integrator.cache.field.snapshot(), "alpha": np.array(integrator.cache.queried.alpha)}
            self.integrators[key] = integrator, learned
        return self.integrators[key]

    def check(self, name, kind, splits, depth=-1, visible=None, spp=SPP, **keys):
        """The mean of each division is that of `path`."""
        if depth >= 0:
            keys["max_depth"] = depth
        integrator, learned = self.integrator(name, **keys)
        fill(integrator, kind, learned)
        steps = integrator.cache.steps
        for label, numbers in splits.items():
            integrator.choice.split = split_of(numbers)
            ours = renders(self.scene(name), integrator, N_RENDERS, spp, first_seed=7)
            assert np.isfinite(ours).all()
            what = f"{name}, {kind} cache, {label} {numbers} {keys or ''}"
            seen = assert_same_mean(ours, self.reference(name, depth), what, relative=1e-5, tests=N_TESTS)
            if visible is not None:
                assert seen < visible, f"{what}: a bias of {seen:.1%} would have gone unseen"
        assert integrator.cache.steps == steps and integrator.statistics()["nonfinite"] == 0
