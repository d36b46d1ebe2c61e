"""Dr.Jit gets a libLLVM that is new enough, or an error message of one line says what to do.

Without our check, Dr.Jit would kill the process because of an old libLLVM.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import nma
from nma import llvm
from nma.jit import _has_gpu

needs_llvm = pytest.mark.skipif(_has_gpu(), reason="Dr.Jit computes on a GPU here and needs no libLLVM")
SIMULATE = "from nma.cli import main; main()"
KERNEL = """
import os
import numpy as np
from nma import sources
from nma.table import stream_keys, tabulate

source = sources.get("layered3")
params = source.space.sample(np.random.default_rng(1), 1)
table = tabulate(source, params, 40, stream_keys(0, [0]))
print(table.walks[0], os.environ["DRJIT_LIBLLVM_PATH"])
"""


def run(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    """Runs Python `code` in a new process, which chooses its own libLLVM."""
    kept = {key: value for key, value in os.environ.items() if key != llvm.VARIABLE}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, env=kept | environment, capture_output=True, text=True, timeout=60)


@needs_llvm
@pytest.mark.parametrize("which", ["old", "none"])
def test_simulate_with_an_unusable_library_exits_1_with_one_line(which, old_library, tmp_path):
    library = old_library if which == "old" else "/nowhere/libLLVM.so"
    output = str(tmp_path / "x.npz")
    options = ("simulate", "--material", "gold-red-lacquer", "--walks", "40", "-o", output)
    result = run(SIMULATE, *options, DRJIT_LIBLLVM_PATH=library)
    assert result.returncode == 1
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("nma: ")
    assert f"unset {llvm.VARIABLE}" in result.stderr
    assert library in result.stderr
    assert not Path(output).exists()


@needs_llvm
def test_an_old_library_that_dr_jit_has_loaded_already_is_refused(old_library):
    result = run("import drjit\nimport nma.table", DRJIT_LIBLLVM_PATH=old_library)
    assert result.returncode == 1
    assert re.search(r"MissingDependencyError: Dr.Jit has loaded .*; (set|run)", result.stderr)


def test_the_choice_is_made_before_dr_jit_is_imported():
    result = run(KERNEL)
    assert result.returncode == 0, result.stderr
    walks, library = result.stdout.split()
    assert int(walks) == 40
    assert llvm.version(library) >= llvm.MIN_VERSION


def test_loading_dr_jit_loads_no_mitsuba():
    result = run("import sys, nma.table, nma.evaluate, nma.sources.layered; print('mitsuba' in sys.modules)")
    assert result.stdout == "False\n", result.stderr


def test_modules_take_dr_jit_from_the_gate():
    """Outside `nma.render` and `nma.sources`, no module imports Dr.Jit or Mitsuba directly at its top level."""
    root = Path(nma.__file__).parent
    gated = ("render", "sources")
    for path in root.rglob("*.py"):
        if path.name == "jit.py" or path.relative_to(root).parts[0] in gated:
            continue
        own = re.findall(r"^(?:import|from) (?:drjit|mitsuba)\b.*", path.read_text(), re.M)
        assert not own, f"{path}: {own}; write `from nma.jit import dr`"


@pytest.mark.slow
@needs_llvm
@pytest.mark.usefixtures("compiler")
def test_the_scalar_renderer_needs_no_library():
    code = (
        "import nma.render; import mitsuba as mi; nma.render.use('scalar_rgb');"
        "print(mi.load_dict({'type': 'nma', 'adapter': 'layered3-3x32', 'alpha_top': .1, 'alpha_bottom': .2,"
        " 'eta_top': 1.5, 'eta_conductor': .2, 'k_conductor': 3., 'albedo': .5, 'sigma_t': .5}));"
        "nma.render.use('llvm_ad_rgb')"
    )
    result = run(code, DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert "Nma[" in result.stdout
    assert "MissingDependencyError: Dr.Jit has loaded no libLLVM; set DRJIT_LIBLLVM_PATH=" in result.stderr
