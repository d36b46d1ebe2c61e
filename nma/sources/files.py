"""Reading the files of sources."""

from __future__ import annotations

from pathlib import Path

from nma.errors import SourceError


def content(path: Path, dataset: str) -> bytes:
    """All bytes of a file of that data set; `SourceError` if it is missing or cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; see `nma data` for where {dataset}'s come from") from None
    except (OSError, ValueError) as e:  # a name may be too long for a file, or hold a NUL
        raise SourceError(f"{path}: cannot be read: {getattr(e, 'strerror', e)}") from None
