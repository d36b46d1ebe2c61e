"""Mitsuba 3 BSDF `nma`: a material that its adapter evaluates as a blend of Principled BRDFs.

The network maps the material's parameters and the view direction to the parameters of the blend, which is then
evaluated and sampled. Without textures the network runs only when the scene is loaded or edited, and the blend's
parameters are stored as curves over cos(theta_i). With textures, and for anisotropic adapters, the network runs once
per shading point. `nma.render.inputs` reads the material's parameters. The BSDF is one-sided; wrap it in `twosided` if
needed.

The property `adapter` is the name of a shipped adapter or a weights file. With `clamp`, parameters outside the
adapter's training range are clamped to that range instead of rejected. Further properties are the parameters of the
adapter's class, or the name of a `material` of this class. An adapter of a single material needs no parameters, and
rejects the parameters of another material.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

from nma.adapter import DEFAULT_ADAPTER, Adapter, shipped, weights_file
from nma.ops import Color, Vec3, select
from nma.render.bsdf import define_base, mean_of_samples, over, vec3
from nma.render.curves import MIN_COS, Curves
from nma.render.inputs import of_adapter
from nma.render.paths import scene_path
from nma.target import Brdf, numbers

ALBEDO_POINTS = 128


def define() -> type:
    """The plugin's class for Mitsuba's current variant."""
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # Mitsuba's types change with the variant

    probe = mi.Float(0.0)  # `dr.grad_enabled(probe)` is false inside `dr.suspend_grad`
    dr.enable_grad(probe)

    class Nma(define_base()):  # type: ignore[misc]
        def __init__(self, props: mi.Properties) -> None:
            self.name = str(props.get("adapter", DEFAULT_ADAPTER))
            self.adapter = load_once(self.name)
            self.inputs = of_adapter(self.adapter, props)
            self._curves = self._make_curves()
            self._last = _LastBrdf()
            super().__init__(props)
            self._declare(*([mi.BSDFFlags.Anisotropic] if self.adapter.anisotropic else []))

        def parameters_changed(self, keys: Any = ()) -> None:
            try:
                super().parameters_changed(keys)
            finally:  # after an error, too, because only the invalid edits are undone
                if self._curves is not None:
                    self._curves.update(self.inputs.columns())

        def to_string(self) -> str:
            return f"Nma[\n  adapter = {self.name},\n  class = {self.adapter.space.name},\n{self.inputs}\n]"

        def eval_pdf(self, ctx, si, wo, active=True):
            brdf, front = self._prepare(ctx, si, active)
            return self._eval_pdf(ctx, brdf, si, wo, front)

        def sample(self, ctx, si, sample1, sample2, active=True):
            brdf, front = self._prepare(ctx, si, active)
            return self._sample(ctx, brdf, si, sample1, sample2, front)

        def eval_pdf_sample(self, ctx, si, wo, sample1, sample2, active=True):
            brdf, front = self._prepare(ctx, si, active)
            found = self._eval_pdf(ctx, brdf, si, wo, front)
            return *found, *self._sample(ctx, brdf, si, sample1, sample2, front)

        def _eval_pdf(self, ctx, brdf: Brdf, si, wo, front):
            value, pdf = brdf.eval_pdf(vec3(si.wi), vec3(wo))
            if self._from_light(ctx):
                value = self._towards_camera(si, wo, front)
            return mi.Color3f(*value) & front, pdf & front

        def _sample(self, ctx, brdf: Brdf, si, sample1, sample2, front):
            wo, value, pdf = brdf.sample(vec3(si.wi), sample1, sample2.x, sample2.y)
            if self._from_light(ctx):
                value = self._towards_camera(si, mi.Vector3f(*wo), front & (pdf > 0))
            return self._sampled(wo, pdf, over(value, pdf), front)

        def _from_light(self, ctx) -> bool:
            """Whether the path comes from the light and the BRDF is not reciprocal."""
            return ctx.mode == mi.TransportMode.Importance and not self.adapter.reciprocal

        def _towards_camera(self, si, wo, active) -> Color:
            """f cos(theta_o) for light that arrives from `si.wi` and leaves towards the camera along `wo`.

            For a path from the light, the view direction is `wo`, so the BRDF is prepared for `wo`. Thus, paths from
            the light get the same values as paths from the camera, although the BRDF is not reciprocal. Samples are
            still drawn for `si.wi`.
            """
            turned = mi.SurfaceInteraction3f(si)
            turned.wi = wo
            brdf = self._brdf(turned, active, active & (wo.z > 0))
            return brdf.eval(vec3(wo), vec3(si.wi)) * (wo.z / si.wi.z)

        def _albedo(self, si, front) -> Color:
            brdf = self._brdf(si, front, front)

            def draw(k, *u):
                _, value, pdf = brdf.sample(vec3(si.wi), *u)
                return select(pdf > 0, over(value, pdf), 0.0)

            return mean_of_samples(draw, ALBEDO_POINTS, front)

        def _make_curves(self) -> Curves | None:
            """The curves over cos(theta_i) that replace the network; None if the blend also depends on the point or the
            azimuth."""
            if self.inputs.textured or self.adapter.anisotropic:
                return None
            return Curves(self.adapter, self.inputs.columns())

        def _prepare(self, ctx, si, active) -> tuple[Brdf, Any]:
            """The BRDF at `si`, and `front`: the active lanes that see the front of the surface."""
            front = self._front(ctx, si, active)
            return self._brdf(si, active, front), front

        def _brdf(self, si, active, front) -> Brdf:
            """Returns the BRDF at `si`, which comes from the curves, from the previous call, or else from the
            network."""
            self.inputs.check()
            # The BRDF is prepared for `si.wi` with its z raised to MIN_COS, because no adapter is evaluated at the
            # horizon. The parameters of the blend hardly change between cos(theta_i) = 0 and MIN_COS. The BRDF is then
            # evaluated and sampled for the unchanged `si.wi`, whose half vectors and cosines are exact.
            wi = Vec3(si.wi.x, si.wi.y, dr.clip(si.wi.z, MIN_COS, 1.0))
            if self._curves is not None:
                return self._curves.at(wi, self.inputs.columns() if self._curves.slopes else [], front)
            query = _Query(dr.detach(mi.SurfaceInteraction3f(si)), active, dr.grad_enabled(probe))
            if brdf := self._last.take(query):
                return brdf
            brdf = self.adapter.prepare(self.inputs.columns(si, front), wi, front)
            recording = si.wi.z.state == dr.VarState.Symbolic
            if recording and not dr.grad_enabled(numbers(brdf.blend, self.adapter.target)):
                self._last.keep(query, brdf)
            return brdf

    return Nma


def load_once(name_or_path: str | Path) -> Adapter:
    """Loads an adapter by its name or from a weights file. BSDFs that name the same file share one `Adapter`, unless
    the file changes.

    Paths are those of `scene_path`, once a variant of Mitsuba is set.
    """
    import mitsuba as mi

    name_or_path = str(name_or_path)
    if name_or_path not in shipped() and mi.variant() is not None:
        name_or_path = scene_path(name_or_path)
    path = weights_file(name_or_path)
    stat = Path(path).stat() if Path(path).is_file() else None
    return _loaded(name_or_path, (stat.st_mtime_ns, stat.st_size) if stat else None)


@lru_cache(maxsize=16)
def _loaded(name_or_path: str, stamp: tuple[int, int] | None) -> Adapter:
    return Adapter.load(name_or_path)


class _Query(NamedTuple):
    """A request for the BRDF at a point: the interaction without its derivatives, and the active lanes."""

    si: Any
    active: Any
    gradients: bool  # false inside `dr.suspend_grad`

    def identity(self) -> list[int]:
        """A list that is equal for two queries only if the queries have the same Dr.Jit variables, the same scope and
        the same value of `gradients`."""
        from nma.jit import dr

        scope = dr.detail.scope(dr.backend_v(self.si.wi))
        return [self.gradients, scope, *dr.detail.collect_indices((self.si, self.active))]


class _LastBrdf:
    """Keeps the BRDF of one call for the next call, so that the network runs once at a shading point.

    At each shading point, Mitsuba calls `eval_pdf` and then `sample`, because Mitsuba does not call `eval_pdf_sample`
    of Python BSDFs. Without this class, the kernel that Dr.Jit records would contain the network twice.

    The class keeps the BRDF, whose numbers are variables of the kernel that is being recorded, and the query that asked
    for the BRDF. The query keeps its own variables alive, because Dr.Jit gives the indices of freed variables to new
    variables. A BRDF with derivatives must not be kept, because the next backward pass would reach variables that no
    longer exist.

    The next call reuses the BRDF if that call makes the same query in the same scope, and otherwise deletes the BRDF.
    In another scope the BRDF's variables may not exist, because Dr.Jit records all BSDFs of a scene with the same
    arguments, each in a new scope. `keep` opens a new scope too, so only a call directly after `keep` can reuse the
    BRDF.

    This class does not declare its fields to Dr.Jit, because frozen functions must not find variables of a kernel that
    is still being recorded.
    """

    def __init__(self) -> None:
        self._kept: tuple[list[int], _Query, Brdf] | None = None

    def keep(self, query: _Query, brdf: Brdf) -> None:
        from nma.jit import dr

        dr.detail.new_scope(dr.backend_v(query.si.wi))
        self._kept = query.identity(), query, brdf

    def take(self, query: _Query) -> Brdf | None:
        kept, self._kept = self._kept, None
        return kept[2] if kept and kept[0] == query.identity() else None
