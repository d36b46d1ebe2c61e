"""Mitsuba 3 BSDF `nma`: a source material, evaluated by its adapter as a blend of Principled BRDFs.

The network maps source parameters and cos(theta_i) to the blend, which gives value, density and samples. Without
textures the network runs once, when the scene is loaded, and fills curves over cos(theta_i). With textures, and for
anisotropic adapters, it runs once per shading point. Inputs: `nma.render.inputs`. The BSDF is one-sided; wrap it in
`twosided` if needed.

Properties: `adapter`, the name of a shipped adapter or a weights file; `clamp`, whether inputs beyond the adapter's
training range are moved to its bounds instead of refused; and the parameters of the adapter's class, or a `material`
that has them. An adapter of a single material needs no parameters, and refuses the parameters of another material.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from nma import target
from nma.adapter import Adapter, shipped, weights_file
from nma.ops import Color, Vec3, select
from nma.render.bsdf import define_base, mean_of_samples, over, vec3
from nma.render.curves import MIN_COS, Curves
from nma.render.inputs import of_adapter
from nma.target import Brdf

DEFAULT_ADAPTER = "layered3-5x64"
ALBEDO_POINTS = 128


def define() -> type:
    """The plugin's class for Mitsuba's current variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant

    attached = mi.Float(0.0)  # has a gradient wherever gradients are not suspended
    dr.enable_grad(attached)

    class Nma(define_base()):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            self.name = str(props.get("adapter", DEFAULT_ADAPTER))
            # Paths are relative to the scene's folder, as for Mitsuba's own plugins.
            self.adapter = load_once(
                self.name if self.name in shipped() else str(mi.file_resolver().resolve(self.name))
            )
            self.inputs = of_adapter(self.adapter, props)
            self._curves = self._make_curves()
            self._recorded = _Recorded()
            super().__init__(props)
            self._declare(*([mi.BSDFFlags.Anisotropic] if self.adapter.anisotropic else []))

        def parameters_changed(self, keys: Any = ()) -> None:
            try:
                super().parameters_changed(keys)
            finally:  # refused edits were undone, but other parameters may have changed
                if self._curves is not None:
                    self._curves.update(self.inputs.columns())

        def to_string(self) -> str:
            return f"Nma[\n  adapter = {self.name},\n  class = {self.adapter.space.name},\n{self.inputs}\n]"

        def eval_pdf(self, ctx, si, wo, active=True):
            brdf, active = self._prepare(ctx, si, active)
            return self._eval_pdf(ctx, brdf, si, wo, active)

        def sample(self, ctx, si, sample1, sample2, active=True):
            brdf, active = self._prepare(ctx, si, active)
            return self._sample(ctx, brdf, si, sample1, sample2, active)

        def eval_pdf_sample(self, ctx, si, wo, sample1, sample2, active=True):
            brdf, active = self._prepare(ctx, si, active)
            found = self._eval_pdf(ctx, brdf, si, wo, active)
            return *found, *self._sample(ctx, brdf, si, sample1, sample2, active)

        def _eval_pdf(self, ctx, brdf: Brdf, si, wo, active):
            value, pdf = brdf.eval_pdf(vec3(si.wi), vec3(wo))
            if self._from_light(ctx):
                value = self._towards_camera(si, wo, active)
            return mi.Color3f(*value) & active, pdf & active

        def _sample(self, ctx, brdf: Brdf, si, sample1, sample2, active):
            wo, value, pdf = brdf.sample(vec3(si.wi), sample1, sample2.x, sample2.y)
            if self._from_light(ctx):
                value = self._towards_camera(si, mi.Vector3f(*wo), active & (pdf > 0))
            return self._sampled(wo, pdf, over(value, pdf), active)

        def _from_light(self, ctx) -> bool:
            """Whether the path comes from the light and the BRDF is not reciprocal."""
            return ctx.mode == mi.TransportMode.Importance and not self.adapter.reciprocal

        def _towards_camera(self, si, wo, active) -> Color:
            """f cos(theta_o) of light that arrives along `si.wi` and goes on to the camera along `wo`.

            The view direction is then `wo`, so the BRDF is prepared for `wo`. Paths from the light thus get the same
            values as paths from the camera, although the BRDF is not reciprocal. Samples are still drawn for `si.wi`.
            """
            turned = mi.SurfaceInteraction3f(si)
            turned.wi = wo
            brdf = self._brdf(turned, active, active & (wo.z > 0))
            return brdf.eval(vec3(wo), vec3(si.wi)) * (wo.z / si.wi.z)

        def _albedo(self, si, active) -> Color:
            brdf = self._brdf(si, active, active)

            def draw(k, *u):
                _, value, pdf = brdf.sample(vec3(si.wi), *u)
                return select(pdf > 0, over(value, pdf), 0.0)

            return mean_of_samples(draw, ALBEDO_POINTS, active)

        def _make_curves(self) -> Curves | None:
            """The curves that replace the network; None if more than cos(theta_i) varies, and the network must run."""
            if self.inputs.textured or self.adapter.anisotropic:
                return None
            return Curves(self.adapter, self.inputs.columns())

        def _prepare(self, ctx, si, active) -> tuple[Brdf, Any]:
            """The BRDF at `si`, and which lanes see the front."""
            front = self._front(ctx, si, active)
            return self._brdf(si, active, front), front

        def _brdf(self, si, active, front) -> Brdf:
            """The BRDF at `si`.

            At a point Mitsuba calls `eval_pdf` and then `sample`; it does not call `eval_pdf_sample` of Python BSDFs.
            The second call reuses the BRDF of the first call, if both are in the same basic block.
            """
            self.inputs.check()
            wi = Vec3(si.wi.x, si.wi.y, dr.clip(si.wi.z, MIN_COS, 1.0))
            if self._curves is not None:
                return self._curves.at(wi, self.inputs.columns() if self._curves.slopes else [], front)
            asked = dr.detach(mi.SurfaceInteraction3f(si)), active
            if brdf := self._recorded.take(asked, dr.grad_enabled(attached)):
                return brdf
            brdf = self.adapter.prepare(self.inputs.columns(si, front), wi, front)
            derived = dr.grad_enabled(target.numbers(brdf.blend, self.adapter.target))
            if si.wi.z.state == dr.VarState.Symbolic and not derived:
                self._recorded.leave(asked, dr.grad_enabled(attached), brdf)
            return brdf

    return Nma


