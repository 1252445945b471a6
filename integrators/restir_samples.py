"""Light samples of ``restir_di``: what they are kept in proportion to, and the candidates of one frame."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mi_neural.estimators import reservoir
from mi_neural.estimators.mis import mis_weight
from mi_neural.estimators.reservoir import Reservoir
from mi_neural.render import vertex


def light_share(integrator, power, index, pdf, pdf_bsdf, active):
    """Share of light samples in what reaches a surface from a point on light `index`; the rest is the BSDF ray's.

    A fixed partition of the light, however lights are sampled: `initial_candidates` of them in proportion to power
    against one of the BSDF (Veach 1997, eq. 9.13).
    """
    pmf = power.pmf(None, None, None, index, active)
    return mis_weight(integrator.initial_candidates * pmf * pdf, pdf_bsdf)


def contribution(integrator, scene, power, si, index, uv, active):
    """What a light sample gives, shadows apart: (share times f Le cos over the density of `uv`, point on it)."""
    ds, weight, pdf = power.table.sample(scene, si, index, uv, active)
    active = active & (pdf > 0)
    f, pdf_bsdf = si.bsdf().eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
    share = dr.select(ds.delta, 1, light_share(integrator, power, index, pdf, pdf_bsdf, active))
    return vertex.finite(f * weight * share, active), ds.p


def target(integrator, scene, power, si, index, uv, active):
    """What light samples are kept in proportion to: the mean of the channels, and 0 where something stands between if
    `visible_target`."""
    f, p_light = contribution(integrator, scene, power, si, index, uv, active)
    value = dr.mean(f)
    if integrator.visible_target:
        value = dr.select(visible(scene, si, p_light, active & (value > 0)), value, 0)
    return value


def initial(integrator, scene, lights, power, si, found, sampler, active) -> Reservoir:
    """A reservoir of this frame's own candidates, confidence 1; its W is 0 where the kept one is in shadow.

    E[g W] = integral of g over what is visible (Bitterli et al. 2020, alg. 3; visibility as in alg. 5); without
    `candidate_shadow_ray` over all.
    """
    n_candidates = integrator.initial_candidates
    n, transmits = vertex.receiver(si, si.bsdf())

    def draw(lights, sampler, active):
        if hasattr(lights, "remembering"):
            lights = lights.remembering(si, n, transmits)

        def candidate(i, kept, sampler):
            u = (mi.Float(i) + sampler.next_1d()) * (1 / n_candidates)
            choice = lights.choose(si, n, transmits, u, sampler, mi.UInt32(0), active)
            sampler = choice.advanced(sampler)
            uv = sampler.next_2d()
            f, _ = contribution(integrator, scene, power, si, choice.index, uv, active & (choice.weight > 0))
            target = dr.mean(f)
            kept = reservoir.update(kept, choice.index, uv, target * choice.weight, target, sampler.next_1d())
            return i + 1, kept, sampler

        _, kept, sampler = dr.while_loop(
            (mi.UInt32(0), Reservoir.empty(dr.width(si)), sampler), lambda i, *_: active & (i < n_candidates),
            candidate, label="initial candidates",
        )  # fmt: skip
        return kept, sampler

    if integrator.candidates == "nvc" and integrator.nvc_where == "disoccluded":
        kept, sampler = draw(power, sampler, active & found)
        # A loop of at most one round: nothing is computed where no pixel of a packet is new
        _, kept, sampler = dr.while_loop(
            (active & ~found, kept, sampler), lambda new, *_: new,
            lambda new, _, sampler: (mi.Bool(False), *draw(lights, sampler, new)), label="disoccluded",
        )  # fmt: skip
    else:
        kept, sampler = draw(lights, sampler, active)
    kept = replace(reservoir.finish(kept), M=dr.select(active, mi.Float(1), 0))
    if not integrator.candidate_shadow_ray:
        return kept
    lit = active & (kept.W > 0)
    _, p_light = contribution(integrator, scene, power, si, kept.index, kept.uv, lit)
    lit &= visible(scene, si, p_light, lit)
    return replace(kept, W=dr.select(lit, kept.W, 0), target=dr.select(lit, kept.target, 0))


def visible(scene, si, p_light, active):
    """Whether nothing stands between a surface and a point on a light; false where not `active`."""
    return active & ~scene.ray_test(si.spawn_ray_to(p_light), active)
