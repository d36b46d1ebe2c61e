"""The common base of this package's Mitsuba BSDFs, which are one-sided and have one glossy lobe."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import count
from typing import Any

from nma.lattice import lattice_steps
from nma.ops import Color, Vec3, minimum, select
from nma.render.collector import collect_postponed

# The Mitsuba variants in which our Python BSDFs run. Other variants lack RGB colours or vectorised code.
VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
# Mitsuba's BSDFs that call one nested BSDF and return its result.
_WRAPPERS = ("TwoSidedBRDF", "NormalMap", "BumpMap")


def define_base() -> type:
    """The base class of all our BSDFs, for Mitsuba's current variant.

    A subclass defines `eval_pdf`, `sample` and `_albedo`. If a subclass has `inputs` (`nma.render.inputs.Inputs`),
    `mi.traverse` and the BSDF's attributes list these inputs, and `differentiable` says whether the inputs have
    derivatives. A subclass calls this `__init__` last, after everything that can fail, because this `__init__`
    registers the BSDF in Dr.Jit. Dr.Jit calls a registered BSDF in all scenes until the BSDF is destroyed. If the
    subclass's `__init__` failed after the registration, a traceback could keep the incomplete BSDF alive.
    """
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # Mitsuba's types change with the variant

    class OneSided(mi.BSDF):
        inputs: Any = None
        differentiable = True

        def __init__(self, props: mi.Properties) -> None:
            collect_postponed()
            super().__init__(props)
            self.serial = next(_serials)

        def _declare(self, *flags: mi.BSDFFlags) -> None:
            """Declares one component: glossy reflection on the front side, with the given `flags`, and
            `SpatiallyVarying` if an input is textured."""
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
            """The directional albedo at wi, at most 1. Denoisers and `aov` use this albedo as the colour of the
            surface."""
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
            # The mean of a colour's channels, as Mitsuba's own BSDFs return.
            channels = self.inputs.channels(name, si, active)
            return sum(channels) * (1.0 / len(channels)) if len(channels) > 1 else channels[0]

        def eval_attribute_3(self, name, si, active=True):
            if name not in self._attributes():
                return super().eval_attribute_3(name, si, active)
            channels = self.inputs.channels(name, si, active)
            return mi.Color3f(*channels) if len(channels) == 3 else mi.Color3f(channels[0])

        def _attributes(self) -> Any:
            return self.inputs.values if self.inputs is not None else ()

        def _front(self, ctx, si, active):
            """A mask of the lanes that see the front of the surface; False if the context disables the glossy lobe."""
            if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
                return mi.Bool(False)
            return mi.Bool(active) & (si.wi.z > 0)

        def _sampled(self, wo: Vec3, pdf, weight: Color, active):
            """The return value of `sample`: direction, density, and value divided by density. Density and value are 0
            for invalid samples."""
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
    """The mean of draw(k, u1, u2, u3) over points (u1, u2, u3) of a lattice in the unit cube, with the indices k = 0,
    1, ..., points - 1.

    All lanes use the same points, so the mean has a small error, but no noise.
    """
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba

    def body(k, x, y, z):
        u = [mi.Float(k) * step + 0.5 for step in lattice_steps(3)]
        found = draw(k, *(v - dr.floor(v) for v in u))
        return k + 1, x + found.x, y + found.y, z + found.z

    active = mi.Bool(active)
    zero = dr.select(active, mi.Float(0.0), 0.0)
    start = (dr.select(active, mi.UInt32(0), points), zero, zero, zero)
    _, x, y, z = dr.while_loop(start, lambda k, *rest: k < points, body, label="albedo")
    return Color(x, y, z) * (1.0 / points)


def over(value: Any, pdf: Any) -> Any:
    """The value divided by the density. Where the density is 0, the value is returned unchanged."""
    return value * (1.0 / select(pdf > 0, pdf, 1.0))


def vec3(v: Any) -> Vec3:
    """A Mitsuba vector as this package's `Vec3`."""
    return Vec3(v.x, v.y, v.z)


def blended(bsdf: Any) -> bool:
    """Whether any existing Mitsuba BSDF blends `bsdf` with other BSDFs, directly or through nested BSDFs.

    A BSDF has no access to the BSDFs that contain it, so this function searches all existing BSDFs. BSDFs that only
    change the shading frame or the side of their nested BSDF do not count as blends.
    """
    global _blends
    everything = _registered()
    key = [(type(other), other.class_name(), other.id(), _serial(other)) for other in everything]
    if _blends[0] != key:
        _blends = key, _inside_blends(everything)
    return bsdf.serial in _blends[1]


# Generates the unique ids of our BSDFs. Addresses and names are not unique, because scenes that are loaded one after
# another may reuse them.
_serials = count(1)
# The cache of `blended`: a description of all BSDFs at its last call, and the ids of our BSDFs inside a blend.
_blends: tuple[list[Any], set[int]] = [], set()


def _serial(bsdf: Any) -> int:
    """The unique id of one of our BSDFs; 0 for other BSDFs."""
    return getattr(bsdf, "serial", 0)


def _registered() -> list[Any]:
    """All existing BSDFs of Mitsuba's current variant."""
    import drjit
    import mitsuba

    dr: Any = drjit
    mi: Any = mitsuba  # Mitsuba's types change with the variant
    found: list[Any] = []
    for number in count(1):
        try:
            bsdf = dr.reinterpret_array(mi.BSDFPtr, mi.UInt32(number))[0]
        except RuntimeError:  # there are no more BSDFs
            return found
        if bsdf is not None:
            found.append(bsdf)
    return found


def _inside_blends(everything: list[Any]) -> set[int]:
    inside: set[int] = set()
    for bsdf in everything:
        if bsdf.class_name() not in _WRAPPERS:
            inside |= {_serial(part) for part in _parts(bsdf)}
    return inside


def _parts(bsdf: Any) -> list[Any]:
    """The BSDFs nested in `bsdf`, at all levels.

    Textures are not traversed. Traversing a coloured texture computes its pixels, and if Dr.Jit is recording at that
    moment, these pixels would stay symbolic.
    """
    import mitsuba

    mi: Any = mitsuba  # Mitsuba's types change with the variant
    found: list[Any] = []
    bsdf.traverse(_define_parts(mi.TraversalCallback, mi.BSDF)(found))
    return found


@cache
def _define_parts(base: Any, kind: Any) -> Any:
    """The class of a callback that lists the objects of type `kind` inside a traversed object.

    A class forms a reference cycle with its methods. If each search defined a class of its own, whose methods know the
    list, the BSDFs of the list would stay in memory until the garbage collector runs.
    """

    class Parts(base):
        def __init__(self, found: list[Any]) -> None:
            super().__init__()
            self.found = found

        def put(self, name, value, flags, cpptype=None):
            self.put_object(name, value, flags)

        def put_value(self, name, value, flags, cpptype=None):
            pass

        def put_object(self, name, value, flags):
            if isinstance(value, kind):
                self.found.append(value)
                # A new `Parts` is needed, because nanobind does not call a method of an object from within the same
                # method.
                value.traverse(Parts(self.found))

    return Parts
