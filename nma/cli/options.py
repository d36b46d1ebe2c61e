"""Options that several commands share. Numbers have a smallest and a largest value, where they are declared."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer


def number(help: str, low: float, high: float, **more: Any) -> Any:
    """A number between two bounds, both included; NaN lies outside."""
    return typer.Option(min=low, max=high, help=help, callback=_no_nan, **more)


def _no_nan(value: float | None) -> float | None:
    """Which no bounds of typer's keep out, in some of its versions."""
    if value is not None and value != value:
        raise typer.BadParameter("NaN is no number between the bounds")
    return value


def walks(help: str) -> Any:
    return number(help, 1, 10**12)


def seed(help: str) -> Any:
    return number(help, 0, 2**32 - 1)


def samples(help: str, **more: Any) -> Any:
    """Samples per pixel."""
    return number(help, 1, 2**16, **more)


def exposure(help: str) -> Any:
    return number(help, -32, 32)


def choice(help: str, *values: str) -> Any:
    """One of some words."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in values:
            raise typer.BadParameter(f"'{value}' is not one of {', '.join(values)}")
        return value

    return typer.Option(help=f"{', '.join(values)}. {help}", callback=check)


def output(help: str, *endings: str, **more: Any) -> Any:
    """A file to write, whose name ends as those do that read it."""

    def check(path: Path | None) -> Path | None:
        if path is not None and path.suffix not in endings:
            raise typer.BadParameter(f"{path} must end in {' or '.join(endings)}")
        return path

    return typer.Option("--output", "-o", help=help, callback=check, **more)


def _network(name: str | None) -> str | None:
    """Refused at once rather than after the simulation of a material."""
    if name is not None:
        from nma.network import hidden

        hidden(name)
    return name


# As `nma.train.recipe.Recipe` and `nma.params` declare them.
TARGETS = ("principled", "stretched", "measured", "anisotropic")
POINTS_LAWS = ("crowded", "uniform", "centre")
LOSSES = ("huber", "log")
POPULATIONS = ("mixed", "range", "metals", "held_out_metals", "unseen_metals")
# Of the paper: how many instances, and whether they follow the view direction.
VARIANTS = {"blended+omega_i": (2, True), "blended": (2, False), "omega_i": (1, True), "single": (1, False)}

# Of training.
Weights = Annotated[Path, output("The weights file to write.", ".safetensors")]
Variant = Annotated[str, choice("Whether two instances are blended, and follow the direction.", *VARIANTS)]
Network = Annotated[
    str | None,
    typer.Option(help="Hidden layers, DEPTHxWIDTH, for example 5x64 or 3x32.", callback=_network),
]
Target = Annotated[
    str | None,
    choice(
        "The first has the paper's 11 numbers, the second stretches lobes along the plane of incidence, the third "
        "lets them fade out, too, the last does the same along the surface's axes.",
        *TARGETS,
    ),
]
Steps = Annotated[int | None, number("Number of optimisation steps.", 1, 10**9)]
Points = Annotated[int | None, number("Points per bin of the AvA estimate (eq. 6).", 1, 4096)]
PointsLaw = Annotated[
    str | None, choice("Where points lie: centre is point supervision, uniform the paper's.", *POINTS_LAWS)
]
Finest = Annotated[float | None, number("Microfacet width down to which points crowd.", 1e-6, 1)]
Loss = Annotated[str | None, choice("log is the paper's eq. 7.", *LOSSES)]
Albedo = Annotated[float | None, number("Weight of the error of the directional albedo; 0: none.", 0, 1e6)]
Rate = Annotated[
    float | None, number("Learning rate of Adam, its peak under the one-cycle schedule.", 1e-9, 10)
]
TrainingSeed = Annotated[int, seed("Seed of the weights, of the batches and of a simulated table.")]

# Of adapters at work.
AdapterName = Annotated[str, typer.Option(help="A shipped adapter's name or a weights file.")]
Clamp = Annotated[
    bool, typer.Option("--clamp", help="Move parameters beyond the adapter's training range to the range.")
]

# Of pictures.
Changes = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Change a parameter of the material: alpha_top=.2, albedo=.9,.1,.1 or #3366ee, conductor=Ag, "
        "sigma_t=wear.png, alpha_bottom=orm.png,channel=g. May be repeated.",
    ),
]
Camera = Annotated[str, typer.Option(help="hero, close or top.")]
Lighting = Annotated[
    str, typer.Option(help="studio, softboxes in a dim dome, or outdoors, sun, sky and a small lamp.")
]
Envmap = Annotated[
    Path | None, typer.Option(help="Light by this environment map (EXR or HDR), instead of --lighting.")
]
Size = Annotated[str, typer.Option(help="Pixels: 512 for a square, or 512x384.")]
Depth = Annotated[int, number("Longest path, in edges.", 1, 1000)]
PictureSeed = Annotated[int, seed("Equal seeds give equal pictures.")]
MitsubaVariant = Annotated[
    str,
    typer.Option(
        help="Mitsuba's variant; auto is cuda_ad_rgb where there is an NVIDIA GPU, else llvm_ad_rgb."
    ),
]
