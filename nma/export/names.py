"""Checks the names of classes and of their parameters, which become names in the generated C++ headers."""

from __future__ import annotations

import inspect
import re

from nma import ops, sources
from nma.errors import ParamError
from nma.export.functions import functions
from nma.params import ParamSpace

_WORD = re.compile(r"[a-z][a-z0-9]*(_[a-z0-9]+)*")
_KEYWORDS = frozenset(
    "alignas alignof and and_eq asm auto bitand bitor bool break case catch char char8_t char16_t "
    "char32_t class co_await co_return co_yield compl concept const const_cast consteval constexpr "
    "constinit continue decltype default delete do double dynamic_cast else enum explicit export extern "
    "false float for friend goto if inline int long mutable namespace new noexcept not not_eq nullptr "
    "operator or or_eq private protected public register reinterpret_cast requires return short signed "
    "sizeof static static_assert static_cast struct switch template this thread_local throw true try "
    "typedef typeid typename union unsigned using virtual void volatile wchar_t while xor xor_eq".split()
)
# The name of a class becomes a namespace in the namespace `nma`, which has these namespaces already.
_NAMESPACES = frozenset(("avx2", "avx512", "avx512_bf16", "detail", "layered", "neon", "portable", "tests"))
# The names of parameters become constants in capital letters. `COLUMNS` is the size of the parameter vector, and the
# other names are macros of the C++ standard library.
_CAPITALS = frozenset(
    ("columns", "nan", "infinity", "null", "eof", "assert", "errno", "domain", "overflow", "underflow")
)


def simulated() -> list[tuple[str, ParamSpace]]:
    """The names and the parameters of the classes of materials that have a source in nma/sources.

    Raises `ParamError` if a name cannot be a name in C++.
    """
    found = [(name, sources.space(name)) for name in sources.names()]
    defined = {name for name, _ in inspect.getmembers(ops, inspect.isfunction)}
    taken = _NAMESPACES | {function.name for function in functions()} | defined
    for name, space in found:
        _check(f"the class '{name}'", name, _KEYWORDS | taken)
        for param in space.params:
            _check(f"the parameter '{param.name}' of the class '{name}'", param.name, _CAPITALS)
    return found


def _check(what: str, name: str, taken: frozenset[str]) -> None:
    if not _WORD.fullmatch(name):
        raise ParamError(
            f"{what} cannot be a name in C++; use lower-case letters, digits and single underscores between them, and "
            "begin with a letter"
        )
    if name in taken:
        raise ParamError(
            f"{what} cannot be a name in C++, where '{name}' has another meaning; choose another name"
        )
