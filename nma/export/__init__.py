"""Prints the analytic BRDF as C++ headers, and a Principled BRDF for other renderers.

To print the analytic BRDF in another language, add one file to this folder and one line to `FILES`. To write files for
another renderer that has a Principled BRDF of its own, add one file to this folder and one line to `TEXTS`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from nma.target import Principled

__all__ = ["FILES", "TEXTS", "Text", "principled_text", "printed"]


class Text(NamedTuple):
    """A text format: the renderer that reads the format, and the function that returns the content of a file."""

    renderer: str
    printer: str


# The functions in `FILES` and `TEXTS` are named as `module:name`: a module of this folder, and a function of the
# module. The module is imported when the function is first used, so that `nma --help` is quick.

# Each generated file of `runtime/`, and the function that returns the content of the file.
FILES = {
    "nma/generated/target.h": "cpp:cpp",
    "nma/generated/classes.h": "classes:classes",
    "nma/generated/constants.h": "shared:shared",
}
# The text formats of a Principled BRDF, by the ending of a file's name. If two endings fit a name, the longer ending is
# used, so another renderer whose files are JSON can have an ending such as `.blend.json`. The function of a format
# takes a `Principled`, whose fields are plain numbers.
TEXTS = {
    ".xml": Text("Mitsuba", "mitsuba:principled_xml"),
    ".json": Text("Mitsuba", "mitsuba:principled_json"),
}


def printed(name: str) -> str:
    """The content of the generated file `name` of `runtime/`, one of `FILES`."""
    return _at(FILES[name])()


def principled_text(ending: str, principled: Principled) -> str:
    """The content of a file in the text format `ending`, one of `TEXTS`, that describes `principled`."""
    return _at(TEXTS[ending].printer)(principled)


def _at(home: str) -> Callable[..., str]:
    module, name = home.split(":")
    return getattr(import_module(f"nma.export.{module}"), name)
