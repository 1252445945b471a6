"""Pictures of the guides: ``python -m mi_neural.manual.figures [FOLDER]``."""

from __future__ import annotations

import sys
from pathlib import Path

from mi_neural.bench.terminal import DEFAULT_VARIANT, set_variant
from mi_neural.image import exr

#: Pixel of the Cornell box (256x256) whose hemisphere is shown, training frames, paths a direction.
PIXEL, FRAMES, PATHS = (60, 120), 300, 256


def hemisphere(path: Path) -> None:
    """Incident light at a point: by the incident cache, by the outgoing cache, path-traced."""
    from mi_neural.bench.load import IntegratorSpec, build_integrator, load_scene
    from mi_neural.explore import pictures, views

    scene = load_scene("cornell_box").scene
    shown = []
    for name in ("nirc", "nrc"):
        integrator, _ = build_integrator(IntegratorSpec(name))
        integrator.train(scene, FRAMES)
        view = views.Hemisphere(scene, integrator, PIXEL, size=96)
        shown.append(view.predicted())
    for _ in range(PATHS // 16):
        view.add(16)
    shown.append(view.traced)
    exposure = exr.automatic_exposure(view.traced[view.traced.sum(axis=-1) > 0][None])
    exr.write_bytes(path, pictures.side_by_side(shown, exposure, zoom=2))


def main(folder: str | None = None) -> None:
    set_variant(DEFAULT_VARIANT)
    target = Path(folder) if folder else Path(__file__).resolve().parent
    hemisphere(target / "hemisphere.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
