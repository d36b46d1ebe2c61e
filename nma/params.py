"""Declares the parameters of classes of materials. Training, rendering, the command line and the exports read these
declarations.

This file declares `layered3` and the classes without a source. Every other class declares its parameters in the file of
its source. `nma.sources.space` finds the parameters of every class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nma import ops
from nma.conductors import load_conductors
from nma.errors import ParamError

Law = Literal["uniform", "log10", "one_minus_square", "conductor"]
Population = Literal["mixed", "broad", "range", "metals", "held_out_metals", "unseen_metals"]
Range = Literal["training", "valid"]

# A parameter may exceed a bound by ROUNDING, or by ROUNDING times the range if the range is narrower than 1. Textures
# and other languages store parameters in single precision, whose rounding moves the bounds of our classes by up to
# 1e-7.
ROUNDING = 1e-6
# The advice at the end of the error message for a parameter that is out of range.
_ADVICE = {
    "training": ", the range that the adapter was trained on; set `clamp` to clamp such values",
    "valid": "; choose a value within this range",
}


class Bounds(NamedTuple):
    """The range from `low` to `high`. Every check of a parameter calls `bad`, and reports the message that `refusal`
    returns.

    The methods accept NumPy or Dr.Jit arrays. `low` and `high` may also be arrays, with one bound per column.
    """

    low: Any
    high: Any

    def bad(self, x: Any, clamp: bool = False) -> Any:
        """Whether each number is not finite or, without `clamp`, out of range by more than rounding (`ROUNDING`)."""
        finite = abs(x) < np.inf
        if clamp:
            return ~finite
        slack = ROUNDING * ops.minimum(self.high - self.low, 1.0)
        return ~(finite & (x >= self.low - slack) & (x <= self.high + slack))

    def moved(self, x: Any) -> Any:
        """`x` clamped to the bounds; NaN becomes the lower bound. Where `x` equals a bound, the derivative is 1."""
        return ops.select(x >= self.low, ops.select(x <= self.high, x, self.high), self.low)

    def refusal(self, name: str, found: ArrayLike, kind: Range = "valid") -> str:
        """The error message for a bad number or triple `found`. A grey triple is shown as one number."""
        numbers = [f"{x:.7g}" for x in np.ravel(np.asarray(found, np.float64))]
        shown = ", ".join(numbers if len(set(numbers)) > 1 else numbers[:1])
        return f"{name} is {shown}, allowed is {self.low:g} .. {self.high:g}{_ADVICE[kind]}"


@dataclass(frozen=True)
class Param:
    """One parameter of a class: a number (size 1) or an RGB triple (size 3).

    `law` names the distribution from which training draws the parameter. With "log10", the parameter's logarithm is
    uniform. With "one_minus_square", the parameter is 1 - U^2 for a uniform U. With "conductor", the parameter comes
    from real metals or from a uniform distribution (CONVENTIONS.md). Adapters accept the training range, `low` to
    `high`. Sources accept the physically meaningful range, `valid_low` to `valid_high`.
    """

    name: str
    symbol: str
    law: Law
    low: float
    high: float
    valid_low: float
    valid_high: float
    description: str
    size: int = 1

    def normalise(self, x):
        """Maps the training range to [0, 1]: linearly, or logarithmically if the law is "log10"."""
        if self.law == "log10":
            span = np.log(self.high / self.low)
            return ops.log(x / self.low) * float(1.0 / span)
        return (x - self.low) / (self.high - self.low)

    def draw(self, rng: np.random.Generator, n: int) -> NDArray[np.float64]:
        """Random values (n, size), drawn from the parameter's law. For the law "conductor", the values are uniform (see
        `ParamSpace.sample`)."""
        return self._of_unit(rng.random((n, self.size)))

    def draw_extreme(self, rng: np.random.Generator, n: int) -> NDArray[np.float64]:
        """Random values (n, size) that are denser towards both ends of the training range. Half of the colours are
        grey."""
        u = rng.beta(0.5, 0.5, (n, self.size))
        grey = rng.random((n, 1)) < 0.5
        return self._of_unit(np.where(grey, u[:, :1], u))

    def _of_unit(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Maps uniform random numbers to values that follow the parameter's law."""
        if self.law == "log10":
            return 10.0 ** (np.log10(self.low) + u * np.log10(self.high / self.low))
        if self.law == "one_minus_square":
            return 1.0 - u * u
        return self.low + u * (self.high - self.low)

    def bounds(self, kind: Range) -> Bounds:
        return Bounds(*((self.low, self.high) if kind == "training" else (self.valid_low, self.valid_high)))


