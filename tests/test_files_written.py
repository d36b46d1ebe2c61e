"""All code writes files through `nma.files`, so that no partly written file remains after an error.

The tests search the code for calls that write files without `nma.files`.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Methods and functions that write, rename or copy files, on any object and in any module.
WRITERS = {"write_text", "write_bytes", "save_file", "savez", "savez_compressed", "savefig", "tofile"}
WRITERS |= {"NamedTemporaryFile", "mkstemp", "mkdtemp", "rename", "copytree", "copyfile", "copy2", "move"}
# Functions that write or rename files. The module is part of each entry, because other modules have functions of the
# same name.
OF_MODULES = {"np.save", "json.dump", "os.replace"}
# Context managers whose blocks fill a temporary file or folder, which gets its final name at the end of the block.
WHOLE = {"whole", "whole_folder"}
ALLOWED = {
    "nma/files.py": "what all others go through",
    "figures/common.py: open": "a lock, which has no content",
    "nma/render/shaderball.py: mkdtemp": "a folder of this process, gone with it",
}


def code() -> list[Path]:
    return sorted(
        file for folder in ("nma", "figures", "bench", "tools") for file in (ROOT / folder).rglob("*.py")
    )


def writes(tree: ast.AST) -> Iterator[ast.Call]:
    """Yields the calls that write a file outside of the blocks named in `WHOLE`."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.With) and any(name(item.context_expr) in WHOLE for item in node.items):
            continue
        if isinstance(node, ast.Call) and is_write(node):
            yield node
        yield from writes(node)


def name(node: ast.AST) -> str:
    """Returns the last part of the name of a called function: `whole` for files.whole(path)."""
    return ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""


def is_write(call: ast.Call) -> bool:
    called = ast.unparse(call.func)
    if called.startswith("files."):
        return False
    if called in OF_MODULES or (name(call) in WRITERS and "." in called):
        return True
    if name(call) == "open":
        mode = [
            arg.value
            for arg in [*call.args, *(k.value for k in call.keywords)]
            if isinstance(arg, ast.Constant)
        ]
        return any(isinstance(text, str) and text[:1] in "wax" and len(text) < 4 for text in mode)
    # A call of `replace` with one argument is `Path.replace`, which renames a file. `str.replace` has two arguments,
    # and `dataclasses.replace` has keyword arguments.
    return name(call) == "replace" and "." in called and len(call.args) == 1 and not call.keywords


def test_all_code_writes_files_by_nma_files():
    found = []
    for file in code():
        place = str(file.relative_to(ROOT))
        for call in writes(ast.parse(file.read_text())):
            if place not in ALLOWED and f"{place}: {name(call)}" not in ALLOWED:
                found.append(f"{place}:{call.lineno}: {ast.unparse(call)[:60]}")
    assert not found, "write these by nma.files, which leaves no partial file behind:\n" + "\n".join(found)


@pytest.mark.parametrize(
    "line",
    [
        "path.write_text('x')",
        "Path(name).with_suffix('.md').write_bytes(b'x')",
        "open(path, 'w')",
        "path.open(mode='ab')",
        "np.savez(path, a=a)",
        "json.dump(data, file)",
        "figure.savefig(path, dpi=110)",
        "partial.replace(path)",
        "os.replace(partial, path)",
        "shutil.copytree(here, there)",
    ],
)
def test_the_search_finds_calls_that_write(line):
    assert list(writes(ast.parse(line)))


@pytest.mark.parametrize(
    "line",
    [
        "with whole(path) as file:\n    figure.savefig(file)",
        "with files.whole_folder(path) as folder:\n    shutil.copytree(here, folder)",
        "files.write_text(path, 'x')",
        "write_text(path, 'x')",
        "text.replace('a', 'b')",
        "replace(settings, seed=2)",
        "path.open()",
        "path.open('rb')",
    ],
)
def test_the_search_passes_over_calls_that_do_not_write(line):
    assert not list(writes(ast.parse(line)))
