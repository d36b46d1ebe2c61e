"""Compiles the C++ runtime on this machine: the plugins for Mitsuba's variant scalar_rgb, and the shared library that
`nma.native.runtime` calls.

The compiled files are kept in the user's cache, in a subfolder whose name contains a digest of the C++ sources and of
the versions of the packages that the plugins link to. So the C++ sources are compiled again after an update of this
package or of Mitsuba, and plugins of another version are never loaded. The compiler is the one that the environment
variable `CXX` names, or else c++, g++ or clang++. This module is tested on Linux, should work on macOS, and raises an
error on Windows.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

from nma.errors import MissingDependencyError, NmaError
from nma.files import cleaning, whole_folder

PLUGINS = ("nma", "layered")
_ADAPTERS = Path(__file__).parent.parent / "adapter" / "trained"
# The flags with which Mitsuba's wheel was compiled. The instruction set decides how function calls pass vectors, so a
# plugin that is compiled for another instruction set loads, but returns wrong values.
_MITSUBA_FLAGS = (
    *(["-march=haswell"] if platform.machine() in ("x86_64", "AMD64") else []),
    *("-std=c++20", "-O2", "-fPIC", "-shared", "-fvisibility=hidden"),
    *("-DMI_ENABLE_CUDA=1", "-DMI_ENABLE_LLVM=1", "-DMI_ENABLE_EMBREE=1", "-DMI_ENABLE_AUTODIFF=1"),
    "-DLITTLE_ENDIAN",
)


class BuildError(NmaError, RuntimeError):
    """The compiler failed. The message contains the first two errors of the compiler."""


def sources() -> Path:
    """The folder with the sources of the C++ runtime, in a checkout or in an installed wheel."""
    package = Path(__file__).parent
    for folder in (package / "cpp", package.parent.parent / "runtime"):
        if (folder / "nma.h").exists():
            return folder
    raise NmaError(f"there are no C++ sources beside {package}; install the package again")


def mitsuba_folder() -> Path:
    """The folder of the plugins for the installed Mitsuba, to be put on Mitsuba's resource path. The folder does not
    exist until `build_mitsuba` has run."""
    return _cache() / f"mitsuba-{_digest('mitsuba', 'drjit')}"


def has_mitsuba_plugins() -> bool:
    """Whether the plugins have been compiled for the installed Mitsuba."""
    return mitsuba_folder().exists()


def build_mitsuba(say: Callable[[str], None] = lambda line: None) -> Path:
    """Compiles the plugins `nma` and `layered` for `scalar_rgb` against the installed Mitsuba, unless they exist.

    Args:
        say: a function that is called with a line of text for each step.

    Returns:
        The folder to put on Mitsuba's resource path. The folder also contains the shipped adapters.

    Raises:
        MissingDependencyError: there is no compiler, or the package nanobind is missing, whose headers Dr.Jit's headers
            include.
        BuildError: the compiler failed, or the operating system is Windows.
    """
    folder = mitsuba_folder()
    if folder.exists():
        say(f"{folder} is up to date")
        return folder
    mitsuba, drjit, nanobind = (_package(name) for name in ("mitsuba", "drjit", "nanobind"))
    headers = [mitsuba / "include", drjit / "include", nanobind / "include"]
    headers.append(nanobind / "ext/robin_map/include")
    flags = [
        *_MITSUBA_FLAGS,
        f"-I{sources()}",
        f"-I{sources() / 'mitsuba'}",
        *(f"-isystem{h}" for h in headers),
    ]
    flags += [f"-L{mitsuba}", f"-L{drjit}", "-lmitsuba", "-ldrjit-core", "-ldrjit-extra"]
    flags.append(_leave_undefined())

    with whole_folder(folder) as into:
        (into / "plugins").mkdir()
        for name in PLUGINS:
            plugin = into / "plugins" / f"{name}{_suffix()}"
            say(f"compiling {plugin.name}")
            # The flags follow the source file, because the linker looks for the symbols of a file only in the libraries
            # that follow the file on the command line.
            _compile([sources() / "mitsuba" / f"{name}.cpp", "-o", plugin], flags)
        shutil.copytree(_ADAPTERS, into / "adapters")
    return folder


def shared_library() -> Path:
    """The path of the shared library of the C interface. This function compiles the library if it does not exist.

    Raises the same errors as `build_mitsuba`.
    """
    folder, name = _cache() / f"library-{_digest()}", f"nma_c{_suffix()}"
    flags = ["-std=c++17", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", f"-I{sources()}"]
    if not folder.exists():
        with whole_folder(folder) as into:
            _compile([sources() / "nma_c.cpp", "-o", into / name], flags)
    return folder / name


def compiler() -> str:
    """The path of the C++ compiler. Raises `MissingDependencyError` if there is no compiler, and `BuildError` on
    Windows."""
    if sys.platform == "win32":
        raise BuildError(
            "the C++ runtime cannot be compiled on Windows, only on Linux and (untested) on macOS; use WSL, or the "
            "variants llvm_ad_rgb and cuda_ad_rgb, which need no compiler"
        )
    for name in filter(None, (os.environ.get("CXX"), "c++", "g++", "clang++")):
        if found := shutil.which(name):
            return found
    raise MissingDependencyError(
        "no C++ compiler found; install one (Debian: sudo apt-get install g++), or set CXX to its path"
    )


def _suffix() -> str:
    """The file extension of shared libraries and of Mitsuba's plugins."""
    return ".dylib" if sys.platform == "darwin" else ".so"


def _leave_undefined() -> str:
    """The linker flag that allows Mitsuba's libraries to have undefined symbols, which are resolved when a plugin
    loads."""
    return "-Wl,-undefined,dynamic_lookup" if sys.platform == "darwin" else "-Wl,--allow-shlib-undefined"


def _compile(words: Sequence[str | Path], flags: Sequence[str]) -> None:
    command = [compiler(), *map(str, words), *flags]
    # The compiler's programs form a process group of their own, so that all of them can be ended together.
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", process_group=0
    ) as process:

        def end() -> None:
            with suppress(OSError, subprocess.TimeoutExpired):
                os.killpg(process.pid, signal.SIGTERM)
                process.wait(2.0)

        with cleaning(end):
            try:
                _, told = process.communicate()
            except BaseException:
                end()
                raise
    if process.returncode:
        errors = [line for line in told.splitlines() if "error" in line] or told.splitlines()
        raise BuildError(f"{' '.join(command[:2])}: {'; '.join(errors[:2])}")


def _package(name: str) -> Path:
    """The folder of the installed package `name`."""
    try:
        return Path(str(importlib.metadata.distribution(name).locate_file(name)))
    except importlib.metadata.PackageNotFoundError:
        raise MissingDependencyError(
            f"the package {name} is missing; install it with: pip install {name}"
        ) from None


def _cache() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home) / "neural-material-adapter"


@cache
def _digest(*packages: str) -> str:
    """A digest of the C++ sources. If `packages` are given, the digest also covers their versions and the shipped
    adapters."""
    digest = hashlib.sha256()
    folders = (sources(), _ADAPTERS) if packages else (sources(),)
    for file in sorted(f for folder in folders for f in folder.rglob("*") if f.is_file()):
        digest.update(file.name.encode() + file.read_bytes())
    for name in packages:
        digest.update(f"{name} {importlib.metadata.version(name)}".encode())
    return digest.hexdigest()[:16]
