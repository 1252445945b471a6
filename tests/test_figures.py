"""Figures for notebooks: what is drawn is what was given, and what cannot be drawn is refused."""

import io

import numpy as np
import pytest
from PIL import Image

from mi_neural.explore import figures


def pixels(drawing) -> np.ndarray:
    return np.array(Image.open(io.BytesIO(drawing.data("png"))).convert("RGB"))


def test_pictures_share_one_exposure(rng):
    """The last picture is at middle grey, and one half as bright comes out darker, by the sRGB curve of 2^-1."""
    grey = np.full((8, 8, 3), 0.7)
    shown = pixels(figures.pictures({"half": 0.5 * grey, "whole": grey}, width=4))
    values, counts = np.unique(shown[..., 0], return_counts=True)
    two = set(values[np.argsort(counts)[-3:]].tolist()) - {255}
    assert two == {118, 85}  # 0.18 and 0.09 through the curve


def test_a_notebook_shows_a_drawing(tmp_path, rng):
    drawing = figures.pictures({"a": rng.random((8, 12, 3))}, marks=[(3, 4)], disk=True, notes={"a": "below"})
    (kind, data), = drawing._repr_mimebundle_().items()
    assert kind == "image/jpeg" and data[:2] == b"\xff\xd8"
    drawing.save(tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    assert [text.get_text() for text in drawing.axes[0].texts] == ["1"]


def test_maps_have_one_scale(rng):
    drawing = figures.maps({"a": np.zeros((4, 6)), "b": np.full((4, 6), 3.0)}, notes={"a": "zero"}, label="metres")
    *places, bar = drawing.axes
    assert [axes.images[0].get_clim() for axes in places] == [(0.0, 3.0)] * 2
    assert bar.get_ylabel() == "metres" and places[0].get_title(loc="left") == "a\nzero"


def test_curves_are_what_was_given():
    lines = {"a": ([1, 2], [3, 4]), "b": ([1, 2], [5, 6], [1, 1])}
    axes = figures.curves(lines, log="xy", vertical={"here": 1.5}).axes[0]
    assert [line.get_label() for line in axes.lines] == ["a", "b", "here"]
    assert axes.lines[1].get_ydata().tolist() == [5, 6] and axes.get_xscale() == axes.get_yscale() == "log"


@pytest.mark.parametrize("draw", [figures.pictures, figures.maps])
def test_what_is_no_picture_is_refused(draw):
    for images in ({}, {"a": np.zeros(3)}, {"a": np.zeros((0, 4))}):
        with pytest.raises(ValueError, match=r"there is no|has shape"):
            draw(images)
