"""A scene of many lamps behind partitions, to compare light samplers on: ``python studies/many_lamps.py N FILE.xml``.

A hall of square bays, ten small coloured lamps in each: half of them hang below the tops of the partitions and shine
down, half stand on the floor and shine to one side. The partitions hide most lamps from any place. The camera looks
down on the bays from a corner. Lamps differ in power by a factor of 16. The same N gives the same file. With ``--fog
EXTINCTION`` (per metre; a bay is 4 m wide) the hall is full of fog that scatters nine tenths of what it takes.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

#: Metres: width of a bay; height of the ceiling, of the partitions, and of the lamps that hang.
BAY, HEIGHT, PARTITION, HANGING = 4.0, 8.0, 2.4, 2.0
LAMPS_IN_A_BAY = 10

HEAD = """<!-- {n} lamps in {side} x {side} bays; made by: python studies/many_lamps.py {n} FILE.xml{options} -->
<scene version="3.0.0">
    <default name="resx" value="320"/>
    <default name="resy" value="180"/>
    <default name="spp" value="16"/>
    <default name="max_depth" value="64"/>
    <integrator type="path"> <integer name="max_depth" value="$max_depth"/> </integrator>
    <sensor type="perspective">
        <float name="fov" value="70"/>
        <transform name="to_world">
            <lookat origin="{eye}, {eye}, 7.5" target="{seen}, {seen}, 0" up="0, 0, 1"/>
        </transform>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="box"/>
        </film>{seen_through}
    </sensor>
    <bsdf type="twosided" id="plaster">
        <bsdf type="diffuse"> <rgb name="reflectance" value="0.6, 0.58, 0.55"/> </bsdf>
    </bsdf>
    <bsdf type="twosided" id="floor_paint">
        <bsdf type="roughplastic">
            <float name="alpha" value="0.2"/>
            <rgb name="diffuse_reflectance" value="0.3, 0.32, 0.35"/>
        </bsdf>
    </bsdf>
    <bsdf type="diffuse" id="black"> <rgb name="reflectance" value="0, 0, 0"/> </bsdf>
"""

FOG = """    <medium type="homogeneous" id="fog">
        <float name="scale" value="{extinction:g}"/>
        <rgb name="albedo" value="0.9, 0.9, 0.9"/>
        <phase type="hg"> <float name="g" value="0.4"/> </phase>
    </medium>
"""
HULL = """    <shape type="cube" id="hull">
        <transform name="to_world"> <scale value="{half}, {half}, {half}"/> </transform>
        <bsdf type="null"/>
        <ref name="interior" id="fog"/>
    </shape>
"""


def rectangle(matrix: np.ndarray, bsdf: str, radiance=None) -> str:
    """A rectangle with that 4x4 ``to_world``; where it has a radiance it shines along its normal."""
    values = " ".join(f"{v:.6g}" for v in matrix.ravel())
    light = ""
    if radiance is not None:
        colour = ", ".join(f"{v:.5g}" for v in radiance)
        light = f'<emitter type="area"> <rgb name="radiance" value="{colour}"/> </emitter>'
    return (
        f'    <shape type="rectangle"> <transform name="to_world"> <matrix value="{values}"/> </transform> '
        f'<ref id="{bsdf}"/> {light}</shape>\n'
    )


def placed(center, along, across) -> np.ndarray:
    """``to_world`` of a rectangle by its centre and the halves of its edges; its normal is their cross product."""
    along, across = np.asarray(along, float), np.asarray(across, float)
    normal = np.cross(along, across)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = along, across, normal / np.linalg.norm(normal)
    matrix[:3, 3] = center
    return matrix


def scene_xml(n: int, extinction: float = 0.0) -> str:
    """The scene of `n` lamps as text, in fog where it has an `extinction`."""
    rng = np.random.default_rng(n)
    side = max(1, int(np.ceil(np.sqrt(n / LAMPS_IN_A_BAY))))
    half = side * BAY / 2
    seen_through = ' <ref name="medium" id="fog"/>' if extinction else ""
    head = HEAD.format(n=n, side=side, eye=f"{half - 0.5:.6g}", seen=f"{half - 7:.6g}", seen_through=seen_through,
                       options=f" --fog {extinction:g}" if extinction else "")  # fmt: skip
    if extinction:
        first = head.index("    <sensor")
        head = head[:first] + FOG.format(extinction=extinction) + head[first:] + HULL.format(half=f"{half + HEIGHT:g}")
    text = [head]
    text += [
        rectangle(placed([0, 0, 0], [half, 0, 0], [0, half, 0]), "floor_paint"),
        rectangle(placed([0, 0, HEIGHT], [half, 0, 0], [0, -half, 0]), "plaster"),
    ]
    for s in (-1, 1):
        text.append(rectangle(placed([s * half, 0, HEIGHT / 2], [0, half, 0], [0, 0, HEIGHT / 2]), "plaster"))
        text.append(rectangle(placed([0, s * half, HEIGHT / 2], [half, 0, 0], [0, 0, HEIGHT / 2]), "plaster"))
    up = [0, 0, PARTITION / 2]
    for i in range(1, side):
        for j in range(side):  # a passage of a quarter of a bay at each partition
            x, y = i * BAY - half, (j + 0.375) * BAY - half
            text.append(rectangle(placed([x, y, PARTITION / 2], [0, 0.375 * BAY, 0], up), "plaster"))
            text.append(rectangle(placed([y, x, PARTITION / 2], [0.375 * BAY, 0, 0], up), "plaster"))
    for k in range(n):
        bay = k // LAMPS_IN_A_BAY
        corner = np.array([bay % side, bay // side]) * BAY - half
        x, y = corner + rng.uniform(0.2, 0.8, 2) * BAY
        size, angle = 0.05, rng.uniform(0, 2 * np.pi)
        sideways = np.array([np.cos(angle), np.sin(angle), 0])
        if k % 2:
            matrix = placed([x, y, HANGING], [size, 0, 0], [0, -size, 0])
        else:
            matrix = placed([x, y, rng.uniform(0.4, 1.4)], size * sideways, [0, 0, size])
        colour = rng.uniform(0.4, 1, 3)
        text.append(rectangle(matrix, "black", colour * 40 * 4 ** rng.uniform(-1, 1)))
    return "".join([*text, "</scene>\n"])


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("lamps", type=int, help="how many")
    parser.add_argument("file", type=Path, help="scene file to write")
    parser.add_argument("--fog", type=float, default=0.0, metavar="EXTINCTION", help="per metre")
    args = parser.parse_args(argv)
    if args.lamps < 1:
        parser.error(f"lamps is {args.lamps}; give 1 or more")
    if args.file.suffix != ".xml":
        parser.error(f"{args.file} does not end in .xml; scene files do")
    if not args.fog >= 0:
        parser.error(f"--fog is {args.fog}; give 0 or more")
    args.file.parent.mkdir(parents=True, exist_ok=True)
    args.file.write_text(scene_xml(args.lamps, args.fog))
    return 0


if __name__ == "__main__":
    sys.exit(main())
