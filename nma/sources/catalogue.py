"""Lists the public measurements that sources can read, and checks a user's copy of them.

This module downloads nothing. The licence of measurements decides what a user may do with the files and with everything
made from them.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nma import sources
from nma.errors import SourceError

MEASUREMENTS = tuple(m for form in sources.formats().values() for m in form.measurements)
# The formats in which measurements are published, by file extension.
_FORMATS = {ending: form for ending, form in sources.formats().items() if form.measurements}
_ENDINGS = ", ".join(sorted(_FORMATS))
# Size and checksum of original files, by the file's name.
_KNOWN = {name: known for m in MEASUREMENTS for name, known in m.known.items()}


@dataclass(frozen=True)
class Finding:
    """The result of `check` for one file.

    `measurements` is the name of the measurements that the file belongs to. `ok` is true if the file is valid and does
    not differ from the original file in size or checksum, if these are known. `note` says what the check found.
    """

    path: Path
    measurements: str
    ok: bool
    note: str


def check(path: str | Path) -> Iterator[Finding]:
    """Checks one file, or all files of measurements in a folder and its subfolders. Yields a `Finding` for each file.
    Hidden files and folders are left out.

    The check compares the file's size and checksum with those of the original file, if they are known. The check also
    reads the file, to test whether its structure and its values are valid. Raises `SourceError` if there is no file to
    check.
    """
    path = Path(path)
    if not os.path.exists(path):
        raise SourceError(f"{path}: no such file or folder")
    if path.is_file():
        yield _check_file(path)
        return
    files = sorted(p for p in path.rglob("*") if p.is_file() and not _hidden(p, path) and _belongs(p))
    if not files:
        raise SourceError(f"{path}: holds no file of known measurements ({_ENDINGS})")
    for file in files:
        yield _check_file(file)


def _check_file(path: Path) -> Finding:
    """Checks one file of measurements."""
    form = _FORMATS.get(path.suffix)
    if form is None or form.identify is None:
        return Finding(path, "", False, f"no file of known measurements ({_ENDINGS})")
    size, checksum = _KNOWN.get(path.name, (0, ""))
    label = form.name
    found = path.stat().st_size
    if size and found != size:
        return Finding(path, label, False, f"{found:,} bytes instead of {size:,}; copy the file again")
    try:
        label = form.identify(path)
    except SourceError as e:
        return Finding(path, label, False, str(e).removeprefix(f"{path}: "))
    if not checksum:
        return Finding(path, label, True, "sound; its checksum is not known here")
    if hashlib.sha256(path.read_bytes()).hexdigest() != checksum:
        return Finding(path, label, False, "sound, but not the original file: its SHA-256 differs")
    return Finding(path, label, True, "sound; its SHA-256 is that of the original")


def _hidden(path: Path, folder: Path) -> bool:
    """Whether a file in `folder`, or a subfolder that contains the file, is hidden, such as the unfinished files of a
    killed run."""
    return any(part.startswith(".") for part in path.relative_to(folder).parts)


def _belongs(path: Path) -> bool:
    """Whether a file belongs to measurements, judged by its name, or else by its extension and content."""
    return path.name in _KNOWN or (path.suffix in _FORMATS and _FORMATS[path.suffix].claims(path))
