"""Computes the layout of a drawing of boxes on floors, so that the arrows are straight and have few crossings.

The layout method is that of Sugiyama, Tagawa and Toda 1981. A *place* is a box, or the point where an arrow passes a
floor. First, the places of each floor are sorted by the mean positions of the places that they are linked to. Then each
place is moved as close to the mean position of its linked places as the order of the places allows.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

Arrow = tuple[str, str]
# The name of a box, or (upper box, lower box, floor) for an arrow that passes the floor.
Place = str | tuple[str, str, int]

TRIES, SWEEPS = 60, 16
# A link is the part of an arrow between two neighbouring floors. The layout minimises the weighted sum of the squared
# horizontal lengths of all links. The weight of a link is multiplied by STRAIGHT for each of its ends that is not a
# box, so that long arrows are straight where they pass floors.
STRAIGHT = 6.0


class Layout(NamedTuple):
    """The x coordinate of the centre of every place, and for every arrow the list of its places from top to bottom."""

    x: dict[Place, float]
    ways: dict[Arrow, list[Place]]


def layout(floors: Sequence[Sequence[str]], arrows: Sequence[Arrow], box: float, passage: float) -> Layout:
    """Computes the positions of the boxes and arrows of a drawing.

    Args:
        floors: the boxes of each floor; the highest floor comes first.
        arrows: pairs of an upper box and a box on a lower floor.
        box: the width of a box, including the space around it.
        passage: the width of an arrow that passes a floor, including the space around it.
    """
    rows, ways = _with_passages(floors, arrows)
    links = [link for way in ways.values() for link in pairwise(way)]
    rows = _ordered(rows, links)
    return Layout(_placed(rows, links, box, passage), ways)


def _with_passages(
    floors: Sequence[Sequence[str]], arrows: Sequence[Arrow]
) -> tuple[list[list[Place]], dict[Arrow, list[Place]]]:
    rows: list[list[Place]] = [list(floor) for floor in floors]
    floor_of = {box: number for number, floor in enumerate(floors) for box in floor}
    ways: dict[Arrow, list[Place]] = {}
    for upper, lower in sorted(arrows):
        passed: list[Place] = [(upper, lower, n) for n in range(floor_of[upper] + 1, floor_of[lower])]
        for place, row in zip(passed, rows[floor_of[upper] + 1 :], strict=False):
            row.append(place)
        ways[upper, lower] = [upper, *passed, lower]
    return rows, ways


def _ordered(rows: list[list[Place]], links: Sequence[tuple[Place, Place]]) -> list[list[Place]]:
    """Sorts the places of each floor so that few links cross.

    The search starts from several random orders, and returns the best order that it met.
    """
    dice = random.Random(0)
    best, fewest = rows, float("inf")
    for _ in range(TRIES):
        tried = [dice.sample(row, len(row)) for row in rows]
        for sweep in range(SWEEPS):
            _sort(tried, links, down=sweep % 2 == 0)
            crossed = crossings(tried, links)
            if crossed < fewest:
                best, fewest = [list(row) for row in tried], crossed
    return best


def _sort(rows: list[list[Place]], links: Sequence[tuple[Place, Place]], down: bool) -> None:
    """Sorts the places of every floor in turn by the mean positions of the places that they are linked to.

    With `down`, the floors are sorted from top to bottom, each by its links to the floor above. Without `down`, the
    floors are sorted from bottom to top, each by its links to the floor below.
    """
    for n in range(1, len(rows)) if down else range(len(rows) - 2, -1, -1):
        before = {place: k for k, place in enumerate(rows[n - 1 if down else n + 1])}
        found: dict[Place, list[int]] = {}
        for upper, lower in links:
            here, there = (lower, upper) if down else (upper, lower)
            if there in before:
                found.setdefault(here, []).append(before[there])
        scale = len(before) / len(rows[n])
        means = {
            place: sum(found[place]) / len(found[place]) if place in found else k * scale
            for k, place in enumerate(rows[n])
        }
        rows[n].sort(key=means.__getitem__)


def crossings(rows: Sequence[Sequence[Place]], links: Sequence[tuple[Place, Place]]) -> int:
    """The number of pairs of links that cross each other."""
    count = 0
    for upper, lower in pairwise(rows):
        above, below = ({place: k for k, place in enumerate(row)} for row in (upper, lower))
        ends = [(above[a], below[b]) for a, b in links if a in above]
        count += sum((a - c) * (b - d) < 0 for k, (a, b) in enumerate(ends) for c, d in ends[:k])
    return count


def _placed(
    rows: Sequence[Sequence[Place]], links: Sequence[tuple[Place, Place]], box: float, passage: float
) -> dict[Place, float]:
    width = lambda place: box if isinstance(place, str) else passage
    pulls: dict[Place, list[tuple[Place, float]]] = {}
    for a, b in links:
        pull = STRAIGHT ** (isinstance(a, tuple) + isinstance(b, tuple))
        pulls.setdefault(a, []).append((b, pull))
        pulls.setdefault(b, []).append((a, pull))
    x: dict[Place, float] = {}
    offsets = []
    for row in rows:
        ends = [width(row[0]) / 2.0]
        for a, b in pairwise(row):
            ends.append(ends[-1] + (width(a) + width(b)) / 2.0)
        offsets.append(ends)
        x |= {place: end - ends[-1] / 2.0 for place, end in zip(row, ends, strict=True)}
    for sweep in range(200):
        for n in range(len(rows))[:: 1 if sweep % 2 else -1]:
            wanted, weights = [], []
            for place, offset in zip(rows[n], offsets[n], strict=True):
                near = pulls.get(place, [(place, 1.0)])
                weights.append(sum(pull for _, pull in near))
                wanted.append(sum(x[other] * pull for other, pull in near) / weights[-1] - offset)
            moved = _rising(wanted, weights)
            x |= {p: m + o for p, m, o in zip(rows[n], moved, offsets[n], strict=True)}
    return x


def _rising(values: Sequence[float], weights: Sequence[float]) -> list[float]:
    """The nondecreasing numbers with the smallest weighted squared distance to `values` (isotonic regression).

    Neighbouring values that decrease are replaced by their weighted mean until no values decrease.
    """
    merged: list[tuple[float, float, int]] = []
    for value, weight in zip(values, weights, strict=True):
        merged.append((value, weight, 1))
        while len(merged) > 1 and merged[-2][0] > merged[-1][0]:
            (a, u, m), (b, v, n) = merged[-2:]
            merged[-2:] = [((a * u + b * v) / (u + v), u + v, m + n)]
    return [value for value, _, count in merged for _ in range(count)]
