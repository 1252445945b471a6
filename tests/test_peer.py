"""Mitsuba's own rendering tests with our integrators in the place of `path` and `volpath`: `pytest -m peer`.

The data are those of github.com/mitsuba-renderer/mitsuba-data (`tests/scenes` and `common`): references with the
variance of each pixel. They are looked for in `../shared/peer` and where `MI_NEURAL_PEER` says; elsewhere the tests
skip. As in Mitsuba's test, nothing but the type of the integrator is exchanged, and a pixel fails whose z-value is less
likely than 1 % over all pixels (Šidák); 0.25 % of them may.
"""

import os
import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from conftest import ROOT
from scipy.stats import norm

DATA = Path(os.environ.get("MI_NEURAL_PEER", ROOT.parent / "shared" / "peer"))
SCENES = sorted(DATA.glob("tests/scenes/*/*.xml"))
#: These border a medium: `plain_path` alone renders them.
MEDIA = ("hetero_", "homo_")
#: It has no depth limit where the reference was rendered with one (`path` fails it, too).
WITHOUT_LIMIT = "test_directional_direct"
NVC = {"type": "nvc_lights"}
UNBIASED = {"plain_path": ("plain_path", {}), "plain_path+nvc": ("plain_path", {"light_sampler": NVC}),
            "nirc_two_level": ("nirc_two_level", {}),
            "nirc_two_level+nvc": ("nirc_two_level", {"light_sampler": NVC})}  # fmt: skip
IN_MEDIA = ("plain_path", "plain_path+nvc")
BIASED = ("nirc", "nrc", "neural_path")

pytestmark = [pytest.mark.peer, pytest.mark.skipif(not SCENES, reason=f"Mitsuba's test scenes are not in {DATA}")]


def of_surfaces(scenes: list[Path], media: bool = False) -> list:
    chosen = [s for s in scenes if any(f"test_{m}" in s.name for m in MEDIA) == media]
    return [pytest.param(s, id=s.stem) for s in chosen] or [pytest.param(None, id="none")]


def reference(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """(mean, variance of a sample) of each pixel, as CIE XYZ."""
    stem = file.parent / "refs" / f"{file.stem.rpartition('_')[0]}_ref_rgb"
    if not stem.with_suffix(".exr").exists():
        pytest.skip(f"no reference in RGB for {file.name}")
    return tuple(xyz(mi.Bitmap(str(stem) + end)) for end in (".exr", "_var.exr"))


def xyz(bitmap: mi.Bitmap) -> np.ndarray:
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.XYZ, mi.Struct.Type.Float32, False))


def image_of(file: Path, kind: str, keys: dict, spp: int) -> np.ndarray:
    """The image in XYZ, made as the scene says but for the type of its integrator."""
    if not keys:
        scene = mi.load_file(str(file), spp=spp, integrator=kind)
        integrator = scene.integrator()
    else:
        scene = mi.load_file(str(file), spp=spp)
        integrator = mi.load_dict({"type": kind, **keys, "max_depth": depth_of(scene, file)})
    integrator.render(scene, seed=0, spp=spp)
    parts = scene.sensors()[0].film().bitmap(raw=False).split()
    if len(parts) > 1:  # of `moment`: mean and square
        return np.array(parts[1][1])
    bitmap = parts[0][1]
    image = xyz(bitmap) if bitmap.channel_count() >= 3 else np.array(bitmap)
    return image.reshape(*image.shape[:2], -1)


def depth_of(scene, file: Path) -> int:
    """The depth limit of the scene's own integrator, -1 without one."""
    limit = 2 if file.stem.endswith("_direct") else -1
    given = re.search(r"max_depth = (\d+)", str(scene.integrator()))
    return int(given[1]) if given and int(given[1]) < 10**6 else limit


@pytest.mark.parametrize("name", UNBIASED)
@pytest.mark.parametrize("file", of_surfaces(SCENES))
def test_unbiased_image_passes_their_z_test(file, name):
    known, variance = reference(file)
    kind, keys = UNBIASED[name]
    if file.stem == WITHOUT_LIMIT and not keys:
        pytest.skip("rendered without the depth limit of its reference; `path` fails it, too")
    n_pixels = known.shape[0] * known.shape[1]
    spp = 2_000_000 // n_pixels
    image = image_of(file, kind, keys, spp)
    p = 2 * norm.sf(np.abs(image - known) * np.sqrt(spp / np.maximum(variance, 1e-4)))
    passing = float((p > 1 - 0.99 ** (1 / n_pixels)).mean())
    print(f"{file.stem}, {name}: {100 * passing:.3f} % of the pixels pass, mean {image.mean() / known.mean() - 1:+.4f}")
    assert passing >= 0.9975


@pytest.mark.parametrize("name", IN_MEDIA)
@pytest.mark.parametrize("file", of_surfaces(SCENES, media=True))
def test_unbiased_image_of_media_passes_their_z_test(file, name):
    test_unbiased_image_passes_their_z_test(file, name)


@pytest.mark.parametrize("name", BIASED)
@pytest.mark.parametrize("file", of_surfaces(SCENES))
def test_cached_image_has_their_mean(file, name):
    known, _ = reference(file)
    image = image_of(file, name, {}, 2_000_000 // (known.shape[0] * known.shape[1]))
    error = np.abs(image - known).mean(axis=2) / known.mean()
    at = np.percentile(error, [50, 90, 99, 100])
    print(f"{file.stem}, {name}: mean {image.mean() / known.mean() - 1:+.4f}; error of a pixel over the mean: median "
          f"{at[0]:.3f}, 90 % {at[1]:.3f}, 99 % {at[2]:.3f}, worst {at[3]:.3f}")  # fmt: skip
    assert np.isfinite(image).all() and abs(image.mean() / known.mean() - 1) < 0.02
