"""The rooms (top-level modules) of the package import only from rooms on lower floors of the architecture drawing.

The committed drawing shows all rooms and imports.
"""

import ast
import re
import sys

import pytest

from tools import map, rooms
from tools.layout import crossings, layout
from tools.map import OUT, WAY, drawing, listing, plan

MOST_ROOMS, MOST_FLOORS = 30, 10


def test_every_import_goes_to_a_lower_floor():
    level = {room: number for number, floor in enumerate(rooms.floors()) for room in floor}
    assert not {(a, b) for a, b in rooms.imports() if level[a] >= level[b]}
    assert not rooms.circle(rooms.imports())


def test_without_the_extra_dev_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "grimp", None)
    with pytest.raises(SystemExit, match=r"^reading the imports .* needs grimp; .* pip install '\.\[dev\]'$"):
        rooms.imports.__wrapped__()


def test_rooms_and_floors_are_few_enough_to_remember():
    floors = rooms.floors()
    listed = [room for floor in floors for room in floor]
    assert sorted(listed) == sorted({room for arrow in rooms.imports() for room in arrow})
    assert len(listed) <= MOST_ROOMS
    assert len(floors) <= MOST_FLOORS


def test_the_committed_drawing_shows_the_current_imports():
    assert OUT.read_text() == drawing(), (
        "the rooms, their imports or their docstrings have changed: run `python -m tools.map`, look at the drawing"
    )


def test_the_drawing_has_every_room_and_every_arrow():
    text, arrows = drawing(), rooms.reduced(rooms.imports())
    assert text.count('<path class="import"') == len(arrows) + 1  # the legend has one more arrow
    assert text.count('<path class="way"') == len(WAY) + 1
    names = re.findall(r'class="name"[^>]*>([^<]+)<', text)
    assert sorted(names) == sorted(room for floor in plan().floors for room in floor)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (("cli", "attic"), "attic: not on any floor"),
        (("target", "adapter"), "target imports adapter: a room imports only from lower floors"),
    ],
)
def test_imports_that_cannot_be_drawn_are_refused(more, told, monkeypatch):
    wrong = rooms.imports() | {more}
    monkeypatch.setattr(rooms, "imports", lambda: wrong)
    with pytest.raises(SystemExit, match=told):
        drawing()


def test_a_step_of_the_data_is_refused_without_an_import(monkeypatch):
    monkeypatch.setattr(map, "WAY", (*WAY, map.Step("conductors", "cli", "nothing")))
    with pytest.raises(SystemExit, match="neither of conductors and cli imports the other"):
        drawing()


def test_the_page_lists_the_steps_of_the_drawing():
    page = (rooms.ROOT / "docs/how-it-is-built.md").read_text()
    found = re.findall(r"^(\d+)\. \*\*`(\S+)` to `(\S+)`\.\*\*", page, re.MULTILINE)
    assert found == [(str(n), step.start, step.end) for n, step in enumerate(WAY, start=1)]


def test_the_docstring_of_each_room_says_what_the_room_does():
    first = {room: rooms.summary(room).split()[0] for floor in rooms.floors() for room in floor}
    assert not {room: word for room, word in first.items() if not re.fullmatch("[A-Z][a-z]+s,?", word)}, (
        "begin the docstring of a room with a verb, as in 'Reads materials': tools.map draws the first sentence"
    )


def test_the_listing_describes_each_room():
    lines = listing().splitlines()
    assert [line.split()[1] for line in lines] == [room for floor in rooms.floors() for room in floor]
    assert all(len(line.split()) > 3 for line in lines)


def test_an_arrow_is_left_out_if_a_longer_way_leads_there():
    arrows = frozenset([("cli", "table"), ("table", "params"), ("cli", "params"), ("cli", "errors")])
    assert rooms.reduced(arrows) == arrows - {("cli", "params")}


def test_circles_are_found():
    way = frozenset([("cli", "table"), ("table", "params")])
    assert not rooms.circle(way)
    assert rooms.circle(way | {("params", "table")}) == ["cli", "params", "table"]


def test_the_summary_of_a_room_is_the_longest_beginning_that_fits(tmp_path, monkeypatch):
    monkeypatch.setattr(rooms, "ROOT", tmp_path)
    (tmp_path / rooms.PACKAGE).mkdir()
    (tmp_path / rooms.PACKAGE / "attic.py").write_text(
        '"""Old things: chairs,\ntables (some broken). More."""'
    )
    assert rooms.summary("attic") == "Old things: chairs, tables (some broken)"
    assert rooms.summary("attic", lambda text: len(text) < 30) == "Old things: chairs, tables"
    assert rooms.summary("attic", lambda text: len(text) < 20) == "Old things"
    with pytest.raises(ValueError, match="attic.py: the first sentence of the docstring is too long"):
        rooms.summary("attic", lambda text: False)
    (tmp_path / rooms.PACKAGE / "attic.py").write_text(
        '"""Things that are old, and things that are broken."""'
    )
    assert rooms.summary("attic", lambda text: len(text) < 30) == "Things that are old"


