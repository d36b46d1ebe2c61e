"""The interfaces of sources: models that random walks sample (`Source`), and models that are evaluated (`Values`)."""

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
    """A random number generator with one stream per lane, such as Dr.Jit's PCG32."""

    def next_float32(self) -> Float:
        """The next number of each stream, uniform in [0, 1)."""
        ...


@dataclass
class Walk:
    """One random walk per lane, in a form that can be the state of a symbolic loop of Dr.Jit.

    `direction` is the direction in which an `alive` walk travels. Once a walk has left the material, `direction` is wo
    (z > 0). A walk that was absorbed has throughput 0.
    """

    direction: tuple[Float, Float, Float]
    throughput: tuple[Float, Float, Float]
    height: Float  # 1 at the top of the slab, 0 at its bottom
    inside: Mask  # true once the walk has entered the material
    alive: Mask

    @staticmethod
    def arriving_from(wi: Vec3) -> Walk:
        """A walk with throughput 1 that is about to hit the surface from `wi` (wi.z > 0)."""
        one = wi.x * 0.0 + 1.0
        toward = -wi
        return Walk(tuple(toward), (one, one, one), one, one < 0.5, one > 0.5)


class Source(Protocol):
    """A stochastic appearance model g(wi) -> (wo, throughput), paper eq. 8, simulated event by event.

    A walk leaves the material in a direction wo, with a throughput. For any set of directions, the integral of f
    cos(theta_o) over the set is the expected throughput of a walk. In this mean, a walk that leaves outside the set has
    throughput 0. A model that can only evaluate f may draw wo from a density p at the first event and return the
    throughput f cos(theta_o) / p. Throughputs should hardly exceed 1, because tables sum them as 32-bit integers, which
    could overflow.
    """

    space: ParamSpace

    def gather(self, columns: list[Any]) -> Any:
        """Converts the parameters, one array per column of the class's parameter vector, to the form `step` takes."""
        ...

    def step(self, params: Any, walk: Walk, rng: Random) -> Walk:
        """Advances every walk by one event.

        The results for walks that have ended may be arbitrary, because callers ignore these results.
        """
        ...


class Values(Protocol):
    """An appearance model that can only be evaluated: a measurement, a table, a network or a renderer's BSDF.

    `name` is the model's name in messages. `isotropic` is true if the value stays the same when both directions are
    rotated about the normal by the same angle. An isotropic model may still have different values for a pair of
    directions and for the mirror image of the pair. An isotropic table has the same bin for a pair and its mirror
    image, and the bin's value is the mean over both.
    """

    @property
    def name(self) -> str: ...

    @property
    def isotropic(self) -> bool: ...

    def eval(self, wi: Vec3, wo: Vec3) -> Color:
        """f(wi, wo) cos(theta_o) [1/sr] for one pair of unit directions per Dr.Jit lane.

        The value is 0 if a direction is below the horizon. The colour is linear sRGB without bounds: a measured colour
        outside the gamut has a negative channel.

        The numbers in the lanes are float32. Their type may be a differentiable type of Dr.Jit, but `eval` does not
        propagate derivatives. Dr.Jit may trace the call into a kernel, so `eval` must not read the values of lanes or
        branch on them.
        """
        ...


def direction(mu: NDArray, phi: NDArray) -> Vec3:
    """Unit directions, one per Dr.Jit lane, from their cosines `mu` and azimuths `phi` [rad], both (n,)."""
    sin = np.sqrt(1.0 - mu * mu)
    return Vec3(*(dr.auto.Float(x.astype(np.float32)) for x in (sin * np.cos(phi), sin * np.sin(phi), mu)))


def throughput(walk: Walk) -> Color:
    """The walk's throughput as a colour."""
    return Color(*walk.throughput)


def walk(source: Source, params: Any, wi: Vec3, rng: Random, active: Mask = True) -> tuple[Vec3, Color]:
    """Runs one walk per lane from `wi` (wi.z > 0) to its end, and returns (wo, throughput), with wo.z > 0.

    The throughput is 0 where the walk was absorbed or the lane is not `active`. The loop is symbolic, so the function
    can be called inside a renderer's own loop.
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
