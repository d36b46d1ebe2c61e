"""Programs that use the C++ runtime: compilers, instruction sets, sanitizers, damaged files and installation."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import random_anisotropic_adapter, random_interface_adapter

ROOT = Path(__file__).parent.parent
RUNTIME = ROOT / "runtime"
WEIGHTS = [ROOT / f"nma/adapter/trained/{name}.safetensors" for name in ("layered3-5x64", "layered3-3x32")]
STRICT = ["-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-pthread", f"-I{RUNTIME}"]
# Only `make test-all` runs the tests with clang++ and most of the other tests in this file.
COMPILERS = ["g++", pytest.param("clang++", marks=pytest.mark.slow)]
ARM, EMULATOR = "aarch64-linux-gnu-g++", "qemu-aarch64-static"


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """The paths of two shipped adapters, of an anisotropic adapter, and of one whose target lies under an interface."""
    folder = tmp_path_factory.mktemp("weights")
    random_anisotropic_adapter().save(folder / "anisotropic.safetensors")
    random_interface_adapter().save(folder / "interface.safetensors")
    return [*WEIGHTS, folder / "anisotropic.safetensors", folder / "interface.safetensors"]


def tool(name):
    """Returns the path of a program. If the program is not installed, the test is skipped.

    `tools/setup.sh test` installs all programs that the tests need.
    """
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


@pytest.mark.parametrize("compiler", COMPILERS)
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


def test_the_example_of_the_simulated_material_agrees_with_itself(tmp_path):
    """The example estimates the reflected light in four ways, and the estimates agree within 4.5 standard errors.

    A false alarm happens in about one of ten thousand runs. The estimate that combines walks and evaluation has a
    smaller error than walks alone or evaluation alone.
    """
    lines = output(built("g++", "example_layered.cpp", tmp_path, "-O2")).splitlines()[1:]
    means, errors = np.array([[float(x) for x in line.split()[-3::2]] for line in lines]).T
    assert (np.abs(means[:, None] - means) <= 4.5 * np.hypot(errors[:, None], errors)).all()
    assert errors[2] < 0.8 * min(errors[:2])


@pytest.mark.parametrize("standard", ["17", "20", "2b"])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_every_header_compiles_in_newer_standards(compiler, standard):
    headers = ["-include", "nma/layered.h", "-include", "nma/generated/classes.h"]
    without = ["-DNMA_NO_AVX512_BF16"] if standard == "17" else []
    command = [tool(compiler), *STRICT, f"-std=c++{standard}", *without, *headers]
    subprocess.run([*command, "-fsyntax-only", RUNTIME / "nma_c.cpp"], check=True)


FINITE = """
#include <cstdio>
#include "nma/weights.h"
// Reads a weights file whose last number is infinite or NaN. Prints whether a parameter may have this value, the
// clamped value, and why the file is refused.
int main(int, char** words) {
    const std::string bytes = nma::read_file(words[1]);
    float number;
    std::memcpy(&number, bytes.data() + bytes.size() - 4, 4);
    const nma::SourceParam p{"sigma_t", 1, false, 0.0, 1.0};
    std::printf("%d %g: ", p.allows(number), p.clamped(number));
    try {
        nma::parse_weights(bytes.data(), bytes.size());
    } catch (const nma::Error& e) {
        std::puts(e.what());
    }
}
"""


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
def test_fast_math_refuses_numbers_that_are_not_finite(compiler, tmp_path):
    """NaN and infinity are refused even with -ffast-math, although compilers then remove `std::isfinite`."""
    source, program, path = (tmp_path / name for name in ("finite.cpp", "finite", "bad.safetensors"))
    source.write_text(FINITE)
    subprocess.run([tool(compiler), *STRICT, "-O1", "-ffast-math", source, "-o", program], check=True)
    for number, moved in ((np.nan, 0), (np.inf, 1), (-np.inf, 0)):
        path.write_bytes(WEIGHTS[1].read_bytes()[:-4] + np.float32(number).tobytes())
        wanted = f"0 {moved}: tensor layer3.weight holds numbers that are not finite; train again\n"
        assert output(program, path) == wanted


@pytest.mark.slow
@pytest.mark.parametrize("compiler", COMPILERS)
def test_instruction_sets_agree(compiler, weights, tmp_path):
    program = built(compiler, "tests/compare.cpp", tmp_path, "-O2")
    for path in weights:
        assert "portable" in output(program, path)


@pytest.mark.slow
def test_neon_agrees_under_emulation(weights, tmp_path):
    program = built(ARM, "tests/compare.cpp", tmp_path, "-O2", "-static")
    for path in weights:
        assert "neon" in output(tool(EMULATOR), program, path)


@pytest.mark.slow
@pytest.mark.parametrize("sanitizer", ["address,undefined,float-divide-by-zero", "thread"])
def test_sanitizers_find_no_fault(sanitizer, tmp_path):
    flags = ["-O0", f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all"]
    program = built("g++", "tests/soak.cpp", tmp_path, *flags)
    assert ", 0 faults" in output(program, 100_000, WEIGHTS[0])


def test_sanitizers_find_no_fault_in_the_simulated_material(tmp_path):
    """Sanitizers find no fault in walks, estimates, densities and samples of random materials and of hard cases."""
    flags = ["-O1", "-fsanitize=address,undefined,float-divide-by-zero", "-fno-sanitize-recover=all"]
    program = built("g++", "tests/soak_layered.cpp", tmp_path, *flags)
    assert ", 0 faults" in output(program, 20_000)


@pytest.mark.slow
def test_a_million_calls_have_no_fault(weights, tmp_path):
    program = built("g++", "tests/soak.cpp", tmp_path, "-O2")
    for path in weights:
        assert ", 0 faults" in output(program, 1_000_000, path)
    simulated = built("g++", "tests/soak_layered.cpp", tmp_path, "-O2")
    assert ", 0 faults" in output(simulated, 1_000_000)


@pytest.mark.slow
def test_damaged_files_load_or_are_refused(weights, tmp_path):
    flags = ["-O0", "-fsanitize=address,undefined,float-divide-by-zero", "-fno-sanitize-recover=all"]
    program = built("g++", "tests/fuzz.cpp", tmp_path, *flags)
    total, loaded = (int(w) for w in output(program, 2000, *weights).split() if w.isdigit())
    assert total == 8000
    assert 0 < loaded < total


@pytest.mark.slow
def test_the_c_header_compiles_as_c_and_as_cpp_without_exceptions(tmp_path):
    """A C program and a C++ program without exceptions include the header, and link with the compiled runtime."""
    text = '#include "nma_c.h"\nint main(void) { return !nma_supported(NMA_PORTABLE) || nma_load("none", 0, 0, 0); }\n'
    (tmp_path / "program.c").write_text(text)
    (tmp_path / "plain.cpp").write_text(text)
    strict = ["-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{RUNTIME}", "-c"]
    for compiler, origin, *flags in (
        ("g++", RUNTIME / "nma_c.cpp", "-std=c++17"),
        ("gcc", tmp_path / "program.c", "-std=c99"),
        ("g++", tmp_path / "plain.cpp", "-std=c++17", "-fno-exceptions", "-fno-rtti"),
    ):
        command = [tool(compiler), *flags, *strict, origin, "-o", tmp_path / f"{origin.stem}.o"]
        subprocess.run(command, check=True)
    for name in ("program", "plain"):
        objects = [tmp_path / "nma_c.o", tmp_path / f"{name}.o"]
        subprocess.run([tool("g++"), *objects, "-o", tmp_path / name], check=True)
        assert output(tmp_path / name) == ""


@pytest.mark.slow
def test_the_runtime_installs_for_cmake_and_pkg_config(tmp_path):
    cmake, prefix = tool("cmake"), tmp_path / "prefix"
    for words in (
        ["-S", RUNTIME, "-B", tmp_path / "b", "-DCMAKE_BUILD_TYPE=Debug"],
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
    flags = output(tool("pkg-config"), "--cflags", "--libs", pc).split()
    source = tmp_path / "program.c"
    source.write_text("#include <nma_c.h>\nint main(void) { return !nma_supported(NMA_PORTABLE); }\n")
    subprocess.run([tool("gcc"), source, *flags, "-o", tmp_path / "p"], check=True)
    assert output(tmp_path / "p") == ""
