"""Fig. 1 of the paper: a textured scene, rendered by simulation and by the adapter at equal samples per pixel.

python -m bench.teaser [--variant scalar_rgb] [--size 288] [--spp 64] [--runs 3] [--reference-spp 2048]
    [--adapter layered3-3x32] [--rr-depth 5] [--quick] [--output out/bench]

The scene has three shader balls with textured materials, so the network runs at every shading point. A table below the
pictures shows, for simulation and adapter, the median time of a frame, the variance, the squared error and the SMAPE
against the converged picture. The table's last row shows the adapter's results divided by the simulation's, and the
adapter's efficiencies relative to the simulation. bench/frames.py defines variance, squared error and efficiency. The
parts of the converged picture are kept in out/bench/references, so a killed run continues where it stopped.

Writes teaser.json and teaser.png.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench import frames, scenes
from nma.adapter import DEFAULT_ADAPTER
from nma.images.metrics import errors
from nma.images.sheet import Row, contact_sheet

ENLARGED = 4
Figures = Mapping[str, Mapping[str, Any]]
# The parts of the picture to enlarge: each part's name, and its upper left corner as fractions of the picture's width
# and height.
CROPS = {"Silver": (0.02, 0.30), "Copper": (0.36, 0.36), "Gold": (0.68, 0.36)}


def main() -> None:
    arguments = parse()
    head = frames.begin(arguments.variant)
    size = scenes.teaser_size(arguments.size)
    models: dict[str, Callable[[scenes.Subject], scenes.Bsdf]] = {
        "layered": scenes.simulation,
        "nma": partial(scenes.network, name=arguments.adapter),
    }
    described = {name: scenes.teaser(model, size, arguments.rr_depth) for name, model in models.items()}
    reference = frames.converged_teaser(described["layered"], arguments)
    measured = frames.in_turns(described, arguments.spp, range(arguments.runs))
    rows = {name: figures(own, reference) for name, own in measured.items()}
    ratios = frames.ratios(rows["nma"], rows["layered"])
    print(frames.markdown(["", *rows["nma"]], [[name, *row.values()] for name, row in rows.items()]))
    print(frames.markdown(["nma, to layered", ""], ratios.items()))
    path = arguments.output / "teaser.json"
    frames.write(path, head, arguments, reference_noise=reference.noise, frames=rows, ratios=ratios)
    pictures = [reference.picture, *(own.pictures[0] for own in measured.values())]
    sheet(pictures, rows, ratios, arguments, path.with_suffix(".png"))


def parse() -> argparse.Namespace:
    parser = frames.parser(__doc__, size=288, spp=64, runs=3)
    parser.add_argument("--variant", default=frames.SCALAR)
    parser.add_argument("--adapter", default=DEFAULT_ADAPTER, help="a shipped name or a weights file")
    parser.add_argument(
        "--reference-spp", type=int, default=2048, help="samples per pixel of the converged picture"
    )
    return frames.parse(parser, size=36, spp=8, runs=2, reference_spp=64)


def figures(own: frames.Frames, reference: frames.Converged) -> dict[str, float | None]:
    return frames.figures(own, reference) | {"smape": errors(own.pictures[0], reference.picture)["smape"]}


def sheet(
    pictures: list[NDArray],
    rows: Figures,
    ratios: Mapping[str, Any],
    arguments: argparse.Namespace,
    path: Path,
) -> None:
    """Writes a sheet with the pictures side by side, enlarged parts of the pictures, and a table."""
    under = ["", *("{seconds:.2f} s, squared error {error:.2e}".format(**row) for row in rows.values())]
    lines = [Row("", pictures, under)]
    lines += [Row(name, [enlarge(picture, corner) for picture in pictures]) for name, corner in CROPS.items()]
    spp, title = arguments.spp, "Silver, copper and gold under textured media, at equal samples"
    columns = [f"layered, {arguments.reference_spp} spp", f"layered, {spp} spp", f"nma, {spp} spp"]
    contact_sheet(path, lines, columns, title=title, table=table(rows, ratios))
    print(path)


def table(rows: Figures, ratios: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Returns the table below the pictures: the results of both BSDFs, and the adapter's results relative to
    `layered`."""
    headings = ("", "time", "variance", "squared error", "SMAPE", "efficiency by variance", "by error")
    keys = ("time", "variance", "error", "smape", "efficiency by variance", "efficiency by error")
    shapes = ("{:.2f} s", "{:.2e}", "{:.2e}", "{:.3f}")
    made: list[tuple[str, ...]] = [headings]
    for name, row in rows.items():
        figures = [row["seconds"], row["variance"], row["error"], row["smape"]]
        cells = [shape.format(value) for shape, value in zip(shapes, figures, strict=True)]
        made.append((name, *cells, "", ""))
    every = {**ratios, "smape": frames.ratio(rows["nma"]["smape"], rows["layered"]["smape"])}
    return [*made, ("nma to layered", *("-" if every[k] is None else f"{every[k]:.2f}" for k in keys))]


def enlarge(picture: NDArray, corner: tuple[float, float]) -> NDArray:
    """Enlarges a part of the picture to the size of the whole picture; every pixel of the part becomes a block."""
    height, width = picture.shape[:2]
    tall, wide = -(-height // ENLARGED), -(-width // ENLARGED)
    top, left = min(int(corner[1] * height), height - tall), min(int(corner[0] * width), width - wide)
    blocks = np.kron(picture[top : top + tall, left : left + wide], np.ones((ENLARGED, ENLARGED, 1)))
    return blocks[:height, :width]


if __name__ == "__main__":
    main()
