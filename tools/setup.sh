#!/bin/sh
# Makes .venv with everything that `make demo` or `make test` needs; run again, it does nothing.
#
#     tools/setup.sh demo|test
#
# Needs Python 3.11 or later. What the system lacks beyond it (venv, libatomic, libLLVM, for the tests compilers) is
# installed with apt-get where we are root on Debian or Ubuntu; otherwise the command to type is printed and we stop.
# PYTHON=/path/to/python3 chooses the interpreter.
set -eu
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*" >&2; }
die() { say "$*"; exit 1; }

# The interpreter of .venv if there is one already, else the first that is new enough.
find_python() {
    for candidate in .venv/bin/python ${PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return 0
        fi
    done
    die "Python 3.11 or later is needed, please run: sudo apt-get install python3.11 python3.11-venv"
}

# The first of several packages that apt knows, or simply the first.
first_known() {
    for package in "$@"; do
        if apt-cache show "$package" >/dev/null 2>&1; then
            echo "$package"
            return 0
        fi
    done
    echo "$1"
}

# Names in Debian and Ubuntu of what the system lacks for this goal.
missing_packages() {
    # Tests compile the C++ runtime with two compilers, install it, and run it as an ARM processor would.
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
        die "please install these with your package manager, here by their names in Debian: $*"
    [ "$(id -u)" = 0 ] || die "please run, and then the same again: sudo apt-get install $*"
    say "apt-get install $*"
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null ||
        die "could not install: $*"
}

install_system() {
    [ -n "$(missing_packages)" ] || return 0
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        say "apt-get update"
        apt-get update -qq >/dev/null || say "that failed, going on with the package lists there are"
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
    for stamp in .venv/installed-test ".venv/installed-$1"; do # what tests need holds what the demo needs
        if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then return 0; fi
    done
    say "installing the package and pinned versions of what it needs, which takes a minute or a few"
    # Modules are compiled when they are first imported: most never are.
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
# Where we may install the system's packages, they arrive while pip works, unless pip needs them.
apt=
if [ "$(id -u)" = 0 ] && "$python" -c 'import ensurepip, venv' 2>/dev/null; then
    install_system &
    apt=$!
else
    install_system
fi
make_venv
install_package "$goal" "$extra"
[ -z "$apt" ] || wait "$apt" || die "the system's packages are missing, see above"
