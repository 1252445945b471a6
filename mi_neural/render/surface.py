"""A surface as a cache of outgoing radiance sees it."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from . import vertex

#: Fixed BSDF samples that albedo and roughness are read from.
N_LOBES = 2


@dataclass
class Surface:
    """A surface as an outgoing cache sees it; the arguments of ``OutgoingField.query``, in that order.

    position   world space
    normal     unit shading normal, on the side of `view`
    view       unit, away from the surface
    albedo     diffuse and specular reflectance together, see :func:`surface_of`
    roughness  1: as rough as Lambert's, 0: a mirror
    """

    position: mi.Point3f
    normal: mi.Vector3f
    view: mi.Vector3f
    albedo: mi.Color3f
    roughness: mi.Float

    def inputs(self) -> tuple:
        return self.position, self.normal, self.view, self.albedo, self.roughness


def scene_is_glossy(scene) -> bool:
    """Whether any surface has a lobe whose width the cache must know of; without one, roughness is 0 everywhere."""
    lobes = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.GlossyTransmission
    return any(s.bsdf() is not None and bool(int(s.bsdf().flags()) & int(lobes)) for s in scene.shapes())


def surface_of(si, bsdf, active, glossy: bool = True) -> Surface:
    """The surface at `si`, seen from where its ray came.

    Mitsuba says neither reflectance (of conductors and glossy lobes) nor roughness of a BSDF. Both are read off a few
    BSDF samples with fixed numbers, the peaks of its lobes: the mean weight ``f cos/p`` is the reflectance (exactly
    for Lambert's), and from a density p follows the roughness ``1/sqrt(π p)``. What matters is that training and query
    get the same answer at the same point: no noise. Without a `glossy` surface in the scene the roughness is 0.
    """
    albedo, roughness, total = mi.Color3f(0), mi.Float(0), mi.Float(1e-6)
    for i in range(N_LOBES):
        bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float((i + 0.5) / N_LOBES), mi.Point2f(0.5, 0.5), active)
        weight = dr.clip(vertex.finite(weight, active), 0, 4)
        albedo += weight * (1 / N_LOBES)
        if glossy:
            share = dr.max(weight)
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            width = dr.minimum(dr.rsqrt(dr.pi * dr.maximum(bs.pdf, 1e-6)), 1)
            roughness += dr.select(delta, 0, share * width)
            total += share
    return Surface(
        mi.Point3f(si.p), vertex.facing(si), si.to_world(si.wi), dr.minimum(albedo, 1),
        roughness / total if glossy else mi.Float(0),
    )  # fmt: skip


class Roughened:
    """A BSDF, and where `lambert` is true a Lambertian of the same albedo in its place."""

    def __init__(self, bsdf, lambert, albedo):
        self.bsdf, self.lambert, self.albedo = bsdf, lambert, albedo

    def flags(self):
        return self.bsdf.flags()

    def sample(self, ctx, si, sample1, sample2, active=True):
        bs, weight = self.bsdf.sample(ctx, si, sample1, sample2, active & ~self.lambert)
        wo = mi.warp.square_to_cosine_hemisphere(sample2)
        pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo)
        bs.wo = dr.select(self.lambert, dr.mulsign(wo, si.wi.z), bs.wo)
        bs.pdf, bs.eta = dr.select(self.lambert, pdf, bs.pdf), dr.select(self.lambert, 1, bs.eta)
        diffuse = mi.UInt32(int(mi.BSDFFlags.DiffuseReflection))
        bs.sampled_type = dr.select(self.lambert, diffuse, bs.sampled_type)
        return bs, dr.select(self.lambert, self.albedo, weight)

    def eval_pdf(self, ctx, si, wo, active=True):
        f, pdf = self.bsdf.eval_pdf(ctx, si, wo, active & ~self.lambert)
        cosine = dr.select(wo.z * si.wi.z > 0, dr.abs(wo.z) * dr.inv_pi, 0)
        return dr.select(self.lambert, self.albedo * cosine, f), dr.select(self.lambert, cosine, pdf)
