"""``termination="auto"``: at each vertex the outgoing cache, the incident cache or another bounce.

What is measured for it, and how that decides: :mod:`mi_neural.caches.accuracy`.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_neural.caches.blend import sigma_channels, where_active
from mi_neural.caches.incident import reflect
from mi_neural.render import prefix, vertex
from mi_neural.render.surface import scene_is_glossy, surface_of

#: Queries a camera sample, at its first vertex and at its end; fewer where only one of them is asked, more where the
#: end is in the incident cache.
QUERIES = 2.0
#: For the class docstrings of the plugins that offer it.
AUTO = """
    With ``termination="auto"``, ``nirc`` and ``nrc`` are one and the same estimator: it has both caches, trained on the
    same paths, and decides at each vertex by their errors, measured while training (no reference, no further rays).
    Training paths start in twos from the same point. Over such pairs of independent estimates T, T' of one more bounce,
    the mean of (A - T)(A - T') is the squared bias of a cache's answer A (:math:`b_o^2`; of the incident cache
    :math:`b_i^2`, its noise :math:`v_i`) and that of (T - T')²/2 the noise v of tracing on, all by cells of 1/16 of the
    box. For an image of N samples a pixel:

    - first vertex: what is traced either ends right there, in the incident cache, or goes on; it is mixed with the
      outgoing cache's answer by the weight of least squared error, :math:`v/N / (v/N + b_o^2)` if it goes on. Of the
      two, that one whose mix has the smaller error in equal time.
    - later vertices, once the path is wide (``spread_threshold``): the outgoing cache with probability
      :math:`1/(1 + N m^2/v)`, m being its mean error over a region; else incident cache or another bounce as above.

    So the first samples show the caches, more samples trust them less, and E[L_o] tends to the path-traced radiance.
"""


def check(integrator) -> None:
    """Refuse settings that do not go with it."""
    blend, n_paths = integrator.cache.blend, integrator.cache.training.n_paths
    integrator._check(blend == "ema", f"blend is '{blend}'; termination 'auto' needs 'ema'")
    integrator._check(n_paths > 1, f"train_samples is {n_paths}; termination 'auto' needs pairs, at least 2")


def estimate(integrator, scene, lights, field, sampler, ray, n_samples, active):
    """E[L] = Le + w L_o(x_1) + (1 - w) [direct light + what a path gathers that ends in either cache].

    `field`: a :class:`~mi_neural.caches.pair.PairField`; None: path tracing. `n_samples`: of the pixel's finished
    image. The first share w depends on nothing but the place, so E[L] is right wherever the two estimates are.
    """
    cached = integrator.needs_cache and field is not None
    glossy = scene_is_glossy(scene)

    def stop(si, spread, smooth, first, sampler):
        share, incident = field.accuracy.choose(si.p, vertex.facing(si), n_samples, smooth)
        incident &= ~mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Delta)  # its reflections are not in the cache
        wide = smooth & ~first & spread.exceeds(integrator.spread_threshold)
        ends = wide & (sampler.next_1d() < field.accuracy.stops(si.p, n_samples, wide))
        return share, ends, incident & (first | wide) & ~ends, sampler

    end, sampler = prefix.trace(
        integrator, scene, lights, sampler, ray, active, stop if cached else None, glossy, look=cached
    )
    path, zero = end.path, mi.Color3f(0)
    channels = {"traced": path.L, "cached": zero, "cache": zero, "density": mi.Float(0),
                "depth": dr.select(path.valid, mi.Float(path.depth), 0),
                "share": end.share if cached else mi.Float(0), **sigma_channels(None, None, None)}  # fmt: skip
    if not cached:
        return path.L, path.valid, channels

    def outgoing(*inputs):
        return tuple(field.outgoing.query(*inputs))

    shows = bool({"cache", "density"} & set(integrator.channels))
    seen = (dr.max(end.β_first) > 0) & ((end.share > 0) | shows)
    at_first = end.β_first * mi.Color3f(*where_active(seen, end.first.inputs(), outgoing, 3))
    bsdf = path.si.bsdf(path.ray)
    at_end = surface_of(path.si, bsdf, end.ends, glossy)
    at_end = mi.Color3f(*where_active(end.ends, at_end.inputs(), outgoing, 3))

    lit = end.ends_lit
    point = mi.Point3f(path.si.p), vertex.facing(path.si)
    features = where_active(
        lit, point, lambda x, n: tuple(field.incident.encode(x, n)), field.incident.shape.n_encoded
    )
    by_incident, sampler = reflect(
        field.incident, list(features), path.si, bsdf, integrator.cache.n_queries, sampler, lit
    )
    cached = end.share * at_first + path.β * (dr.select(end.ends, at_end, 0) + dr.select(lit, by_incident, 0))
    channels |= {"cached": cached, "cache": at_first}
    if shows:
        channels["density"] = dr.select(seen, field.outgoing.density_at(end.first.position), 0)
    return path.L + cached, path.valid, channels