def test_the_page_names_registries_that_are_there():
    named = re.findall(r"`(\w+)` of `([\w/]+\.py)`", (rooms.ROOT / "docs/how-it-is-built.md").read_text())
    assert len(named) >= 6
    missing = [f"{name} of {path}" for name, path in named if name not in (rooms.ROOT / path).read_text()]
    assert not missing


@pytest.fixture
def ladder():
    """Three floors of boxes, and the arrows between the boxes.

    The arrow from "a" to "end" crosses the second floor. In the given order of the boxes on the second floor, some
    arrows cross, so a layout must change this order.
    """
    floors = [["a", "b", "c"], ["z", "y", "x"], ["end"]]
    return floors, [("a", "x"), ("b", "y"), ("c", "z"), ("a", "end"), ("z", "end")]


def test_boxes_are_ordered_so_that_arrows_do_not_cross(ladder):
    placed = layout(*ladder, box=10.0, passage=2.0)
    top, middle, bottom = ladder[0]
    rows = [sorted(row, key=placed.x.__getitem__) for row in (top, [*middle, ("a", "end", 1)], bottom)]
    links = [link for way in placed.ways.values() for link in zip(way, way[1:], strict=False)]
    assert crossings(rows, links) == 0


def test_boxes_keep_their_distance(ladder):
    placed = layout(*ladder, box=10.0, passage=2.0)
    for floor in ladder[0]:
        ends = sorted(placed.x[box] for box in floor)
        assert all(b - a >= 10.0 - 1e-9 for a, b in zip(ends, ends[1:], strict=False))


def test_the_layout_is_the_same_each_time(ladder):
    assert layout(*ladder, box=10.0, passage=2.0) == layout(*ladder, box=10.0, passage=2.0)


# lint-imports sees import statements only. These modules of Python can import a module in other ways:
IMPORTERS = {"_frozen_importlib", "builtins", "imp", "importlib", "pkgutil", "runpy", "zipimport"}
# So can these names, which need no import, and these attributes:
BUILT_IN = {"__builtins__", "__import__", "__loader__", "__spec__", "compile", "eval", "exec"}
ATTRIBUTES = {"__import__", "import_module", "modules"}
# The files that use such modules, names or attributes, the reason, and every use.
BY_NAME = {
    "nma/__init__.py": (
        "each public name is imported when it is first used",
        ["from importlib import import_module", "import_module(home)"],
    ),
    "nma/cli/__init__.py": (
        "each command is a module of the room, and only the module of the given command is imported",
        ["from importlib import import_module", "import_module(f'nma.cli.{name}')"],
    ),
    "nma/export/__init__.py": (
        "each printer is a module of the room, and is imported when first used",
        ["from importlib import import_module", "import_module(f'nma.export.{module}')"],
    ),
    "nma/render/register.py": (
        "each BSDF is a module of the room, and is imported when Mitsuba registers the BSDF",
        ["import importlib", "importlib.import_module(module)"],
    ),
    "nma/sources/__init__.py": (
        "each source is a module of the room, and is imported when the source is first used",
        ["from importlib import import_module", "import_module(f'nma.sources.{module}')"],
    ),
    "nma/sources/lookup.py": (
        "Dr.Jit has a module for each backend",
        ["from importlib import import_module", "import_module(type(lanes).__module__)"],
    ),
    "nma/doctor.py": (
        "packages of others that may be missing, and their versions",
        [
            "from importlib import metadata",
            "import importlib",
            "importlib.import_module(name)",
            "metadata.PackageNotFoundError",
            "metadata.requires(PACKAGE)",
            "metadata.version(distribution)",
        ],
    ),
    "nma/images/metrics.py": (
        "packages of others that may be missing",
        ["from importlib import import_module", "import_module(name)"],
    ),
    "nma/llvm.py": ("whether Dr.Jit is loaded already", ["'drjit' in sys.modules"]),
    "nma/network.py": (
        "NumPy knows the features of the CPU, in a module that has two names",
        ["sys.modules.get('numpy._core._multiarray_umath')", "sys.modules['numpy.core._multiarray_umath']"],
    ),
    "nma/adapter/adapter.py": (
        "files of the package",
        ["files('nma.adapter')", "from importlib.resources import files"],
    ),
    "nma/conductors/__init__.py": (
        "files of the package",
        ["files(__name__)", "from importlib.resources import files"],
    ),
    "nma/native/build.py": (
        "folders and versions of packages",
        [
            "import importlib.metadata",
            "importlib.metadata.PackageNotFoundError",
            "importlib.metadata.distribution(name)",
            "importlib.metadata.version(name)",
        ],
    ),
    "nma/train/run.py": (
        "the version of the package",
        ["import importlib.metadata", "importlib.metadata.version('neural-material-adapter')"],
    ),
}


