"""Reads the rooms of the package, their floors and the imports between them.

A room is a module or a package directly in `nma/`. The floor of each room is read from pyproject.toml, where the
contract that `make lint` checks lists the floors. The imports of each room are read from the code. Imports inside
functions, and imports that only type checkers execute, count too.
"""

from __future__ import annotations

import ast
import itertools
import re
import sys
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = "nma"
CONTRACT = "floors"

Arrow = tuple[str, str]  # from the importing room to the imported room


@cache
def floors() -> tuple[tuple[str, ...], ...]:
    """The rooms of each floor that the contract lists. The highest floor comes first."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]
    (contract,) = (found for found in settings["contracts"] if found["id"] == CONTRACT)
    return tuple(tuple(re.split(r"\s*\|\s*", layer)) for layer in contract["layers"])


@cache
def imports() -> frozenset[Arrow]:
    """All imports of one room by another room. `nma/__init__.py` does not count as a room."""
    try:
        import grimp
    except ImportError:
        sys.exit("reading the imports of the rooms needs grimp; in a checkout run: pip install '.[dev]'")
    graph = grimp.build_graph(PACKAGE, cache_dir=None)
    pairs = {
        (_room(module), _room(imported))
        for module in graph.modules
        for imported in graph.find_modules_directly_imported_by(module)
    }
    return frozenset((a, b) for a, b in pairs if a and b and a != b)


def _room(module: str) -> str:
    return (module.split(".") + [""])[1]


def reduced(arrows: frozenset[Arrow]) -> frozenset[Arrow]:
    """Removes every arrow from A to B for which other arrows form a path from A to B. The arrows must form no cycle."""

    @cache
    def below(room: str) -> frozenset[str]:
        direct = {b for a, b in arrows if a == room}
        return frozenset(direct.union(*map(below, direct)))

    return frozenset(
        (a, b)
        for a, b in arrows
        if not any(b in below(other) for x, other in arrows if x == a and other != b)
    )


def circle(arrows: frozenset[Arrow]) -> list[str]:
    """The rooms in cycles of imports, and the rooms that import such a room directly or indirectly."""
    left = set(arrows)
    while True:
        importing = {a for a, _ in left}
        kept = {(a, b) for a, b in left if b in importing}
        if kept == left:
            return sorted({room for arrow in left for room in arrow})
        left = kept


def summary(room: str, fits: Callable[[str], bool] = lambda text: True) -> str:
    """A short description of a room: the longest beginning of its docstring's first sentence for which `fits` is true.

    The description ends before a colon, a semicolon or a parenthesis or, if no beginning of this kind fits, before a
    comma.
    """
    place = ROOT / PACKAGE / room
    file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
    text = " ".join((ast.get_docstring(ast.parse(file.read_text())) or "").split())
    sentence = re.split(r"[.:]?$|\.\s", text, maxsplit=1)[0]
    for ends in (r"(?=[:;]\s|\s\()", r"(?=,\s)"):
        beginnings = list(itertools.accumulate(re.split(ends, sentence)))
        if found := [beginning for beginning in beginnings if fits(beginning)]:
            return found[-1]
    raise ValueError(
        f"{file}: the first sentence of the docstring is too long for the drawing; write a shorter sentence"
    )
