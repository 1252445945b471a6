"""Images come back as they were written, whole or not at all."""

import io
import os

import numpy as np
import pytest
from matplotlib.image import imread

from mi_neural.bench import terminal
from mi_neural.caches import files
from mi_neural.image import exr


@pytest.fixture
def rgb(rng) -> np.ndarray:
    return rng.random((6, 9, 3)).astype(np.float32)


def test_round_trip(tmp_path, rgb):
    channels = {"weight": rgb[..., 0] * 2, **exr.layer_channels("variance", rgb**2)}
    metadata = {"spp": 16, "seconds": 0.5, "scene": "a", "keys": {"a": 1}, "flag": True, "none": None, "big": 2**40}
    exr.write(tmp_path / "a.exr", rgb, channels, metadata)
    image = exr.read(tmp_path / "a.exr")
    assert np.array_equal(image.rgb, rgb) and image.size == (9, 6)
    assert np.array_equal(image.channels["weight"], rgb[..., 0] * 2)
    assert np.array_equal(image.layer("variance"), rgb**2)
    assert image.layer("nothing") is None
    assert image.metadata == {
        "spp": 16,
        "seconds": 0.5,
        "scene": "a",
        "keys": '{"a": 1}',
        "flag": "true",
        "big": str(2**40),
    }


def test_half_keeps_three_digits_and_halves_the_file(tmp_path, rng):
    rgb = rng.random((64, 64, 3)).astype(np.float32)
    exr.write(tmp_path / "half.exr", rgb, half=True)
    exr.write(tmp_path / "float.exr", rgb)
    assert np.allclose(exr.read(tmp_path / "half.exr").rgb, rgb, rtol=1e-3)
    assert (tmp_path / "half.exr").stat().st_size < 0.7 * (tmp_path / "float.exr").stat().st_size


def test_nonfinite_values_survive(tmp_path, rgb):
    rgb[0, 0], rgb[1, 1] = np.nan, np.inf
    exr.write(tmp_path / "a.exr", rgb)
    assert np.array_equal(exr.read(tmp_path / "a.exr").rgb, rgb, equal_nan=True)


def test_references_of_the_well_known_scenes_are_read(shared_scenes):
    image = exr.read(shared_scenes / "cornell-box" / "reference_256x256.exr")
    assert image.size == (256, 256)
    assert image.layer("variance").shape == (256, 256, 3) and (image.layer("variance") >= 0).all()
    assert int(image.metadata["spp"]) > 1000 and image.metadata["integrator"] == "path"


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    path = tmp_path / "a.txt"
    exr.write_text(path, "old")
    with pytest.raises(RuntimeError), exr.replacing(path) as temporary:
        temporary.write_text("half of the new")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_no_file_is_written_to_and_not_replaced(tmp_path):
    """As `root` a file took the place of ``/dev/null``."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        exr.write_text(pipe, "all of it")
        assert os.read(reader, 100) == b"all of it" and pipe.is_fifo() and os.listdir(tmp_path) == ["pipe"]
    finally:
        os.close(reader)


def test_a_link_stays_one_and_what_it_leads_to_is_replaced(tmp_path):
    (tmp_path / "link.txt").symlink_to("of/file.txt")
    (tmp_path / "of").mkdir()
    for text in ("new", "newer"):
        exr.write_text(tmp_path / "link.txt", text)
        assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "of" / "file.txt").read_text() == text
@pytest.mark.skipif(not os.path.exists("/dev/null"), reason="no /dev/null")
def test_devices_and_links_are_written_to_and_not_replaced(tmp_path, rgb):
    """As root, ``--json /dev/null`` made a file of the device, and every program of the machine failed after that."""
    device, link, target = (tmp_path / name for name in ("null.exr", "link.txt", "target.txt"))
    device.symlink_to("/dev/null")
    link.symlink_to(target)
    exr.write(device, rgb)
    exr.write_text(link, "new")
    files.write(device, "incident", {}, {"a": rgb})
    assert device.is_symlink() and device.is_char_device() and link.is_symlink() and target.read_text() == "new"
    terminal.require_writable(device)
    assert sorted(tmp_path.iterdir()) == [link, device, target]


def test_bad_input_is_refused(tmp_path, rgb):
    path = tmp_path / "a.exr"
    with pytest.raises(ValueError, match="expected \\(height, width, 3\\)"):
        exr.write(path, rgb[..., 0])
    with pytest.raises(ValueError, match="'w' has shape"):
        exr.write(path, rgb, {"w": np.ones((2, 2))})
    with pytest.raises(ValueError, match="appears twice"):
        exr.write(path, rgb, {"R": rgb[..., 0]})
    with pytest.raises(ValueError, match="name of the EXR format"):
        exr.write(path, rgb, metadata={"compression": "x"})
    with pytest.raises(OSError):
        exr.write(tmp_path / "no" / "a.exr", rgb)
    with pytest.raises(FileNotFoundError, match="no such image"):
        exr.read(path)
    path.write_text("no image")
    with pytest.raises(ValueError, match="not a readable EXR"):
        exr.read(path)
    with pytest.raises(ValueError, match="expected uint8"):
        exr.png_bytes(rgb)


def test_png_is_srgb_after_exposure(tmp_path, rgb):
    rgb[0, 0] = np.nan
    exr.write_png(tmp_path / "a.png", rgb, exposure=-1.0)
    pixels = np.round(imread(tmp_path / "a.png") * 255).astype(int)
    assert np.array_equal(pixels, exr.to_srgb8(rgb, -1.0))
    assert (pixels[0, 0] == 0).all()
    expected = 255 * (1.055 * (0.5 * rgb[1, 1]) ** (1 / 2.4) - 0.055)
    assert np.allclose(pixels[1, 1], expected, atol=0.51)


def test_png_of_any_bytes(rng):
    pixels = rng.integers(0, 256, (5, 7, 3), np.uint8)
    assert np.array_equal(np.round(imread(io.BytesIO(exr.png_bytes(pixels))) * 255), pixels)


def test_automatic_exposure():
    assert exr.automatic_exposure(np.full((2, 2, 3), 0.18)) == pytest.approx(0.0, abs=1e-4)
    assert exr.automatic_exposure(np.full((2, 2, 3), 0.72)) == pytest.approx(-2.0, abs=1e-4)
    assert exr.automatic_exposure(np.zeros((2, 2, 3))) == 0.0
