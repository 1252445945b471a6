"""Scenes that entries make themselves: foliage, and a hall with tens of thousands of lamps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

HEAD = """<scene version="3.0.0">
    <default name="resx" value="320"/> <default name="resy" value="180"/>
    <default name="spp" value="16"/> <default name="max_depth" value="{depth}"/>
    <integrator type="path"> <integer name="max_depth" value="$max_depth"/> </integrator>
    <sensor type="perspective">
        <float name="fov" value="{fov}"/>
        <transform name="to_world"> <lookat origin="{eye}" target="{seen}" up="0, 0, 1"/> </transform>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resx"/> <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/> <rfilter type="box"/>
        </film>
    </sensor>
"""


def foliage(folder: Path, leaves: int = 6000) -> Path:
    """A crown of single `leaves` over a floor, in the light of the sun and the sky; without leaves a smooth ball of
    the same size and colour. Returns the scene file."""
    name = "foliage" if leaves else "ball"
    text = [HEAD.format(depth=16, fov=56, eye="0, -6, 2.4", seen="0, 0, 1.9")]
    text.append(f'    <shape type="rectangle"> <transform name="to_world"> <scale value="8"/> </transform> '
                f"{_diffuse('0.45, 0.4, 0.35')} </shape>\n")  # fmt: skip
    green = _diffuse("0.25, 0.5, 0.12")
    if leaves:
        rng = np.random.default_rng(7)
        at = rng.normal(size=(leaves, 3))
        at *= 1.3 * rng.random((leaves, 1)) ** (1 / 3) / np.linalg.norm(at, axis=1, keepdims=True)
        at[:, 2] += 1.8
        _write_squares(folder / "leaves.ply", at, rng.normal(size=(leaves, 3)), 0.05, rng)
        text.append(f'    <shape type="ply"> <string name="filename" value="leaves.ply"/> {green} </shape>\n')
    else:
        text.append(f'    <shape type="sphere"> <point name="center" value="0, 0, 1.8"/> '
                    f'<float name="radius" value="1.3"/> {green} </shape>\n')  # fmt: skip
    text.append('    <emitter type="directional"> <vector name="direction" value="0.5, 0.4, -1"/> '
                '<rgb name="irradiance" value="6, 5.5, 5"/> </emitter>\n')  # fmt: skip
    text.append('    <emitter type="constant"> <rgb name="radiance" value="0.4, 0.5, 0.7"/> </emitter>\n</scene>\n')
    return _write(folder / f"{name}.xml", text)


def hall_of_lamps(folder: Path, lamps: int = 30_000, bays: int = 12) -> Path:
    """A hall of `bays` x `bays` bays behind partitions, in it so many square lamps of random heights, directions and
    colours, two triangles each, in eight meshes. Returns the scene file."""
    rng = np.random.default_rng(3)
    half, wall = bays / 2, 0.75
    text = [HEAD.format(depth=2, fov=75, eye=f"{-half + 0.4:g}, {-half + 0.4:g}, 1.9", seen="0, 0, 0")]
    grey = _diffuse("0.6, 0.6, 0.6")

    def rectangle(values) -> None:
        matrix = np.eye(4)
        matrix[:3, :4] = np.array(values, float).T
        numbers = " ".join(f"{v:g}" for v in matrix.ravel())
        text.append(f'    <shape type="rectangle"> <transform name="to_world"> <matrix value="{numbers}"/> '
                    f"</transform> {grey} </shape>\n")  # fmt: skip

    rectangle([[half, 0, 0], [0, half, 0], [0, 0, 1], [0, 0, 0]])
    for i in range(bays + 1):
        for j in range(bays):  # each partition leaves a quarter of its bay open
            x, y = i - half, j - half + 0.375
            rectangle([[0, 0.375, 0], [0, 0, wall / 2], [1, 0, 0], [x, y, wall / 2]])
            rectangle([[0.375, 0, 0], [0, 0, wall / 2], [0, 1, 0], [y, x, wall / 2]])
    n = lamps // 8
    for k in range(8):
        at = np.column_stack([rng.uniform(-half, half, (n, 2)), rng.uniform(0.05, 0.7, n)])
        _write_squares(folder / f"lamps_{k}.ply", at, rng.normal(size=(n, 3)) - [0, 0, 0.7], 0.003, rng)
        colour = ", ".join(f"{v:.3g}" for v in 300 * 4.0 ** rng.uniform(-1, 1) * rng.uniform(0.3, 1, 3))
        text.append(f'    <shape type="ply"> <string name="filename" value="lamps_{k}.ply"/> {_diffuse("0, 0, 0")} '
                    f'<emitter type="area"> <rgb name="radiance" value="{colour}"/> </emitter> </shape>\n')  # fmt: skip
    return _write(folder / f"hall_{2 * 8 * n}.xml", [*text, "</scene>\n"])


def _diffuse(colour: str) -> str:
    return (f'<bsdf type="twosided"> <bsdf type="diffuse"> <rgb name="reflectance" value="{colour}"/> </bsdf> '
            "</bsdf>")  # fmt: skip


def _write(path: Path, text: list[str]) -> Path:
    path.write_text("".join(text), encoding="utf-8")
    return path


def _write_squares(path: Path, centers, normals, half: float, rng) -> None:
    """A PLY file of squares (two triangles each) of side ``2 half`` with these centres and normals, (n, 3)."""
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    along = np.cross(normals, rng.normal(size=normals.shape))
    along *= half / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(normals, along)
    corners = np.stack([centers + s * along + t * across for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1)
    first = 4 * np.arange(len(centers))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    faces = np.empty(2 * len(centers), [("n", "u1"), ("index", "<i4", 3)])
    faces["n"], faces["index"] = 3, first.reshape(-1, 3)
    head = (f"ply\nformat binary_little_endian 1.0\nelement vertex {4 * len(centers)}\nproperty float x\n"
            f"property float y\nproperty float z\nelement face {len(faces)}\n"
            "property list uchar int vertex_indices\nend_header\n")  # fmt: skip
    path.write_bytes(head.encode() + corners.astype("<f4").tobytes() + faces.tobytes())