def load_once(name_or_path: str) -> Adapter:
    """The adapter of a name or a weights file. BSDFs of the same file share it while the file does not change."""
    path = weights_file(name_or_path)
    stat = Path(path).stat() if Path(path).is_file() else None
    return _loaded(name_or_path, (stat.st_mtime_ns, stat.st_size) if stat else None)


@lru_cache(maxsize=16)
def _loaded(name_or_path: str, stamp: tuple[int, int] | None) -> Adapter:
    return Adapter.load(name_or_path)


class _Recorded:
    """The BRDF that a call prepared while Dr.Jit recorded it, for the next call in the same basic block.

    In another block the variables of the BRDF may not exist: Dr.Jit records all callables of a virtual call with the
    same arguments, each in a new scope. So `leave` opens a new scope, and `take` succeeds only in that scope. The
    arguments are kept, because Dr.Jit reuses the indices of variables that are freed. A BRDF with derivatives is never
    kept, because the next pass would follow them to variables that no longer exist. Frozen functions do not look into
    this class, because they must not find symbolic variables.
    """

    def __init__(self) -> None:
        self._left: tuple[list[int], Any, Brdf] | None = None

    def leave(self, asked: Any, attached: bool, brdf: Brdf) -> None:
        from nma.jit import dr

        dr.detail.new_scope(dr.backend_v(asked[0].wi))
        self._left = _key(asked, attached), asked, brdf

    def take(self, asked: Any, attached: bool) -> Brdf | None:
        left, self._left = self._left, None
        return left[2] if left and left[0] == _key(asked, attached) else None


def _key(asked: Any, attached: bool) -> list[int]:
    from nma.jit import dr

    return [attached, dr.detail.scope(dr.backend_v(asked[0].wi)), *dr.detail.collect_indices(asked)]
