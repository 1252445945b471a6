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
    from mi_neural.bench.load import load_scene
    from mi_neural.bench.specs import IntegratorSpec, build_integrator
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


#: Size of an image of the lamps, samples a pixel of each; and of the light that rays find.
LAMPS, SAMPLES, TRUTH = (192, 128), 256, 4096


def lamp_room():
    """A room with two lamps that Mitsuba 3.9.1 samples wrong: a cube with a picture, and a mesh with bent normals."""
    import mitsuba as mi
    import numpy as np

    T = mi.ScalarTransform4f
    stripes = np.where(np.arange(8)[None, :, None] % 4 == 0, [6.0, 3.0, 1.0], [0.02, 0.02, 0.05]).astype(np.float32)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(stripes), "raw": True, "filter_type": "nearest"}
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    props = mi.Properties()
    props["emitter"] = mi.load_dict({"type": "area", "radiance": {"type": "rgb", "value": [2.0, 4.0, 8.0]}})
    props["bsdf"] = mi.load_dict(black)
    bent = mi.Mesh("bent", 4, 2, has_vertex_normals=True, props=props)
    params = mi.traverse(bent)
    params["vertex_positions"] = [0.5, 0.2, -0.3, 0.5, 0.7, -0.3, 0.9, 0.7, -0.3, 0.9, 0.2, -0.3]
    params["vertex_normals"] = [-0.8, 0.0, 0.6] * 4
    params["faces"] = [0, 2, 1, 0, 3, 2]
    params.update()

    def wall(at, axis, angle):
        place = T().translate(at).rotate(axis, angle).scale(1.5)
        return {"type": "rectangle", "to_world": place, "bsdf": grey}

    film = {"type": "hdrfilm", "width": LAMPS[0], "height": LAMPS[1], "rfilter": {"type": "box"}}
    look = T().look_at([0, 0.2, 3.2], [0, -0.1, 0], [0, 1, 0])
    cube = T().translate([-0.6, 0.1, 0]).rotate([0, 1, 0], 30).scale(0.22)
    return mi.load_dict({
        "type": "scene", "sensor": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
        "floor": wall([0, -1, 0], [1, 0, 0], -90), "back": wall([0, 0, -1], [1, 0, 0], 0),
        "left": wall([-1.5, 0, 0], [0, 1, 0], 90), "right": wall([1.5, 0, 0], [0, 1, 0], -90), "bent": bent,
        "cube": {"type": "cube", "to_world": cube, "bsdf": black, "emitter": {"type": "area", "radiance": picture}},
    })  # fmt: skip


def lamps(path: Path) -> None:
    """Lamps that `path` samples wrong: by it, by `plain_path`, and by rays alone, which meet them by chance."""
    import mitsuba as mi
    import numpy as np

    scene = lamp_room()
    integrators = (
        ({"type": "path", "max_depth": 2}, SAMPLES), ({"type": "plain_path", "max_depth": 2}, SAMPLES),
        ({"type": "direct", "emitter_samples": 0, "bsdf_samples": 16}, TRUTH // 16),
    )  # fmt: skip
    images = [np.array(mi.render(scene, integrator=mi.load_dict(i), spp=spp)) for i, spp in integrators]
    for (integrator, _), image in zip(integrators, images, strict=True):
        print(f"{integrator['type']}: mean {image.mean():.4f}, {image.mean() / images[-1].mean() - 1:+.1%}")
    gap = np.ones((LAMPS[1], 4, 3), np.float32)
    rgb8 = exr.to_srgb8(np.hstack([images[0], gap, images[1], gap, images[2]]), 1.0)
    exr.write_bytes(path, exr.png_bytes(rgb8))


def main(folder: str | None = None) -> None:
    set_variant(DEFAULT_VARIANT)
    target = Path(folder) if folder else Path(__file__).resolve().parent
    hemisphere(target / "hemisphere.png")
    lamps(target / "lamps.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
