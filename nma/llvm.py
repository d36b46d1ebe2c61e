"""Finds a libLLVM with which Dr.Jit can compile CPU kernels.

An old libLLVM raises no error, but kills the process while Dr.Jit compiles a kernel ("LLVM ERROR: Cannot select"). So
this module looks for the newest libLLVM of the system, and raises an error before Dr.Jit loads an old one.

This file needs only the standard library, so `python3 -I nma/llvm.py` can be run before anything is installed.
"""

import ctypes
import glob
import os
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

# On CPUs with AVX-512, Dr.Jit 1.5 aborts in libLLVM 15 and 16 (at `fmaximum`). With libLLVM 17, 18, 19 and 22, Dr.Jit
# rendered identical pictures.
MIN_VERSION = 17
VARIABLE = "DRJIT_LIBLLVM_PATH"
NEED = f"Dr.Jit needs {MIN_VERSION} or later to compile for the CPU"

# The places outside the search path of the dynamic linker where Linux distributions and macOS package managers install
# libLLVM.
PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM*",
    "/usr/lib/llvm*/lib*/libLLVM*",
    "/usr/lib64/libLLVM*",
    "/usr/lib64/llvm*/lib*/libLLVM*",
    "/usr/lib/libLLVM*",
    "/usr/local/lib*/libLLVM*",
    "/opt/homebrew/opt/llvm*/lib/libLLVM*",
    "/usr/local/opt/llvm*/lib/libLLVM*",
    "/opt/local/libexec/llvm*/lib/libLLVM*",
)

# Matches libLLVM-15.so.1, libLLVM.so.19.1, libLLVM-14.0.6.so and libLLVM.dylib, but not libLLVM-C.so and
# libLLVM-15-rust.so.
_NAME = re.compile(r"libLLVM(-\d+[\d.]*)?\.(so|dylib)[\d.]*")
_NUMBER = re.compile(r"(?:libLLVM-|libLLVM\.so\.|llvm[-@/]?)(\d+)")

_INSTALL = {
    "debian": "sudo apt-get install libllvm19",
    "fedora": "sudo dnf install llvm-libs",
    "arch": "sudo pacman -S llvm-libs",
    "macos": "brew install llvm",
    # Dr.Jit could use LLVM-C.dll on Windows, but this package was never tried there.
    "windows": "wsl --install (Windows is not supported, so use Linux in WSL)",
}


def platform() -> str:
    """The name of the system, which decides the package manager: debian (includes Ubuntu), fedora, arch, macos, windows
    or other."""
    if sys.platform in ("darwin", "win32"):
        return "macos" if sys.platform == "darwin" else "windows"
    try:
        release = Path("/etc/os-release").read_text(encoding="utf-8")
    except OSError:
        return "other"
    words = " ".join(re.findall(r"^ID(?:_LIKE)?=(.*)$", release, re.M)).replace('"', "").split()
    aliases = {"debian": "debian", "ubuntu": "debian", "fedora": "fedora", "rhel": "fedora", "arch": "arch"}
    return next((aliases[word] for word in words if word in aliases), "other")


def install_command() -> str:
    """The command that installs a new enough libLLVM on this system."""
    return _INSTALL.get(platform(), f"install libLLVM {MIN_VERSION} or later and point {VARIABLE} to it")


def version(path: str) -> int | None:
    """The major version of the libLLVM at `path`.

    The version is 0 if the libLLVM has no function that returns the version (before 16), and None if the libLLVM cannot
    be loaded.
    """
    try:
        library = ctypes.CDLL(path)
    except OSError:
        return None
    try:
        ask = library.LLVMGetVersion
    except AttributeError:
        return 0 if hasattr(library, "LLVMGetGlobalContext") else None
    major, minor, patch = (ctypes.c_uint() for _ in range(3))
    ask(ctypes.byref(major), ctypes.byref(minor), ctypes.byref(patch))
    return major.value


def _version_of_name(path: str) -> int:
    """The major version in the resolved path of the file, or 0 if the path contains no version."""
    numbers = _NUMBER.findall(os.path.realpath(path))
    return int(numbers[-1]) if numbers else 0


