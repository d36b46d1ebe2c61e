"""Errors of pictures rendered with the shipped adapters and the variant "single", by samples per pixel (paper Table 2).

    python -m figures.rendered.run [--quick] [--materials N] [--resolution N] [--spp N] [--reference-spp N]
        [--single WEIGHTS] [--only SUBJECT ...]

The error of a picture with few samples per pixel is mostly noise. Therefore the adapters are compared with a converged
simulation at an increasing number of samples per pixel. A second simulation is compared with the converged simulation
in the same way. The second simulation's error is only noise, and shows how much of an adapter's error is noise. The
script takes about two hours on one core. The pictures are kept in out/figures/rendered, so a killed run continues where
it stopped, and processes with different --only can share the work.

Prints the tables of README.md, and writes tables.md, rendered.json, rendered.png and materials.png beside this file.
With --quick, renders a few small pictures and writes to out/figures/rendered.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
import nma.render
from figures import common, studio
from nma.adapter import DEFAULT_ADAPTER
from nma.cli.console import progress
from nma.files import write_text
from nma.images.metrics import METRICS
from nma.images.sheet import Row, contact_sheet
from nma.render.load import material_bsdf

SIMULATION, AGAIN, SINGLE = "reference", "simulation again", "single"
# From the paper's Table 2: the FLIP of the variant "blended + omega_i", and its ratio to the FLIP of the variant
# "single".
PAPER = {"flip_hdr": (0.0432, 0.89), "flip_ldr": (0.0352, 0.91)}
# Weights of the variant "single", trained by figures/variants with its first seed.
SINGLE_WEIGHTS = common.ROOT / "out/figures/variants/single_8000_6000-steps_seed-0.safetensors"
# Correlated multi-jittered samples (Kensler 2013). At 64 samples per pixel, multi-jittered samples reduce the
# adapters' variance to a sixth of the variance with independent samples, and the simulation's variance to two thirds.
SAMPLER = "multijitter"
FIRST_LEVEL = 64
# The second simulation has at most AGAIN_SPP samples per pixel, which is enough to see how its noise falls.
AGAIN_SPP = 256
ROWS = 4


class Subject(NamedTuple):
    """An adapter, or the simulation if `weights` is None, with its seed and its largest number of samples per pixel."""

    name: str
    weights: Path | str | None
    spp: int
    seed: int

    def bsdf(self, material: nma.materials.Material) -> dict[str, Any]:
        if self.weights is None:
            return material_bsdf(material, "layered")
        return material_bsdf(material, "nma", adapter=self.weights)

    @property
    def key(self) -> str:
        """The prefix of the pictures' file names. The prefix contains a hash of the weights, so that pictures are
        rendered again after the weights have changed."""
        if self.weights is None:
            return f"layered_seed-{self.seed}"
        layers = nma.Adapter.load(self.weights).layers
        weights = b"".join(np.asarray(part, np.float32).tobytes() for layer in layers for part in layer)
        return f"{self.name}_{hashlib.sha256(weights).hexdigest()[:12]}"


def main() -> None:
    arguments = parse()
    folder = common.results(__file__, arguments.quick)
    kept = common.ROOT / "out/figures/rendered" / ("quick" if arguments.quick else "pictures")
    count, population, seed = common.SETS["range"]
    params = nma.LAYERED3.sample(np.random.default_rng(seed), count, population)[: arguments.materials]
    materials = [studio.material(number, row) for number, row in enumerate(params)]
    nma.render.use()
    pictures = {}
    for subject in subjects(arguments):
        if not arguments.only or subject.name in arguments.only:
            pictures[subject.name] = gallery(subject, materials, arguments.resolution, kept)
    if not arguments.only:
        report(pictures, materials, arguments, folder)


def parse() -> argparse.Namespace:
    parser = common.parser(__doc__)
    parser.add_argument(
        "--materials", type=int, default=89, help="how many of the 89 materials, from the first"
    )
    parser.add_argument("--resolution", type=int, default=96, help="size of the pictures, in pixels")
    parser.add_argument("--spp", type=int, default=1024, help="the most samples per pixel of the adapters")
    parser.add_argument("--reference-spp", type=int, default=4096, help="samples per pixel of the simulation")
    parser.add_argument("--single", type=Path, default=SINGLE_WEIGHTS, help="weights of the variant single")
    parser.add_argument("--only", nargs="+", help="render only these, and report nothing")
    arguments = parser.parse_args()
    if arguments.quick:
        vars(arguments).update(materials=2, resolution=64, spp=128, reference_spp=128)
    return arguments


def subjects(arguments: argparse.Namespace) -> list[Subject]:
    spp = arguments.spp
    found = [
        Subject(SIMULATION, None, arguments.reference_spp, 1),
        Subject(AGAIN, None, min(spp, AGAIN_SPP), 2),
    ]
    found += [Subject(name, name, spp, 3) for name in nma.shipped()]
    if arguments.single.exists():
        found.append(Subject(SINGLE, arguments.single, spp, 3))
    elif not arguments.quick:
        sys.exit(
            f"{arguments.single} does not exist; `python -m figures.variants.run --only single --seeds 1` makes it"
        )
    return found


def levels(spp: int) -> list[int]:
    """Returns the samples per pixel of the stored pictures: FIRST_LEVEL, doubled repeatedly up to `spp`."""
    found = [min(FIRST_LEVEL, spp)]
    while found[-1] < spp:
        found.append(min(2 * found[-1], spp))
    return found


def gallery(
    subject: Subject, materials: list[nma.materials.Material], size: int, kept: Path
) -> list[NDArray[np.float32]]:
    """Returns each material's pictures (levels, size, size, 3), and renders the pictures whose file is missing."""
    found, bar = [], progress("materials/min")
    with bar:
        task = bar.add_task(subject.name, total=len(materials), rate="", note=f"{subject.spp} spp")
        for number, material in enumerate(materials):
            path = kept / f"{subject.key}_{size}px_{subject.spp}-spp_{number}.npy"
            if not path.exists():
                common.save_array(
                    path, converge(subject, subject.bsdf(material), size, earlier(path, subject))
                )
            found.append(np.load(path))
            rate = bar.tasks[task].speed
            bar.update(task, advance=1, rate=f"{60 * rate:.1f}" if rate else "")
    return found


