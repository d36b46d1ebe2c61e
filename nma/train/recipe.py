"""The settings of a training run. The settings are stored with the weights, so that the run can be repeated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin, get_type_hints

from nma import network, sources
from nma.adapter import encoding
from nma.errors import NmaError
from nma.params import ParamSpace
from nma.table import ISOTROPIC, Grid
from nma.table.quadrature import FINEST
from nma.target import TARGETS, TargetParam


@dataclass(frozen=True)
class Recipe:
    """Settings of a training run.

    A row is a bin of wi of one material. A training step takes `rows` random rows, and `bins_per_row` bins of wo in
    each row. The step runs the network once per row, and averages the target over `points` points per bin.

    - `target`: "principled" has the paper's 11 parameters per instance. "stretched" adds one parameter, which stretches
      the specular lobe along the plane of incidence. "interface" is for classes whose uppermost layer is the interface
      of a rough dielectric: the instances lie under the interface, whose own reflection is exact
      (`nma.target.interface`). "measured" adds to "stretched" three more parameters per instance: one flattens the
      diffuse lobe, and two fade out the whole instance where the half vector is far from the normal. "anisotropic" has
      the parameters of "measured", but stretches lobes along the axes of the surface.
    - `without`: parameters of the target that the network does not set. They are 0.
    - `grid`: the resolution of the tables.
    - `bounded`: if true, the target is dimmed where it might reflect more light than it receives. Targets that are not
      `directional` are never dimmed.
    - `points_law`: how the points of a bin are drawn. "crowded" points are denser towards the mirror direction
      (`nma.table.quadrature`). "uniform" points are uniform over the bin, as in the paper. "centre" is a single point
      in the middle of the bin (point supervision).
    - `finest`: smallest microfacet width (alpha) that "crowded" points resolve.
    - `bins_law`: how bins are chosen. "uniform" chooses bins uniformly. "mirror" chooses half of the bins uniformly and
      half near the mirror direction, with weights that correct the bias of this choice.
    - `loss`: "log" is eq. 7. "huber" is linear like eq. 7 for residuals beyond three standard errors of the table's
      bin, and quadratic for smaller residuals. The quadratic part makes the fit of a noisy bin approach the bin's mean,
      not its median.
    - `energy`: weight of the error of the values themselves, which is added to the error of their logarithms. The
      larger `energy` is, the more bright bins count.
    - `dim`: weight of the error of log(`dim_floor` + value), which sees relative errors in dim bins. eq. 7 hardly sees
      them, because its logarithm is that of 1 + value.
    - `albedo`: weight of the squared error of the directional albedo, which is estimated from two times
      `albedo_samples` samples per row.
    - `albedo_floor`: if above 0, errors of the albedo are relative to `albedo_floor` + albedo, so that dark materials
      count as much as bright ones.
    - `schedule`: how the learning rate changes. "onecycle" rises to `learning_rate` and falls again. "plateau" starts
      at `learning_rate` and halves the rate when the loss stalls. "constant" keeps `learning_rate`.
    - `average`: decay of the exponential moving average of the weights; 0 means no averaging.
    """

    network: str = "5x64"
    instances: int = 2
    directional: bool = True
    target: Literal["principled", "stretched", "interface", "measured", "anisotropic"] = "principled"
    without: tuple[str, ...] = ()
    bounded: bool = True
    encoding: str = "layered3"
    rows: int = 512
    bins_per_row: int = 8
    points: int = 8
    points_law: Literal["crowded", "uniform", "centre"] = "crowded"
    finest: float = FINEST
    bins_law: Literal["mirror", "uniform"] = "mirror"
    loss: Literal["huber", "log"] = "huber"
    energy: float = 0.05
    dim: float = 0.0
    dim_floor: float = 0.02
    albedo: float = 1.0
    albedo_floor: float = 0.0
    albedo_samples: int = 8
    schedule: Literal["onecycle", "plateau", "constant"] = "onecycle"
    learning_rate: float = 3e-3
    average: float = 0.999
    steps: int = 150_000
    seed: int = 0
    grid: Grid = ISOTROPIC

    def __post_init__(self) -> None:
        positive = (
            *("finest", "rows", "bins_per_row", "points", "albedo_samples"),
            *("steps", "learning_rate", "instances"),
        )
        for name in positive:
            if not getattr(self, name) > 0:
                raise NmaError(f"{name} must be positive, got {getattr(self, name)}")
        if self.network != "none":
            network.hidden(self.network)
        for name, hint in get_type_hints(Recipe).items():
            if get_origin(hint) is Literal and getattr(self, name) not in get_args(hint):
                raise NmaError(f"{name} is one of {', '.join(get_args(hint))}; got '{getattr(self, name)}'")
        if self.target in ("stretched", "interface", "measured") and not self.directional:
            raise NmaError(
                "a target stretched along the plane of incidence depends on the direction, so it cannot have constant "
                "parameters; use the target 'principled'"
            )
        names = {p.name for p in TARGETS[self.target]} - {"base_color"}
        if unknown := set(self.without) - names:
            raise NmaError(
                f"the target '{self.target}' cannot be without {', '.join(sorted(unknown))}; it can be without "
                f"{', '.join(sorted(names))}"
            )
        if bool(self.grid.phi_i) != (self.target == "anisotropic"):
            raise NmaError(
                "the target 'anisotropic' needs a grid with azimuths of wi, and such a grid needs this target; "
                "set both, or neither"
            )
        if not 0 <= self.average < 1:
            raise NmaError(f"average must be at least 0 and below 1, got {self.average}")

    @property
    def params(self) -> tuple[TargetParam, ...]:
        """The parameters of an instance that the network sets."""
        return tuple(p for p in TARGETS[self.target] if p.name not in self.without)

    @property
    def bounds_energy(self) -> bool:
        """Whether the target is dimmed.

        A target with constant parameters is not dimmed, so that it stays reciprocal.
        """
        return self.bounded and self.directional

    @property
    def bins_per_step(self) -> int:
        return self.rows * self.bins_per_row


CLASS = Recipe()

# The paper's recipe (section 3.4), for comparison.
PAPER = Recipe(
    bounded=False,
    encoding="raw",
    rows=1000,
    bins_per_row=1,
    points=20,
    points_law="uniform",
    bins_law="uniform",
    loss="log",
    energy=0.0,
    albedo=0.0,
    learning_rate=1e-5,
    average=0.0,
)

# This recipe is for one material, so its network is small and has the direction as its only input.
SINGLE = Recipe(
    network="3x32",
    encoding="direction",
    target="stretched",
    rows=160,
    bins_per_row=16,
    albedo=0.3,
    albedo_samples=16,
    schedule="plateau",
    learning_rate=5e-3,
    average=0.99,
    steps=6_000,
)

# This recipe is for one material whose values have no noise: a measurement, a tabulated material, or a BSDF of another
# program.
MEASURED = replace(
    SINGLE,
    target="measured",
    # The bound on the reflected light ignores that lobes may be faded out, so the bound would dim bright lobes that
    # reflect little light anyway.
    bounded=False,
    rows=512,
    bins_per_row=64,
    points=1,
    energy=0.02,
    albedo=0.1,
    albedo_samples=4,
    loss="log",
    schedule="onecycle",
    learning_rate=1e-2,
    average=0.0,
    steps=16_000,
)
# The recipe `MEASURED` for an anisotropic material.
ANISOTROPIC = replace(
    MEASURED, encoding="azimuth", target="anisotropic", grid=Grid(theta_i=20, theta_o=20, phi_o=40, phi_i=40)
)

PRESETS = {
    "class": CLASS,
    "paper": PAPER,
    "single": SINGLE,
    "measured": MEASURED,
    "anisotropic": ANISOTROPIC,
}


# Changes of presets for classes whose uppermost layer is the interface of a rough dielectric.
_BELOW: dict[str, dict[str, Any]] = {
    "class": {
        "target": "interface",
        "energy": 0.15,
        "dim": 0.05,
        "albedo": 0.2,
        "albedo_floor": 0.1,
        "steps": 50_000,
    },
    "single": {"target": "interface"},
}


def preset(name: str, **changes) -> Recipe:
    """The preset `name` with `changes` to some settings; the value `None` leaves a setting unchanged."""
    if name not in PRESETS:
        raise NmaError(f"unknown preset '{name}'; known presets are {', '.join(PRESETS)}")
    return replace(PRESETS[name], **{k: v for k, v in changes.items() if v is not None})


def for_class(space: ParamSpace, name: str = "class", **changes) -> Recipe:
    """The preset `name` for a class, with `changes` as for `preset`.

    If the class has an interface, the target of the presets `class` and `single` lies under the interface, unless
    `changes` say otherwise. If the preset's encoding is named after a class, it is replaced by the encoding of the
    class `space` for the target, or by `raw` if this class has no encoding.
    """
    given = {k: v for k, v in changes.items() if v is not None}
    if space.interface and given.get("directional", True) and given.get("target", "interface") == "interface":
        given = _BELOW.get(name, {}) | given
    recipe = preset(name, **given)
    if recipe.encoding not in sources.classes():
        return recipe
    return replace(recipe, encoding=encoding.of_class(space, under_interface=recipe.target == "interface"))
