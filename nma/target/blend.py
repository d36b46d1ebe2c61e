"""A blend of Principled BRDFs, the target of every adapter: value, density and sampling over all lobes together."""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Color, Float, Vec3
from nma.target.albedo import Albedos, lobe_albedos, lobe_albedos_below
from nma.target.interface import Interface, crossing, eval_pdf_lobes_below, sample_below
from nma.target.principled import (
    MIN_COS,
    Geometry,
    Lobes,
    Principled,
    clearcoat_alpha,
    eval_pdf_lobes,
    geometry,
    spec_alpha,
)
from nma.target.sampling import sample_clearcoat, sample_diffuse, sample_spec


class Blend(NamedTuple):
    """Instances of the Principled BRDF, and their weights, which sum to one.

    With two instances, the first weight is the paper's `blend` (eq. 3). `scale` is a factor on the value of the blend,
    which `bounded` sets. If there is an `interface`, all instances lie under it (`nma.target.interface`).
    """

    instances: tuple[Principled, ...]
    weights: tuple[Float, ...]
    scale: Color = Color(1.0, 1.0, 1.0)
    interface: Interface | None = None


class LobeProbabilities(NamedTuple):
    """The probability of sampling each lobe of an instance.

    Under an interface, `clearcoat` is the instance's share of the probability of the interface's lobe.
    """

    diffuse: Float
    spec: Float
    clearcoat: Float


def bounded(blend: Blend, cos_theta_i: Float) -> Blend:
    """The blend, dimmed if its albedo at cos(theta_i) might exceed 1: each channel is divided by the bound of its
    albedo.

    Channels whose bound is below 1 do not change. Use this function only if the parameters of the blend depend on the
    view direction, because a blend of constant parameters would lose its reciprocity.
    """
    # Below the horizon, where nothing is reflected, the bound is computed for normal incidence instead, because the
    # formula of the bound might divide by zero.
    cosine = ops.select(cos_theta_i > MIN_COS, cos_theta_i, 1.0)
    total = Color(0.0, 0.0, 0.0)
    for albedos, weight in zip(albedos_of(blend, cosine), blend.weights, strict=True):
        total = total + (albedos.diffuse + albedos.spec + albedos.clearcoat) * weight
    return blend._replace(scale=Color(*(1.0 / ops.maximum(c, 1.0) for c in total)))


def eval_pdf(blend: Blend, wi: Vec3, wo: Vec3) -> tuple[Color, Float]:
    """f cos(theta_o) [1/sr] and the density of `sample` [1/sr], zero below the horizon. Directions are unit vectors."""
    g = geometry(wi, wo)
    value = Color(0.0, 0.0, 0.0)
    pdf: Float = 0.0
    for lobes, weight, probability in zip(
        lobes_of(blend, g), blend.weights, lobe_probabilities(blend, g.wi.z), strict=True
    ):
        value = value + lobes.value * weight
        pdf = pdf + (
            probability.diffuse * lobes.diffuse_pdf
            + probability.spec * lobes.spec_pdf
            + probability.clearcoat * lobes.clearcoat_pdf
        )
    return ops.select(g.valid, value * blend.scale, 0.0), ops.select(g.valid, pdf, 0.0)


def eval(blend: Blend, wi: Vec3, wo: Vec3) -> Color:
    """f cos(theta_o) [1/sr] of the blend, zero below the horizon. `wi` and `wo` are unit vectors."""
    g = geometry(wi, wo)
    value = Color(0.0, 0.0, 0.0)
    for lobes, weight in zip(lobes_of(blend, g), blend.weights, strict=True):
        value = value + lobes.value * weight
    return ops.select(g.valid, value * blend.scale, 0.0)


def pdf(blend: Blend, wi: Vec3, wo: Vec3) -> Float:
    """The density of `sample` per solid angle of `wo` [1/sr]."""
    return eval_pdf(blend, wi, wo)[1]


