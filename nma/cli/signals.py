"""Ends a command on Ctrl-C (SIGINT), on SIGTERM, and on SIGHUP, which a terminal sends when it is closed.

The signal handler raises no exception, for two reasons. Python discards an exception that a handler raises while the
garbage collector runs a callback, and JAX has such a callback, so the command would go on. Also, JAX compiles in
threads of its own, and crashes if the interpreter exits while these threads compile.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from rich.control import Control

from nma import files
from nma.cli.console import err

# Windows has no SIGHUP.
SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


@contextmanager
def handled(message: Callable[[], str]) -> Iterator[None]:
    """Within the `with` block, each of `SIGNALS` deletes temporary files, prints `message()` and ends the process.

    Python sets signal handlers only in the main thread, so this function does nothing in another thread. A signal that
    is ignored when the block begins stays ignored, because `nohup` ignores SIGHUP.
    """
    before = {}

    def end(number: int, frame: FrameType | None) -> None:
        _end(number, message())

    try:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                    before[number] = signal.signal(number, end)
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int, message: str) -> None:
    files.clean_up()
    # From here on, a second signal ends the process at once, for example if the next lines wait for a full pipe.
    for each in SIGNALS:
        if callable(signal.getsignal(each)):
            signal.signal(each, signal.SIG_DFL)
    # Writing fails if the reader of a pipe has ended, or if the signal interrupted another write to the same stream.
    with suppress(Exception):
        sys.stdout.flush()
    with suppress(Exception):
        if sys.__stderr__:
            os.write(sys.__stderr__.fileno(), f"{_below_the_bar()}nma: {message}\n".encode())
    # The parent process then sees which signal ended this process, and shells report 128 plus the signal's number.
    signal.raise_signal(number)
    # The system ignores the signal if this process is the first process of a container.
    os._exit(128 + number)


def _below_the_bar() -> str:
    """What to print before a message on a terminal, where a progress bar may have hidden the cursor."""
    return f"\n{Control.show_cursor(True)}" if err.is_terminal and not err.is_dumb_terminal else ""