def earlier(path: Path, subject: Subject) -> list[NDArray[np.float32]]:
    """Returns the pictures that an earlier run with fewer samples per pixel has rendered, or an empty list."""
    for spp in reversed(levels(subject.spp)[:-1]):
        shorter = path.with_name(path.name.replace(f"_{subject.spp}-spp_", f"_{spp}-spp_"))
        if shorter.exists():
            return list(np.load(shorter))
    return []


def converge(
    subject: Subject, bsdf: dict[str, Any], size: int, found: list[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Renders pictures (levels, size, size, 3), where each level adds samples to the picture of the previous level.

    Args:
        found: the pictures of the lowest levels that an earlier run has rendered; may be empty.
    """
    steps = levels(subject.spp)
    before = steps[len(found) - 1] if found else 0
    total = before * found[-1].astype(np.float64) if found else np.zeros((size, size, 3))
    for number, level in list(enumerate(steps))[len(found) :]:
        more = studio.render(bsdf, size, level - before, seed=1000 * subject.seed + number, sampler=SAMPLER)
        total += (level - before) * more.astype(np.float64)
        before = level
        found.append((total / level).astype(np.float32))
    return np.asarray(found)


def report(
    pictures: dict[str, list[NDArray[np.float32]]],
    materials: list[nma.materials.Material],
    arguments: argparse.Namespace,
    folder: Path,
) -> None:
    """Compares the pictures with the references, prints the tables, and writes metrics, tables, plot and sheet."""
    references = [levels_of_it[-1] for levels_of_it in pictures[SIMULATION]]
    steps = levels(arguments.spp)
    errors = {
        name: {
            spp: compare([own[n] for own in images], references)
            for n, spp in enumerate(steps)
            if n < len(images[0])
        }
        for name, images in pictures.items()
        if name != SIMULATION
    }
    means = {
        name: {spp: {metric: mean(row, metric) for metric in METRICS} for spp, row in by_spp.items()}
        for name, by_spp in errors.items()
    }
    text = markdown(means, arguments)
    print(text)
    write_text(folder / "tables.md", text)
    settings = {key: getattr(arguments, key) for key in ("materials", "resolution", "spp", "reference_spp")}
    flips = {
        name: {metric: [round(row[metric], 5) for row in by_spp[max(by_spp)]] for metric in PAPER}
        for name, by_spp in errors.items()
    }
    data = {"settings": settings, "means": means, "flip_by_material": flips}
    common.write_json(folder / "rendered.json", data)
    plot(means, folder / "rendered.png")
    sheet(pictures, flips, materials, folder / "materials.png")


def compare(
    images: list[NDArray[np.float32]], references: list[NDArray[np.float32]]
) -> list[dict[str, float]]:
    return [nma.compare_images(image, own) for image, own in zip(images, references, strict=True)]


def mean(rows: list[dict[str, float]], metric: str) -> float:
    return round(float(np.mean([row[metric] for row in rows])), 7)


def markdown(means: dict[str, dict[int, dict[str, float]]], arguments: argparse.Namespace) -> str:
    """Returns tables in Markdown: all metrics at the largest number of samples, then FLIP by samples per pixel."""
    most = arguments.spp
    lines = [
        f"The first table shows means over pictures of {arguments.materials} materials, with {arguments.resolution} x "
        f"{arguments.resolution} pixels. The reference has {arguments.reference_spp} samples per pixel.",
        "",
        "| | samples | " + " | ".join(METRICS) + " |",
        "|---|---|" + "---|" * len(METRICS),
    ]
    lines += [
        f"| {name} | {max(by_spp)} | "
        + " | ".join(f"{by_spp[max(by_spp)][metric]:.5f}" for metric in METRICS)
        + " |"
        for name, by_spp in means.items()
    ]
    for metric, (value, ratio) in PAPER.items():
        steps = levels(most)
        lines += [
            "",
            f"Mean {metric} by samples per pixel (paper: {value}, which is {ratio} of the variant single):",
            "",
        ]
        lines += [
            "| | " + " | ".join(map(str, steps)) + " | of single |",
            "|---|" + "---|" * (len(steps) + 1),
        ]
        for name, by_spp in means.items():
            cells = [f"{by_spp[spp][metric]:.4f}" if spp in by_spp else "" for spp in steps]
            known = SINGLE in means and most in by_spp
            cells.append(f"{by_spp[most][metric] / means[SINGLE][most][metric]:.2f}" if known else "")
            lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def plot(means: dict[str, dict[int, dict[str, float]]], path: Path) -> None:
    """Plots FLIP against samples per pixel, with the paper's values as lines."""
    figure = Figure(figsize=(10, 3.8), layout="constrained")
    for axes, (metric, (paper, _)) in zip(figure.subplots(1, 2), PAPER.items(), strict=True):
        for name, by_spp in means.items():
            style = {"color": "0.6", "linestyle": "--"} if name == AGAIN else {"marker": "."}
            axes.loglog(list(by_spp), [row[metric] for row in by_spp.values()], label=name, **style)
        axes.axhline(paper, color="k", linewidth=0.8, linestyle=":", label="paper, its own scene")
        axes.set(xlabel="samples per pixel", ylabel=metric.replace("_", "-").upper())
        axes.grid(alpha=0.3, which="both")
    axes.legend()
    common.save_figure(figure, path)


def sheet(
    pictures: dict[str, list[NDArray[np.float32]]],
    flips: dict[str, dict[str, list[float]]],
    materials: list[nma.materials.Material],
    path: Path,
) -> None:
    """Writes a sheet with pictures of ROWS materials, from the default adapter's largest HDR-FLIP to its median."""
    shown = [name for name in flips if name != AGAIN]
    chosen = studio.worst_to_median(flips[DEFAULT_ADAPTER]["flip_hdr"], ROWS)
    caption = partial("HDR {:.4f}, LDR {:.4f}".format)
    lines = [
        Row(
            studio.describe(materials[m]),
            [pictures[SIMULATION][m][-1], *(pictures[name][m][-1] for name in shown)],
            ["", *(caption(flips[name]["flip_hdr"][m], flips[name]["flip_ldr"][m]) for name in shown)],
        )
        for m in chosen
    ]
    note = f"FLIP; rows by that of {DEFAULT_ADAPTER}, worst first"
    contact_sheet(path, lines, [SIMULATION, *shown], title="Rendered error on unseen materials", note=note)


if __name__ == "__main__":
    main()
