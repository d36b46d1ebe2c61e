"""Checks whether this machine has all that the package needs, and says how to install what is missing."""

import ctypes
import importlib
import os
import platform
import re
import sys
import tempfile
from dataclasses import dataclass
from importlib import metadata

from nma import llvm
from nma.errors import MissingDependencyError
from nma.llvm import ensure_llvm
from nma.native import build

__all__ = ["Finding", "check", "ensure_llvm"]

MIN_PYTHON = (3, 11)
PACKAGE = "neural-material-adapter"
SYSTEM_PACKAGES = {
    "python": {
        "debian": "sudo apt-get install python3.11 python3.11-venv",
        "fedora": "sudo dnf install python3.11",
        "arch": "sudo pacman -S python",
        "macos": "brew install python@3.12",
    },
    "libatomic": {
        "debian": "sudo apt-get install libatomic1",
        "fedora": "sudo dnf install libatomic",
        "arch": "sudo pacman -S gcc-libs",
    },
    "compiler": {
        "debian": "sudo apt-get install g++",
        "fedora": "sudo dnf install gcc-c++",
        "arch": "sudo pacman -S gcc",
        "macos": "xcode-select --install",
    },
    "nvidia": {
        "debian": "sudo apt-get install nvidia-driver (Ubuntu: sudo ubuntu-drivers install)",
        "fedora": "sudo dnf install akmod-nvidia xorg-x11-drv-nvidia-cuda",
        "arch": "sudo pacman -S nvidia-utils",
        "macos": "not available on macOS; the CPU is used",
    },
}


@dataclass(frozen=True)
class Finding:
    """The result of one check: whether the checked item is `ok`, and what was `found`.

    `fix` is the command that repairs a fault, or "" if there is none. If `optional` is true, the package runs without
    the checked item, and `found` names the feature that is then missing.
    """

    name: str
    ok: bool
    found: str
    fix: str = ""
    optional: bool = False


def check() -> list[Finding]:
    """Checks everything the package needs. Compiles nothing, and changes no setting other than DRJIT_LIBLLVM_PATH.

    Repair the faults in the order of the findings, since a later finding may be a consequence of an earlier one.
    """
    needed = {"drjit": "", "mitsuba": "", "numpy": "", "safetensors": "", "zarr": "", "matplotlib": ""}
    needed["PIL"] = "pillow"
    return [
        _system(),
        _python(),
        *([_libatomic()] if sys.platform == "linux" else []),
        _llvm(),  # precedes `_module`, because `_module` imports Dr.Jit, which then loads libLLVM
        *(_module(name, distribution=distribution) for name, distribution in needed.items()),
        _cuda(),
        *(_module(name, "training") for name in ("jax", "optax")),
        _module("flip_evaluator", "comparing images", "flip-evaluator"),
        _module("skimage", "comparing images", "scikit-image"),
        _module("nanobind", "compiling plugins for scalar_rgb"),
        _compiler(),
        _working_directory(),
    ]


def _advice(what: str) -> str:
    commands = SYSTEM_PACKAGES[what]
    return commands.get(llvm.platform(), f"install it with your package manager ({what})")


def _system() -> Finding:
    """Checks whether the operating system is supported. This package is tested on Linux only."""
    system = llvm.platform()
    if system == "windows":
        return Finding("system", False, "Windows is not supported; use Linux in WSL", llvm.install_command())
    found = f"{platform.system()} on {platform.machine()}"
    if system == "macos":
        found += ": should work on the CPU, but was never tested; Metal is not supported"
    return Finding("system", True, found)


def _python() -> Finding:
    wanted = ".".join(map(str, MIN_PYTHON))
    found = f"{sys.version.split()[0]} at {sys.executable}"
    if sys.version_info >= MIN_PYTHON:
        return Finding("Python", True, found)
    return Finding("Python", False, f"{found}, {wanted} or later is needed", _advice("python"))


def _libatomic() -> Finding:
    try:
        ctypes.CDLL("libatomic.so.1")
    except OSError:
        return Finding("libatomic", False, "libatomic.so.1 is missing, Dr.Jit needs it", _advice("libatomic"))
    return Finding("libatomic", True, "libatomic.so.1")


def _llvm() -> Finding:
    try:
        ensure_llvm()
        path, version = llvm.find()
    except MissingDependencyError as error:
        fault, _, fix = str(error).rpartition("; ")
        return Finding("libLLVM", False, fault, fix.removeprefix("run: "))
    return Finding("libLLVM", True, f"{version} at {path}")


def _module(name: str, purpose: str = "", distribution: str = "") -> Finding:
    """Checks that the module `name` can be imported.

    A module that has a `purpose` is optional. `distribution` is the name that pip uses for the module, if it differs
    from `name`.
    """
    distribution = distribution or name
    try:
        importlib.import_module(name)
    except Exception as error:
        # If a shared library is missing, the import may raise an error other than ImportError.
        found = f"for {purpose}; not installed" if purpose else f"cannot be imported: {error}"
        fix = f"{sys.executable} -m pip install '{_requirement(distribution)}'"
        return Finding(name, False, found, fix, bool(purpose))
    return Finding(name, True, metadata.version(distribution), optional=bool(purpose))


def _requirement(distribution: str) -> str:
    """The line of this package's requirements that names `distribution` and its versions, such as "mitsuba==3.9.*"."""
    try:
        wanted = metadata.requires(PACKAGE) or []
    except metadata.PackageNotFoundError:
        wanted = []
    specifiers = (line.partition(";")[0].strip() for line in wanted)
    return next((line for line in specifiers if re.split(r"[^\w.-]", line)[0] == distribution), distribution)


def _compiler() -> Finding:
    purpose = "for plugins of scalar_rgb and the C++ runtime in Python"
    try:
        return Finding("C++ compiler", True, build.compiler(), optional=True)
    except MissingDependencyError:
        return Finding("C++ compiler", False, f"{purpose}; no compiler found", _advice("compiler"), True)


def _cuda() -> Finding:
    """Counts the devices of the NVIDIA driver, without creating a CUDA context."""
    purpose = "for rendering and simulating on a GPU"
    try:
        driver = ctypes.CDLL(os.environ.get("DRJIT_LIBCUDA_PATH") or "libcuda.so.1")
    except OSError:
        return Finding("CUDA", False, f"{purpose}; there is no NVIDIA driver", _advice("nvidia"), True)
    count, version = ctypes.c_int(), ctypes.c_int()
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)) or not count.value:
        return Finding("CUDA", False, f"{purpose}; the NVIDIA driver sees no device", "nvidia-smi", True)
    driver.cuDriverGetVersion(ctypes.byref(version))
    major, minor = version.value // 1000, version.value % 1000 // 10
    return Finding("CUDA", True, f"driver for CUDA {major}.{minor}, {count.value} device(s)", optional=True)


def _working_directory() -> Finding:
    folder = os.getcwd()
    try:
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return Finding(
            "working directory", False, f"{folder}: {error.strerror}", f"chmod u+w '{folder}', or cd"
        )
    return Finding("working directory", True, f"{folder} can be written to")
