"""The target in other languages, printed from the Python functions that define it: `python -m nma.export`."""

from nma.export.classes import classes
from nma.export.cpp import cpp

__all__ = ["classes", "cpp"]
