"""Unbiased gradients: traced ones have the mean of those of Mitsuba's ``prb``, and ``gradient="prb"`` is ``prb``.

Means are compared by Welch's test of each derivative, with Šidák's correction: one choice of seeds in ten thousand
fails.
"""

import mitsuba as mi
import numpy as np
import pytest
from cheap import sweep
from expectation import ERROR_RATE
from gradient_scenes import SMALL, assert_is_difference, black_wall, gradients_of, room, scene_of, tracked
from scipy import stats

# ---------------------------------------------------------------- unbiased: traced, with the mean of prb


def assert_same_means(a, b, what: str) -> None:
    """Two stacks of independent gradients, (n, number of derivatives), have the same mean."""
    means, variances = zip(*((v.mean(0), v.var(0, ddof=1) / len(v)) for v in (a, b)), strict=True)
    total = np.maximum(sum(variances), 1e-300)
    dof = total**2 / np.maximum(sum(v**2 / (len(x) - 1) for v, x in zip(variances, (a, b), strict=True)), 1e-300)
    each = 1 - (1 - ERROR_RATE) ** (1 / total.size)
    norm = np.linalg.norm(means[1])
    bound = stats.t.isf(each / 2, np.maximum(dof, 1)) * total**0.5 + 1e-6 * norm
    off = np.abs(means[0] - means[1])
    print(f"{what}: {off.size} derivatives, noise {total.sum() ** 0.5 / norm:.2%} of the norm; the "
          f"worst {np.max(off / bound):.2f} of its bound, all bounds {np.linalg.norm(bound) / norm:.1%}")  # fmt: skip
    assert (off <= bound).all()


@pytest.mark.parametrize("kind, keys", sweep([
    ("diffuse", {}), ("glossy", {"rr_depth": 2}), ("mirror", {"max_depth": 4}), ("mask", {"hide_emitters": True}),
    ("sky", {"light_sampler": {"type": "tree_lights"}}), ("sky", {}),
], [("glossy", {"rr_depth": 2}), ("sky", {"light_sampler": {"type": "tree_lights"}})]))  # fmt: skip
def test_traced_gradients_have_the_mean_of_prb(kind, keys):
    """By paths that may end early, with and without a light sampler; the cache is not trained and does not matter."""
    scene, params, wanted = scene_of(kind)
    limits = {"max_depth": 8, **{k: v for k, v in keys.items() if k != "light_sampler"}}
    ours = mi.load_dict({"type": "nirc_two_level", **SMALL, **limits, **keys})
    prb = mi.load_dict({"type": "prb", **limits})
    a, b = (np.array([gradients_of(scene, params, wanted, x, 64, s) for s in range(12)]) for x in (ours, prb))
    assert_same_means(a, b, f"{kind} {keys}")
    assert ours.cache.steps == 0


def test_traced_gradients_have_all_direct_light_on_black_surfaces():
    """Against a finite difference; ``prb`` finds a part of it."""
    scene, params, key = black_wall()
    ours = mi.load_dict({"type": "nirc_two_level", **SMALL, "max_depth": 2})
    found = gradients_of(scene, params, [key], ours, 1024, 1)
    assert_is_difference(scene, params, key, found, 2, 0.05)


# ---------------------------------------------------------------- unbiased: prb itself


@pytest.mark.parametrize("keys", [{"type": "nirc_two_level", "gradient": "prb"}, {"type": "nrc", "gradient": "prb"},
                                  {"type": "nirc", "max_depth": 2}])  # fmt: skip
def test_without_the_cache_gradients_are_prbs_own(keys):
    """By its key, and where no cache is needed."""
    scene = room(width=6)
    params, wanted = tracked(scene)
    integrator = mi.load_dict({**SMALL, "rr_depth": 3, "hide_emitters": True, "max_depth": 6, **keys})
    prb = mi.load_dict({"type": "prb", "max_depth": keys.get("max_depth", 6), "rr_depth": 3, "hide_emitters": True})
    a, b = (gradients_of(scene, params, wanted, x, 16, 3) for x in (integrator, prb))
    assert np.linalg.norm(a) > 0
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5 * np.abs(b).max())
