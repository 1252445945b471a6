"""Training records: what caches learn from."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass

import drjit as dr
import mitsuba as mi

from ..render.surface import Surface


@dataclass
class TrainingRecords:
    """A fixed number of records; where `valid` is false, a record holds nothing.

    position   points on surfaces, world space
    direction  unit vectors, away from the surface
    normal     unit shading normals, on the side that the path came from
    target     estimates of the radiance that arrives at `position` from `direction` after at least one reflection
    valid      mask

    Where the loss or the network's inputs need them, else None:

    weight, pdf        ``f cos/p`` of the BSDF sample that `direction` is, and its density p (solid angle)
    albedo, roughness  of the surface, see :func:`~mi_neural.render.surface.surface_of`

    In scenes with participating media, else None:

    inside   what the record is in: see :meth:`~mi_neural.render.walk.SurfaceWalk.inside`; `position` may lie in a
             medium, `normal` is the direction in which the path came to it then
    """

    position: mi.Point3f
    direction: mi.Vector3f
    normal: mi.Vector3f
    target: mi.Color3f
    valid: mi.Bool
    weight: mi.Color3f | None = None
    pdf: mi.Float | None = None
    albedo: mi.Color3f | None = None
    roughness: mi.Float | None = None
    inside: mi.UInt32 | None = None

    def material(self) -> dict:
        """Keywords for the ``encode`` of a field that has the material as an input; none where it is not known."""
        return {} if self.albedo is None else {"material": (self.albedo, self.roughness)}


def empty_records(n: int) -> TrainingRecords:
    """`n` records that hold nothing."""
    return TrainingRecords(
        dr.zeros(mi.Point3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Color3f, n),
        dr.zeros(mi.Bool, n),
    )  # fmt: skip


def leave_out_nonfinite(records: TrainingRecords) -> mi.UInt32:
    """Make records invalid, and harmless, of which anything is not finite; returns how many.

    Positions, directions and normals are so where those of a mesh are.
    """
    finite = mi.Bool(True)
    for v in (records.position, records.direction, records.normal, records.target):
        finite &= dr.all(dr.isfinite(v))
    n_bad = dr.count(records.valid & ~finite)
    records.valid &= finite
    up = mi.Vector3f(0, 0, 1)
    records.position = dr.select(finite, records.position, 0)
    records.direction, records.normal = (dr.select(finite, v, up) for v in (records.direction, records.normal))
    records.target = dr.select(records.valid, records.target, 0)
    return n_bad


@dataclass
class OutgoingRecords:
    """A fixed number of records; where `valid` is false, a record holds nothing.

    target   estimates of the radiance that leaves `surface` towards its `view`, what the cache holds of it
    inside   in scenes with participating media, what it is in: see :meth:`~mi_neural.render.walk.SurfaceWalk.inside`
    """

    surface: Surface
    target: mi.Color3f
    valid: mi.Bool
    inside: mi.UInt32 | None = None


def empty_surfaces(n: int, in_media: bool = False) -> OutgoingRecords:
    """`n` records that hold nothing, with places for `inside` where there are media."""
    vectors = (dr.zeros(mi.Point3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Vector3f, n), dr.zeros(mi.Color3f, n))
    return OutgoingRecords(Surface(*vectors, dr.zeros(mi.Float, n)), dr.zeros(mi.Color3f, n), dr.zeros(mi.Bool, n),
                           dr.zeros(mi.UInt32, n) if in_media else None)  # fmt: skip


def packed(records, n: int):
    """The valid records in `n` places, in their order; what does not fit is left out, the rest holds nothing."""
    slot = dr.prefix_sum(dr.select(records.valid, mi.UInt32(1), mi.UInt32(0)))
    fits = records.valid & (slot < n)
    outgoing = isinstance(records, OutgoingRecords)
    out = empty_surfaces(n, records.inside is not None) if outgoing else empty_records(n)

    def put(to, value):
        if is_dataclass(to):
            for field in fields(to):
                put(getattr(to, field.name), getattr(value, field.name))
        elif to is not None:
            dr.scatter(to, value, slot, fits)

    put(out, records)
    return out
