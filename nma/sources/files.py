"""How sources read their files."""

from __future__ import annotations

from pathlib import Path

from nma.errors import SourceError


def content(path: Path, dataset: str) -> bytes:
    """All bytes of a file of the data set `dataset`. Raises `SourceError` if the file cannot be read."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; `nma data` says where to get {dataset} files") from None
    except (OSError, ValueError) as e:  # ValueError: the name contains a NUL
        raise SourceError(f"{path}: cannot be read: {getattr(e, 'strerror', e)}") from None
