"""What a chart shows, as data for its picture, its page and its table: a title, and panels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from leco_plugin.chart import summary
from leco_plugin.chart.learned import learned_headline, learned_of, not_always_frozen
from leco_plugin.chart.representations import (
    SPARSE,
    Representation,
    representations_of,
    shortest_verdict,
    verdict,
)
from leco_plugin.chart.summary import Cost, Line

HELD_COSTS = {"size": "size of the occupancy, kB", "learn_seconds": summary.LEARNING.titled}
"""Names in `Held` of what an occupancy costs, and their titles."""


def finding_of(results: Mapping[str, Any], short: bool = False) -> str:
    """One sentence, without a full stop, about results that hold at least one run; a short one, for
    a title, has about ten words."""
    lines = summary.lines_of(results)
    if held := representations_of(lines):
        never = 0 if short else len(not_always_frozen(lines))
        said = shortest_verdict(held) if short else verdict(held)
        return summary.sentence(said) + (f"; {never} not always frozen" if never else "")
    if asks_what_was_learned(results):
        return summary.sentence(learned_headline(learned_of(lines), short))
    return summary.sentence(summary.headline(results, short))


def asks_what_was_learned(results: Mapping[str, Any]) -> bool:
    """Whether the chart compares what gates learn in equal steps, not where runs end."""
    by_steps = results["suite"] is not None and results["protocol"]["seconds"] is None
    return by_steps and bool(learned_of(summary.lines_of(results)))


@dataclass(frozen=True)
class Point:
    """A contender, or an occupancy, in a panel."""

    name: str
    x: float
    y: float
    line: int | None
    """Number of the contender whose look it has; None for a grid."""
    seeds: tuple[tuple[float, float], ...] = ()
    """Places of its seeds, where they are shown."""
    ours: bool = False
    small: bool = False
    """Whether it is a small gate."""


@dataclass(frozen=True)
class Panel:
    """Points, and the axes on which nothing beats those on the front."""

    title: str
    points: tuple[Point, ...]
    less: bool = True
    """Whether less of y is better, and drawn upwards."""
    more_x: bool = False
    """Whether more of x is better."""

    def front(self) -> list[tuple[float, float]]:
        """The points that no other one beats in both, from the best x on."""
        places = [(one.x, one.y) for one in self.points]
        across, up = -1.0 if self.more_x else 1.0, -1.0 if self.less else 1.0
        return [places[i] for i in summary.front([(across * x, up * y) for x, y in places])]


@dataclass(frozen=True)
class Shown:
    lines: list[Line]
    costs: list[Panel]
    """PSNR against each cost."""
    space: list[Panel]
    """Space kept at equal loss, where the chart is about that: against size and learning time, or
    against PSNR."""


def shown_of(results: Mapping[str, Any]) -> Shown:
    """Of results that hold at least one run."""
    lines = summary.lines_of(results)
    space = []
    if held := representations_of(lines):
        space = [kept_panel(figure, held, lines) for figure in HELD_COSTS]
    elif asks_what_was_learned(results):
        space = [learned_panel(lines)]
    return Shown(lines, [cost_panel(cost, lines) for cost in summary.COSTS], space)


def cost_panel(cost: Cost, lines: Sequence[Line]) -> Panel:
    points = [
        Point(line.name, value, line.psnr, i, tuple((value, psnr) for psnr in line.psnrs))
        for i, line in enumerate(lines)
        if (value := line.median(cost)) is not None
    ]
    return Panel(cost.titled, tuple(points), less=False)


def kept_panel(figure: str, held: Sequence[Representation], lines: Sequence[Line]) -> Panel:
    """Space kept at equal loss against one of `HELD_COSTS`, of occupancies that have it."""
    numbers = {line.name: i for i, line in enumerate(lines)}
    points = []
    for one in (one for one in held if one.has(figure) and one.name != SPARSE):
        itself, place = numbers.get(one.name), (one.median(figure), one.kept)
        large = [numbers[o.name] for o in held if o.name in numbers and one.is_small_of(o)]
        like = itself if itself is not None else next(iter(large), None)
        small = itself is None and like is not None
        points.append(Point(one.name, *place, like, ours=one.ours, small=small))
    return Panel(HELD_COSTS[figure], tuple(points))


def learned_panel(lines: Sequence[Line]) -> Panel:
    """Space kept at equal loss against PSNR after equal steps, of gates that always froze."""
    numbers = {line.name: i for i, line in enumerate(lines)}
    points = []
    for one in (one for one in learned_of(lines) if one.is_measured):
        psnrs = {run["seed"]: run["psnr"] for run in one.runs}
        seeds = tuple((psnrs[seed], kept) for seed, kept in one.kept_by_seed.items())
        late = " (frozen at the end)" if one.guided_nothing == one.seeds else ""
        points.append(Point(one.name + late, one.psnr, one.kept, numbers[one.name], seeds))
    return Panel("space kept at equal loss, against PSNR, dB", tuple(points), more_x=True)
