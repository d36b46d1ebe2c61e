"""What this package's Mitsuba BSDFs share: the variants they run in, one side, one glossy lobe, one kind of sample."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

from nma.ops import Color, Vec3, minimum, select

# Mitsuba's variants that BSDFs written in Python run in: parameters are RGB, code is vectorised.
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
# Mitsuba's BSDFs that ask one other and hand on its answer.
_HAND_ON = ("TwoSidedBRDF", "NormalMap", "BumpMap")
# Roberts 2018, "The Unreasonable Effectiveness of Quasirandom Sequences": powers of the inverse of this number, the
# root of x^4 = x + 1, spread points evenly over a cube.
_SPREAD = 1.2207440846057596


def define_base() -> type:
    """The class below all our BSDFs, for Mitsuba's present variant.

    A BSDF of ours has `eval_pdf`, `sample` and `_albedo`. If it has `inputs` (`nma.render.inputs.Inputs`), these are
    what `mi.traverse` and attributes show, and `differentiable` says whether derivatives reach them.
    Its `__init__` calls the one here when nothing can fail any more: from then on Dr.Jit knows the BSDF and calls it in
    all scenes, for as long as a traceback, say, keeps it.
    """
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant

    class OneSided(mi.BSDF):
        inputs: Any = None
        differentiable = True

        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.serial = next(_serials)

        def _declare(self, *flags: mi.BSDFFlags) -> None:
            """One component: glossy reflection on the front, with these flags besides, and with that of textures."""
            both = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            if self.inputs is not None and self.inputs.textured:
                both |= mi.BSDFFlags.SpatiallyVarying
            for flag in flags:
                both |= flag
            self.m_components = [both]
            self.m_flags = both

        def traverse(self, callback):
            if self.inputs is not None:
                self.inputs.traverse(callback, self.differentiable)

        def parameters_changed(self, keys=()):
            if self.inputs is not None:
                self.inputs.changed()

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf_sample(self, ctx, si, wo, sample1, sample2, active=True):
            return *self.eval_pdf(ctx, si, wo, active), *self.sample(ctx, si, sample1, sample2, active)

        def eval_diffuse_reflectance(self, si, active=True):
            """The directional albedo at wi, at most 1: what denoisers and `aov` take for the colour of a surface."""
            front = mi.Bool(active) & (si.wi.z > 0)
            albedo = self._albedo(si, front)
            return mi.Color3f(*(minimum(c, 1.0) for c in albedo)) & front

        def has_attribute(self, name, active=True):
            return name in self._attributes() or super().has_attribute(name, active)

        def eval_attribute(self, name, si, active=True):
            return self.eval_attribute_3(name, si, active)

        def eval_attribute_1(self, name, si, active=True):
            if name not in self._attributes():
                return super().eval_attribute_1(name, si, active)
            return self.inputs.channels(name, si, active)[0]

        def eval_attribute_3(self, name, si, active=True):
            if name not in self._attributes():
                return super().eval_attribute_3(name, si, active)
            channels = self.inputs.channels(name, si, active)
            return mi.Color3f(*channels) if len(channels) == 3 else mi.Color3f(channels[0])

        def _attributes(self) -> Any:
            return self.inputs.values if self.inputs is not None else ()

        def _front(self, ctx, si, active):
            """The lanes that see the front, if our lobe is wanted."""
            if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                return mi.Bool(False)
            return mi.Bool(active) & (si.wi.z > 0)

        def _sampled(self, wo: Vec3, pdf, weight: Color, active):
            """What `sample` returns: a direction, its density, and value over density; all 0 where the density is."""
            valid = active & (pdf > 0)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.Vector3f(*wo)
            bs.pdf = dr.select(valid, pdf, 0.0)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
            bs.sampled_component = mi.UInt32(0)
            return bs, dr.select(valid, mi.Color3f(*weight), 0.0)

    return OneSided


def mean_of_samples(draw: Callable[[Any, Any, Any, Any], Color], points: int, active: Any = True) -> Color:
    """The mean of draw(k, u1, u2, u3) over the same `points` points of the unit cube for every lane, k = 0, 1, ...

    Equal lanes give equal means: there is no noise, but the small error that so many points leave.
    """
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba

    def body(k, x, y, z):
        u = [mi.Float(k) * _SPREAD**-power + 0.5 for power in (1, 2, 3)]
        found = draw(k, *(v - dr.floor(v) for v in u))
        return k + 1, x + found.x, y + found.y, z + found.z

    active = mi.Bool(active)
    zero = dr.select(active, mi.Float(0.0), 0.0)
    start = (dr.select(active, mi.UInt32(0), points), zero, zero, zero)
    _, x, y, z = dr.while_loop(start, lambda k, *rest: k < points, body, label="albedo")
    return Color(x, y, z) * (1.0 / points)


def over(value: Any, pdf: Any) -> Any:
    """A value per density. Where the density is 0 it is the value as it is."""
    return value * (1.0 / select(pdf > 0, pdf, 1.0))


def vec3(v: Any) -> Vec3:
    """A vector of Mitsuba's for the physics of this package."""
    return Vec3(v.x, v.y, v.z)


def blended(bsdf: Any) -> bool:
    """Whether Mitsuba holds a BSDF that blends `bsdf` with others, by any levels between.

    A BSDF is not told of those around it, so this looks through all that there are. Those that only turn a frame or a
    side hand on what they are given.
    """
    global _blends
    everything = _registered()
    key = [(type(other), other.class_name(), other.id(), _serial(other)) for other in everything]
    if _blends[0] != key:
        _blends = key, _inside_blends(everything)
    return bsdf.serial in _blends[1]


# Numbers of our BSDFs, never given out again: scenes that are loaded one after the other may share addresses and names.
_serials = count(1)
# What `blended` found last: in which BSDFs, and the numbers of ours inside a blend.
_blends: tuple[list[Any], set[int]] = [], set()


def _serial(bsdf: Any) -> int:
    """The number of one of our BSDFs; 0 for others."""
    return getattr(bsdf, "serial", 0)


def _registered() -> list[Any]:
    """All BSDFs of Mitsuba's present variant."""
    import drjit
    import mitsuba

    dr: Any = drjit
    mi: Any = mitsuba  # its types change with the variant
    found: list[Any] = []
    for number in count(1):
        try:
            bsdf = dr.reinterpret_array(mi.BSDFPtr, mi.UInt32(number))[0]
        except RuntimeError:  # beyond the last one
            return found
        if bsdf is not None:
            found.append(bsdf)
    return found


def _inside_blends(everything: list[Any]) -> set[int]:
    inside: set[int] = set()
    for bsdf in everything:
        if bsdf.class_name() not in _HAND_ON:
            inside |= {_serial(part) for part in _parts(bsdf)}
    return inside


def _parts(bsdf: Any) -> list[Any]:
    """The BSDFs inside of one, at all levels. Textures are not looked into: a coloured one works out its pixels when it
    is, and while Dr.Jit records these would be symbolic ever after."""
    import mitsuba

    mi: Any = mitsuba  # its types change with the variant
    found: list[Any] = []

    class Parts(mi.TraversalCallback):
        def put(self, name, value, flags, cpptype=None):
            self.put_object(name, value, flags)

        def put_value(self, name, value, flags, cpptype=None):
            pass

        def put_object(self, name, value, flags):
            if isinstance(value, mi.BSDF):
                found.append(value)
                value.traverse(Parts())  # nanobind calls no method of an object within itself

    bsdf.traverse(Parts())
    return found
