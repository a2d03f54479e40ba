"""Ways to represent an occupancy: what each keeps for its size and learning time; the fronts."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from leco_plugin.chart.contender import LEARNED
from leco_plugin.chart.summary import KEPT, LEARNING, Line, Verdict, compare

OUR_KIND = "MLP"
"""Kind of the default gate."""
SMALL_OURS = "small MLP (ours)"
"""The small gate of that kind, which the trained field taught."""
OURS_NEVER_FROZEN = "our own gate was not frozen with every seed"
SPARSE = "sparse points"
"""What is near one of the scene's is kept. In tables, not in pictures: it mostly keeps far more."""
BYTES_A_NUMBER = 2
"""In bfloat16, in which gates are asked on a CPU."""
COSTS = {"size": "size", "learning time": "learn_seconds"}
"""Costs of fronts, and the figure of each in `Held`."""
AS_CHEAP = {"size": "as small", "learning time": "learned as soon"}
"""Words for what costs no more."""


_What = tuple[str, bool, str | None]
"""Name, whether it is ours, and kind of a representation."""


class Held(NamedTuple):
    """One representation in one run."""

    size: float
    """kB: a gate's numbers in bfloat16, a grid as an octree, or in bits where none was stored."""
    learn_seconds: float | None
    """Seconds until it is there; None for a grid, made from a field that learned a gate too."""
    kept: float
    """Percent of the volume reached by rays that it keeps at equal loss."""
    beyond: float | None = None
    """Seconds to make it from the field; None for the gate that learned with it."""


@dataclass(frozen=True)
class Representation:
    """One way to represent an occupancy, in all runs."""

    name: str
    by_seed: Mapping[int, Held]
    ours: bool = False
    """Whether it is the default gate, or a small one of its kind."""
    kind: str | None = None
    """Kind of a small gate: the name of the large one in a suite."""

    @property
    def is_grid(self) -> bool:
        return not self.has("learn_seconds")

    def is_small_of(self, large: Representation) -> bool:
        return self.kind is not None and ((self.ours and large.ours) or self.kind == large.name)

    def of_seeds(self, figure: str) -> list[float]:
        """A figure of `Held` in each run."""
        return [getattr(held, figure) for held in self.by_seed.values()]

    def has(self, figure: str) -> bool:
        return None not in self.of_seeds(figure)

    def median(self, figure: str) -> float:
        return statistics.median(self.of_seeds(figure))

    @property
    def kept(self) -> float:
        """Median of what it keeps, percent."""
        return self.median("kept")

    def against(self, other: Representation, figure: str) -> Verdict:
        """Whether it is ahead in a figure of `Held`, of which less is better; both have it."""
        return compare(other.of_seeds(figure), self.of_seeds(figure), close=None)

    def leads(self, other: Representation, figure: str) -> bool:
        """Whether it keeps no more at no more cost, and is better in one of the two: medians."""
        mine, theirs = ((one.median(figure), one.kept) for one in (self, other))
        return mine[0] <= theirs[0] and mine[1] <= theirs[1] and mine != theirs


def representations_of(lines: Sequence[Line]) -> list[Representation]:
    """Gates, and small gates and grids of the same field, that every run has measured; none where
    all are gates of one kind."""
    found: list[Representation] = []
    gates: set[str] = set()
    for line in lines:
        runs = {run["seed"]: _held_in(run, line) for run in line.runs}
        for name, ours, kind in next(iter(runs.values())):
            what = name, ours, kind
            if all(what in held for held in runs.values()):
                by_seed = {seed: held[what] for seed, held in runs.items()}
                found.append(Representation(name, by_seed, ours, kind))
                gates.add(line.sampler)
    return found if len(gates) > 1 or any(one.is_grid for one in found) else []


def keeps_all(row: Mapping[str, Any]) -> bool:
    """Whether what was measured of a representation is that it holds nothing."""
    return bool(row["kept_reached_volume"] >= 1.0)


