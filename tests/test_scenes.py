"""The shipped scenes: they load, render, and show what is known about them."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_neural import scenes

NAMES = ["ajar_door", "cornell_box", "foggy_hall", "glossy_hall", "lamp_bays", "lit_cube", "point_lit_sphere"]
OBJECTS = "bsdf emitter integrator sensor shape".split()


def test_names_lists_the_shipped_scenes():
    assert scenes.names() == NAMES
    assert set(scenes.ANSWERS) <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_path_is_an_existing_absolute_file(name):
    file = scenes.path(name)
    assert isinstance(file, Path) and file.is_absolute() and file.is_file()


@pytest.mark.parametrize("name", ["ajar_dor", "", "ajar_door.xml", "../scenes/ajar_door"])
def test_unknown_name_raises_and_lists_the_known_ones(name):
    with pytest.raises(ValueError) as error:
        scenes.path(name)
    assert repr(name) in str(error.value) and all(n in str(error.value) for n in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_objects_have_unique_ids_and_references_meet_them(name):
    root = ET.parse(scenes.path(name)).getroot()
    ids = [e.get("id") for e in root.iter() if e.tag in OBJECTS[1:] and e.get("id")]
    assert len(ids) == len(set(ids))
    assert all(e.get("id") for e in root if e.tag in OBJECTS)
    assert all(e.get("id") for e in root.iter("emitter"))

    references = {e.get("id") for e in root.iter("ref")}
    named = {e.get("id") for e in (*root.findall("bsdf"), *root.findall("medium"))}
    assert references == named  # none unknown, none unused


@pytest.mark.parametrize("name", NAMES)
def test_scene_needs_no_other_file_and_takes_the_common_parameters(name):
    root = ET.parse(scenes.path(name)).getroot()
    assert [e.get("name") for e in root.findall("default")] == ["resx", "resy", "spp", "max_depth"]
    assert not [e for e in root.iter("string") if e.get("name") == "filename"]

    scene = mi.load_file(str(scenes.path(name)), resx=12, resy=7, spp=3, max_depth=5)
    sensor = scene.sensors()[0]
    assert list(sensor.film().size()) == [12, 7]
    assert sensor.sampler().sample_count() == 3
    assert re.search(r"max_depth = 5\b", str(scene.integrator()))


@pytest.mark.parametrize("name", ["ajar_door", "cornell_box", "foggy_hall", "glossy_hall", "lamp_bays"])
def test_renders_finite_and_well_exposed(name):
    image = np.array(mi.render(mi.load_file(str(scenes.path(name)), resx=64, resy=36, spp=64)))
    assert np.isfinite(image).all() and (image >= 0).all()
    print(f"{name}: mean {image.mean():.3f}")
    assert 0.15 < image.mean() < 0.8


def test_ajar_door_is_lit_indirectly():
    size = dict(resx=64, resy=36, spp=64)
    direct, full = (
        np.mean(mi.render(mi.load_file(str(scenes.path("ajar_door")), max_depth=depth, **size))) for depth in (2, 12)
    )
    print(f"direct light: {direct / full:.1e} of the image")
    assert direct < 0.01 * full


def test_ajar_door_lets_no_light_in_from_outside():
    """With its lamp off, and a bright sky put around it, the room must stay black: its walls have no cracks."""
    text = re.sub(r'<emitter type="area".*?</emitter>', "", scenes.path("ajar_door").read_text(), flags=re.S)
    sky = '<emitter type="constant"><float name="radiance" value="1e4"/></emitter>'
    scene = mi.load_string(text.replace("</scene>", f"{sky}</scene>"), resx=64, resy=36, spp=128)
    assert np.max(mi.render(scene)) == 0


# 14 images held to 4.5 standard errors each, and their 224 blocks to 5.5: a false alarm in about 3,000 choices of seed
@pytest.mark.parametrize("depth", [0, 1, 2, 3, 5, 16, -1])
@pytest.mark.parametrize("name", sorted(scenes.ANSWERS))
def test_path_gives_the_known_answer(name, depth):
    scene = mi.load_file(str(scenes.path(name)), resx=32, resy=32, spp=256, max_depth=depth)
    image = np.array(mi.render(scene, seed=1), dtype=np.float64).mean(axis=-1)
    known = scenes.ANSWERS[name](depth)

    # The answer holds in every pixel: test the whole image, and each block of 8x8 pixels (an edge hides in the mean)
    blocks = image.reshape(4, 8, 4, 8).swapaxes(1, 2).reshape(16, 64)
    for part, pixels, quantile in (("image", image.reshape(1, -1), 4.5), ("block", blocks, 5.5)):
        error = np.abs(pixels.mean(axis=1) - known)
        tolerance = quantile * pixels.std(axis=1, ddof=1) / np.sqrt(pixels.shape[1]) + 2e-6  # single precision
        worst = np.argmax(error / tolerance)
        print(f"{name}, depth {depth}, {part}: known {known:.6f}, off by {error[worst]:.1e} of {tolerance[worst]:.1e}")
        assert (error <= tolerance).all()
