"""Defines the errors that this package raises. Each message says what is wrong, where, and what to do next."""

import difflib
import re
import textwrap
from collections.abc import Iterable, Sequence

_TRACEBACK = "Traceback (most recent call last):"
_LONGEST = 600  # longer messages are shortened, because some of Mitsuba's errors print whole objects
_LONGEST_VALUE = 100


class NmaError(Exception):
    """The base class of all errors that this package raises on purpose. The command line prints these errors without a
    traceback."""


class ParamError(NmaError, ValueError):
    """A parameter of a source is missing, has the wrong shape, is not finite, or lies outside its range."""


class MaterialError(NmaError, ValueError):
    """A material name is unknown, or a material file is malformed."""


class TextureError(NmaError, ValueError):
    """A texture cannot be read, or holds values that its parameter does not allow."""


class WeightsError(NmaError, ValueError):
    """A weights file is missing, truncated, of another format, or of another class."""


class DatasetError(NmaError, ValueError):
    """A dataset is damaged, incomplete, or was made with other settings."""


class SourceError(NmaError, ValueError):
    """A file of measurements or weights, or a renderer's BSDF, is missing, damaged, or of an unknown kind."""


class TableError(NmaError, ValueError):
    """A table or reference file (.npz) is damaged or has the wrong shape."""


class OutputError(NmaError, OSError):
    """A file cannot be written: the disk is full, a folder has the file's name, or permission is denied."""


class MissingDependencyError(NmaError, ImportError):
    """A package or a program that a feature needs is missing or too old."""


def either(words: Iterable[str]) -> str:
    """Joins options into a text such as "a, b or c"."""
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def closest(given: str, known: Sequence[str]) -> str | None:
    """The known name that is most similar to `given`, ignoring case, or None if no name is similar."""
    names = {name.casefold(): name for name in reversed(known)}
    near = difflib.get_close_matches(given.casefold(), names, n=1, cutoff=0.5)
    return names[near[0]] if near else None


def some(names: Sequence[str]) -> str:
    """Joins only the first five names into a text, because there may be hundreds of names."""
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def hint(given: str, known: Sequence[str]) -> str:
    """The advice for an unknown name: a similar name, or the first of the known names."""
    near = closest(given, known)
    return f"did you mean '{near}'?" if near else f"it has {some(known)}"


def shown(value: object) -> str:
    """A value from a file for an error message: its `repr`, which has no control characters, shortened."""
    text = repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def one_line(message: str) -> str:
    """Shortens an error message of Mitsuba to one line with the place and the fault.

    Leaves out locations in Mitsuba's source code, and the whole traceback except the error itself.
    """
    message = re.sub(r"^\[[\w.]+:\d+\] ", "", message.strip())
    message = re.sub(r'failed to instantiate \w+ plugin of type "\w+": ', "", message)
    head, traceback, _ = message.partition(_TRACEBACK)
    if traceback:
        # The lines of a traceback are indented, and the error message comes after the indented lines.
        error = re.search(
            r"^(?!\s)(?:[\w.]+: )?(.*)", message.rpartition(_TRACEBACK)[2].lstrip("\n"), re.M | re.S
        )
        message = head + (error[1] if error else "")
    return textwrap.shorten(message, _LONGEST, placeholder=" ...")
