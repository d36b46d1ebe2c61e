"""Fixtures and settings for all test files."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from material_cases import PLAIN

from nma import cli, llvm

# Tests keep compiled code in a cache of their own, apart from the user's. All test processes and all test runs share
# this cache. Each folder in the cache is named by the digest of the sources that were compiled.
CACHE = Path(__file__).parents[1] / "build/tests"
os.environ["XDG_CACHE_HOME"] = str(CACHE)
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(CACHE / "jax")
# XLA's older emitters compile the training steps of the tests twice as fast as the newer ("fusion") emitters.
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")


@pytest.fixture
def old_library(tmp_path: Path) -> str:
    """The path of a libLLVM older than 16, which cannot report its version.

    If the system has no old libLLVM, the fixture compiles an imitation.
    """
    for path in llvm.candidates():
        if llvm._version_of_name(path) < 16:
            return path
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no old libLLVM here, and no C compiler to imitate one")
    source = tmp_path / "old.c"
    source.write_text("void *LLVMGetGlobalContext(void) { return 0; }\n")
    library = tmp_path / "libLLVM-14.so.1"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source], check=True)
    return str(library)


@pytest.fixture(scope="session")
def compiler() -> str:
    """The path of a C++ compiler. Tests that need a compiler are skipped on machines without one."""
    found = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if found is None:
        pytest.skip("there is no C++ compiler here")
    return found


@pytest.fixture(scope="session")
def measurements() -> Path:
    """The folder of measured materials: NMA_TEST_DATA, or shared/data beside the checkout.

    The repository holds no measurements. A test that needs measurements is skipped if the measurements are missing.
    """
    named = os.environ.get("NMA_TEST_DATA")
    folder = Path(named or Path(__file__).parents[2] / "shared/data")
    missing = [name for name in ("rgl", "rgl_nbrdf", "merl_nbrdf") if not (folder / name).is_dir()]
    if missing:
        reason = (
            f"no measured materials in {', '.join(missing)} of {folder}: NMA_TEST_DATA names another folder, "
            "`nma data` says where they come from"
        )
        (pytest.fail if named else pytest.skip)(reason)
    return folder


@pytest.fixture(scope="session")
def untrained(tmp_path_factory) -> Path:
    """The weights file of a small untrained adapter."""
    import numpy as np

    from nma import network
    from nma.adapter import Adapter, encoding
    from nma.params import LAYERED3
    from nma.target import PRINCIPLED_PARAMS, output_size

    sizes = [encoding.size("layered3", LAYERED3, True), 8, 8, output_size(2, PRINCIPLED_PARAMS)]
    layers = network.init(np.random.default_rng(0), sizes)
    path = tmp_path_factory.mktemp("untrained") / "tiny.safetensors"
    Adapter(LAYERED3, "layered3", layers, 2, True, PRINCIPLED_PARAMS).save(path)
    return path


@pytest.fixture
def nma(monkeypatch, capsys):
    """A function that runs `nma ARGUMENTS` in this process and returns (exit status, stdout, stderr)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["nma", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
            sys.exit(0)
        return end.value.code or 0, *capsys.readouterr()

    return run


@pytest.fixture(scope="module")
def fast_steps():
    """Compiles training steps with few optimisations, because compiling takes longer than a short training run."""
    import jax
    from target_cases import FAST_COMPILE

    from nma.train import loop

    with pytest.MonkeyPatch.context() as patch:
        steps = jax.jit(loop._group.__wrapped__, static_argnames=("recipe", "objective"), **FAST_COMPILE)
        patch.setattr(loop, "_group", steps)
        yield


@pytest.fixture
def material_file(tmp_path):
    """A function that replaces text in the material file PLAIN, writes the result to a file, and returns its path."""

    def write(old: str = "", new: str = "") -> Path:
        assert old in PLAIN
        path = tmp_path / "test.toml"
        path.write_text(PLAIN.replace(old, new, 1))
        return path

    return write
