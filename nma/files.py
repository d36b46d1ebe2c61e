"""Writing files: whole or not at all, and tried before long work begins."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nma.errors import NmaError, OutputError

# What a trial writes: a full disk gives a name to a file, and refuses its bytes.
_TRIAL = bytes(1 << 16)
_ADVICE = {
    errno.ENOSPC: "free some space, or choose another place",
    errno.EDQUOT: "free some space, or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
}


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """A file to be filled, which takes the place of `path` once the block has ended; if it fails, nothing is left.

        with whole("gold.npz") as file:
            np.savez(file, ...)

    The name ends as that of `path` does. Folders on the way are made. Raises `OutputError` where the file cannot be
    written.
    """
    path = Path(path)
    partial = _partial(path)
    try:
        _check_place(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A folder to be filled, which becomes `path` once the block has ended; if it fails, nothing is left.

    Where another process makes the same folder and is faster, its folder stays.
    """
    partial = _partial(path)
    try:
        partial.mkdir(parents=True)
        yield partial
        try:
            partial.rename(path)
        except OSError:
            if not path.is_dir():
                raise
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def write_bytes(path: str | Path, content: bytes) -> None:
    """Writes a whole file, as `whole`."""
    with whole(path) as file:
        file.write_bytes(content)


def write_text(path: str | Path, content: str) -> None:
    """The same for text, as UTF-8."""
    write_bytes(path, content.encode())


@contextmanager
def arrays(path: str | Path) -> Iterator[Any]:
    """The arrays of an .npz file, by name. What is none is a `ValueError`, where NumPy would advise to unpickle it."""
    import numpy as np

    with Path(path).open("rb") as file:
        if file.read(2) != b"PK":
            raise ValueError("it is no .npz file")
        file.seek(0)
        with np.load(file) as found:
            yield found


def try_file(*paths: str | Path) -> None:
    """Makes sure that files can be written, so that hours of work do not end in nothing; leaves no trace.

    Raises `OutputError` for a folder or a device in a file's place, a file in a folder's place, a name that is too
    long, and a disk that is full or must not be written to.
    """
    for path in map(Path, paths):
        try:
            _check_place(path)
            _try_folder(path.parent, path.name)
        except OSError as error:
            raise _refused(path, error) from error


def try_folder(path: str | Path) -> None:
    """The same for a folder that files will be written to, which need not exist."""
    path = Path(path)
    try:
        _try_folder(path)
    except OSError as error:
        raise _refused(path, error) from error


def _try_folder(folder: Path, *names: str) -> None:
    """Writes a file to the folder or, as folders must not stay behind either, to the nearest one that exists."""
    missing = list(names)
    while not os.path.lexists(folder):
        missing.append(folder.name)
        folder = folder.parent
    for name in missing:
        # Names that are too long are so in any folder.
        with suppress(FileNotFoundError):
            os.lstat(folder / name)
    trial = _partial(folder / "trial")
    try:
        trial.write_bytes(_TRIAL)
    finally:
        with suppress(OSError):
            trial.unlink(missing_ok=True)


def _check_place(path: Path) -> None:
    """Refuses to replace what is no file: folders, devices, pipes."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "a folder has this name")
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "this is no ordinary file")


def _partial(path: Path) -> Path:
    """A name beside the file, of its kind, that nobody else uses and that is short enough."""
    return path.with_name(f".nma-{secrets.token_hex(6)}.partial{path.suffix}")


def _refused(path: Path, error: OSError) -> NmaError:
    if isinstance(error, NmaError):
        return error
    reason = (
        "there is a file where a folder is wanted"
        if isinstance(error, NotADirectoryError)
        else error.strerror
    )
    advice = _ADVICE.get(error.errno or 0, "choose another place")
    return OutputError(f"{_shown(path)}: cannot be written ({reason or error}); {advice}")


def _shown(path: Path) -> str:
    text = str(path)
    return text if len(text) <= 200 else f"{text[:80]}...{text[-40:]}"
