"""Which photographs are compared with which: near ones by GPS, next ones in order, or all."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.poses.originals import Exif

FEW = 40
"""Up to so many photographs are all compared: 780 pairs, two minutes of one core."""
NEIGHBOURS = 16
"""Nearest photographs by position that each is compared with."""
WIDE = 20.0
"""Metres from their middle, root mean square, from which on positions tell who sees the same."""
NEXT = 10
"""Photographs in order that each is compared with, and one at each power of two beyond."""
ANCHORS = 100
"""Of an ordered survey, so many photographs, evenly spread, are all compared: they close loops."""


class Pairs(NamedTuple):
    """Pairs of photographs that are compared, by number, and why those."""

    pairs: list[tuple[int, int]]
    reason: str


def choose_pairs(names: Sequence[str], exifs: Sequence[Exif], places: NDArray[np.float64]) -> Pairs:
    """The pairs to compare.

    Args:
        names: of the photographs, which may count them.
        exifs: what EXIF says of each.
        places: [N, 3] metres, nan where EXIF has no position.
    """
    count = len(names)
    everything = list(combinations(range(count), 2))
    if count <= FEW:
        return Pairs(everything, "all pairs")
    order = capture_order(names, exifs)
    steps = {*range(1, NEXT + 1), *(2**power for power in range(count.bit_length()))}
    known = np.isfinite(places[:, 0])
    apart = places[known, :2] - np.median(places[known, :2], axis=0) if known.any() else 0.0
    if known.mean() >= 0.5 and np.sqrt(2.0 * np.mean(np.square(apart))) >= WIDE:
        numbers = known.nonzero()[0]
        near = _near(places[numbers, :2], np.arange(NEIGHBOURS))
        found = {(int(numbers[one]), int(numbers[other])) for one, other in near}
        found |= _in_order(order or [], (1, 2))
        lost = [number for number in range(count) if not known[number]]
        around = _in_order(order, steps) if order else set(everything)
        found |= {pair for pair in around if {*pair} & {*lost}}
        return Pairs(sorted(found), f"{NEIGHBOURS} nearest by GPS")
    if order is None or count <= ANCHORS:
        return Pairs(everything, "all pairs")
    anchors = order[:: -(-count // ANCHORS)]
    loops = {(min(pair), max(pair)) for pair in combinations(anchors, 2)}
    return Pairs(sorted(_in_order(order, steps) | loops), f"{NEXT} next in order, and loops")


def choose_posed_pairs(poses: NDArray[np.float64]) -> Pairs:
    """The pairs to compare of photographs whose poses are known.

    Args:
        poses: [N, 3, 4] OpenGL camera to world.
    """
    count = len(poses)
    if count <= FEW:
        return Pairs(list(combinations(range(count), 2)), "all pairs")
    places, ahead = poses[:, :, 3], -poses[:, :, 2]
    ranks = np.array(sorted({*range(NEIGHBOURS // 2), *(2**power for power in range(3, 7))}))
    found = _near(places, ranks, ahead)
    return Pairs(sorted(found), "near ones by pose that look the same way")


def capture_order(names: Sequence[str], exifs: Sequence[Exif]) -> list[int] | None:
    """Numbers of the photographs as they were taken: by EXIF's time, or as names count them.

    None where neither tells.
    """
    times = [each.time for each in exifs if each.time is not None]
    if len(times) == len(names) and 2 * len(set(times)) > len(names):
        return sorted(range(len(names)), key=lambda number: (exifs[number].time, names[number]))
    counted = [re.findall(r"\d+", name.rsplit(".", 1)[0]) for name in names]
    if not all(counted) or len({parts[-1] for parts in counted}) * 2 <= len(names):
        return None

    def by_value(number: int) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", names[number])
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]

    return sorted(range(len(names)), key=by_value)


def _near(
    places: NDArray[np.float64], ranks: NDArray[np.int64], ahead: NDArray[np.float64] | None = None
) -> set[tuple[int, int]]:
    """Pairs of each photograph with others near to its place [N, 2 or 3].

    Args:
        ranks: which of the others, ordered by distance.
        ahead: [N, 3] where each looks; those that look another way are left out.
    """
    found = set()
    for row in range(len(places)):
        distances = ((places - places[row]) ** 2).sum(axis=1)
        if ahead is not None:
            distances[ahead @ ahead[row] <= 0.0] = np.inf
        distances[row] = np.inf
        order = np.argsort(distances, kind="stable")[ranks[ranks < len(places)]]
        found |= {(min(row, o), max(row, o)) for o in order.tolist() if distances[o] < np.inf}
    return found


def _in_order(order: Sequence[int], steps: Iterable[int]) -> set[tuple[int, int]]:
    """Pairs of photographs that are so many steps apart in an order."""
    pairs = ((order[at], order[at + step]) for step in steps for at in range(len(order) - step))
    return {(min(pair), max(pair)) for pair in pairs}
