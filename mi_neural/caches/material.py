"""Albedo and roughness of surfaces, for networks of incident radiance that have them as inputs."""

from __future__ import annotations

import drjit as dr

from ..render.surface import surface_of


def needs_material(field) -> bool:
    """Whether a field, or what blends its weights, has albedo or roughness as an input of its network."""
    shape = getattr(getattr(field, "field", field), "shape", None)
    return bool({"albedo", "roughness"} & set(getattr(shape, "surface", ())))


def material_of(field, si, bsdf, active) -> dict:
    """What :meth:`~mi_neural.caches.field.Field.encode` takes beside position and normal of the surface at `si`, as
    keywords: its albedo and roughness (see :func:`~mi_neural.render.surface.surface_of`) where `field` needs them."""
    if not needs_material(field):
        return {}
    with dr.suspend_grad():
        surface = surface_of(si, bsdf, active)
    return {"material": (dr.detach(surface.albedo), dr.detach(surface.roughness))}


def material_at(field, walk, path, bsdf, active) -> dict:
    """As :func:`material_of`, where a path stands that goes on by a `walk` (:mod:`mi_neural.render.walk`): at a surface
    of that `bsdf`, or where a medium scatters."""
    if not walk.in_media:
        return material_of(field, path.si, bsdf, active)
    if not needs_material(field):
        return {}
    surface = walk.surface(path, active, True)
    return {"material": (surface.albedo, surface.roughness)}
