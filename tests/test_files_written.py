"""All code writes files through `nma.files`, so that no partly written file remains after an error.

The tests search the code for calls that write files without `nma.files`.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Names of methods and functions that write, rename, copy or link files. No other methods have these names.
WRITERS = set(
    """write_text write_bytes rename renames touch symlink_to hardlink_to truncate
    save_file savez savez_compressed savetxt tofile open_memmap memmap savefig imsave imwrite
    write_bitmap write_async write_ply NamedTemporaryFile SpooledTemporaryFile mkstemp mkdtemp
    copytree copyfile copyfileobj copy2 move make_archive unpack_archive extract extractall
    urlretrieve FileHandler create_array""".split()
)
# Functions that write or rename files, but have names that methods of other objects also have. The entries are full
# names, which `imported` finds for names such as `np.save`.
OF_MODULES = set(
    """numpy.save os.open os.replace os.link os.symlink shutil.copy io.FileIO
    json.dump pickle.dump marshal.dump tomli_w.dump yaml.dump shelve.open sqlite3.connect""".split()
)
# The modes in which files are opened to be written.
MODE = r"[wax][bt]?\+?[bt]?(:\w*)?|r[bt]?\+[bt]?"
# Context managers whose blocks fill a temporary file or folder, which gets its final name at the end of the block.
WHOLE = {"whole", "whole_folder"}
ALLOWED = {
    "nma/files.py": "what all others go through",
    "figures/common.py: open": "a lock, which has no content",
    "nma/cli/__init__.py: open": "the null device",
    "nma/table/dataset.py: create_array": "zarr writes each chunk whole",
}


def code() -> list[Path]:
    return sorted(
        file for folder in ("nma", "figures", "bench", "tools") for file in (ROOT / folder).rglob("*.py")
    )


def imported(tree: ast.AST) -> dict[str, str]:
    """Returns the full name of each imported name, for example numpy for `np` and shutil.copy for `copy`."""
    found = {"np": "numpy"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.asname: alias.name for alias in node.names if alias.asname}
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return found


def writes(tree: ast.AST, known: dict[str, str] | None = None) -> Iterator[ast.Call]:
    """Yields the calls that write files, except calls inside a `with` block of a context manager named in `WHOLE`."""
    known = imported(tree) if known is None else known
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.With) and any(name(item.context_expr) in WHOLE for item in node.items):
            continue
        if isinstance(node, ast.Call) and is_write(node, known):
            yield node
        yield from writes(node, known)


def name(node: ast.AST) -> str:
    """Returns the last part of the name of a called function, for example `whole` for the call `files.whole(path)`."""
    return ast.unparse(node.func).rpartition(".")[2] if isinstance(node, ast.Call) else ""


def is_write(call: ast.Call, known: dict[str, str]) -> bool:
    first, *rest = re.split(r"\b", ast.unparse(call.func).lstrip("("), maxsplit=2)[1:]
    called = known.get(first, first) + "".join(rest)
    if called.startswith(("files.", "nma.files.")):
        return False
    last = called.rpartition(".")[2]
    if called in OF_MODULES or (last in WRITERS and "." in called):
        return True
    if last == "save" and called.startswith("PIL."):  # other methods `save` are ours and use nma.files
        return True
    if last in ("open", "fdopen", "ZipFile", "TarFile", "GzipFile"):
        mode = [
            arg.value
            for arg in [*call.args, *(k.value for k in call.keywords)]
            if isinstance(arg, ast.Constant)
        ]
        return any(isinstance(text, str) and re.fullmatch(MODE, text) for text in mode)
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
        "open(path, 'r+b')",
        "tarfile.open(path, 'w:gz')",
        "zipfile.ZipFile(path, 'w')",
        "os.open(path, os.O_WRONLY)",
        "np.savetxt(path, a)",
        "import numpy\nnumpy.save(path, a)",
        "import numpy as n\nn.save(path, a)",
        "np.lib.format.open_memmap(path, 'w+')",
        "shutil.copy(here, there)",
        "from shutil import copy\ncopy(here, there)",
        "from tempfile import mkdtemp as made\nmade()",
        "from PIL import Image\nImage.fromarray(a).save(path)",
        "mi.util.write_bitmap(path, image)",
        "path.touch()",
        "path.symlink_to(there)",
        "archive.extractall(folder)",
        "pickle.dump(data, file)",
        "zarr.create_array(store=path)",
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
        "open('a.txt')",
        "zipfile.ZipFile(path)",
        "a.copy()",
        "adapter.save(path)",
        "from nma.files import write_text\nwrite_text(path, 'x')",
        "from copy import copy\ncopy(a)",
    ],
)
def test_the_search_passes_over_calls_that_do_not_write(line):
    assert not list(writes(ast.parse(line)))
