"""The rooms (top-level modules) of the package import only from rooms on lower floors of the architecture drawing.

The committed drawing shows all rooms and imports.
"""

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


# lint-imports does not see imports by name. These files import modules of this package by name:
BY_NAME = {
    "nma/__init__.py",
    *("nma/cli/__init__.py", "nma/export/__init__.py", "nma/render/register.py", "nma/sources/__init__.py"),
}
# These files import other packages by name:
OTHERS_BY_NAME = {"nma/doctor.py", "nma/images/metrics.py", "nma/sources/lookup.py"}


def test_only_known_files_import_by_name():
    found = {
        str(path.relative_to(rooms.ROOT))
        for path in (rooms.ROOT / rooms.PACKAGE).rglob("*.py")
        if re.search(r"\b(import_module|__import__)\(", path.read_text())
    }
    assert found == BY_NAME | OTHERS_BY_NAME


@pytest.mark.parametrize("path", sorted(BY_NAME - {"nma/__init__.py"}))
def test_modules_are_imported_by_name_within_their_room(path):
    """`nma/__init__.py` lies on no floor of the drawing, so it may import any room."""
    named = re.findall(r'"(nma\.\w+)', (rooms.ROOT / path).read_text())
    assert set(named) == {".".join(path.split("/")[:2])}
