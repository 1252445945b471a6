"""Images in and out: EXR with named channels and metadata, PNG for looking at.

Files appear whole or not at all: each is written under a temporary name in its own folder and then renamed.
"""

from __future__ import annotations

import json
import os
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

#: Header attributes that belong to the EXR format and cannot carry metadata.
RESERVED = frozenset(
    "channels chunkCount compression dataWindow displayWindow lineOrder maxSamplesPerPixel name pixelAspectRatio "
    "screenWindowCenter screenWindowWidth tiles type version view".split()
)
#: Mean luminance of a picture shown at its automatic exposure, before the sRGB curve.
MIDDLE_GREY = 0.18


@dataclass
class Image:
    """A picture, its further channels and its metadata.

    rgb       float32, shape (height, width, 3), linear; a file with one grey channel `Y` is repeated to three
    channels  every other channel by its name in the file, float32, shape (height, width)
    metadata  header attributes that are not part of the format: str, int or float
    """

    rgb: np.ndarray
    channels: dict[str, np.ndarray] = field(default_factory=dict)
    metadata: dict[str, str | int | float] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.rgb.shape[1], self.rgb.shape[0]

    def layer(self, name: str) -> np.ndarray | None:
        """The channels `name.R`, `name.G`, `name.B` as one array of shape (height, width, 3), or None without them."""
        parts = [self.channels.get(f"{name}.{c}") for c in "RGB"]
        return None if any(p is None for p in parts) else np.stack(parts, axis=-1)


def layer_channels(name: str, rgb: np.ndarray) -> dict[str, np.ndarray]:
    """The inverse of :meth:`Image.layer`: a dictionary to hand to :func:`write`."""
    return {f"{name}.{c}": rgb[..., k] for k, c in enumerate("RGB")}


def write(
    path: str | os.PathLike,
    image: np.ndarray,
    channels: dict[str, np.ndarray] | None = None,
    metadata: dict[str, object] | None = None,
    half: bool = False,
) -> None:
    """Write linear RGB of shape (height, width, 3) as an EXR file, ZIP compressed, 32 bit or `half`.

    `channels` are further channels of shape (height, width) under any name (`variance.R`). `metadata` values become
    header attributes: str, int and float as they are, None is left out, anything else as JSON text.

    Raises ``ValueError`` for wrong shapes or a reserved name, ``OSError`` where the file cannot be written.
    """
    import OpenEXR

    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"image has shape {image.shape}, expected (height, width, 3) with at least one pixel")
    dtype = np.float16 if half else np.float32

    pixels = {"R": image[..., 0], "G": image[..., 1], "B": image[..., 2]}
    for name, values in (channels or {}).items():
        if name in pixels:
            raise ValueError(f"channel {name!r} appears twice")
        if np.shape(values) != image.shape[:2]:
            raise ValueError(f"channel {name!r} has shape {np.shape(values)}, the image {image.shape[:2]}")
        pixels[name] = values

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for name, value in (metadata or {}).items():
        if name in RESERVED:
            raise ValueError(f"metadata {name!r} is a name of the EXR format: choose another")
        if value is not None:
            header[name] = _attribute(value)

    with np.errstate(over="ignore"):  # half: too large becomes infinite, as the format has it
        pixels = {name: np.ascontiguousarray(values, dtype) for name, values in pixels.items()}
    with replacing(path) as temporary:
        try:
            OpenEXR.File(header, pixels).write(str(temporary))
        except RuntimeError as error:  # what the library makes of a full disk
            raise OSError(f"cannot write {path}: {error}") from None


def read(path: str | os.PathLike) -> Image:
    """Read an EXR file with channels R, G, B (or Y) and any others.

    Raises ``FileNotFoundError`` where there is none, ``ValueError`` for a file that is no EXR image or has no colour.
    """
    import OpenEXR

    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no such image: {path}")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            pixels = {name: np.array(c.pixels, np.float32) for name, c in file.channels().items()}
            header = dict(file.header())
    except Exception as error:  # the library raises plain RuntimeError and others
        raise ValueError(f"{path} is not a readable EXR image: {error}") from None

    if {"R", "G", "B"} <= pixels.keys():
        rgb = np.stack([pixels.pop(c) for c in "RGB"], axis=-1)
    elif "Y" in pixels:
        rgb = np.repeat(pixels.pop("Y")[..., None], 3, axis=-1)
    else:
        raise ValueError(f"{path} has the channels {', '.join(pixels)}: R, G and B (or Y) are needed")
    metadata = {k: v for k, v in header.items() if k not in RESERVED and isinstance(v, (str, int, float))}
    return Image(rgb, pixels, metadata)


# ------------------------------------------------------------------------------------------------------------------


def automatic_exposure(rgb: np.ndarray) -> float:
    """Exposure in stops that puts the mean luminance of the finite pixels at middle grey; 0 for a black image."""
    from .metrics import luminance

    lum = luminance(rgb)
    mean = lum[np.isfinite(lum)].mean() if np.isfinite(lum).any() else 0.0
    return float(np.log2(MIDDLE_GREY / mean)) if mean > 0.0 else 0.0


def to_srgb8(rgb: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Linear RGB times 2^exposure, clipped to [0, 1], through the sRGB curve, as uint8. Non-finite values become 0."""
    linear = np.nan_to_num(np.asarray(rgb, np.float64) * 2.0**exposure, nan=0.0, posinf=0.0, neginf=0.0).clip(0.0, 1.0)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.round(srgb * 255.0).astype(np.uint8)


def png_bytes(rgb8: np.ndarray) -> bytes:
    """Encode uint8 RGB of shape (height, width, 3) as PNG."""
    import mitsuba as mi  # its Bitmap is the same in all variants, and there before one is chosen

    rgb8 = np.asarray(rgb8)
    if rgb8.dtype != np.uint8 or rgb8.ndim != 3 or rgb8.shape[2] != 3:
        raise ValueError(f"expected uint8 of shape (height, width, 3), got {rgb8.dtype} of shape {rgb8.shape}")
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(rgb8)).write(stream, mi.Bitmap.FileFormat.PNG)
    return stream.raw_buffer()


def write_png(path: str | os.PathLike, rgb: np.ndarray, exposure: float = 0.0) -> None:
    """Write linear RGB of shape (height, width, 3) as an 8-bit sRGB PNG after scaling by 2^exposure."""
    write_bytes(path, png_bytes(to_srgb8(rgb, exposure)))


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write a file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file whole or not at all, in UTF-8."""
    write_bytes(path, text.encode())


@contextmanager
def replacing(path: str | os.PathLike):
    """Hand out a temporary path beside `path`; on success it takes that name, on an exception it is removed.

    A link stays one, and its target is written. What is no file, as ``/dev/null`` or a pipe, is written to: to give its
    name to a file would destroy it.
    """
    path = Path(path)
    if special := is_special(path):
        folder = None
    else:
        path = path.resolve()
        folder = path.parent
    # A suffix of its own keeps what libraries derive from it; hidden, so that nobody takes it for a result
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=folder)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        if special:
            path.write_bytes(temporary.read_bytes())
            temporary.unlink()
            return
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def is_special(path: Path) -> bool:
    """Whether there is something of that name that is neither file nor folder: a device, a pipe."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _attribute(value: object) -> str | int | float:
    if isinstance(value, bool) or not isinstance(value, (str, int, float, np.integer, np.floating)):
        return json.dumps(value, default=str)
    if isinstance(value, (int, np.integer)):
        return int(value) if abs(int(value)) < 2**31 else str(value)
    if isinstance(value, (float, np.floating)):
        return float(value)
    return value
