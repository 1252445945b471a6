"""What a path needs to know of a surface point. All functions may be called inside symbolic loops."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def finite(value, active):
    """`value` where `active` and every channel is finite, else 0."""
    return dr.select(active & dr.all(dr.isfinite(value)), value, 0)


def has_smooth(bsdf):
    """Whether a BSDF has a non-delta lobe: next-event estimation and the cache make sense there."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def has_null(bsdf):
    """Whether a BSDF lets some light pass as if it were not there (masks, boundaries without refraction)."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)


def transmits(bsdf):
    """Whether a BSDF has a lobe that transmits."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)


def is_smooth(si, active):
    """Whether there is a surface with a non-delta lobe."""
    return active & si.is_valid() & has_smooth(si.bsdf())


def is_terminal(si, active):
    """Whether a path may end there in a cache: a surface with a non-delta lobe through which nothing is seen."""
    bsdf = si.bsdf()
    return active & si.is_valid() & has_smooth(bsdf) & ~has_null(bsdf)


def is_mirror(si, active):
    """Whether there is a surface without a non-delta lobe: a mirror, glass, or a boundary without refraction."""
    return active & si.is_valid() & ~has_smooth(si.bsdf())


def reference_point(p, n):
    """An interaction that serves emitters as the point they are seen from."""
    it = dr.zeros(mi.Interaction3f, dr.width(p))
    it.p, it.n = mi.Point3f(p), mi.Normal3f(n)
    return it


def emission(scene, si, active):
    """Radiance emitted towards ``-si.wi`` by what a ray met, the environment included."""
    emitter = si.emitter(scene, active)
    return dr.select(active, emitter.eval(si, active), 0)


def facing(si):
    """Unit shading normal on the side that the path came from."""
    return dr.mulsign(mi.Vector3f(si.sh_frame.n), si.wi.z)


def receiver(si, bsdf):
    """How a surface receives light, for choosing one: its normal on the side that is seen, and whether it transmits."""
    return facing(si), transmits(bsdf)
