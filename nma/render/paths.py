"""Finds the files that BSDFs in a scene name."""

from __future__ import annotations

from typing import Any


def scene_path(name: str) -> str:
    """The path of a file that a scene names.

    Paths are relative to the folders of Mitsuba's file resolver, such as the scene's folder, as for Mitsuba's own
    plugins.
    """
    import mitsuba

    mi: Any = mitsuba  # Mitsuba's type stubs lack `file_resolver`
    return str(mi.file_resolver().resolve(name))
