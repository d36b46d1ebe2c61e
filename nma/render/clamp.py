"""Against fireflies: an integrator that dims samples brighter than a limit."""

from __future__ import annotations

from typing import Any

from nma.errors import ParamError


def clamped(integrator: Any, limit: float) -> Any:
    """Another integrator around Mitsuba's `integrator`, to be passed to `mi.render`.

    Samples of a pixel whose brightest channel exceeds `limit` [radiance] are scaled down to it and keep their colour.
    What they carried beyond is lost, so pictures become darker: most where light arrives by chance, as caustics do.

    Raises:
        ParamError: an integrator that does not trace one path for each sample, or writes other channels than colour.
    """
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # its types change with the variant
    if not isinstance(integrator, mi.SamplingIntegrator) or isinstance(integrator, mi.CppADIntegrator):
        raise ParamError("samples can only be clamped where each is one path: use path, volpath or direct")
    if integrator.aov_names():
        others = ", ".join(integrator.aov_names())
        raise ParamError(f"samples cannot be clamped beside other channels ({others}); render colours alone")

    class Clamped(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            radiance, valid, channels = integrator.sample(scene, sampler, ray, medium, active)
            return radiance * (limit / dr.maximum(dr.max(radiance), limit)), valid, channels

    return Clamped(mi.Properties())
