"""Options that several commands share. Every numeric option declares its smallest and its largest value."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from nma.errors import either


def number(help: str, low: float, high: float, **more: Any) -> Any:
    """An option for a number from `low` to `high`, both included. NaN is rejected."""
    return typer.Option(min=low, max=high, help=help, callback=_no_nan, **more)


def _no_nan(value: float | None) -> float | None:
    """Rejects NaN, which some versions of typer accept although NaN is not within the bounds."""
    if value is not None and value != value:
        raise typer.BadParameter("NaN is not allowed; give a number")
    return value


def walks(help: str) -> Any:
    return number(help, 1, 10**12)


def seed(help: str) -> Any:
    return number(help, 0, 2**32 - 1)


def samples(help: str, **more: Any) -> Any:
    """An option for the number of samples per pixel."""
    return number(help, 1, 2**16, **more)


def exposure(help: str) -> Any:
    return number(help, -32, 32)


def choice(help: str, *values: str) -> Any:
    """An option whose value is one of the words `values`."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in values:
            raise typer.BadParameter(f"'{value}' is not one of {', '.join(values)}")
        return value

    return typer.Option(help=f"{', '.join(values)}. {help}", callback=check)


def ending(path: Path, endings: Iterable[str]) -> str | None:
    """The element of `endings` with which the file's name ends, or None.

    If several elements fit, such as `.json` and `.blend.json`, returns the longest element.
    """
    fitting = [text for text in endings if path.name.endswith(text) and path.name != text]
    return max(fitting, key=len, default=None)


def path(text: str | Path) -> Path:
    """Parses a path. Rejects an empty path, which Python would read as the current folder."""
    if str(text) == "":
        raise typer.BadParameter("the path is empty; name a file or a folder")
    return Path(text)


def output(help: str, *endings: str, **more: Any) -> Any:
    """The option --output: a file to write, whose name must end in one of `endings`.

    The option's callback has an attribute `endings`, which tests read.
    """

    def check(path: Path | None) -> Path | None:
        if path is not None and ending(path, endings) is None:
            raise typer.BadParameter(f"{path} must end in {either(endings)}")
        return path

    check.endings = endings  # type: ignore[attr-defined]

    return typer.Option("--output", "-o", help=help, callback=check, parser=path, **more)


def _network(name: str | None) -> str | None:
    """Rejects an invalid network size when the arguments are parsed, before a long simulation starts."""
    if name is not None:
        from nma.network import hidden

        hidden(name)
    return name


# The allowed values of options. A test checks that `nma.train.recipe.Recipe` and `nma.params` declare the same values.
TARGETS = ("principled", "stretched", "interface", "measured", "anisotropic")
POINTS_LAWS = ("crowded", "uniform", "centre")
LOSSES = ("huber", "log")
POPULATIONS = ("mixed", "broad", "range", "metals", "held_out_metals", "unseen_metals")
# The paper's variants of the target, as pairs: the number of Principled BRDFs in the blend, and whether the parameters
# of these BRDFs depend on the view direction.
VARIANTS = {"blended+omega_i": (2, True), "blended": (2, False), "omega_i": (1, True), "single": (1, False)}

# Options of commands that train.
Weights = Annotated[Path, output("The weights file to write.", ".safetensors")]
Variant = Annotated[
    str, choice("blended: two instances. omega_i: parameters depend on the view direction.", *VARIANTS)
]
Network = Annotated[
    str | None,
    typer.Option(help="Hidden layers, DEPTHxWIDTH, for example 5x64 or 3x32.", callback=_network),
]
Target = Annotated[
    str | None,
    choice(
        "principled: the paper's 11 numbers per instance. stretched: lobes can also stretch along the plane of "
        "incidence. interface: they lie under the coat of the class. measured: they can also fade out. "
        "anisotropic: as measured, along the axes of the surface.",
        *TARGETS,
    ),
]
Steps = Annotated[int | None, number("Number of optimisation steps.", 1, 10**9)]
Points = Annotated[int | None, number("Points per bin, from which its mean is estimated (eq. 6).", 1, 4096)]
PointsLaw = Annotated[
    str | None,
    choice(
        "Where the points of a bin lie. crowded: denser towards the mirror direction. uniform: as in the paper. "
        "centre: one in the middle (point supervision).",
        *POINTS_LAWS,
    ),
]
Finest = Annotated[
    float | None, number("The microfacet width down to which crowded points get denser.", 1e-6, 1)
]
Loss = Annotated[
    str | None, choice("log: the paper's eq. 7. huber: quadratic within the noise of a bin.", *LOSSES)
]
Dim = Annotated[
    float | None,
    number("Weight of the error of log(.02 + value), which sees dim bins; 0 turns it off.", 0, 1e6),
]
Albedo = Annotated[
    float | None, number("Weight of the error of the directional albedo; 0 turns it off.", 0, 1e6)
]
Rate = Annotated[
    float | None, number("Learning rate of Adam; under the one-cycle schedule, its peak.", 1e-9, 10)
]
TrainingSeed = Annotated[int, seed("Seed of the weights, of the batches and of a simulated table.")]

# Options of commands that use an adapter.
# The value of `nma.adapter.DEFAULT_ADAPTER`, whose import would slow down `--help`.
DEFAULT_ADAPTER = "layered3-3x32"
AdapterName = Annotated[str, typer.Option(help="A shipped adapter's name or a weights file.")]
Clamp = Annotated[
    bool,
    typer.Option(
        "--clamp", help="Move parameters outside the adapter's training range to its nearest bound."
    ),
]

# Options of commands that render.
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
    str, typer.Option(help="studio: softboxes in a dim dome. outdoors: sun, sky and a small lamp.")
]
Envmap = Annotated[
    Path | None,
    typer.Option(
        help="Light the scene by this environment map (EXR or HDR), instead of --lighting.",
        parser=path,
    ),
]
Size = Annotated[str, typer.Option(help="Pixels: 512 for a square, or 512x384.")]
Depth = Annotated[int, number("Longest light path, in edges.", 1, 1000)]
PictureSeed = Annotated[int, seed("Equal seeds give equal pictures.")]
MitsubaVariant = Annotated[
    str,
    typer.Option(
        help="Mitsuba's variant; auto is cuda_ad_rgb where there is an NVIDIA GPU, else llvm_ad_rgb."
    ),
]
