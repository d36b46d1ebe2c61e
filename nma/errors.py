"""Errors that users meet. Each message says what is wrong, where, and what to do next."""

import re
import textwrap

_TRACEBACK = "Traceback (most recent call last):"
_LONGEST = 600  # letters of an error that prints whole objects


class NmaError(Exception):
    """Base of all errors raised on purpose by this package; the command line prints them without a traceback."""


class ParamError(NmaError, ValueError):
    """A source parameter is missing, has the wrong shape, is not finite, or lies outside its range."""


class MaterialError(NmaError, ValueError):
    """A material name is unknown, or a material file is malformed."""


class TextureError(NmaError, ValueError):
    """A texture cannot be read, or holds values that its parameter does not allow."""


class WeightsError(NmaError, ValueError):
    """A weights file is missing, truncated, of another format, or of another class."""


class DatasetError(NmaError, ValueError):
    """A dataset is damaged, incomplete, or was made with other settings."""


class SourceError(NmaError, ValueError):
    """A file of measurements or weights, or a renderer's BSDF, is missing, damaged, or not what a source can read."""


class TableError(NmaError, ValueError):
    """A table or reference file (.npz) is damaged or has the wrong shape."""


class OutputError(NmaError, OSError):
    """A file cannot be written: a full disk, a folder in its place, no permission."""


class MissingDependencyError(NmaError, ImportError):
    """A library this feature needs is missing or too old."""


def one_line(message: str) -> str:
    """Mitsuba's error: where, and what is wrong, without lines of source code; of a traceback only the error."""
    message = re.sub(r"^\[[\w.]+:\d+\] ", "", message.strip())
    message = re.sub(r'failed to instantiate \w+ plugin of type "\w+": ', "", message)
    head, traceback, _ = message.partition(_TRACEBACK)
    if traceback:
        # Lines of a traceback are indented; what follows is the error, of one line or more.
        error = re.search(
            r"^(?!\s)(?:[\w.]+: )?(.*)", message.rpartition(_TRACEBACK)[2].lstrip("\n"), re.M | re.S
        )
        message = head + (error[1] if error else "")
    return textwrap.shorten(message, _LONGEST, placeholder=" ...")
