"""Trainings of all variants: planned, done once, kept as weights with their figures beside them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import nma
from figures import common
from nma.errors import NmaError
from nma.evaluate.metrics import mean_metrics
from nma.files import write_text
from nma.train.recipe import Recipe, preset
from nma.train.run import train_class

# The paper's variants: (instances, whether their parameters follow the view direction).
VARIANTS = {
    "single": (1, False),
    "omega_i": (1, True),
    "blended": (2, False),
    "blended + omega_i": (2, True),
}
INSTANCES = {f"{n} instances": (n, True) for n in (3, 4, 5)}
ALL = VARIANTS | INSTANCES


@dataclass(frozen=True)
class Job:
    """One training. `size` counts the materials; 0 means the validation set's own, the bound by overfitting."""

    variant: str
    size: int
    seed: int
    steps: int

    @property
    def stem(self) -> str:
        """Its files' name."""
        words = self.variant.replace(" + ", "+").replace(" ", "-"), self.size or "overfit"
        return "{}_{}_{}-steps_seed-{}".format(*words, self.steps, self.seed)

    @property
    def recipe(self) -> Recipe:
        instances, directional = ALL[self.variant]
        # A target can only be stretched in the plane of incidence where it knows wi.
        target = None if directional else "principled"
        settings = {"instances": instances, "directional": directional, "target": target}
        return preset("class", **settings, steps=self.steps, seed=self.seed)


def plan(sizes: list[int], seeds: int, steps: int, instances: list[str]) -> list[Job]:
    """All jobs: seed by seed, so that early results span all variants; bounds and more instances with the first one."""
    jobs, sizes = [], sorted(set(sizes))
    for seed in range(seeds):
        jobs += [Job(name, size, seed, steps) for size in sizes for name in VARIANTS]
        if seed == 0:
            jobs += [Job(name, 0, seed, steps) for name in VARIANTS]
            jobs += [Job(name, max(sizes), seed, steps) for name in instances]
    return jobs


class Store:
    """The folder of weights and figures, with the data that they come from.

    `data` is a dataset of which small sets are the first materials, `validation` what every adapter is judged by, and
    `name` what determines the validation set. Anything here that was made from other data is made again.
    """

    def __init__(self, folder: Path, data: Path, validation: nma.Tables, name: str):
        self.folder, self.validation, self._name = folder, validation, name
        self._dataset = nma.Dataset.open(data)
        folder.mkdir(parents=True, exist_ok=True)

    @cached_property
    def _tables(self) -> nma.Tables:
        """All tables of the dataset; read when a training first needs them."""
        return self._dataset.load()

    def check(self, sizes: list[int]) -> None:
        """Refuses sizes that the dataset does not have."""
        most = self._dataset.settings.materials
        if min(sizes) < 1 or max(sizes) > most:
            raise NmaError(f"sizes {sizes} must lie in 1 .. {most}, the materials of {self._dataset.path}")

    def weights(self, job: Job) -> Path:
        return self.folder / f"{job.stem}.safetensors"

    def adapter(self, job: Job) -> nma.Adapter | None:
        """The trained adapter, if it is there and was trained like this."""
        path = self.weights(job)
        if not path.exists():
            return None
        adapter = nma.Adapter.load(path)
        found, wanted = adapter.training, {"recipe": asdict(job.recipe), **self._record(job)}
        return adapter if all(found.get(k) == v for k, v in wanted.items()) else None

    def train(self, job: Job) -> nma.Adapter:
        """The adapter of a job, trained unless that is done; a killed training goes on from its checkpoint."""
        done = self.adapter(job)
        if done:
            return done
        path = self.weights(job)
        checkpoint = path.with_suffix(".ckpt")
        adapter, run = train_class(
            nma.LAYERED3, job.recipe, self._training_set(job), self._record(job), checkpoint=checkpoint
        )
        adapter.save(path)
        checkpoint.unlink(missing_ok=True)
        print(f"{job.stem}: trained in {run.seconds:.0f} s", flush=True)
        return adapter

    def log_losses(self, job: Job, adapter: nma.Adapter) -> dict[str, Any]:
        """The figures of an adapter on the validation set, from the cache if they are there."""

        def measure() -> dict[str, float]:
            # A quarter of the points of `nma.evaluate_adapter`: .00003 more than it finds, in all variants.
            found = common.figures(adapter, self.validation, directions=16)
            return {name: round(value, 7) for name, value in mean_metrics(found).items()}

        return self.cached(job, "tables", {"validation": self._name}, adapter, measure)

    def cached(
        self, job: Job, kind: str, settings: dict[str, Any], adapter: nma.Adapter, make: Callable[[], Any]
    ) -> Any:
        """What `make` returned for these settings and this training, kept in STEM.KIND.json."""
        path = self.folder / f"{job.stem}.{kind}.json"
        key = json.loads(json.dumps({**settings, "training": adapter.training}))
        if path.exists():
            stored = json.loads(path.read_text())
            if stored["key"] == key:
                return stored["value"]
        began = time.perf_counter()
        value = make()
        write_text(path, json.dumps({"key": key, "value": value}, indent=1))
        print(f"{job.stem}: {kind} in {time.perf_counter() - began:.0f} s", flush=True)
        return value

    def _training_set(self, job: Job) -> nma.Tables:
        if job.size == 0:
            return self.validation
        return self._tables[: job.size]

    def _record(self, job: Job) -> dict[str, Any]:
        """Where the training's data come from, as the weights file has it."""
        if job.size == 0:
            return {"data": f"validation set {self._name}"}
        return {
            "data": "dataset",
            "dataset": asdict(self._dataset.settings),
            "first_materials": job.size,
        }
