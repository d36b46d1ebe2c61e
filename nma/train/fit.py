"""An adapter for a single material of which nothing is known but its values, or a table of them (paper Fig. 4, 13)."""

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
    """The settings that suit a source, isotropic or not, with or without noise.

    `changes` are fields of `Recipe`; None leaves one as it is.
    """
    changes = {name: value for name, value in changes.items() if value is not None}
    if isinstance(source, Tables):
        grid = source.grid
        suited = {"encoding": "azimuth", "target": "anisotropic"} if grid.phi_i else {}
        return recipes.preset("single", grid=grid, **(suited | changes))
    return recipes.preset("measured" if source.isotropic else "anisotropic", **changes)


def fit(
    source: Values | Tables,
    recipe: Recipe | None = None,
    record: dict[str, Any] | None = None,
    *,
    progress: Progress | None = None,
    budget_seconds: float = float("inf"),
) -> tuple[Adapter, loop.Run]:
    """An adapter of class "measured", which has no parameters, for one material.

    Sources that know their values are compared with the target point by point, tables bin by bin, isotropic or not.
    `recipe_for(source)` is the recipe unless another is given; `record` says where the source comes from and is stored
    with the weights. `progress` is called as training goes on; without one, a bar goes along on stderr if that is a
    terminal, and `lambda run: None` keeps it quiet. Raises `NmaError` where the recipe is for isotropic materials and
    the source is not, or the other way round, and `TableError` for tables of several materials.
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
            f"{source.name} has values without noise, which the loss 'log' is for, not '{recipe.loss}'"
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
        raise TableError(f"a fit is for one material, the table has {len(tables.values)}; choose one")
    _check_isotropy("the table", not tables.grid.phi_i, recipe)
    unnamed = Tables(tables.params[:, :0], tables.values, tables.walks)
    return train_class(MEASURED, recipe, unnamed, record, progress=progress, budget_seconds=budget_seconds)


def _check_isotropy(name: str, isotropic: bool, recipe: Recipe) -> None:
    if isotropic == (recipe.target == "anisotropic"):
        kind = "isotropic" if isotropic else "anisotropic"
        raise NmaError(f"{name} is {kind}; take a recipe for such: its target, encoding and grid")