def sample(blend: Blend, wi: Vec3, u_lobe: Float, u1: Float, u2: Float) -> tuple[Vec3, Color, Float]:
    """Returns a direction `wo` drawn with three uniform numbers in [0, 1), its value, and its density (0 if `wo` is
    invalid)."""
    view = Vec3(wi.x, wi.y, ops.select(wi.z > MIN_COS, wi.z, 1.0))
    probabilities = lobe_probabilities(blend, view.z)
    # Each lobe has an interval of [0, 1), and `u_lobe` selects the lobe whose interval contains `u_lobe`. All diffuse
    # lobes come first, then all specular lobes, then all clearcoats. Under an interface, the last interval selects the
    # lobe of the interface.
    spec_start = sum(p.diffuse for p in probabilities)
    clearcoat_start = spec_start + sum(p.spec for p in probabilities)
    (alpha_x, alpha_y, alpha_c), *others = lobe_alphas(blend)
    shift, *shifts = (p.shift for p in blend.instances)
    spec_end = spec_start
    clearcoat_end = clearcoat_start
    # Select the microfacet widths (alphas) and the shift of the instance to which the selected lobe belongs. Within the
    # specular lobes and within the clearcoats, the intervals are in the order of the instances.
    for p, (next_x, next_y, next_c), next_shift in zip(probabilities, others, shifts, strict=False):
        spec_end = spec_end + p.spec
        clearcoat_end = clearcoat_end + p.clearcoat
        alpha_x = ops.select(u_lobe >= spec_end, next_x, alpha_x)
        alpha_y = ops.select(u_lobe >= spec_end, next_y, alpha_y)
        alpha_c = ops.select(u_lobe >= clearcoat_end, next_c, alpha_c)
        if blend.interface is not None:
            shift = ops.select(u_lobe >= spec_end, next_shift, shift)
    if blend.interface is None:
        spec = sample_spec(view, alpha_x, alpha_y, u1, u2)
        last = sample_clearcoat(view, alpha_c, u1, u2)
    else:
        alpha, eta = blend.interface
        spec = sample_below(view, eta, shift, alpha_x, alpha_y, u1, u2)
        last = sample_spec(view, alpha, alpha, u1, u2)
    wo = ops.select(
        u_lobe < spec_start, sample_diffuse(u1, u2), ops.select(u_lobe < clearcoat_start, spec, last)
    )
    value, density = eval_pdf(blend, wi, wo)
    return wo, value, density


def lobe_probabilities(blend: Blend, cos_theta_i: Float) -> tuple[LobeProbabilities, ...]:
    """The probability of each lobe of each instance: the instance's weight times an estimate of the lobe's albedo,
    divided by the sum over all lobes."""
    means = [
        LobeProbabilities(ops.mean(a.diffuse), ops.mean(a.spec) * a.leaving, a.clearcoat)
        for a in albedos_of(blend, cos_theta_i)
    ]
    total = sum(w * (m.diffuse + m.spec + m.clearcoat) for w, m in zip(blend.weights, means, strict=True))
    shares = [w / total for w in blend.weights]
    return tuple(
        LobeProbabilities(s * m.diffuse, s * m.spec, s * m.clearcoat)
        for s, m in zip(shares, means, strict=True)
    )


def albedos_of(blend: Blend, cos_theta_i: Float) -> list[Albedos]:
    """The albedo bounds of all lobes of each instance, at cos(theta_i) > 0."""
    if blend.interface is None:
        return [lobe_albedos(p, cos_theta_i) for p in blend.instances]
    return [lobe_albedos_below(p, blend.interface, cos_theta_i) for p in blend.instances]


def lobes_of(blend: Blend, g: Geometry) -> list[Lobes]:
    """The value of each instance, and the densities of its lobes."""
    if blend.interface is None:
        return [eval_pdf_lobes(p, g) for p in blend.instances]
    c = crossing(blend.interface, g)
    return [eval_pdf_lobes_below(p, c) for p in blend.instances]


def lobe_alphas(blend: Blend) -> tuple[tuple[Float, Float, Float], ...]:
    """For each instance: the widths of the specular lobe along x and along y, and the width of the clearcoat."""
    return tuple(
        (*spec_alpha(p.roughness, p.anisotropic), clearcoat_alpha(p.clearcoat_gloss)) for p in blend.instances
    )
