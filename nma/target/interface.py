"""Instances of the Principled BRDF that lie under the interface of a rough dielectric, such as a coat.

The interface reflects light by one lobe of its own, whose width and index of refraction are known. The specular lobes
of the instances lie under the interface: they are evaluated and sampled for the refracted directions. The diffuse lobes
are evaluated for the directions above the interface, because scattering and refraction together leave little of the
shape of a diffuse lobe. On their way out, all lobes of an instance are dimmed by two parameters that the network sets:
`veil`, the share of the interface's inner reflection that is lost, and `absorption`, the optical depth below.

An instance that lies under an interface has no clearcoat of its own. Where code has three lobes per instance, the lobe
of the interface takes the place of the clearcoat. The lobe is the same for all instances, whose weights sum to one.
"""

from __future__ import annotations

from typing import NamedTuple

from nma import ops
from nma.ops import Float, Vec3
from nma.target.principled import (
    Geometry,
    Lobes,
    Principled,
    dielectric_reflectance,
    diffuse_terms,
    geometry,
    microfacet_lobe,
    spec_alpha,
    spec_fresnel,
)
from nma.target.sampling import sample_spec

# The function `exp` of the C++ runtime is exact for arguments of at least -87.
_LEAST_EXPONENT = -87.0


class Interface(NamedTuple):
    """The interface above all instances: its GGX width, and the index of refraction below it (at least 1)."""

    alpha: Float
    eta: Float


class Crossing(NamedTuple):
    """Quantities of one pair of directions that all instances under an interface use."""

    below: Geometry  # the geometry of the refracted directions
    jacobian: Float  # solid angle below the interface per solid angle of `wo`
    lost: Float  # the part of the light towards `wo` that the interface reflects back down
    path: Float  # length of the way up along the refracted `wo`, in depths, minus 1
    value: Float  # the interface's own reflection, times cos(theta_o)
    pdf: Float  # the density with which the interface's own lobe samples `wo`


def cos_below(cos: Float, eta: Float) -> Float:
    """The cosine of a direction after its refraction at a smooth interface."""
    return ops.sqrt(eta * eta - 1.0 + cos * cos) / eta


def refracted(v: Vec3, eta: Float) -> Vec3:
    """The direction `v` refracted at a smooth interface, and mirrored to point up."""
    return Vec3(v.x / eta, v.y / eta, cos_below(v.z, eta))


def crossing(interface: Interface, g: Geometry) -> Crossing:
    """What an interface does with the directions of `g`."""
    eta = interface.eta
    below = geometry(refracted(g.wi, eta), refracted(g.wo, eta))
    lobe, pdf = microfacet_lobe(g, interface.alpha, interface.alpha)
    return Crossing(
        below,
        g.wo.z / (eta * eta * below.wo.z),
        dielectric_reflectance(g.wo.z, g.wo.z * g.wo.z, eta),
        1.0 / below.wo.z - 1.0,
        lobe * dielectric_reflectance(g.cos_d, g.cos_d * g.cos_d, eta),
        pdf,
    )


def eval_pdf_lobes_below(p: Principled, g: Geometry, c: Crossing) -> Lobes:
    """The value of one instance under an interface, f cos(theta_o) [1/sr], and the densities of its lobes.

    The value contains the interface's own reflection, and `clearcoat_pdf` is the density of this reflection.
    """
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    spec, spec_pdf = microfacet_lobe(c.below, alpha_x, alpha_y)
    fresnel = spec_fresnel(p, c.below.cos_d, c.below.cos_d * c.below.cos_d, c.below.weight_d)
    diffuse = diffuse_terms(p, g)
    left = (1.0 - p.veil * c.lost) * ops.exp(ops.maximum(-p.absorption * c.path, _LEAST_EXPONENT))
    density = c.jacobian * spec_pdf
    value = c.jacobian * spec
    colored = left * (diffuse.colored + value * fresnel.colored)
    white = left * (diffuse.white + value * fresnel.white) + c.value
    return Lobes(p.base_color * colored + white, g.wo.z * ops.INV_PI, density, c.pdf)


def sample_below(wi: Vec3, eta: Float, alpha_x: Float, alpha_y: Float, u1: Float, u2: Float) -> Vec3:
    """A direction of a specular lobe under an interface. The direction points below the horizon where the interface
    reflects all light back down, or where the lobe itself leads down."""
    o = sample_spec(refracted(wi, eta), alpha_x, alpha_y, u1, u2)
    cos2 = 1.0 - eta * eta * (1.0 - o.z * o.z)
    leaves = (o.z > 0.0) & (cos2 > 0.0)
    up = ops.sqrt(ops.select(leaves, cos2, 1.0))
    bent = ops.select(leaves, eta, 1.0)
    return Vec3(bent * o.x, bent * o.y, ops.select(leaves, up, -ops.absolute(o.z)))
