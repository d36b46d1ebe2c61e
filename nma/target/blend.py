"""Blend of Principled BRDFs: the target of every adapter (CONVENTIONS.md)."""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Color, Float, Vec3
from nma.target.principled import (
    Principled,
    clearcoat_alpha,
    eval_geometry,
    geometry,
    spec_alpha,
)


class Blend(NamedTuple):
    """Instances and their weights, which sum to one; with two, the first weight is the paper's `blend` (eq. 3)."""

    instances: tuple[Principled, ...]
    weights: tuple[Float, ...]


def eval(blend: Blend, wi: Vec3, wo: Vec3) -> Color:
    """f cos(theta_o) [1/sr] of the blend, zero below the horizon. `wi` and `wo` are unit vectors."""
    g = geometry(wi, wo)
    value = Color(0.0, 0.0, 0.0)
    for p, weight in zip(blend.instances, blend.weights, strict=True):
        value = value + eval_geometry(p, g) * weight
    return ops.select(g.valid, value, 0.0)


def lobe_alphas(blend: Blend) -> tuple[tuple[Float, Float, Float], ...]:
    """For each instance the widths of the specular lobe along x and y and of the clearcoat: where narrow peaks are."""
    return tuple(
        (*spec_alpha(p.roughness, p.anisotropic), clearcoat_alpha(p.clearcoat_gloss)) for p in blend.instances
    )
