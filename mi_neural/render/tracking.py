"""What happens to light on its way through a medium, as functions of a sampled interaction with it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Optical depths are compared up to this distance, so that none of them is infinite.
FAR = 1e18


def event(mei, distance, u, channel, shares, active) -> tuple:
    """What happens at a sampled distance, before a surface at `distance`: (whether the medium scatters, whether it is a
    null collision, weight, shares). `u` decides between the two.

    All colours could have sampled what happened: its density is the mean of theirs, each with its share of the path so
    far (spectral MIS; Miller et al. 2019). `shares` are brought up to date.
    """
    collides = active & mei.is_valid() & (mei.t < distance)
    majorant = mei.combined_extinction
    real = collides & (u * colour(majorant, channel) < colour(mei.sigma_t, channel))
    null = collides & ~real
    # What all colours have in common of the transmittance is left out, as it cancels
    passed = dr.exp(-flown(mei, distance) * (majorant - dr.min(majorant)))
    density = passed * dr.select(real, mei.sigma_t, dr.select(null, mei.sigma_n, 1))
    value = passed * dr.select(real, mei.sigma_s, dr.select(null, mei.sigma_n, 1))
    density *= shares
    total = dr.sum(density)
    possible = active & (total > 0)
    inv = dr.select(possible, dr.rcp(total), 0)
    return real, null, dr.select(active, value * inv, 1), dr.select(possible, density * inv, shares)


def flown(mei, distance):
    """Way through the medium up to a sampled distance, or up to a surface at `distance`."""
    return dr.clip(dr.minimum(mei.t, distance) - mei.mint, 0, FAR)


def colour(value, channel):
    """The value of one colour, by which distances are sampled: in RGB variants `channel`, in others the first."""
    if not mi.is_rgb:
        return value[0]
    return dr.select(channel == 0, value[0], dr.select(channel == 1, value[1], value[2]))


def is_boundary(bsdf):
    """Whether a surface lets all light pass unchanged in direction: the boundary of a medium, say."""
    return (bsdf.flags() & int(mi.BSDFFlags.All)) == int(mi.BSDFFlags.Null)


def shadowed(scene, ray, active):
    """Whether a surface that is no :func:`is_boundary` lies on a ray, up to its end."""

    def step(active, ray, shadow):
        si = scene.ray_intersect(ray, active)
        meets = active & si.is_valid()
        passes = meets & is_boundary(si.bsdf())
        left = ray.maxt - si.t
        ray = dr.select(passes, si.spawn_ray(ray.d), ray)
        ray.maxt = dr.select(passes, left, ray.maxt)
        return passes & (left > 0), ray, shadow | (meets & ~passes)

    state = (mi.Bool(active), mi.Ray3f(ray), mi.Bool(False))
    return dr.while_loop(state, lambda active, *_: active, step, label="shadows")[2]


def exists(pointer):
    """Whether a pointer points to something."""
    return dr.reinterpret_array(mi.UInt32, pointer) > 0


def medium_interaction(p, ray, medium):
    """A point in a medium, as its phase function takes it: light goes on against `ray`."""
    mei = dr.zeros(mi.MediumInteraction3f)
    mei.p, mei.wi, mei.sh_frame, mei.medium = p, -ray.d, mi.Frame3f(-ray.d), medium
    mei.time, mei.wavelengths = ray.time, ray.wavelengths
    return mei
