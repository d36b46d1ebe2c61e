"""The target in other languages, printed from the Python functions that define it: `python -m nma.export`."""

from nma.export.classes import classes
from nma.export.cpp import cpp
from nma.export.shared import shared

# The generated files of `runtime/`, each with the function that returns its content.
FILES = {
    "nma/generated/target.h": cpp,
    "nma/generated/classes.h": classes,
    "nma/generated/constants.h": shared,
}

__all__ = ["FILES"]
