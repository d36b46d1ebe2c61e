"""Ctrl-C and the signals SIGTERM and SIGHUP end a command with an honest exit status, and leave no partial file."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from nma import cli, materials

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
# The command `nma materials`, in which the function `names` of a test replaces the function that lists the materials.
COMMAND = """
import gc, os, signal, sys, time
for number in {defaults}:
    signal.signal(number, signal.SIG_DFL)
from nma import cli, files, materials
{body}
materials.names = names
sys.argv = ["nma", "materials"]
cli.main()
"""
WRITING = """
def names():
    with files.whole("x.txt") as file:
        file.write_text("half")
        files.scratch_folder()
        print("writing", flush=True)
        {wait}
    return []
"""


def start(folder, body, *before):
    """Starts a command in `folder`, which also becomes the folder of temporary files.

    A program that starts the tests in the background may ignore signals, and processes inherit this. Without a command
    `before`, such as `nohup`, the started command therefore sets the signals to their defaults.
    """
    defaults = [] if before else [int(number) for number in SIGNALS]
    return subprocess.Popen(
        [*before, sys.executable, "-c", COMMAND.format(body=body, defaults=defaults)],
        cwd=folder,
        env=os.environ | {"TMPDIR": str(folder)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ended(process, number):
    """Sends a signal as soon as the process has printed a line. Returns (exit status, stderr)."""
    try:
        assert process.stdout.readline() == "writing\n"
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, err


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_ends_a_command_without_partial_files(tmp_path, number):
    """Job queues send SIGTERM to stop a job, and a terminal sends SIGHUP when it is closed."""
    status, err = ended(start(tmp_path, WRITING.format(wait="time.sleep(60)")), number)
    assert (status, err.count("\n")) == (-number, 1)
    assert err.startswith("nma: interrupted; ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_during_a_garbage_collection_is_not_lost(tmp_path, number):
    """Python discards exceptions in callbacks of the garbage collector, and JAX has such a callback."""
    waiting = """
        gc.callbacks.append(lambda *_: time.sleep(60))
        gc.collect()"""
    status, err = ended(start(tmp_path, WRITING.format(wait=waiting)), number)
    assert (status, err.count("\n")) == (-number, 1)
    assert not list(tmp_path.iterdir())


def test_a_signal_ends_a_command_that_compiles(tmp_path):
    """JAX compiles in threads of its own. If the interpreter exits meanwhile, the process crashes."""
    pytest.importorskip("jax")
    body = """
import threading
import jax, jax.numpy as jnp
def chain(x):
    for k in range(300):
        x = jnp.sort(jnp.sin(x @ x) + k, axis=k % 2)
    return x
def names():
    lowered = jax.jit(chain).lower(jnp.ones((9, 9)))
    threading.Timer(0.3, print, ["writing"], {"flush": True}).start()
    lowered.compile()
"""
    status, err = ended(start(tmp_path, body), signal.SIGTERM)
    assert (status, err.count("\n")) == (-signal.SIGTERM, 1)


def test_nohup_keeps_a_command_running(tmp_path):
    process = start(tmp_path, WRITING.format(wait="time.sleep(0.5)"), "nohup")
    assert ended(process, signal.SIGHUP)[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["x.txt"]


def test_a_first_process_whose_signals_the_system_ignores_ends(tmp_path):
    """The first process of a container ignores the signals that it sends itself. The test imitates the process."""
    body = "signal.raise_signal = lambda number: None" + WRITING.format(wait="time.sleep(60)")
    assert ended(start(tmp_path, body), signal.SIGTERM)[0] == 128 + signal.SIGTERM
    assert not list(tmp_path.iterdir())


def test_a_command_in_a_thread_handles_no_signals(monkeypatch, capsys):
    ends = []

    def command():
        with pytest.raises(SystemExit) as end:
            cli.main()
        ends.append(end.value.code)

    monkeypatch.setattr(sys, "argv", ["nma", "--version"])
    thread = threading.Thread(target=command)
    thread.start()
    thread.join()
    assert ends == [0]
    assert capsys.readouterr().out.startswith("nma ")


def test_after_a_command_signals_have_their_former_handlers(nma):
    before = [signal.getsignal(number) for number in SIGNALS]
    assert nma("materials")[0] == 0
    assert [signal.getsignal(number) for number in SIGNALS] == before
    assert materials.names()


def test_a_signal_ends_the_compiler(tmp_path):
    """The compiler would otherwise go on after the command, and write to a folder that no longer exists."""
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\ntrap 'touch ended; exit 1' TERM\ntouch started\nsleep 60 & wait\n")
    compiler.chmod(0o755)
    body = f"""
from pathlib import Path
from nma.native import build
os.environ.update(CXX={str(compiler)!r}, XDG_CACHE_HOME="cache")
names = build.shared_library
"""
    process = start(tmp_path, body)
    while not (tmp_path / "started").exists() and process.poll() is None:
        time.sleep(0.02)
    process.terminate()
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGTERM
    assert not list((tmp_path / "cache").glob("*/*"))
    assert (tmp_path / "ended").exists()


@pytest.mark.parametrize("part", ["zarr.json", "c"])
def test_a_signal_waits_until_a_file_of_a_dataset_is_complete(tmp_path, part):
    """A thread of zarr writes the description of a dataset, and each of its chunks, by way of a temporary file."""
    body = f"""
from pathlib import Path
import numpy as np
from nma.table import dataset, ISOTROPIC
replace = Path.replace
def slowly(self, target):
    if {part!r} in Path(target).parts:
        print("writing", flush=True)
        time.sleep(0.4)
    return replace(self, target)
Path.replace = slowly
def names():
    data = dataset.Dataset.create("x.zarr", dataset.Settings("layered3", 2, 1, 0))
    data._store([0, 1], np.zeros((2, *ISOTROPIC.shape), np.float16))
"""
    assert ended(start(tmp_path, body), signal.SIGTERM)[0] == -signal.SIGTERM
    left = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert left == ({"zarr.json"} if part == "zarr.json" else {"zarr.json", "0"})
