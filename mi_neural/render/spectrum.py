"""Radiance in the variant that is set: three colours, one value (mono), or values at four wavelengths (spectral)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

#: Wavelengths in nm at which lights are looked at in spectral variants, spread over what is visible.
PROBES = (450.0, 520.0, 590.0, 660.0)


def is_rgb() -> bool:
    """Whether a radiance is three colours, as tables and caches hold it."""
    return not (mi.is_spectral or mi.is_monochromatic)


def film_colour(L, wavelengths, active=True) -> mi.Color3f:
    """What a sample of radiance (with its weight) adds to a film: linear sRGB, or three times the value in mono."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(L, wavelengths, active)
    return mi.Color3f(L.x) if mi.is_monochromatic else mi.Color3f(L)


def as_three(value) -> mi.Color3f:
    """Three numbers for a radiance at `PROBES`, to compare lights by: its colours, or its mean three times."""
    if is_rgb():
        return mi.Color3f(value)
    return mi.Color3f(dr.mean(mi.Spectrum(value), axis=0))


def at_probes(interaction):
    """The interaction, its wavelengths set to `PROBES`; unchanged where there are none."""
    if mi.is_spectral:
        interaction.wavelengths = mi.Spectrum(*PROBES) + dr.zeros(mi.Float, dr.width(interaction.p))
    return interaction
