"""One path vertex: emission, next-event estimation, MIS weights.

Functions of a surface interaction. All of them may be called inside symbolic loops.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def mis_weight(pdf_a, pdf_b):
    """Power heuristic with exponent 2 (Veach 1997, eq. 9.13); 0 where `pdf_a` is 0, or where both are infinite or one
    is no number: always in [0, 1].

    Both densities are over solid angle. The ratio is squared, not they: a small or far light's exceeds 1e20.
    """
    weight = 1 / (1 + dr.square(pdf_b / pdf_a))
    return dr.select((pdf_a > 0) & (weight >= 0), weight, 0)


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

    `sample` are two uniform numbers. With `alone`, no BSDF ray will be traced to share the work with, and the sample
    counts in full; it may be a function of the BSDF's density, which says where. Elsewhere it carries its MIS weight.
    """
    ds, weight = scene.sample_emitter_direction(si, sample, True, active)
    active = active & (ds.pdf > 0)
    f, pdf_bsdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    full = ds.delta | (alone(pdf_bsdf) if callable(alone) else bool(alone))
    w_mis = dr.select(full, 1, mis_weight(ds.pdf, pdf_bsdf))
    return finite(f * weight * w_mis, active)


def emitted(
    scene, lights, si, bsdf, u, sample, sampler, active, si_next, pdf_bsdf, delta, followed, alone=None
):  # fmt: skip
    """Both halves of direct light at a vertex whose BSDF ray was traced already.

    Next-event estimation, and the emission that the ray met, weighted against each other: ``E[first + f/p second] = ∫
    f Le cos dω``. `lights` chooses the light (see ``mi_neural.lights.sampling``); None: the scene itself, uniformly.
    `u`, `sample`: one and two uniform numbers, to choose a light and a point on it. `si_next`: what the BSDF ray met,
    with density `pdf_bsdf`, where `followed`. ``alone(pdf)`` says at which densities of the BSDF the ray will not be
    followed and next-event estimation counts in full.
    """
    smooth = active & has_smooth(bsdf)
    if lights is None:
        L = direct_light(scene, si, bsdf, sample, smooth, alone)
        return L, emission_mis(scene, si_next, si.p, si.n, pdf_bsdf, delta, followed)

    table = lights.table
    hit, emits = table.index_of(scene, si_next, followed)
    n, transmits = receiver(si, bsdf)
    choice = lights.choose(si, n, transmits, u, sampler, hit, active)

    ds, weight, pdf = table.sample(scene, si, choice.index, sample, smooth & (choice.weight > 0))
    f, pdf_at_light = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), smooth & (pdf > 0))
    reaches = smooth & (dr.max(f * weight) > 0)
    reaches &= ~scene.ray_test(si.spawn_ray_to(ds.p), reaches)
    counts_in_full = mi.Bool(ds.delta)
    if alone is not None:
        counts_in_full |= alone(pdf_at_light)
    w_mis = dr.select(counts_in_full, 1, mis_weight(choice.pmf * pdf, pdf_at_light))
    L = finite(f * weight * choice.weight * w_mis, reaches)

    ds_hit = mi.DirectionSample3f(scene, si_next, reference_point(si.p, si.n))
    pdf_hit = choice.pmf_hit * table.pdf(scene, si, hit, si_next, ds_hit, emits & ~delta)
    w_mis = dr.select(delta, 1, mis_weight(pdf_bsdf, pdf_hit))
    return L, dr.select(emits, si_next.emitter(scene, emits).eval(si_next, emits) * w_mis, 0)


def facing(si):
    """Unit shading normal on the side that the path came from."""
    return dr.mulsign(mi.Vector3f(si.sh_frame.n), si.wi.z)


def receiver(si, bsdf):
    """How a surface receives light, for choosing one: its normal on the side that is seen, and whether it transmits."""
    return facing(si), mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
