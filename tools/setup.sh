#!/bin/sh
# Creates .venv with everything that `make demo` or `make test` needs. A second run does nothing.
#
#     tools/setup.sh demo|test
#
# This script needs Python 3.11 or later; PYTHON=/path/to/python3 chooses the interpreter. It installs missing system
# packages with apt-get if it runs as root on Debian or Ubuntu: venv, libatomic, libLLVM and, for the tests, compilers.
# Otherwise it prints the command that installs them, and stops.
set -eu
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }

# Prints the interpreter of .venv if it exists, or else the first interpreter that is new enough.
find_python() {
    for candidate in .venv/bin/python ${PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return 0
        fi
    done
    die "Python 3.11 or later is needed, please run: sudo apt-get install python3.11 python3.11-venv"
}

# Prints the first of several packages that apt knows. If apt knows none of them, prints the first.
first_known() {
    for package in "$@"; do
        if apt-cache show "$package" >/dev/null 2>&1; then
            echo "$package"
            return 0
        fi
    done
    echo "$1"
}

# Prints the Debian and Ubuntu packages that the system lacks for this goal.
missing_packages() {
    # Tests compile the C++ runtime with two compilers, install it, and also run it on an emulated ARM processor.
    if [ "$goal" = test ]; then
        for tool in g++ clang++:clang cmake pkg-config aarch64-linux-gnu-g++:g++-aarch64-linux-gnu \
            qemu-aarch64-static:qemu-user-static; do
            command -v "${tool%:*}" >/dev/null || echo "${tool#*:}"
        done
    fi
    "$python" -c 'import ensurepip, venv' 2>/dev/null ||
        "$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    # Dr.Jit's wheel for Linux links libatomic, which a minimal system lacks.
    [ "$(uname -s)" != Linux ] || "$python" -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' 2>/dev/null ||
        echo libatomic1
    "$python" -I nma/llvm.py >/dev/null || first_known libllvm19 libllvm20 libllvm21 libllvm22 libllvm18
}

install_packages() {
    command -v apt-get >/dev/null ||
        die "please install these packages with your package manager (the names are Debian's): $*"
    [ "$(id -u)" = 0 ] || die "please run this command, then try again: sudo apt-get install $*"
    say "apt-get install $*"
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null ||
        die "could not install: $*"
}

install_system() {
    [ -n "$(missing_packages)" ] || return 0
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        say "apt-get update"
        apt-get update -qq >/dev/null || say "apt-get update failed; continuing with the present package lists"
    fi
    # shellcheck disable=SC2046 # one word per package
    install_packages $(missing_packages)
    fault=$("$python" -I nma/llvm.py) || die "$fault"
}

make_venv() {
    if .venv/bin/python -m pip --version >/dev/null 2>&1; then return 0; fi
    say "making .venv with $("$python" --version)"
    rm -rf .venv
    "$python" -m venv .venv
}

install_package() { # GOAL EXTRA
    wanted=$(cksum pyproject.toml requirements.lock)
    for stamp in .venv/installed-test ".venv/installed-$1"; do # the packages for tests include those for the demo
        if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then return 0; fi
    done
    say "installing the package and pinned versions of its dependencies; this takes a few minutes"
    # --no-compile: Python compiles a module when it is first imported, and most modules never are.
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-compile \
        --constraint requirements.lock --editable ".[$2]" >&2
    printf '%s' "$wanted" >".venv/installed-$1"
}

goal=${1:-}
case "$goal" in
demo) extra=demo ;;
test) extra=dev ;;
*) die "usage: tools/setup.sh demo|test" ;;
esac

python=$(find_python)
if [ -n "${DRJIT_LIBLLVM_PATH:-}" ]; then
    fault=$("$python" -I nma/llvm.py) || die "DRJIT_LIBLLVM_PATH: $fault; unset it"
fi
# As root, the system packages are installed in the background while pip runs, unless pip itself needs one of them.
apt=
if [ "$(id -u)" = 0 ] && "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    install_system &
    apt=$!
else
    install_system
fi
make_venv
install_package "$goal" "$extra"
[ -z "$apt" ] || wait "$apt" || die "the system packages could not be installed, see above"
