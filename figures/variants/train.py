"""Plans and runs the trainings of all variants. Each training runs once; its weights and metrics are kept."""

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

# The paper's variants: (number of instances, whether the parameters depend on the view direction).
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
    """One training. `size` is the number of training materials; 0 means training on the validation set, which gives a
    lower bound of the validation error."""

    variant: str
    size: int
    seed: int
    steps: int

    @property
    def stem(self) -> str:
        """The name of the training's files, without a suffix such as .safetensors."""
        words = self.variant.replace(" + ", "+").replace(" ", "-"), self.size or "overfit"
        return "{}_{}_{}-steps_seed-{}".format(*words, self.steps, self.seed)

    @property
    def recipe(self) -> Recipe:
        instances, directional = ALL[self.variant]
        # The target "stretched" depends on wi, so variants that do not depend on wi have the target "principled".
        target = None if directional else "principled"
        settings = {"instances": instances, "directional": directional, "target": target}
        return preset("class", **settings, steps=self.steps, seed=self.seed)


def plan(sizes: list[int], seeds: int, steps: int, instances: list[str]) -> list[Job]:
    """Returns all jobs in the order of training.

    All variants are trained with one seed before the next seed is used, so that early results cover all variants. The
    trainings on the validation set, and the variants `instances`, are run with the first seed only.
    """
    jobs, sizes = [], sorted(set(sizes))
    for seed in range(seeds):
        jobs += [Job(name, size, seed, steps) for size in sizes for name in VARIANTS]
        if seed == 0:
            jobs += [Job(name, 0, seed, steps) for name in VARIANTS]
            jobs += [Job(name, max(sizes), seed, steps) for name in instances]
    return jobs


class Store:
    """Trains and evaluates adapters, and stores their weights and metrics in a folder.

    Stored weights and metrics that were computed from other data are computed again.

    Args:
        folder: where weights and metrics are kept.
        data: the dataset, whose first materials are the training set.
        validation: the tables that every adapter is evaluated on.
        name: a name that identifies the validation set.
    """

    def __init__(self, folder: Path, data: Path, validation: nma.Tables, name: str):
        self.folder, self.validation, self._name = folder, validation, name
        self._dataset = nma.Dataset.open(data)
        folder.mkdir(parents=True, exist_ok=True)

    @cached_property
    def _tables(self) -> nma.Tables:
        """All tables of the dataset, which are read only if a training needs them."""
        return self._dataset.load()

    def check(self, sizes: list[int]) -> None:
        """Raises an error if a size is not between 1 and the number of materials in the dataset."""
        most = self._dataset.settings.materials
        if min(sizes) < 1 or max(sizes) > most:
            raise NmaError(
                f"--sizes {sizes}: {self._dataset.path} has {most} materials; give sizes in 1 .. {most}"
            )

    def weights(self, job: Job) -> Path:
        return self.folder / f"{job.stem}.safetensors"

    def adapter(self, job: Job) -> nma.Adapter | None:
        """Returns the stored adapter of a job, or None if no adapter with the job's settings and data is stored."""
        path = self.weights(job)
        if not path.exists():
            return None
        adapter = nma.Adapter.load(path)
        found, wanted = adapter.training, {"recipe": asdict(job.recipe), **self._record(job)}
        return adapter if all(found.get(k) == v for k, v in wanted.items()) else None

    def train(self, job: Job) -> nma.Adapter:
        """Returns a job's adapter. If the adapter is not stored, trains it, from its checkpoint if there is one."""
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
        """Returns the mean metrics of an adapter on the validation set, from the stored metrics if they exist."""

        def measure() -> dict[str, float]:
            # With 16 directions, `common.figures` uses a quarter of the points that `nma.evaluate_adapter` uses, which
            # makes the log loss of all variants .00003 larger.
            found = common.figures(adapter, self.validation, directions=16)
            return {name: round(value, 7) for name, value in mean_metrics(found).items()}

        return self.cached(job, "tables", {"validation": self._name}, adapter, measure)

    def cached(
        self, job: Job, kind: str, settings: dict[str, Any], adapter: nma.Adapter, make: Callable[[], Any]
    ) -> Any:
        """Returns the result of `make`, which is stored in the file STEM.KIND.json.

        `make` is called only if the file has no result for these settings and this training.
        """
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
        """Returns the entries of the weights file that describe the training data."""
        if job.size == 0:
            return {"data": f"validation set {self._name}"}
        return {
            "data": "dataset",
            "dataset": asdict(self._dataset.settings),
            "first_materials": job.size,
        }
