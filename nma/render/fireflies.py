"""Removes fireflies: an integrator that dims samples brighter than a limit."""

from __future__ import annotations

from typing import Any

from nma.errors import ParamError


def clamped(integrator: Any, limit: float) -> Any:
    """An integrator that wraps Mitsuba's `integrator` and limits its samples; pass it to `mi.render`.

    A sample whose brightest channel exceeds `limit` [radiance] is scaled down to the limit, so that it keeps its
    colour. The radiance beyond the limit is lost, so pictures become darker, most of all in caustics and where few
    paths reach the light.

    Raises:
        ParamError: the integrator does not trace one path for each sample, or writes channels other than colour.
    """
    import mitsuba

    from nma.jit import dr

    mi: Any = mitsuba  # Mitsuba's types change with the variant
    if not isinstance(integrator, mi.SamplingIntegrator) or isinstance(integrator, mi.CppADIntegrator):
        raise ParamError(
            "samples can be clamped only if each sample is one path; use the integrator path, volpath or direct"
        )
    if integrator.aov_names():
        others = ", ".join(integrator.aov_names())
        raise ParamError(
            f"samples cannot be clamped if the integrator also writes other channels ({others}); render colours only"
        )

    class Clamped(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            radiance, valid, channels = integrator.sample(scene, sampler, ray, medium, active)
            return radiance * (limit / dr.maximum(dr.max(radiance), limit)), valid, channels

    return Clamped(mi.Properties())
