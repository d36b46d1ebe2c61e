"""What a source of appearance offers to the rest of the package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nma import ops
from nma.jit import dr
from nma.ops import Color, Float, Mask, Vec3
from nma.params import ParamSpace


class Random(Protocol):
    """A stream of random numbers, one per lane, such as Dr.Jit's PCG32."""

    def next_float32(self) -> Float:
        """Uniform in [0, 1)."""
        ...


@dataclass
class Walk:
    """One random walk per lane, in a form that Dr.Jit's symbolic loops can carry.

    While `alive`, `direction` is where the walk is heading; once it is over and `throughput` is positive, it is wo, the
    direction in which it left (z > 0). A walk that was absorbed has throughput 0.
    """

    direction: tuple[Float, Float, Float]
    throughput: tuple[Float, Float, Float]
    height: Float  # 1 at the top of the slab, 0 at its bottom
    inside: Mask  # has entered the material
    alive: Mask

    @staticmethod
    def arriving_from(wi: Vec3) -> Walk:
        """A walk about to meet the surface from `wi` (wi.z > 0), throughput 1."""
        one = wi.x * 0.0 + 1.0
        toward = -wi
        return Walk(tuple(toward), (one, one, one), one, one < 0.5, one > 0.5)


class Source(Protocol):
    """A stochastic appearance model g(wi) -> (wo, throughput), paper eq. 8, one event at a time.

    The mean of the throughput over all walks that leave through a set of directions is the integral of f cos(theta_o)
    over that set. A model that only knows its f draws wo from a density p at the first event and returns
    f cos(theta_o) / p. Throughputs hardly exceed 1: tables count in fixed point.
    """

    space: ParamSpace

    def gather(self, columns: list[Any]) -> Any:
        """The parameters in the form `step` wants, from one array per column of the class's parameter vector."""
        ...

    def step(self, params: Any, walk: Walk, rng: Random) -> Walk:
        """Advances every walk by one event. Lanes whose walk is over may return anything: callers mask them."""
        ...


class Values(Protocol):
    """An appearance model that knows its value and nothing else: measurements, tables, networks, a renderer's BSDFs.

    `name` is what texts call it. `isotropic` says whether turning both directions about the normal changes nothing; the
    mirror image of a pair may still have another value, and a table's folded bins hold the mean of both.
    """

    @property
    def name(self) -> str: ...

    @property
    def isotropic(self) -> bool: ...

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f(wi, wo) cos(theta_o) [1/sr] for one pair of unit directions per Dr.Jit lane; 0 below the horizon.

        Linear sRGB without bounds: measured colours out of its gamut have a negative channel.

        Lanes are float32, with or without derivatives, which are not followed. The call may be traced into a kernel, so
        it neither branches on values nor reads them.
        """
        ...


def direction(mu: NDArray, phi: NDArray) -> Vec3:
    """Unit directions, one per Dr.Jit lane, from their cosines and azimuths."""
    sin = np.sqrt(1.0 - mu * mu)
    return Vec3(*(dr.auto.Float(x.astype(np.float32)) for x in (sin * np.cos(phi), sin * np.sin(phi), mu)))


def throughput(walk: Walk) -> Color:
    """The walk's throughput as a colour."""
    return Color(*walk.throughput)


def walk(source: Source, params: Any, wi: Vec3, rng: Random, active: Mask = True) -> tuple[Vec3, Color]:
    """One whole walk per lane from `wi` (wi.z > 0): (wo, throughput), wo.z > 0.

    Walks that were absorbed, and lanes that are not `active`, have throughput 0. The loop is symbolic, so this may run
    inside a renderer's own loop.
    """
    start = Walk.arriving_from(wi)
    start.alive = start.alive & active
    end, _ = dr.while_loop(
        (start, rng),
        lambda walk, rng: walk.alive,
        lambda walk, rng: (source.step(params, walk, rng), rng),
        label="walk",
    )
    out = Vec3(*end.direction)
    return out, ops.select((out.z > 0) & active, throughput(end), Color.of(0.0))
