"""Instances of the Principled BRDF that lie under the interface of a rough dielectric, such as a coat.

The interface reflects light by one lobe of its own, whose width and index of refraction are known. Below it, each
instance is simpler than a Principled BRDF above: a specular lobe and a diffuse lobe, both in the colour `base_color`,
with the shares `metallic` and 1 - `metallic`. There is no Fresnel term, because the angles below are far from grazing,
and no sheen.

- The specular lobe is evaluated and sampled for the refracted directions. Because a rough interface bends light on
  average more or less than a smooth interface does, `shift` moves the lobe: the slope of the refracted `wi` is
  multiplied by 1 + `shift`.
- The diffuse lobe is evaluated for the directions above the interface, because scattering and refraction together leave
  little of the shape of a diffuse lobe. `flatness` blends it towards a lobe that sends almost as much light per solid
  angle to grazing directions as to others, as light does that an interface has held back until its roughness lets the
  light out.
- `veil` dims both lobes on their way out. It is the share of the interface's inner reflection that is lost.

Where code has three lobes per instance, the lobe of the interface takes the place of the clearcoat. The lobe is the
same for all instances, whose weights sum to one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from nma import ops
from nma.ops import Float, Vec3
from nma.target.principled import (
    Geometry,
    Lobes,
    Principled,
    dielectric_reflectance,
    microfacet_lobe,
    spec_alpha,
)
from nma.target.sampling import sample_spec

# The flat diffuse lobe is FLAT / (cos(theta_o) + FLAT_COSINE) times the diffuse lobe. FLAT makes the albedos of both
# lobes equal.
FLAT_COSINE = 0.15
FLAT = 0.5 / (1.0 - FLAT_COSINE * math.log(1.0 + 1.0 / FLAT_COSINE))


class Interface(NamedTuple):
    """The interface above all instances: its GGX width, and the index of refraction below it (at least 1)."""

    alpha: Float
    eta: Float


class Crossing(NamedTuple):
    """Quantities of one pair of directions that all instances under an interface use."""

    wi: Vec3  # the refracted directions, mirrored to point up
    wo: Vec3
    jacobian: Float  # solid angle below the interface per solid angle of `wo`
    lost: Float  # the part of the light towards `wo` that the interface reflects back down
    diffuse: Float  # values of the diffuse lobe and of the flat diffuse lobe, times cos(theta_o)
    flat: Float
    value: Float  # the interface's own reflection, times cos(theta_o)
    pdf: Float  # the density with which the interface's own lobe samples `wo`


def cos_below(cos: Float, eta: Float, inverse: Float) -> Float:
    """The cosine of a direction after its refraction at a smooth interface. `inverse` is 1 / eta."""
    return ops.sqrt(eta * eta - 1.0 + cos * cos) * inverse


def refracted(v: Vec3, eta: Float, inverse: Float) -> Vec3:
    """The direction `v` refracted at a smooth interface, and mirrored to point up. `inverse` is 1 / eta."""
    return Vec3(v.x * inverse, v.y * inverse, cos_below(v.z, eta, inverse))


def stretch(sin2: Float, shift: Float) -> Float:
    """The length of a unit vector after its horizontal part is multiplied by 1 + `shift`.

    `sin2` is the squared length of the horizontal part. Without a shift, the result is exactly 1, so that narrow lobes
    stay where they are.
    """
    return ops.sqrt(1.0 + shift * (2.0 + shift) * sin2)


def shifted(wi: Vec3, shift: Float) -> Vec3:
    """The direction `wi`, its slope multiplied by 1 + `shift`."""
    inverse = 1.0 / stretch(wi.x * wi.x + wi.y * wi.y, shift)
    factor = (1.0 + shift) * inverse
    return Vec3(factor * wi.x, factor * wi.y, inverse * wi.z)


def cos_shifted(cos: Float, shift: Float) -> Float:
    """The cosine of a direction after `shifted`."""
    return cos / stretch(1.0 - cos * cos, shift)


def way_out(cos_o: Float, below: Float, inverse: Float) -> tuple[Float, Float, Float]:
    """The fields `jacobian`, `diffuse` and `flat` of `Crossing`. `below` is the cosine of the refracted `wo`."""
    jacobian = cos_o * inverse * inverse / below
    diffuse = cos_o * ops.INV_PI
    return jacobian, diffuse, diffuse * (FLAT / (cos_o + FLAT_COSINE))


def crossing(interface: Interface, g: Geometry) -> Crossing:
    """What an interface does with the directions of `g`."""
    eta = interface.eta
    inverse = 1.0 / eta
    wi = refracted(g.wi, eta, inverse)
    wo = refracted(g.wo, eta, inverse)
    jacobian, diffuse, flat = way_out(g.wo.z, wo.z, inverse)
    lost = dielectric_reflectance(g.wo.z, g.wo.z * g.wo.z, eta)
    lobe, pdf = microfacet_lobe(g.wi, g.wo, interface.alpha, interface.alpha)
    value = lobe * dielectric_reflectance(g.cos_d, g.cos_d * g.cos_d, eta)
    return Crossing(wi, wo, jacobian, lost, diffuse, flat, value, pdf)


def lobes_below(p: Principled, c: Crossing, spec: Float, spec_pdf: Float) -> Lobes:
    """`eval_pdf_lobes_below`, given the `microfacet_lobe` of the refracted directions."""
    diffuse = ops.lerp(c.diffuse, c.flat, p.flatness)
    left = 1.0 - p.veil * c.lost
    below = left * ops.lerp(diffuse, c.jacobian * spec, p.metallic)
    return Lobes(p.base_color * below + c.value, c.diffuse, c.jacobian * spec_pdf, c.pdf)


def eval_pdf_lobes_below(p: Principled, c: Crossing) -> Lobes:
    """The value of one instance under an interface, f cos(theta_o) [1/sr], and the densities of its lobes.

    The value contains the interface's own reflection, and `clearcoat_pdf` is the density of this reflection.
    """
    alpha_x, alpha_y = spec_alpha(p.roughness, p.anisotropic)
    spec, spec_pdf = microfacet_lobe(shifted(c.wi, p.shift), c.wo, alpha_x, alpha_y)
    return lobes_below(p, c, spec, spec_pdf)


def sample_below(
    wi: Vec3, eta: Float, shift: Float, alpha_x: Float, alpha_y: Float, u1: Float, u2: Float
) -> Vec3:
    """A direction of a specular lobe under an interface. The direction points below the horizon where the interface
    reflects all light back down, or where the lobe itself leads down."""
    o = sample_spec(shifted(refracted(wi, eta, 1.0 / eta), shift), alpha_x, alpha_y, u1, u2)
    cos2 = 1.0 - eta * eta * (1.0 - o.z * o.z)
    leaves = (o.z > 0.0) & (cos2 > 0.0)
    up = ops.sqrt(ops.select(leaves, cos2, 1.0))
    bent = ops.select(leaves, eta, 1.0)
    return Vec3(bent * o.x, bent * o.y, ops.select(leaves, up, -ops.absolute(o.z)))
