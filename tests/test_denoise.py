"""The denoiser's guides, and `mi_neural.denoise`."""

import mitsuba as mi
import numpy as np
import pytest

import mi_neural
from mi_neural import scenes
from mi_neural.bench import guides as guides_module
from mi_neural.image import denoise as oidn
from mi_neural.image import metrics

SIZE = 24


def has_denoiser() -> bool:
    try:
        oidn.denoiser()
    except ImportError:
        return False
    return True


needs_denoiser = pytest.mark.skipif(not has_denoiser(), reason="mitsuba-oidn is not installed")


@pytest.fixture
def unfiltered(monkeypatch):
    """Guides as they are rendered."""

    def missing(*guides):
        raise ImportError

    monkeypatch.setattr(guides_module.oidn, "prefilter", missing)


def wall(bsdf: dict, **further) -> mi.Scene:
    """A wall that fills the picture, seen at a right angle by a camera on the z axis that looks towards -z."""
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 40, "film": film,
              "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}  # fmt: skip
    return mi.load_dict({
        "type": "scene", "camera": camera, "light": {"type": "constant"},
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": bsdf}, **further,
    })  # fmt: skip


DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}}
#: A diffuse wall behind the camera, which a mirror in front of it shows.
BEHIND = {"type": "rectangle", "bsdf": DIFFUSE,
          "to_world": mi.ScalarTransform4f().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]).scale(20)}  # fmt: skip


@pytest.mark.parametrize("bsdf, albedo", [
    (DIFFUSE, [0.2, 0.5, 0.8]),
    ({"type": "twosided", "bsdf": DIFFUSE}, [0.2, 0.5, 0.8]),
    ({"type": "mask", "opacity": 0.999, "bsdf": DIFFUSE}, [0.2, 0.5, 0.8]),
    ({"type": "roughconductor", "alpha": 0.3, "material": "none",
      "specular_reflectance": {"type": "rgb", "value": [0.9, 0.6, 0.3]}}, [0.9, 0.6, 0.3]),
    ({"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": [1.0, 0.5, 0.5]}},
     [0.2, 0.25, 0.4]),
    ({"type": "null"}, [0, 0, 0]),
])  # fmt: skip
def test_guides_hold_the_reflectance_of_what_a_pixel_shows(bsdf, albedo, unfiltered):
    found = mi_neural.guides(wall(bsdf, behind=BEHIND))
    assert found.albedo.shape == (SIZE, SIZE, 3) and not found.clean
    np.testing.assert_allclose(found.albedo.mean(axis=(0, 1)), albedo, atol=0.06, err_msg="rough metal loses a little")
    assert found.albedo.max() <= 1
    expected = {"conductor": [0, 0, -1], "null": [0, 0, 0]}.get(bsdf["type"], [0, 0, 1])
    np.testing.assert_allclose(found.normal.mean(axis=(0, 1)), expected, atol=0.02)


def test_guides_leave_the_samples_of_the_sensor_as_they_are():
    scene = wall(DIFFUSE)
    sampler = scene.sensors()[0].sampler()
    before = sampler.sample_count()
    mi_neural.guides(scene)
    assert sampler.sample_count() == before != guides_module.GUIDE_SPP


@needs_denoiser
def test_guides_of_a_blurred_view_are_filtered():
    """A lens that is out of focus: the noise of the guides is removed, or it would be taken for texture."""
    checker = {"type": "diffuse", "reflectance": {"type": "checkerboard",
                                                  "to_uv": mi.ScalarTransform4f().scale([8, 8, 1])}}  # fmt: skip
    film = {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}}
    lens = {"type": "thinlens", "fov": 40, "aperture_radius": 0.3, "focus_distance": 1.5, "film": film,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}  # fmt: skip
    scene = wall(checker, camera=lens)
    found = mi_neural.guides(scene)
    exact, noisy = (_rendered(scene, spp) for spp in (1024, guides_module.GUIDE_SPP))
    assert found.clean
    assert np.std(found.albedo - exact) < 0.6 * np.std(noisy - exact)


def _rendered(scene, spp: int) -> np.ndarray:
    """Albedo with its noise."""
    integrator = guides_module._integrator()
    return np.array(integrator.render(scene, scene.sensors()[0], seed=3, spp=spp))[..., -6:-3]


@needs_denoiser
def test_denoised_images_are_nearer_to_the_truth_than_with_the_guides_of_aov():
    """Fixed seeds. Of five seeds the ratio was 0.80 to 0.83 at 128x72, and 0.98 to 1.07 in a scene without mirrors."""
    scene = mi.load_file(str(scenes.path("glossy_hall")), resx=96, resy=54)
    path = mi.load_dict({"type": "path", "max_depth": 8})
    passes = np.array([mi.render(scene, integrator=path, spp=32, seed=10 + k) for k in range(8)])
    exact, variance = passes.mean(axis=0), passes.var(axis=0, ddof=1) / len(passes)
    noisy = mi.render(scene, integrator=path, spp=16, seed=2)
    clean = mi_neural.denoise(noisy, scene)
    assert isinstance(clean, mi.TensorXf) and clean.shape == noisy.shape
    aov = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
    guides = np.array(mi.render(scene, integrator=aov, spp=16, seed=3))[..., -6:]
    before = oidn.denoise(np.array(noisy), guides[..., :3].clip(0, 1).copy(), guides[..., 3:].clip(-1, 1).copy())
    error = [metrics.relmse_trimmed(i, exact, variance) for i in (np.array(clean), before, np.array(noisy))]
    print(f"errors {error}")
    assert error[0] < 0.9 * error[1] and error[1] < 0.5 * error[2]


@needs_denoiser
def test_images_of_any_kind_can_be_denoised():
    scene = wall(DIFFUSE)
    rng = np.random.default_rng(1)
    image = rng.uniform(0, 1, (SIZE, SIZE, 4)).astype(np.float32)
    with_alpha = np.array(mi_neural.denoise(image, scene, sensor=scene.sensors()[0]))
    np.testing.assert_array_equal(with_alpha[..., 3], image[..., 3])
    plain = np.array(mi_neural.denoise(mi.Bitmap(image[..., :3]), scene))
    np.testing.assert_array_equal(plain, with_alpha[..., :3])
    assert plain.std() < 0.5 * image[..., :3].std()
    guides = mi_neural.guides(scene)
    np.testing.assert_array_equal(np.array(guides.denoise(mi.TensorXf(image[..., :3].copy()))), plain)


@needs_denoiser
@pytest.mark.parametrize("shape, message", [
    ((SIZE, SIZE, 6), r"pass image\[..., :3\]"),
    ((SIZE, SIZE), "takes .height, width, 3."),
    ((SIZE, SIZE + 1, 3), f"the image has {SIZE + 1}x{SIZE} pixels, the film of the sensor {SIZE}x{SIZE}"),
])  # fmt: skip
def test_images_that_cannot_be_denoised_say_why(shape, message):
    with pytest.raises(ValueError, match=message):
        mi_neural.denoise(np.zeros(shape, np.float32), wall(DIFFUSE))


def test_denoise_says_what_to_type_where_the_denoiser_is_missing(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mitsuba_oidn", None)
    with pytest.raises(ImportError, match=r"pip install 'mi_neural\[denoise\]'"):
        mi_neural.denoise(np.zeros((SIZE, SIZE, 3)), wall(DIFFUSE))
