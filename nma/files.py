"""Writes files completely or not at all, and tests before long work whether a file can be written."""

from __future__ import annotations

import atexit
import errno
import os
import secrets
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

from nma.errors import NmaError, OutputError

# The content of a test file. The file must not be empty, because an empty file can be created even on a full disk.
_TRIAL = bytes(1 << 16)
_ADVICE = {
    errno.ENOSPC: "free some space, or choose another place",
    errno.EDQUOT: "free some space, or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
}
# The functions that `clean_up` calls.
_CLEANERS: list[Callable[[], None]] = []


@contextmanager
def cleaning(cleaner: Callable[[], None]) -> Iterator[None]:
    """A context manager: while the `with` block runs, `clean_up` calls `cleaner`.

    `cleaner` deletes temporary files, ends a process that writes them, or waits until a file is complete. `cleaner` is
    not called at the end of the block.
    """
    _CLEANERS.append(cleaner)
    try:
        yield
    finally:
        _CLEANERS.remove(cleaner)


def clean_up() -> None:
    """Deletes the temporary files and folders of this process. A signal handler that ends the process calls this
    function."""
    for cleaner in reversed(_CLEANERS.copy()):
        with suppress(Exception):
            cleaner()


@contextmanager
def whole(path: str | Path) -> Iterator[Path]:
    """A context manager: the `with` block gets the path of a temporary file, which replaces `path` when the block ends
    and is deleted if the block fails.

        with whole("gold.npz") as file:
            np.savez(file, ...)

    The temporary file has the same suffix as `path`. Missing folders are created. If `path` exists, the new file has
    the permissions of the old file. Raises `OutputError` if the file cannot be written.
    """
    path = _named(path)
    place = _place(path)
    try:
        with _temporary(place.parent / path.name) as partial:
            _check_place(path)
            place.parent.mkdir(parents=True, exist_ok=True)
            yield partial
            if place.exists():
                shutil.copymode(place, partial)
            partial.replace(place)
    except OSError as error:
        raise _refused(path, error) from error


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """A context manager: the `with` block gets the path of a temporary folder, which becomes `path` when the block ends
    and is deleted if the block fails.

    If another process has created the folder `path` in the meantime, that folder stays and the temporary folder is
    deleted.
    """
    try:
        with _temporary(path) as partial:
            partial.mkdir(parents=True)
            yield partial
            try:
                partial.rename(path)
            except OSError:
                if not path.is_dir():
                    raise
    except OSError as error:
        raise _refused(path, error) from error


def write_bytes(path: str | Path, content: bytes) -> None:
    """Writes bytes to a file, completely or not at all, as `whole` does."""
    with whole(path) as file:
        file.write_bytes(content)


def write_text(path: str | Path, content: str) -> None:
    """Writes text to a file as UTF-8, completely or not at all, as `whole` does."""
    write_bytes(path, content.encode())


@cache
def scratch_folder() -> Path:
    """A temporary folder of this process, which is deleted when the process ends."""
    folder = Path(tempfile.mkdtemp(prefix="nma-"))

    def delete() -> None:
        shutil.rmtree(folder, ignore_errors=True)

    atexit.register(delete)
    _CLEANERS.append(delete)
    return folder


@contextmanager
def arrays(path: str | Path) -> Iterator[Any]:
    """The arrays of an .npz file, by name. For other files, this function raises its own `ValueError`, because NumPy's
    error message would suggest unpickling."""
    import numpy as np

    with Path(path).open("rb") as file:
        if file.read(2) != b"PK":
            raise ValueError("it is not an .npz file")
        file.seek(0)
        with np.load(file) as found:
            yield found


def try_file(*paths: str | Path) -> None:
    """Tests whether files can be written, so that hours of work are not lost at the end. The test leaves no file
    behind.

    Raises `OutputError` if a folder or a device has the name of a file, if a file has the name of a folder, if a name
    is too long, or if the disk is full or read-only.
    """
    for path in map(_named, paths):
        try:
            _check_place(path)
            place = _place(path)
            _try_folder(place.parent, place.name)
        except OSError as error:
            raise _refused(path, error) from error


def try_folder(path: str | Path) -> None:
    """Tests whether files can be written to a folder, which need not exist yet. Raises `OutputError`."""
    path = _named(path)
    try:
        _try_folder(path)
    except OSError as error:
        raise _refused(path, error) from error


def close_stdout() -> None:
    """Redirects stdout to the null device if writing to stdout fails.

    Writing fails if the reader of a pipe has ended or the disk is full. Without the redirection, Python would print
    another error when it flushes stdout at its exit.
    """
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def into_pipe() -> Iterator[None]:
    """A context manager for programs that print: ends the program without a traceback if the reader of a pipe, such as
    `head`, has ended."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        close_stdout()
        sys.exit(1)


def _named(path: str | Path) -> Path:
    """The path as a `Path`. Raises `OutputError` for an empty text, which `Path` would read as the current folder."""
    if str(path) == "":
        raise OutputError("cannot be written (the path is empty); name a file or a folder")
    return Path(path)


def _try_folder(folder: Path, *names: str) -> None:
    """Writes a test file to the folder, or, if the folder does not exist, to its nearest existing parent, because the
    test must not create folders."""
    missing = list(names)
    while not os.path.lexists(folder):
        missing.append(folder.name)
        folder = folder.parent
    for name in missing:
        # A name that is too long is invalid in every folder, so `lstat` can test the name in this folder.
        with suppress(FileNotFoundError):
            os.lstat(folder / name)
    with _temporary(folder / "trial") as trial:
        trial.write_bytes(_TRIAL)


def _place(path: Path) -> Path:
    """The path of the file that a write to `path` replaces. For a symbolic link, the link's target is replaced and the
    link stays."""
    return Path(os.path.realpath(path))


def _check_place(path: Path) -> None:
    """Raises an error if `path` is a folder, a device or a pipe, which must not be replaced."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "a folder has this name")
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "this is not a regular file")


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """A context manager: the `with` block gets a path for a temporary file or folder, which is deleted when the block
    ends. The path has a short, unique name, is in the folder of `path`, and has the suffix of `path`."""
    partial = path.parent / f".nma-{secrets.token_hex(6)}.partial{path.suffix}"

    def delete() -> None:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        shutil.rmtree(partial, ignore_errors=True)

    with cleaning(delete):
        try:
            yield partial
        finally:
            delete()


def _refused(path: Path, error: OSError) -> NmaError:
    if isinstance(error, NmaError):
        return error
    reason = (
        "there is a file where a folder is needed"
        if isinstance(error, NotADirectoryError)
        else error.strerror
    )
    advice = _ADVICE.get(error.errno or 0, "choose another place")
    return OutputError(f"{_shown(path)}: cannot be written ({reason or error}); {advice}")


def _shown(path: Path) -> str:
    text = str(path)
    return text if len(text) <= 200 else f"{text[:80]}...{text[-40:]}"
