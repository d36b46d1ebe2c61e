"""Draws the rooms of the package, the imports between the rooms, and the path of the data through the rooms.

    python -m tools.map [OUT.svg]     draws docs/images/architecture.svg and lists the rooms

A room is a module or a package directly in `nma/`. The floors of the rooms are read from the contract in
pyproject.toml, and the imports are read from the code. A thin arrow from room A to room B means that A imports B. The
arrow from A to B is omitted if A also imports B through other rooms.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from nma.files import into_pipe, write_text
from tools import rooms
from tools.layout import Arrow, Layout, Place, layout

OUT = Path(__file__).parents[1] / "docs/images/architecture.svg"
# A box for the C++ runtime, which is outside the package: its name, its text, and a room whose floor it shares.
OUTSIDE = ("runtime/", "Evaluates and samples adapters in C++, for any renderer", "render")


class Step(NamedTuple):
    """One step of the data: the room that returns the data, the room that receives the data, and the kind of data."""

    start: str
    end: str
    what: str


WAY = (
    Step("params", "sources", "the parameters of a class"),
    Step("sources", "table", "random walks through a material, or BRDF values"),
    Step("table", "train", "tables: binned values, with their noise"),
    Step("train", "adapter", "a trained network"),
    Step("adapter", "render", "the blend at a point, for Mitsuba"),
    Step("adapter", OUTSIDE[0], "a weights file, for C++"),
    Step("target", "export", "the analytic BRDF, as syntax trees"),
    Step("export", OUTSIDE[0], "the analytic BRDF, printed as C++"),
    Step(OUTSIDE[0], "native", "the C++ code, compiled for Python and for Mitsuba's scalar_rgb"),
)

BOX, HEIGHT, GAP, RISE, PASSAGE, PORT = 230, 118, 14, 58, 16, 13  # px
MARGIN, LABEL = 18, 20
LETTERS, LINES = 24, 4  # the most letters per line, and the most lines, of the text in a box
LEGEND = 28  # px from one line of the legend to the next
STYLE = """\
text { font-family: "Helvetica Neue", Helvetica, Arial, "DejaVu Sans", sans-serif; fill: #23303d }
.name { font-family: Menlo, Consolas, "DejaVu Sans Mono", monospace; font-weight: bold; font-size: 19px }
.what { font-size: 15.5px; fill: #3e4c59 }
.legend { font-size: 18px }
.floor { font-size: 15px; fill: #7b8794 }
.number { font-size: 14px; font-weight: bold; fill: #ffffff; text-anchor: middle }
.room { fill: #ffffff; stroke: #7b8794; stroke-width: 1.2 }
.on-way { fill: #fff3e6; stroke: #d9782d; stroke-width: 1.6 }
.outside { stroke-dasharray: 5 4 }
.band { fill: #f4f6f8 }
.import { fill: none; stroke: #7b8794; stroke-width: 1.2; marker-end: url(#head) }
.way { fill: none; stroke: #f5a65b; stroke-width: 6; stroke-opacity: .75; marker-end: url(#way-head) }
.step { fill: #c65d12 }"""
MARKERS = """\
<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto-start-reverse" \
markerUnits="userSpaceOnUse"><path d="M0 0.8 8 4 0 7.2z" fill="#7b8794"/></marker>
<marker id="way-head" viewBox="0 0 10 10" refX="6" refY="5" markerWidth="18" markerHeight="16" \
orient="auto-start-reverse" markerUnits="userSpaceOnUse"><path d="M0 0 10 5 0 10z" fill="#e8893a"/></marker>"""


def main() -> None:
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else OUT
    write_text(out, drawing())
    print(listing())
    print(out)


def listing() -> str:
    """A text with one line for each room, which gives its floor and its purpose. The highest floor comes first."""
    lines = []
    for number, floor in reversed(list(enumerate(reversed(rooms.floors()), start=1))):
        lines += [f"{number}  {room:11} {rooms.summary(room)}" for room in floor]
    return "\n".join(lines)


class Plan(NamedTuple):
    """The positions of all boxes and arrows of the drawing. The highest floor has the index 0."""

    floors: list[list[str]]
    imports: frozenset[Arrow]
    steps: dict[Arrow, Step]  # the key is (upper room, lower room) of the step
    layout: Layout
    ports: dict[tuple[Arrow, str], float]  # x of an arrow's end at a box, relative to the centre of the box
    left: float

    def x(self, place: Place) -> float:
        return self.layout.x[place] - self.left

    def level(self, box: str) -> int:
        return next(n for n, floor in enumerate(self.floors) if box in floor)

    @property
    def width(self) -> int:
        return round(max(map(self.x, self.layout.x)) + BOX / 2 + 2 * MARGIN)


def plan() -> Plan:
    name, _, neighbour = OUTSIDE
    floors = [[*floor, name] if neighbour in floor else [*floor] for floor in rooms.floors()]
    level = {box: n for n, floor in enumerate(floors) for box in floor}
    steps = {(a, b) if level[a] < level[b] else (b, a): step for step in WAY for a, b in [step[:2]]}
    _check(rooms.imports(), level)
    imports = rooms.reduced(rooms.imports())
    arrows = sorted(imports | set(steps))
    placed = layout(floors, arrows, BOX + GAP, PASSAGE)
    left = min(placed.x[box] for box in level) - BOX / 2 - 2 * MARGIN - LABEL
    return Plan(floors, imports, steps, placed, _ports(placed, arrows), left)


def _check(imports: frozenset[Arrow], level: Mapping[str, int]) -> None:
    """Exits with a message if an import cannot be drawn, or if neither of the two rooms of a step imports the other."""
    if unknown := {room for arrow in imports for room in arrow if room not in level}:
        sys.exit(
            f"{', '.join(sorted(unknown))}: not on any floor; add the room to the contract in pyproject.toml"
        )
    if upwards := [f"{a} imports {b}" for a, b in sorted(imports) if level[a] >= level[b]]:
        sys.exit(f"{'; '.join(upwards)}: a room imports only from lower floors; see `make lint`")
    for step in WAY:
        ends = {(step.start, step.end), (step.end, step.start)}
        if OUTSIDE[0] not in step[:2] and not ends & imports:
            sys.exit(f"neither of {step.start} and {step.end} imports the other; correct WAY in tools/map.py")


def _ports(placed: Layout, arrows: Sequence[Arrow]) -> dict[tuple[Arrow, str], float]:
    """Spreads the ends of the arrows along the upper and the lower side of each box.

    At each side, the ends have the same order as the places at which the arrows arrive on the neighbouring floor.
    """
    sides: dict[tuple[str, bool], list[tuple[float, Arrow]]] = {}
    for arrow in arrows:
        way = placed.ways[arrow]
        sides.setdefault((arrow[0], True), []).append((placed.x[way[1]], arrow))
        sides.setdefault((arrow[1], False), []).append((placed.x[way[-2]], arrow))
    return {
        (arrow, box): PORT * (k - (len(side) - 1) / 2)
        for (box, _), side in sides.items()
        for k, (_, arrow) in enumerate(sorted(side))
    }


def drawing() -> str:
    """Returns the drawing as SVG text."""
    p = plan()
    height = _top(len(p.floors)) + LEGEND * (len(WAY) + 2)
    size = f'width="{p.width}" height="{height}"'
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {p.width} {height}" {size}>',
        "<!-- Drawn by `python -m tools.map`; do not edit. -->",
        f"<title>The rooms of {rooms.PACKAGE}, their imports, and the path of the data</title>",
        f"<style>\n{STYLE}\n</style>\n<defs>\n{MARKERS}\n</defs>",
        f'<rect {size} rx="8" fill="#ffffff"/>',
        *_bands(p),
        *(_arrow(p, "way", arrow, upwards=arrow[1] == step.start) for arrow, step in p.steps.items()),
        *(_arrow(p, "import", arrow) for arrow in sorted(p.imports)),
        *(_box(p, box) for floor in p.floors for box in sorted(floor, key=p.x)),
        *(_number(n, *_middle(p, arrow)) for n, arrow in enumerate(p.steps, start=1)),
        *_legend(p),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _top(level: int) -> int:
    """The y coordinate of the upper edge of the boxes on the floor `level`, in pixels."""
    return MARGIN + 8 + level * (HEIGHT + RISE)


def _bands(p: Plan) -> list[str]:
    """Draws a stripe behind the boxes of each floor, with the number of the floor."""
    parts = []
    for level in range(len(p.floors)):
        top, width = _top(level) - 8, p.width - 2 * MARGIN
        parts += [
            f'<rect class="band" x="{MARGIN}" y="{top}" width="{width}" height="{HEIGHT + 16}" rx="6"/>',
            f'<text class="floor" x="{MARGIN + 8}" y="{top + 20}">{len(p.floors) - level}</text>',
        ]
    return parts


def _box(p: Plan, box: str) -> str:
    left, top = round(p.x(box) - BOX / 2), _top(p.level(box))
    outside = box == OUTSIDE[0]
    kinds = ["room", *["outside"] * outside, *["on-way"] * any(box in arrow for arrow in p.steps)]
    what = OUTSIDE[1] if outside else rooms.summary(box, lambda text: len(_lines(text)) <= LINES)
    lines = [
        f'<text class="what" x="{left + 12}" y="{top + 47 + 19 * n}">{escape(line)}</text>'
        for n, line in enumerate(_lines(what))
    ]
    frame = f'<rect class="{" ".join(kinds)}" x="{left}" y="{top}" width="{BOX}" height="{HEIGHT}" rx="7"/>'
    name = f'<text class="name" x="{left + 12}" y="{top + 25}">{escape(box)}</text>'
    return "\n".join([frame, name, *lines])


def _lines(text: str) -> list[str]:
    return textwrap.wrap(text.replace("`", ""), LETTERS)


def _arrow(p: Plan, kind: str, arrow: Arrow, upwards: bool = False) -> str:
    """Draws an arrow between two boxes. The arrow is straight where it passes a floor."""
    points = _points(p, arrow)
    if upwards:
        points.reverse()
    path = f"M{points[0][0]} {points[0][1]}"
    for (x0, y0), (x1, y1) in pairwise(points):
        half = (y0 + y1) // 2
        path += f"V{y1}" if x0 == x1 else f"C{x0} {half} {x1} {half} {x1} {y1}"
    return f'<path class="{kind}" d="{path}"/>'


def _points(p: Plan, arrow: Arrow) -> list[tuple[int, int]]:
    """The points of an arrow from top to bottom.

    The first point is at the upper box and the last point at the lower box. Every floor that the arrow passes has two
    points: where the arrow enters the floor, and where the arrow leaves the floor.
    """
    upper, lower = arrow
    level = p.level(upper)
    points = [(p.x(upper) + p.ports[arrow, upper], _top(level) + HEIGHT)]
    for n, place in enumerate(p.layout.ways[arrow][1:-1], start=level + 1):
        points += [(p.x(place), _top(n)), (p.x(place), _top(n) + HEIGHT)]
    points.append((p.x(lower) + p.ports[arrow, lower], _top(p.level(lower))))
    return [(round(x), y) for x, y in points]


def _middle(p: Plan, arrow: Arrow) -> tuple[int, int]:
    (x0, y0), (x1, y1) = _points(p, arrow)[:2]
    return (x0 + x1) // 2, (y0 + y1) // 2


def _number(number: int, x: int, y: int) -> str:
    circle = f'<circle class="step" cx="{x}" cy="{y}" r="11"/>'
    return f'{circle}\n<text class="number" x="{x}" y="{y + 5}">{number}</text>'


def _legend(p: Plan) -> list[str]:
    """Draws the legend: the meaning of the two kinds of arrows, and the list of the steps of the data."""
    left, top = MARGIN + 16, _top(len(p.floors)) + 4
    told = (
        "The upper room imports the lower room. An import that also exists through other rooms is not drawn."
    )
    parts = [
        f'<path class="import" d="M{left} {top - 6}h34"/>',
        f'<text class="legend" x="{left + 46}" y="{top}">{told}</text>',
        f'<path class="way" d="M{left} {top + LEGEND - 6}h30"/>',
        f'<text class="legend" x="{left + 46}" y="{top + LEGEND}">The path of the data:</text>',
    ]
    for n, step in enumerate(WAY, start=1):
        y = top + LEGEND * (n + 1)
        text = f"{step.start} to {step.end}: {step.what}"
        parts += [
            _number(n, left + 15, y - 6),
            f'<text class="legend" x="{left + 46}" y="{y}">{escape(text)}</text>',
        ]
    return parts


if __name__ == "__main__":
    with into_pipe():
        main()
