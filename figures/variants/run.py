"""Variants of the target: log loss by the size of the dataset, and pictures (paper Fig. 3, Table 2, Fig. 6, Table 3).

    python -m figures.variants.run [--quick] [--data FOLDER.zarr] [--sizes N ...] [--seeds N] [--steps N]
        [--only VARIANT ...] [--materials N] [--resolution N] [--spp N] [--reference-spp N]

Trains every variant on the first N materials of a dataset (`nma dataset`, see docs/training.md), for several N
(--sizes). Also trains every variant on the validation set, which gives a lower bound of the validation error. All
trainings together take hours. The adapters, their metrics and their pictures are kept in out/figures/variants, so a
killed run continues where it stopped, and nothing is computed twice. With --only, only the named variants are trained;
the report still contains all adapters that exist.

Writes variants.json, tables.md, variants.png and materials.png beside this file. With --quick, makes a few small
trainings and writes to out/figures/variants.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import jax

import nma
import nma.render
from figures import common
from figures.variants import report
from figures.variants.images import Gallery, View, sheet
from figures.variants.train import ALL, INSTANCES, VARIANTS, Job, Store, plan
from nma.files import write_text

SET = "range"
SETTINGS = ("sizes", "seeds", "steps", "materials", "resolution", "spp", "reference_spp")
# Settings of --quick: materials and walks of the dataset, number of validation materials, and values of other options.
QUICK_DATA = (16, 100_000)
QUICK_VALIDATION = 2
QUICK = {"sizes": [16], "seeds": 1, "steps": 20, "materials": 2, "resolution": 160, "spp": 8}


def main() -> None:
    arguments = parse()
    quick = arguments.quick
    folder, kept = common.results(__file__, quick), common.ROOT / "out/figures/variants"
    kept = kept / "quick" if quick else kept
    data = quick_dataset(kept / "data.zarr") if quick else arguments.data
    validation = common.reference(SET, quick)
    if quick:
        # Optimisations are disabled, because with so few steps the optimised compilation would take longer than the
        # training.
        jax.config.update("jax_disable_most_optimizations", True)
        validation = validation[:QUICK_VALIDATION]
    name = f"{SET}-{len(validation.params)}x{int(validation.walks[0])}"
    store = Store(kept, data, validation, name)
    store.check(arguments.sizes)

    jobs = plan(arguments.sizes, arguments.seeds, arguments.steps, [] if quick else list(INSTANCES))
    done, results = {}, {}
    for job in jobs:
        adapter = store.train(job) if job.variant in arguments.only else store.adapter(job)
        if adapter is not None:
            done[job], results[job] = adapter, {"tables": store.log_losses(job, adapter)}
    if not done:
        sys.exit(f"{kept} has no trained adapters for these options; run again without --only to train them")

    nma.render.use()
    view = View(arguments.materials, arguments.resolution, arguments.spp, arguments.reference_spp)
    gallery = Gallery(store, view, name)
    for job, adapter in done.items():
        if job.size == max(arguments.sizes):
            results[job]["images"] = gallery.metrics(job, adapter)
    write(folder, results, gallery, arguments, done)


def parse() -> argparse.Namespace:
    parser = common.parser(__doc__)
    parser.add_argument("--data", type=Path, default=common.ROOT / "out/layered3.zarr", help="a dataset")
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[250, 1000, 8000], help="numbers of training materials"
    )
    parser.add_argument("--seeds", type=int, default=3, help="how many seeds for each training")
    parser.add_argument("--steps", type=int, default=6_000, help="steps of each training")
    parser.add_argument(
        "--only", nargs="+", choices=list(ALL), default=list(ALL), help="train only these variants"
    )
    parser.add_argument(
        "--materials", type=int, default=View().materials, help="how many materials to render"
    )
    parser.add_argument("--resolution", type=int, default=View().size, help="size of the pictures, in pixels")
    parser.add_argument("--spp", type=int, default=View().spp, help="samples per pixel of the adapters")
    parser.add_argument(
        "--reference-spp", type=int, default=View().reference_spp, help="samples per pixel of the simulation"
    )
    arguments = parser.parse_args()
    if arguments.quick:
        vars(arguments).update(QUICK, reference_spp=64)
    return arguments


def quick_dataset(path: Path) -> Path:
    """Simulates a small dataset unless its folder exists, and returns the path."""
    materials, walks = QUICK_DATA
    nma.Dataset.create(path, nma.Settings("layered3", materials, walks, seed=2)).write()
    return path


def write(
    folder: Path,
    results: report.Results,
    gallery: Gallery,
    arguments: argparse.Namespace,
    done: dict[Job, nma.Adapter],
) -> None:
    """Prints the tables, and writes files with tables, metrics, plot and pictures."""
    floor = next(iter(results.values()))["tables"]["noise_floor"]
    noise = gallery.noise()
    found = report.summary(results, arguments.sizes)
    for name in nma.shipped():
        metrics = gallery.shipped(name).items()
        found["images"][name] = {metric: report.statistics([value]) for metric, value in metrics}
    tables = report.markdown(found, noise, floor)
    print(tables)
    write_text(folder / "tables.md", tables)
    settings = {key: getattr(arguments, key) for key in SETTINGS}
    runs = [{**vars(job), **result} for job, result in results.items()]
    common.write_json(folder / "variants.json", {"settings": settings, "noise": noise, **found, "runs": runs})
    report.plot(found["log_loss"], floor, folder / "variants.png")
    shown = {
        job.variant: gallery.pictures(job, adapter)
        for job, adapter in done.items()
        if job.size == max(arguments.sizes) and job.seed == 0 and job.variant in VARIANTS
    }
    if shown:
        sheet(gallery, shown, folder / "materials.png")


if __name__ == "__main__":
    main()
