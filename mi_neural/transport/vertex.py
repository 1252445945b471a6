"""One path vertex: emission, next-event estimation, MIS weights.

Functions of a surface interaction. All of them may be called inside symbolic loops.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mis_weight(pdf_a, pdf_b):
    """Power heuristic with exponent 2 (Veach 1997, eq. 9.13); 0 where `pdf_a` is 0, so no 0/0 can arise.

    Both densities are over solid angle. The ratio is squared, not they: a small or far light's exceeds 1e20.
    """
    return dr.select(pdf_a > 0, 1 / (1 + dr.square(pdf_b / pdf_a)), 0)


def finite(value, active):
    """`value` where `active` and every channel is finite, else 0."""
    return dr.select(active & dr.all(dr.isfinite(value)), value, 0)


def has_smooth(bsdf):
    """Whether a BSDF has a non-delta lobe: next-event estimation and the cache make sense there."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def reference_point(p, n):
    """An interaction that serves emitters as the point they are seen from."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p, it.n = mi.Point3f(p), mi.Normal3f(n)
    return it


def emission(scene, si, active):
    """Radiance emitted towards ``-si.wi`` by what a ray met, the environment included."""
    emitter = si.emitter(scene, active)
    return dr.select(active, emitter.eval(si, active), 0)


def emission_mis(scene, si, p_prev, n_prev, pdf_bsdf, delta, active):
    """Emission met by a BSDF ray from `p_prev`, weighted against next-event estimation there.

    `pdf_bsdf` is the density of the ray's direction over solid angle; a `delta` lobe has weight 1, since no other
    technique samples it. ``E[direct_light + emission_mis] = ∫ f Le cos dω``.
    """
    emitter = si.emitter(scene, active)
    ds = mi.DirectionSample3f(scene, si, reference_point(p_prev, n_prev))
    pdf_emitter = scene.pdf_emitter_direction(reference_point(p_prev, n_prev), ds, active & ~delta)
    weight = dr.select(delta, 1, mis_weight(pdf_bsdf, pdf_emitter))
    return dr.select(active, emitter.eval(si, active) * weight, 0)


def direct_light(scene, si, bsdf, sample, active, alone=False):
    """Next-event estimation: one emitter sample, one shadow ray.

    `sample` are two uniform numbers. Where `alone` (a mask) holds, no BSDF ray will be traced to share the work with,
    and the sample counts in full; elsewhere it carries its MIS weight.
    """
    ds, weight = scene.sample_emitter_direction(si, sample, True, active)
    active = active & (ds.pdf > 0)
    f, pdf_bsdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    w_mis = dr.select(ds.delta | alone, 1, mis_weight(ds.pdf, pdf_bsdf))
    return finite(f * weight * w_mis, active)

