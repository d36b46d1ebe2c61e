"""Where appearance comes from. A new source model is one file here and one line in `_FACTORIES`."""

from __future__ import annotations

from collections.abc import Callable

from nma.errors import ParamError
from nma.sources.base import Source


def _layered3() -> Source:
    from nma.sources.layered import Layered3

    return Layered3()


_FACTORIES: dict[str, Callable[[], Source]] = {"layered3": _layered3}


def names() -> tuple[str, ...]:
    """Names of the classes that can be simulated."""
    return tuple(_FACTORIES)


def get(name: str) -> Source:
    """The source model of a class."""
    if name not in _FACTORIES:
        raise ParamError(f"unknown class '{name}'; known are {', '.join(_FACTORIES)}")
    return _FACTORIES[name]()