@dataclass(frozen=True)
class ParamSpace:
    """The parameters of a class, in the order of the columns of a parameter vector.

    If the uppermost layer of the class is the interface of a rough dielectric, `interface` names the two parameters
    that are its microfacet width and its index of refraction. Targets whose lobes lie under an interface need them.
    """

    name: str
    params: tuple[Param, ...]
    interface: tuple[str, str] | None = None

    @property
    def size(self) -> int:
        """Number of columns of a parameter vector."""
        return sum(p.size for p in self.params)

    @property
    def slices(self) -> dict[str, slice]:
        """For each parameter, by name, its columns in a parameter vector."""
        ends = np.cumsum([p.size for p in self.params])
        return {p.name: slice(int(e) - p.size, int(e)) for p, e in zip(self.params, ends, strict=True)}

    @property
    def interface_columns(self) -> tuple[int, ...]:
        """The columns of the two parameters of the interface; empty for a class without an interface."""
        return tuple(self.slices[name].start for name in self.interface or ())

    def __getitem__(self, name: str) -> Param:
        for p in self.params:
            if p.name == name:
                return p
        raise ParamError(
            f"class {self.name} has no parameter '{name}'; it has {', '.join(p.name for p in self.params)}"
        )

    def vector(self, values: dict[str, ArrayLike]) -> NDArray[np.float64]:
        """The parameter vector (size,) from the value of each parameter, by name. A single number for an RGB parameter
        means grey."""
        unknown = set(values) - {p.name for p in self.params}
        missing = [p.name for p in self.params if p.name not in values]
        if unknown or missing:
            raise ParamError(
                f"class {self.name}: "
                + "; ".join(
                    [f"unknown parameter '{u}'" for u in sorted(unknown)]
                    + [f"missing parameter '{m}'" for m in missing]
                )
            )
        out = np.empty(self.size)
        for name, columns in self.slices.items():
            try:
                value = np.asarray(values[name], np.float64)
            except (TypeError, ValueError):
                raise ParamError(f"{name} needs numbers, got {values[name]!r}") from None
            if value.ndim > 1 or value.size not in (1, columns.stop - columns.start):
                raise ParamError(
                    f"{name} needs {columns.stop - columns.start} number(s), got shape {value.shape}"
                )
            out[columns] = value
        return out

    def check(self, params: ArrayLike, bounds: Range = "valid", clamp: bool = False) -> NDArray[np.float64]:
        """Returns `params` as float64 (n, size) within the bounds. Raises `ParamError`, which names the first bad
        value.

        Values that exceed a bound by a rounding error are replaced by the bound. With `clamp`, all values out of range
        are replaced by the nearest bound. Values that are not finite raise the error even with `clamp`.
        """
        p = np.atleast_2d(np.asarray(params, np.float64))
        if p.ndim != 2 or p.shape[1] != self.size:
            raise ParamError(
                f"parameters of class {self.name} have shape (n, {self.size}), got {np.shape(params)}"
            )
        for param in self.params:
            values, allowed = p[:, self.slices[param.name]], param.bounds(bounds)
            bad = allowed.bad(values, clamp).any(axis=1)
            if bad.any():
                row = int(np.argmax(bad))
                where = f"material {row}: " if len(p) > 1 else ""
                raise ParamError(where + allowed.refusal(param.name, values[row], bounds))
        return Bounds(*self.columns(bounds)).moved(p)

    def columns(self, bounds: Range) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The lower and the upper bound of each column."""
        pairs = np.array([p.bounds(bounds) for p in self.params for _ in range(p.size)]).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def sample(
        self, rng: np.random.Generator, n: int, population: Population = "mixed"
    ) -> NDArray[np.float64]:
        """Random parameter vectors (n, size), drawn from the law of each parameter.

        For classes with a conductor, `population` chooses how (eta, k) is drawn. "range" draws every channel uniformly.
        "metals" draws from the real metals, except those held out for tests. "held_out_metals" draws only from the
        metals held out. "mixed", for training, uses "range" or "metals" with equal probability. "broad", for training,
        draws a third of the materials from "range", a third from "metals", and a third from "metals" with all other
        parameters near the ends of their ranges (`Param.draw_extreme`), where the materials lie that people choose.
        "unseen_metals", for tests, draws every third material from the metals held out and the other materials from the
        other metals.
        """
        if population not in get_args(Population):
            raise ParamError(
                f"unknown population '{population}'; known are {', '.join(get_args(Population))}"
            )
        out = np.concatenate([np.empty((n, 0)), *(p.draw(rng, n) for p in self.params)], axis=1)
        if not any(p.law == "conductor" for p in self.params) or population == "range":
            return out
        metals = load_conductors()
        known, held_out = np.nonzero(~metals.held_out)[0], np.nonzero(metals.held_out)[0]
        pick = known[rng.integers(len(known), size=n)]
        choice = rng.random(n)
        rows = np.ones(n, bool)
        if population == "mixed":
            rows = choice < 0.5
        if population == "broad":
            rows = choice < 2 / 3
            extreme = np.concatenate([p.draw_extreme(rng, n) for p in self.params], axis=1)
            out[choice < 1 / 3] = extreme[choice < 1 / 3]
        if population in ("held_out_metals", "unseen_metals"):
            step = 1 if population == "held_out_metals" else 3
            pick[::step] = held_out[rng.integers(len(held_out), size=len(pick[::step]))]
        out[rows, self.slices["eta_conductor"]] = metals.eta[pick[rows]]
        out[rows, self.slices["k_conductor"]] = metals.k[pick[rows]]
        return out


# The largest refractive index and the largest optical depth that sources accept. Larger indices would make Fresnel
# terms overflow in single precision. In a white medium, the number of steps of a random walk grows with about the
# square of the depth, so at larger depths the program would seem to hang.
_MAX_INDEX, _MAX_DEPTH = 1e4, 1e3

LAYERED3 = ParamSpace(
    "layered3",
    (
        Param("alpha_top", "alpha_1", "log10", 1e-3, 10**-0.5, 1e-4, 1.0, "microfacet width of the coat"),
        Param("alpha_bottom", "alpha_2", "log10", 1e-3, 1.0, 1e-4, 1.0, "microfacet width of the conductor"),
        Param("eta_top", "eta_1", "uniform", 1.05, 2.0, 1.0, 4.0, "refractive index of the coat"),
        Param(
            "eta_conductor",
            "eta",
            "conductor",
            0.03,
            7.6,
            0.0,
            _MAX_INDEX,
            "real part of the conductor's index",
            3,
        ),
        Param(
            "k_conductor",
            "kappa",
            "conductor",
            0.0,
            9.5,
            0.0,
            _MAX_INDEX,
            "imaginary part of the conductor's index",
            3,
        ),
        Param(
            "albedo",
            "rho",
            "one_minus_square",
            0.0,
            1.0,
            0.0,
            1.0,
            "single-scattering albedo of the medium",
            3,
        ),
        Param(
            "sigma_t",
            "sigma_t",
            "uniform",
            0.0,
            1.0,
            0.0,
            _MAX_DEPTH,
            "optical depth of the medium (thickness 1)",
        ),
    ),
    interface=("alpha_top", "eta_top"),
)

# The class of materials that have no parameters, only BRDF values: measured, tabulated, or from another program's BSDF.
MEASURED = ParamSpace("measured", ())

# The class of the materials of a library (`nma.adapter.library`). The only parameter of this class is the learned code
# of a material. The individual numbers of a code have no meaning.
CODE_BOUND = 4.0
LIBRARY = ParamSpace(
    "library",
    (
        Param(
            "code",
            "z",
            "uniform",
            -CODE_BOUND,
            CODE_BOUND,
            -CODE_BOUND,
            CODE_BOUND,
            "place in the latent space",
            32,
        ),
    ),
)
