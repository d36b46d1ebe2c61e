"""Exports the target as C++ headers, generated from Python, and a Principled BRDF for Mitsuba's plugin `principled`."""

from nma.export.classes import classes
from nma.export.cpp import cpp
from nma.export.shared import shared

# Each generated file of `runtime/`, and the function that returns the content of the file.
FILES = {
    "nma/generated/target.h": cpp,
    "nma/generated/classes.h": classes,
    "nma/generated/constants.h": shared,
}

__all__ = ["FILES"]
