"""`nma.doctor`, and the search for a libLLVM that is new enough for Dr.Jit."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from nma import doctor, llvm
from nma.errors import MissingDependencyError

# A program that calls `ensure_llvm`, as every program does before it runs its first kernel. Then the program runs a
# kernel that an old libLLVM cannot compile.
FIRST_KERNEL = """
from nma.errors import NmaError
from nma.llvm import ensure_llvm
try:
    ensure_llvm()
except NmaError as error:
    print("refused:", error)
else:
    import drjit as dr
    print("computed:", dr.maximum(dr.llvm.Float([1, 2]), 1.5))
"""


def run(code: str, **environment: str) -> subprocess.CompletedProcess:
    """Runs Python `code` in a new process, because a process can load only one libLLVM."""
    kept = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    return subprocess.run(
        [sys.executable, "-c", code], env=kept | environment, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("prelude", ["", "import drjit\n"], ids=["before-drjit", "after-drjit"])
def test_the_newest_library_is_used(prelude):
    result = run(prelude + FIRST_KERNEL)
    assert result.returncode == 0
    assert result.stdout == "computed: [1.5, 2]\n"


@pytest.mark.parametrize("prelude", ["", "import drjit\n"], ids=["before-drjit", "after-drjit"])
def test_an_old_library_is_refused_instead_of_dying_in_the_compiler(prelude, old_library):
    result = run(prelude + FIRST_KERNEL, DRJIT_LIBLLVM_PATH=old_library)
    assert result.returncode == 0
    assert result.stdout.startswith("refused: ")
    assert result.stdout.count("\n") == 1
    assert llvm.VARIABLE in result.stdout
    if not prelude:
        assert f"{old_library} is too old" in result.stdout


@pytest.mark.parametrize("prelude", ["", "import drjit\n"], ids=["before-drjit", "after-drjit"])
@pytest.mark.parametrize("missing", ["/nowhere/libLLVM.so", __file__], ids=["no-file", "no-library"])
def test_a_missing_library_is_refused(prelude, missing):
    result = run(prelude + FIRST_KERNEL, DRJIT_LIBLLVM_PATH=missing)
    assert result.returncode == 0
    assert result.stdout.startswith("refused: ")
    assert result.stdout.count("\n") == 1


@pytest.fixture
def _fresh_search(monkeypatch):
    """Clears the cached results of the search for libLLVM before and after a test."""
    monkeypatch.delenv(llvm.VARIABLE, raising=False)
    for cached in (llvm._newest, llvm._examine):
        cached.cache_clear()
    yield
    for cached in (llvm._newest, llvm._examine):
        cached.cache_clear()


@pytest.mark.usefixtures("_fresh_search")
@pytest.mark.parametrize(
    ("system", "command"),
    [
        ("debian", "apt-get"),
        ("fedora", "dnf"),
        ("arch", "pacman"),
        ("macos", "brew"),
        ("windows", "wsl"),
        ("other", "install"),
    ],
)
def test_a_system_without_libllvm_is_told_what_to_install(monkeypatch, system, command):
    monkeypatch.setattr(llvm, "candidates", list)
    monkeypatch.setattr(llvm, "platform", lambda: system)
    with pytest.raises(MissingDependencyError, match=f"there is no libLLVM.*{command}"):
        llvm.find()


@pytest.mark.usefixtures("_fresh_search")
def test_the_newest_of_several_wins_and_what_does_not_load_is_passed_over(monkeypatch):
    versions = {"libLLVM-21.so": None, "libLLVM-20.so": 20, "libLLVM-14.so": 0}
    monkeypatch.setattr(llvm, "candidates", lambda: list(versions))
    monkeypatch.setattr(llvm, "version", versions.get)
    assert llvm.find() == ("libLLVM-20.so", 20)
    monkeypatch.setenv(llvm.VARIABLE, "libLLVM-14.so")
    with pytest.raises(MissingDependencyError, match="libLLVM 14 at .* is too old.*; unset"):
        llvm.find()


def test_libraries_are_ordered_by_number(tmp_path, monkeypatch):
    names = ["libLLVM-9.so.1", "libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM-15-rust-1.7.so", "libLLVM-C.so"]
    for name in names:
        (tmp_path / name).touch()
    monkeypatch.setattr(llvm, "PATTERNS", ())
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))
    monkeypatch.delenv("CONDA_PREFIX", raising=False)
    found = [Path(path).name for path in llvm.candidates()]
    assert found == ["libLLVM.so.19.1", "libLLVM-14.so.1", "libLLVM-9.so.1"]


def test_findings_name_a_command_where_something_is_wrong():
    findings = doctor.check()
    assert {"system", "Python", "libLLVM", "drjit", "CUDA", "jax", "nanobind", "C++ compiler"} <= {
        finding.name for finding in findings
    }
    for finding in findings:
        assert finding.found
        assert bool(finding.fix) != finding.ok


@pytest.mark.parametrize(
    ("system", "ok", "found"),
    [
        ("debian", True, "on"),
        ("macos", True, "never tested; Metal is not supported"),
        ("windows", False, "Windows is not supported"),
    ],
)
def test_it_says_which_systems_are_supported(monkeypatch, system, ok, found):
    monkeypatch.setattr(llvm, "platform", lambda: system)
    finding = doctor.check()[0]
    assert (finding.name, finding.ok, finding.optional) == ("system", ok, False)
    assert found in finding.found
    assert ok or finding.fix.startswith("wsl --install")


def test_what_compiling_needs_is_optional(monkeypatch):
    monkeypatch.setitem(sys.modules, "nanobind", None)
    monkeypatch.setattr(shutil, "which", lambda *_, **__: None)
    findings = {finding.name: finding for finding in doctor.check()}
    for name, fix in (("nanobind", "pip install 'nanobind"), ("C++ compiler", "g++")):
        assert not findings[name].ok and findings[name].optional
        assert "scalar_rgb" in findings[name].found
        assert fix in findings[name].fix or llvm.platform() != "debian"


def test_a_missing_module_is_found_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "jax", None)
    finding = next(finding for finding in doctor.check() if finding.name == "jax")
    assert not finding.ok
    assert finding.optional
    assert "training" in finding.found
    assert "pip install 'jax" in finding.fix


def test_importing_the_package_loads_neither_mitsuba_nor_drjit():
    result = run("import sys, nma, nma.doctor; print({'mitsuba', 'drjit', 'jax'} & set(sys.modules))")
    assert result.stdout == "set()\n"
