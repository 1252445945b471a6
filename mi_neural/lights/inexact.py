"""Area lights whose light Mitsuba 3.9.1 loses or invents in next-event estimation (`path`, `direct`).

Errors are measured against BSDF sampling alone (``direct`` with ``emitter_samples=0``). The light table samples all of
these by the area of their surface, which is exact.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from .. import parameters

#: A shading normal counts as bent where its cosine to the normal of its face is smaller.
BENT = 1 - 1e-4


def inexact(emitter) -> str:
    """What keeps Mitsuba from sampling an emitter exactly; empty where nothing does.

    - A picture on a mesh is sampled as if each point of the uv square were on the mesh once: -71 % of the light of a
      ``cube``. One ``rectangle`` is right.
    - The colours of a mesh attribute are read at the first face: -100 %.
    - The density of a point of a mesh is taken from its shading normal: -22 to +17 % where that is bent.
    - With an axis whose length is not 1, a rotation is no rotation, and the inverse that Mitsuba computes is not its
      inverse: normals of a rectangle are bent, and rays hit another disk or cylinder than is sampled. -3 % and more.
    - Points of a picture on a cylinder are sought along rays, some of which miss: -1 to -4 %. Of a stretched cylinder
      the area is wrong: -5 to +37 %. A mirrored one shines inwards: -100 %.
    """
    shape = emitter.get_shape()
    if shape is None or emitter.class_name() != "AreaLight":
        return ""
    kind = shape.class_name()
    if kind in ("Rectangle", "Disk", "Cylinder"):
        to_world = parameters.read(mi.traverse(shape), "to_world")
        matrix, normals = (np.array(m, np.float64).reshape(4, 4) for m in (to_world.matrix, to_world.inverse_transpose))
        if np.abs(matrix.T @ normals - np.eye(4)).max() > 1e-3:
            return "a rotation about an axis that is not of length 1"
        if kind != "Cylinder":
            return ""
        gram = matrix[:3, :3].T @ matrix[:3, :3]
        even = abs(gram[0, 0] - gram[1, 1]) <= 1e-4 * gram[0, 0]
        if not even or np.abs(gram - np.diag(np.diag(gram))).max() > 1e-4 * np.diag(gram).max():
            return "a stretched cylinder"
        if np.linalg.det(matrix) < 0:
            return "a mirrored cylinder"
        return "a picture on a cylinder" if _texture(emitter) else ""
    if not shape.is_mesh():
        return ""
    texture = _texture(emitter)
    if texture:
        return "a mesh attribute" if texture == "MeshAttribute" else "a picture on a mesh"
    return "a mesh with bent normals" if _bent(shape) else ""


def _texture(emitter) -> str:
    """Class of what makes the radiance differ from place to place, if anything does."""
    nodes = [node for node in parameters.traverse(emitter).hierarchy if isinstance(node, mi.Texture)]
    varying = [n.class_name() for n in nodes if n.is_spatially_varying() or n.class_name() == "MeshAttribute"]
    return "MeshAttribute" if "MeshAttribute" in varying else varying[0] if varying else ""


def _bent(mesh) -> bool:
    """Whether a mesh has shading normals that are not those of its faces."""
    params = mi.traverse(mesh)
    p, n, faces = (np.array(parameters.read(params, key)) for key in ("vertex_positions", "vertex_normals", "faces"))
    if n.size != p.size:
        return False
    p, n, faces = p.reshape(-1, 3).astype(np.float64), n.reshape(-1, 3).astype(np.float64), faces.reshape(-1, 3)
    a, b, c = (p[faces[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    size = np.linalg.norm(face, axis=1)
    cosines = np.abs((n[faces] * face[:, None]).sum(axis=-1)) / np.maximum(size, 1e-300)[:, None]
    lengths = np.linalg.norm(n[faces], axis=-1)
    return bool((cosines < BENT * lengths)[(size > 0)].any())
