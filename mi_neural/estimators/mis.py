"""Weights of two techniques that sample the same directions (multiple importance sampling, MIS)."""

from __future__ import annotations

import drjit as dr


def mis_weight(pdf_a, pdf_b):
    """Power heuristic with exponent 2 (Veach 1997, eq. 9.13); 0 where `pdf_a` is 0, or where both are infinite or one
    is no number: always in [0, 1]. ``mis_weight(a, b) + mis_weight(b, a) = 1`` where either density is positive.

    Both densities are over solid angle. The ratio is squared, not they: a small or far light's exceeds 1e20.
    """
    weight = 1 / (1 + dr.square(pdf_b / pdf_a))
    return dr.select((pdf_a > 0) & (weight >= 0), weight, 0)
