"""Mitsuba 3 BSDF `nma`: an expensive source material as its adapter sees it, a blend of Principled BRDFs.

The network maps source parameters and cos(theta_i) to the blend; value, density and sampling are those of the blend.
Without textures it runs when the scene is loaded, into curves over cos(theta_i); with textures, and for anisotropic
adapters, at every shading point, once for all that a path tracer asks there. Inputs: `nma.render.inputs`. One-sided;
wrap it in `twosided` if needed.

Properties: `adapter`, the name of a shipped adapter or a weights file; `clamp`, whether inputs beyond its training
range are moved there instead of refused; and the parameters of the adapter's class, or a `material` that has them.
One that knows a single material wants none, and refuses those of another.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from nma import target
from nma.adapter import Adapter, shipped
from nma.ops import Vec3
from nma.render.curves import MIN_COS, Curves
from nma.render.inputs import of_adapter
from nma.render.layered import check_variant
from nma.target import Blend, Plane

DEFAULT_ADAPTER = "layered3-5x64"


def define() -> type:
    """The plugin's class for Mitsuba's present variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant

    class Nma(mi.BSDF):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            check_variant(mi.variant(), props.plugin_name())
            self.name = str(props.get("adapter", DEFAULT_ADAPTER))
            # Weights lie beside the scene, as the files of Mitsuba's own plugins do.
            found = self.name if self.name in shipped() else str(mi.file_resolver().resolve(self.name))
            self.adapter = Adapter.load(found)
            self.inputs = of_adapter(self.adapter, props)
            self._curves = self._make_curves()
            self._last: Any = None
            self._attached = mi.Float(0.0)  # has a gradient wherever gradients are not suspended
            dr.enable_grad(self._attached)
            self._warned = False
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
            if self.adapter.anisotropic:
                flags |= mi.BSDFFlags.Anisotropic
            if self.inputs.textured:
                flags |= mi.BSDFFlags.SpatiallyVarying
            self.m_components = [flags]
            self.m_flags = flags

        def traverse(self, callback: mi.TraversalCallback) -> None:
            self.inputs.traverse(callback)

        def parameters_changed(self, keys: Any = ()) -> None:
            self.inputs.check(keys)
            self._curves = self._make_curves()
            self._last = None

        def to_string(self) -> str:
            return f"Nma[\n  adapter = {self.name},\n  class = {self.adapter.space.name},\n{self.inputs}\n]"

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx, si, wo, active=True):
            blend, active = self._prepare(ctx, si, active)
            return _eval_pdf(blend, self._plane(si), si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            blend, active = self._prepare(ctx, si, active)
            return _sample(blend, self._plane(si), si, sample1, sample2, active)

        def eval_pdf_sample(self, ctx, si, wo, sample1, sample2, active=True):
            blend, active = self._prepare(ctx, si, active)
            plane = self._plane(si)
            found = _eval_pdf(blend, plane, si, wo, active)
            return *found, *_sample(blend, plane, si, sample1, sample2, active)

        def _make_curves(self) -> Curves | None:
            """What spares the network where nothing but cos(theta_i) varies."""
            if self.inputs.textured or self.adapter.anisotropic:
                return None
            return Curves(self.adapter, self.inputs.columns())

        def _prepare(self, ctx, si, active) -> tuple[Blend, Any]:
            """The blend at `si`, and the lanes that see the front."""
            self._warn_of_light_paths(ctx)
            active = mi.Bool(active if ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0) else False)
            front = active & (si.wi.z > 0)
            cos_theta_i = dr.clip(si.wi.z, MIN_COS, 1.0)
            if self._curves is not None:
                return self._curves.at(cos_theta_i, front), front
            return self._by_network(si, cos_theta_i, active, front), front

        def _by_network(self, si, cos_theta_i, active, front) -> Blend:
            """The blend at `si`.

            Of one point Mitsuba asks for the value and then for a sample, even where one call could give both: it does
            not call `eval_pdf_sample` of Python BSDFs. The second takes what the first left in the same recording.
            """
            seen = mi.SurfaceInteraction3f(si), active
            key = dr.grad_enabled(self._attached), *dr.detail.collect_indices(seen)
            last, self._last = self._last, None
            if last is not None and last.key == key:
                return last.blend
            columns, tangent = self.inputs.columns(si, front), (si.wi.x, si.wi.y)
            blend = self.adapter.prepare(columns, cos_theta_i, front, tangent)
            if si.wi.z.state == dr.VarState.Symbolic:
                self._last = _Prepared(key, seen, blend)
            return blend

        def _plane(self, si) -> Plane:
            """The frame that the blend holds in."""
            return Plane.of(_vec3(si.wi)) if self.adapter.in_plane else Plane()

        def _warn_of_light_paths(self, ctx) -> None:
            """Says once that light traced from its source makes another picture, where it does."""
            if self._warned or ctx.mode != mi.TransportMode.Importance or self.adapter.reciprocal:
                return
            self._warned = True
            mi.Log(
                mi.LogLevel.Warn,
                f"BSDF 'nma' {self.id()}: its adapter ({self.adapter.variant}) is not reciprocal, so integrators that "
                "trace paths from the light converge to another picture than `path`; use `path` or `prb`",
            )

    def _eval_pdf(blend: Blend, plane: Plane, si, wo, active):
        value, pdf = target.eval_pdf(blend, plane.enter(_vec3(si.wi)), plane.enter(_vec3(wo)))
        return mi.Color3f(*value) & active, pdf & active

    def _sample(blend: Blend, plane: Plane, si, sample1, sample2, active):
        wo, value, pdf = target.sample(blend, plane.enter(_vec3(si.wi)), sample1, sample2.x, sample2.y)
        valid = active & (pdf > 0)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = mi.Vector3f(*plane.leave(wo))
        bs.pdf = pdf & valid
        bs.eta = 1.0
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        bs.sampled_component = mi.UInt32(0)
        return bs, (mi.Color3f(*value) / dr.select(valid, pdf, 1.0)) & valid

    return Nma


class _Prepared(NamedTuple):
    """A blend, what it was prepared for, and the names of that: no other variables bear them while these are kept."""

    key: tuple[int, ...]
    seen: Any
    blend: Blend


def _vec3(v: Any) -> Vec3:
    return Vec3(v.x, v.y, v.z)