def _folders_of_user() -> list[str]:
    """The folders that environment variables add to the search for libLLVM."""
    variables = ("LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "DYLD_FALLBACK_LIBRARY_PATH")
    folders = [folder for name in variables for folder in os.environ.get(name, "").split(os.pathsep)]
    prefix = os.environ.get("CONDA_PREFIX")
    return [folder for folder in (*folders, f"{prefix}/lib" if prefix else "") if folder]


def candidates() -> list[str]:
    """The paths of all libLLVM files of this system, without duplicates, newest first according to their names."""
    patterns = (*PATTERNS, *(f"{folder}/libLLVM*" for folder in _folders_of_user()))
    paths = [path for pattern in patterns for path in glob.glob(pattern)]
    search = os.pathsep.join((os.environ.get("PATH", ""), "/sbin", "/usr/sbin"))
    if ldconfig := shutil.which("ldconfig", path=search):
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, check=False).stdout
        paths += re.findall(r"=> (\S*libLLVM\S*)", listing)
    files = {os.path.realpath(path): path for path in paths if _NAME.fullmatch(os.path.basename(path))}
    return sorted(files.values(), key=lambda path: (_version_of_name(path), path), reverse=True)


@cache
def _examine(path: str) -> tuple[int | None, str]:
    """The version of the libLLVM at `path`, and a message that says why this libLLVM is unusable ("" if it is
    usable)."""
    found = version(path)
    if found is None:
        return None, f"{path} is no libLLVM that can be loaded"
    if found < MIN_VERSION:
        number = found or _version_of_name(path) or "older than 16"
        return found, f"libLLVM {number} at {path} is too old, {NEED}"
    return found, ""


@cache
def _newest() -> tuple[str, int, str]:
    """The path and the version of the newest libLLVM that can be loaded, and a message that says why there is no usable
    libLLVM ("" if there is one)."""
    for path in candidates():
        found, fault = _examine(path)
        if found is not None:
            return path, found, fault
    return "", 0, f"there is no libLLVM, {NEED}"


def find() -> tuple[str, int]:
    """The path and the major version of the libLLVM to use.

    The libLLVM that DRJIT_LIBLLVM_PATH names takes precedence over the newest libLLVM on the system. Raises
    `MissingDependencyError`, whose message says what to do, if there is no libLLVM or if it is too old.
    """
    if chosen := os.environ.get(VARIABLE):
        found, fault = _examine(chosen)
        if fault:
            install = f" and run: {install_command()}" if _newest()[2] else ""
            raise _missing(f"{VARIABLE}: {fault}; unset {VARIABLE}{install}")
        return chosen, found or 0
    path, newest, fault = _newest()
    if fault:
        raise _missing(f"{fault}; run: {install_command()}")
    return path, newest


def ensure_llvm() -> None:
    """Makes sure that Dr.Jit uses a libLLVM that is new enough. Call this function before the first CPU kernel.

    The first import of Dr.Jit loads libLLVM. If Dr.Jit is not yet imported, this function sets DRJIT_LIBLLVM_PATH,
    unless the user has set it. If Dr.Jit is already imported, this function asks Dr.Jit which libLLVM is loaded. Raises
    `MissingDependencyError` if there is no usable libLLVM, or if Dr.Jit has loaded a libLLVM that is too old.
    """
    if "drjit" in sys.modules:
        _check_loaded()
    else:
        os.environ[VARIABLE], _ = find()


def _check_loaded() -> None:
    import drjit

    major = drjit.detail.llvm_version()[0]  # `major` is -1 if Dr.Jit has found no libLLVM
    if major >= MIN_VERSION:
        return
    loaded = f"libLLVM {major}, which is too old ({NEED})" if major > 0 else "no libLLVM"
    path, _, fault = _newest()
    mend = f"run: {install_command()}" if fault else f"set {VARIABLE}={path} before Python starts"
    raise _missing(f"Dr.Jit has loaded {loaded}; {mend}")


def _missing(message: str) -> Exception:
    # The import is inside this function, because this file must run before the package is installed.
    from nma.errors import MissingDependencyError

    return MissingDependencyError(message)


def main() -> int:
    """Prints the path of the libLLVM to use and returns 0, or prints why there is no usable libLLVM and returns 1."""
    chosen = os.environ.get(VARIABLE)
    path, fault = (chosen, _examine(chosen)[1]) if chosen else (_newest()[0], _newest()[2])
    print(fault or path)
    return 1 if fault else 0


if __name__ == "__main__":
    sys.exit(main())
