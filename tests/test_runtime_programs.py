"""Programs on the C++ runtime: compilers, instruction sets, sanitizers, damaged files, installation."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import random_anisotropic_adapter

ROOT = Path(__file__).parent.parent
RUNTIME = ROOT / "runtime"
WEIGHTS = [ROOT / f"nma/adapters/{name}.safetensors" for name in ("layered3-5x64", "layered3-3x32")]
STRICT = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-pthread", f"-I{RUNTIME}"]
ARM, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64-static"


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Shipped adapters, and an anisotropic one."""
    path = tmp_path_factory.mktemp("weights") / "anisotropic.safetensors"
    random_anisotropic_adapter().save(path)
    return [*WEIGHTS, path]


def tool(name):
    """Its path; what needs it is skipped where it is missing. `tools/setup.sh test` installs all of them."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"there is no {name} here")
    return found


def built(compiler, source, folder, *flags):
    program = folder / Path(source).stem
    subprocess.run([tool(compiler), *STRICT, *flags, RUNTIME / source, "-o", program], check=True)
    return program


def output(*words, **options):
    run = subprocess.run([str(w) for w in words], capture_output=True, text=True, timeout=300, check=False)
    assert run.returncode == options.get("code", 0), run.stdout + run.stderr
    return run.stderr if options.get("code") else run.stdout


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_the_example_compiles_and_runs(compiler, tmp_path):
    assert len((RUNTIME / "example.cpp").read_text().splitlines()) < 100
    program = built(compiler, "example.cpp", tmp_path, "-O2")
    lines = output(program, WEIGHTS[0]).splitlines()[1:]
    albedos = [[float(x) for x in line.split()[1:]] for line in lines]
    assert np.shape(albedos) == (5, 3)
    assert 0.1 < np.min(albedos) < np.max(albedos) < 1.0
    assert output(program, tmp_path / "none", code=1) == (
        f"{tmp_path / 'none'}: no such weights file, or it cannot be read\n"
    )


@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_instruction_sets_agree(compiler, weights, tmp_path):
    program = built(compiler, "tests/compare.cpp", tmp_path, "-O2")
    for path in weights:
        assert "portable" in output(program, path)


def test_neon_agrees_under_emulation(weights, tmp_path):
    program = built(ARM, "tests/compare.cpp", tmp_path, "-O2", "-static")
    for path in weights:
        assert "neon" in output(tool(EMULATOR), program, path)


@pytest.mark.parametrize("sanitizer", ["address,undefined", "thread"])
def test_sanitizers_find_nothing(sanitizer, tmp_path):
    flags = ["-O1", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all"]
    program = built("g++", "tests/soak.cpp", tmp_path, *flags)
    assert ", 0 faults" in output(program, 100_000, WEIGHTS[0])


def test_a_million_calls_are_sound(weights, tmp_path):
    program = built("g++", "tests/soak.cpp", tmp_path, "-O2")
    for path in weights:
        assert ", 0 faults" in output(program, 1_000_000, path)


def test_damaged_files_load_or_are_refused(weights, tmp_path):
    flags = ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    program = built("g++", "tests/fuzz.cpp", tmp_path, *flags)
    total, loaded = (int(w) for w in output(program, 2000, *weights).split() if w.isdigit())
    assert total == 6000
    assert 0 < loaded < total


def test_the_c_header_is_c(tmp_path):
    source = tmp_path / "program.c"
    source.write_text('#include "nma_c.h"\nint main(void) { return !nma_supported(NMA_PORTABLE); }\n')
    for name, language in (("nma_c", "c++17"), ("program", "c99")):
        origin = source if name == "program" else RUNTIME / "nma_c.cpp"
        command = [
            tool("g++" if name == "nma_c" else "gcc"),
            f"-std={language}",
            "-Wall",
            "-Wextra",
            "-Wpedantic",
        ]
        command += ["-Werror", f"-I{RUNTIME}", "-c", origin, "-o", tmp_path / f"{name}.o"]
        subprocess.run(command, check=True)
    subprocess.run(
        [tool("g++"), tmp_path / "nma_c.o", tmp_path / "program.o", "-o", tmp_path / "p"], check=True
    )
    assert output(tmp_path / "p") == ""


def test_it_installs_for_cmake_and_pkg_config(tmp_path):
    cmake, prefix = tool("cmake"), tmp_path / "prefix"
    for words in (
        ["-S", RUNTIME, "-B", tmp_path / "b"],
        ["--build", tmp_path / "b"],
        ["--install", tmp_path / "b"],
    ):
        output(cmake, *words, *(["--prefix", prefix] if words[0] == "--install" else []))
    user = tmp_path / "user"
    user.mkdir()
    (user / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.20)\n"
        "project(user CXX)\n"
        "find_package(nma 0.1 REQUIRED)\n"
        f"add_executable(user {RUNTIME / 'example.cpp'})\n"
        "target_link_libraries(user nma::nma)\n"
    )
    output(cmake, "-S", user, "-B", user / "b", f"-DCMAKE_PREFIX_PATH={prefix}")
    output(cmake, "--build", user / "b")
    assert "cos(theta_i)" in output(user / "b/user", WEIGHTS[0])

    pc = next(prefix.rglob("nma_c.pc"))
    flags = output(tool("pkg-config"), "--cflags", "--libs", "--static", pc).split()
    source = tmp_path / "program.c"
    source.write_text("#include <nma_c.h>\nint main(void) { return !nma_supported(NMA_PORTABLE); }\n")
    subprocess.run([tool("gcc"), source, *flags, "-o", tmp_path / "p"], check=True)
    assert output(tmp_path / "p") == ""
