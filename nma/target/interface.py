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
    microfacet_lobe,
    schlick_weight,
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

    wi: Vec3  # the refracted directions, mirrored to point up
    wo: Vec3
    cos_d: Float  # cosine between either of them and their half vector
    weight_d: Float  # Schlick weight of `cos_d`
    jacobian: Float  # solid angle below the interface per solid angle of `wo`
    lost: Float  # the part of the light towards `wo` that the interface reflects back down
    path: Float  # length of the way up along the refracted `wo`, in depths, minus 1
    value: Float  # the interface's own reflection, times cos(theta_o)
    pdf: Float  # the density with which the interface's own lobe samples `wo`


def cos_below(cos: Float, eta: Float, inverse: Float) -> Float:
    """The cosine of a direction after its refraction at a smooth interface. `inverse` is 1 / eta."""
    return ops.sqrt(eta * eta - 1.0 + cos * cos) * inverse


def refracted(v: Vec3, eta: Float, inverse: Float) -> Vec3:
    """The direction `v` refracted at a smooth interface, and mirrored to point up. `inverse` is 1 / eta."""
    return Vec3(v.x * inverse, v.y * inverse, cos_below(v.z, eta, inverse))


def crossing(interface: Interface, g: Geometry) -> Crossing:
    """What an interface does with the directions of `g`."""
    eta = interface.eta
    inverse = 1.0 / eta
    wi = refracted(g.wi, eta, inverse)
    wo = refracted(g.wo, eta, inverse)
    h = wi + wo
    cos_d = 0.5 * ops.sqrt(ops.dot(h, h))
    way = 1.0 / wo.z
    jacobian = g.wo.z * inverse * inverse * way
    lost = dielectric_reflectance(g.wo.z, g.wo.z * g.wo.z, eta)
    lobe, pdf = microfacet_lobe(g.wi, g.wo, interface.alpha, interface.alpha)
    value = lobe * dielectric_reflectance(g.cos_d, g.cos_d * g.cos_d, eta)
    return Crossing(wi, wo, cos_d, schlick_weight(cos_d), jacobian, lost, way - 1.0, value, pdf)


def eval_pdf_lobes_below(p: Principled, g: Geometry, c: Crossing) -> Lobes:
    """The value of one instance under an interface, f cos(theta_o) [1/sr], and the densities of its lobes.

    The value contains the interface's own reflection, and `clearcoat_pdf` is the density of this reflection.
    """
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    spec, spec_pdf = microfacet_lobe(c.wi, c.wo, alpha_x, alpha_y)
    fresnel = spec_fresnel(p, c.cos_d, c.cos_d * c.cos_d, c.weight_d)
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
    o = sample_spec(refracted(wi, eta, 1.0 / eta), alpha_x, alpha_y, u1, u2)
    cos2 = 1.0 - eta * eta * (1.0 - o.z * o.z)
    leaves = (o.z > 0.0) & (cos2 > 0.0)
    up = ops.sqrt(ops.select(leaves, cos2, 1.0))
    bent = ops.select(leaves, eta, 1.0)
    return Vec3(bent * o.x, bent * o.y, ops.select(leaves, up, -ops.absolute(o.z)))
