#!/bin/sh
# Makes .venv with everything that `make demo` or `make test` needs; run again, it does nothing.
#
#     tools/setup.sh demo|test
#
# Needs Python 3.11 or later. What the system lacks (venv, libatomic, libLLVM) is installed with apt-get where we are
# root on Debian or Ubuntu; otherwise the command to type is printed and we stop. PYTHON=/path/to/python3 chooses the
# interpreter.
set -eu
cd "$(dirname "$0")/.."

say() { printf '%s\n' "$*" >&2; }
die() { say "setup: $*"; exit 1; }

# install_system PACKAGE...: the first package that apt knows, or a command for the user to type.
install_system() {
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" != 0 ]; then
        die "this needs a system package, please run: sudo apt-get install $1   and then the same command again"
    fi
    say "setup: updating the package lists"
    apt-get update -qq >/dev/null || say "setup: apt-get update failed, going on with the lists there are"
    for package in "$@"; do
        if apt-cache show "$package" >/dev/null 2>&1; then
            say "setup: installing $package"
            DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$package" >/dev/null ||
                die "could not install $package"
            return 0
        fi
    done
    die "none of these packages is to be had: $*"
}

find_python() {
    for candidate in ${PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            command -v "$candidate"
            return 0
        fi
    done
    die "Python 3.11 or later is needed; please run: sudo apt-get install python3.11 python3.11-venv"
}

make_venv() {
    .venv/bin/python -m pip --version >/dev/null 2>&1 && return 0
    python=$(find_python)
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        install_system "python$version-venv" python3-venv ||
            die "$python lacks the modules venv and ensurepip; install them with your package manager"
    fi
    say "setup: making .venv with Python $version"
    rm -rf .venv
    "$python" -m venv .venv
}

# Dr.Jit's wheel links libatomic on Linux, which a minimal system lacks.
install_libatomic() {
    [ "$(uname -s)" = Linux ] || return 0
    .venv/bin/python -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' 2>/dev/null && return 0
    install_system libatomic1 || die "libatomic.so.1 is missing; install it with your package manager"
}

install_llvm() {
    fault=$(.venv/bin/python -I nma/llvm.py) && return 0
    [ -z "${DRJIT_LIBLLVM_PATH:-}" ] || die "DRJIT_LIBLLVM_PATH: $fault; unset it"
    say "setup: $fault"
    install_system libllvm19 libllvm20 libllvm21 libllvm18 ||
        die "please install a newer libLLVM with your package manager (macOS: brew install llvm)"
    fault=$(.venv/bin/python -I nma/llvm.py) || die "$fault"
}

install_package() { # STAMP EXTRA
    wanted=$(cksum pyproject.toml requirements.lock)
    for stamp in .venv/installed-test "$1"; do # what tests need holds what the demo needs
        if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then return 0; fi
    done
    say "setup: installing the package and the pinned versions of what it needs (a few minutes)"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint requirements.lock --editable ".[$2]" >&2
    printf '%s' "$wanted" >"$1"
}

case "${1:-}" in
demo) extra=compare ;;
test) extra=dev ;;
*) die "usage: tools/setup.sh demo|test" ;;
esac
make_venv
install_libatomic
install_llvm
install_package ".venv/installed-$1" "$extra"
