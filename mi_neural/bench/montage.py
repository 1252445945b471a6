"""Pictures side by side: ``python -m mi_neural.bench.montage OUT.png A.png B.png ...`` (two to a row)."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

#: White pixels between pictures.
GAP = 4


def montage(images: list[np.ndarray], per_row: int = 2) -> np.ndarray:
    """Images of equal shape (height, width, 3), uint8, in rows of `per_row`, white where none is left."""
    shapes = {i.shape for i in images}
    if len(shapes) != 1:
        raise ValueError(f"pictures of different sizes cannot stand side by side: {sorted(shapes)}")
    height, width, _ = images[0].shape
    rows = -(-len(images) // per_row)
    sheet = np.full((rows * (height + GAP) - GAP, per_row * (width + GAP) - GAP, 3), 255, np.uint8)
    for n, image in enumerate(images):
        y, x = (n // per_row) * (height + GAP), (n % per_row) * (width + GAP)
        sheet[y : y + height, x : x + width] = image
    return sheet


def main(arguments: list[str]) -> int:
    """The command: output file first, then the pictures."""
    import mitsuba as mi

    if len(arguments) < 2:
        print(__doc__, file=sys.stderr)
        return 2
    mi.set_variant("llvm_ad_rgb")
    output, *inputs = arguments
    rgb8 = (mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True)
    mi.Bitmap(montage([np.array(mi.Bitmap(i).convert(*rgb8)) for i in inputs])).write(str(Path(output)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