def _held_in(run: Mapping[str, Any], line: Line) -> dict[_What, Held]:
    """Its gate, what its field has taught, sparse points, and grids of densities by size; nothing
    where its gate was not measured."""
    seconds, kept = (cost.of(run) for cost in (LEARNING, KEPT))
    if seconds is None or kept is None:
        return {}
    ours, occupancy = line.sampler == LEARNED, run["occupancy"]
    size = BYTES_A_NUMBER * occupancy["params"] / 1e3
    found: dict[_What, Held] = {(line.name, ours, None): Held(size, seconds, kept)}
    for row in occupancy["at_equal_loss"].get("taught", ()):
        is_ours = ours and row["name"] == OUR_KIND
        name = SMALL_OURS if is_ours else f"small {row['name']}"
        learned_in = seconds + row["seconds"]
        found[name, is_ours, row["name"]] = _made_of_field(row, row["seconds"], learned_in)
    for row in (one for one in occupancy["at_equal_loss"].get("others", ()) if not keeps_all(one)):
        learned_in = row["seconds"] + (seconds if row["learned_first"] else 0.0)
        found[row["name"], False, None] = _made_of_field(row, row["seconds"], learned_in)
    for row in sorted(occupancy["at_equal_loss"]["grids"], key=lambda row: row["resolution"]):
        name = f"grid {row['resolution']}³"
        found[name, False, None] = _made_of_field(row, row["update_seconds"], None)
    return found


def _made_of_field(row: Mapping[str, Any], beyond: float, learned_in: float | None) -> Held:
    size = row.get("octree_bytes", row["bytes"])
    return Held(size / 1e3, learned_in, 100.0 * row["kept_reached_volume"], beyond)


def fronts_of(one: Representation, all_of_them: Sequence[Representation]) -> list[str]:
    """The names of the `COSTS` on whose fronts, of medians, a representation is."""
    return [
        name
        for name, figure in COSTS.items()
        if one.has(figure)
        and not any(other.leads(one, figure) for other in all_of_them if other.has(figure))
    ]


def verdict(representations: Sequence[Representation]) -> str:
    """What of ours nothing that costs no more beats in space, and what does: by medians. What the
    seeds do not tell apart is said to be level, or undecided."""
    ours = [one for one in representations if one.ours]
    if not ours:
        return OURS_NEVER_FROZEN
    learned, *small = ours
    said = [_standing_of(one, representations) for one in (*small, learned)]
    return f"{'. '.join(said)} ({learned.against(learned, 'kept').by})"


def shortest_verdict(representations: Sequence[Representation]) -> str:
    """The best that holds for one of ours."""
    ours = [one for one in representations if one.ours]
    if not ours:
        return OURS_NEVER_FROZEN
    for one in ours:
        if all(one.kept <= other.kept for other in representations):
            return f"{one.name} keeps least space, {one.kept:.1f}%"
    for one in ours:
        size, others = one.median("size"), [other for other in representations if other is not one]
        apart = [other for other in others if not one.against(other, "size").is_open]
        if apart == others and all(other.median("size") > size for other in others):
            return f"{one.name} is the smallest occupancy: {size:.0f} kB"
    for one in ours:
        if fronts := fronts_of(one, representations):
            as_cheap = " or ".join(AS_CHEAP[name] for name in fronts)
            return f"no occupancy {as_cheap} as ours keeps less"
    leader = _best_ahead(ours[0], representations, "size")
    return f"{ours[0].name} keeps more space than {leader}"


def _standing_of(one: Representation, all_of_them: Sequence[Representation]) -> str:
    """Of the costs on whose front it is, that nothing as cheap keeps less; of others, what does."""
    others = [other for other in all_of_them if other is not one]
    if all(one.kept <= other.kept for other in others):
        said = f"{one.name} keeps least space, {one.kept:.1f}% in {one.median('size'):.0f} kB"
        words = {other.name: one.against(other, "kept").word for other in others}
        for word, beside in (("level", "level with"), ("undecided", "undecided against")):
            if names := [name for name, its in words.items() if its == word]:
                said += f", {beside} {' and '.join(names)}"
        return said
    fronts = fronts_of(one, all_of_them)
    free = " or ".join(AS_CHEAP[name] for name in fronts)
    parts = [f"nothing {free} keeps less space"] if free else []
    parts += [
        f"{AS_CHEAP[name]}, less is kept by {_best_ahead(one, all_of_them, figure)}"
        for name, figure in COSTS.items()
        if name not in fronts
    ]
    return f"{one.name}: {'; '.join(parts)}"


def _best_ahead(one: Representation, others: Sequence[Representation], figure: str) -> str:
    """Of those that lead a representation, the one that keeps least; and whether it is level in
    space, where the seeds do not tell the two apart."""
    leaders = [other for other in others if other.has(figure) and other.leads(one, figure)]
    best = min(leaders, key=lambda other: other.kept)
    space = best.against(one, "kept")
    if not space.is_open:
        return best.name
    alone = "" if best.against(one, figure).is_open else " in space"
    return f"{best.name} ({space.word}{alone})"