def imported(tree):
    """Yields each import of a syntax tree: the statement, the imported module or object, and its name in the file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node, alias.name, alias.asname or alias.name.split(".")[0]
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield node, f"{node.module}.{alias.name}", alias.asname or alias.name


def unseen_imports(text):
    """Lists all code in the Python file `text` that can import a module without an import statement.

    The listed code is an import from `IMPORTERS` or of `sys.modules`, or the smallest call, subscript or comparison
    around the use of such an import, of a name in `BUILT_IN`, or of an attribute in `ATTRIBUTES`.
    """
    tree, names, found = ast.parse(text), set(BUILT_IN), []
    above = {child: node for node in ast.walk(tree) for child in ast.iter_child_nodes(node)}
    for statement, origin, name in imported(tree):
        if origin.split(".")[0] in IMPORTERS or origin in ("sys.modules", "sys.*"):
            names.add(name)
            found.append(statement)
    for node in ast.walk(tree):
        attribute = getattr(
            node, "attr", getattr(node, "value", None)
        )  # the text of `getattr` is an `ast.Constant`
        if getattr(node, "id", None) in names or (isinstance(attribute, str) and attribute in ATTRIBUTES):
            while isinstance(above[node], ast.Attribute):
                node = above[node]
            around = above[node]
            found.append(around if isinstance(around, (ast.Call, ast.Subscript, ast.Compare)) else node)
    return sorted({ast.unparse(node) for node in found})


def files_of_the_package():
    paths = (rooms.ROOT / rooms.PACKAGE).rglob("*.py")
    return {path.relative_to(rooms.ROOT).as_posix(): path.read_text() for path in paths}


def test_only_listed_code_imports_without_an_import_statement():
    found = {path: uses for path, text in files_of_the_package().items() if (uses := unseen_imports(text))}
    listed = {path: sorted(uses) for path, (_, uses) in BY_NAME.items()}
    assert found == listed, (
        "use an import statement, which lint-imports sees, or add the use and its reason to BY_NAME"
    )


@pytest.mark.parametrize(
    "text",
    [
        "from importlib import import_module as get",
        "import importlib as lib",
        "import importlib.metadata\ngetattr(importlib, 'import_' + 'module')('nma.train')",
        "from importlib.metadata import EntryPoint",
        "from pkgutil import resolve_name",
        "import runpy",
        "exec('import nma.train')",
        "eval(text)",
        "__builtins__['__import__']('nma.cli')",
        "__spec__.loader",
        "sys.modules['nma.cli']",
        "getattr(sys, 'modules')",
        "from sys import modules as loaded",
        "from sys import *",
    ],
)
def test_other_ways_to_import_are_seen(text):
    assert unseen_imports(text)


@pytest.mark.parametrize(
    "call", ["import_module ('nma.cli')", "import_module('nma.' + 'train')", "f(import_module)"]
)
def test_a_listed_file_imports_nothing_else_by_name(call):
    about = "from importlib import import_module\n"
    assert unseen_imports(about + call) != unseen_imports(about + "import_module(name)")


@pytest.mark.parametrize("path", [path for path in BY_NAME if "a module of the room" in BY_NAME[path][0]])
def test_modules_are_imported_by_name_within_their_room(path):
    """`nma/__init__.py` lies on no floor of the drawing, so it may import any room."""
    tree, room = ast.parse((rooms.ROOT / path).read_text()), ".".join(path.split("/")[:2])
    texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    named = {text for text in texts if isinstance(text, str) and re.match(r"nma\.\w*$|nma\.\w+\.", text)}
    assert named and all(text.startswith(f"{room}.") for text in named)


def public_names(text):
    """Lists the names of the package in the Python file `text` that are no imported rooms.

    `nma/__init__.py` imports its public names from any room, when they are first used. lint-imports does not see which.
    """
    tree = ast.parse(text)
    floors = {f"nma.{room}" for floor in rooms.floors() for room in floor}
    origins = {origin for _, origin, _ in imported(tree)}
    aliases = {name for _, origin, name in imported(tree) if origin == "nma"} | {"nma"}
    uses = {
        f"nma.{node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in aliases
    }
    names = {name for name in origins | uses if name.startswith("nma.")}
    imported_rooms = {".".join(name.split(".")[:2]) for name in origins} & floors
    return {name for name in names if ".".join(name.split(".")[:2]) not in imported_rooms}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("from nma import preview_scene, ops", {"nma.preview_scene"}),
        ("from nma import *", {"nma.*"}),
        ("import nma as n\nn.fit", {"nma.fit"}),
        ("import nma.ops\nnma.ops.exp(nma.fit)", {"nma.fit"}),
    ],
)
def test_uses_of_public_names_are_seen(text, found):
    assert public_names(text) == found


def test_rooms_do_not_use_the_public_names():
    """The room `cli` may use the version, because it lies on the highest floor."""
    found = {path: used for path, text in files_of_the_package().items() if (used := public_names(text))}
    assert found == {"nma/cli/__init__.py": {"nma.__version__"}}
