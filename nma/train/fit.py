"""Fits an adapter to a single material of class "measured", given as BRDF values or as a table (paper Fig. 4, 13).

`nma.train.run.fit_material` fits an adapter to a single material of a class with parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nma.adapter import Adapter
from nma.errors import NmaError, TableError
from nma.params import MEASURED
from nma.progress import of_training
from nma.sources.base import Values
from nma.table import Tables
from nma.train import loop
from nma.train import recipe as recipes
from nma.train.points import PointPool, points_loss
from nma.train.recipe import Recipe
from nma.train.run import adapter_of, initial_layers, train_class

Progress = Callable[[loop.Run], None]


def recipe_for(source: Values | Tables, **changes: Any) -> Recipe:
    """The recipe for a source.

    The recipe depends on whether the source is isotropic, and on whether the source is a table or has exact values.
    `changes` are fields of `Recipe`; the value None leaves a field unchanged.
    """
    changes = {name: value for name, value in changes.items() if value is not None}
    if isinstance(source, Tables):
        grid = source.grid
        suited = {"encoding": "azimuth", "target": "anisotropic"} if grid.phi_i else {}
        return recipes.for_class(source.space, "single", grid=grid, **(suited | changes))
    return recipes.preset("measured" if source.isotropic else "anisotropic", **changes)


def fit(
    source: Values | Tables,
    recipe: Recipe | None = None,
    record: dict[str, Any] | None = None,
    *,
    progress: Progress | None = None,
    budget_seconds: float = float("inf"),
) -> tuple[Adapter, loop.Run]:
    """Fits an adapter of class "measured", which has no parameters, to one material. Returns the adapter and the run.

    The target is compared with a source of values point by point, and with a table bin by bin. The default recipe is
    `recipe_for(source)`. `record` says where the source comes from and is stored with the weights. `progress` is called
    during training. If `progress` is None, a progress bar is shown on stderr if stderr is a terminal; `lambda run:
    None` shows nothing. Raises `NmaError` if only the recipe or only the source is isotropic, and `TableError` if a
    table has several materials.
    """
    recipe = recipe or recipe_for(source)
    with of_training(progress, recipe, "fitting") as show:
        if isinstance(source, Tables):
            return _fit_table(source, recipe, record or {}, show, budget_seconds)
        return _fit_values(source, recipe, record or {}, show, budget_seconds)


def _fit_values(
    source: Values, recipe: Recipe, record: dict[str, Any], progress: Progress, budget_seconds: float
) -> tuple[Adapter, loop.Run]:
    _check_isotropy(source.name, source.isotropic, recipe)
    if recipe.loss != "log":
        raise NmaError(
            f"{source.name} has values without noise, so the recipe's loss must be 'log', not '{recipe.loss}'"
        )
    pool = PointPool.of(source, seed=recipe.seed)
    run = loop.start(recipe, initial_layers(recipe, MEASURED), record)
    loop.train(
        recipe,
        run,
        lambda step: pool.draw(recipe, step),
        objective=points_loss,
        progress=progress,
        budget_seconds=budget_seconds,
    )
    return adapter_of(MEASURED, recipe, run, {"material": source.name, **record}), run


def _fit_table(
    tables: Tables, recipe: Recipe, record: dict[str, Any], progress: Progress, budget_seconds: float
) -> tuple[Adapter, loop.Run]:
    if len(tables.values) != 1:
        raise TableError(
            f"a fit is for one material, but the table has {len(tables.values)} materials; choose one of them"
        )
    _check_isotropy("the table", not tables.grid.phi_i, recipe)
    unnamed = Tables(tables.params[:, :0], tables.values, tables.walks, None, MEASURED.name)
    return train_class(MEASURED, recipe, unnamed, record, progress=progress, budget_seconds=budget_seconds)


def _check_isotropy(name: str, isotropic: bool, recipe: Recipe) -> None:
    if isotropic == (recipe.target == "anisotropic"):
        kind = "isotropic" if isotropic else "anisotropic"
        raise NmaError(f"{name} is {kind}; choose a recipe whose target, encoding and grid are {kind}")
