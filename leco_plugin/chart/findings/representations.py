"""Ways to hold an occupancy, side by side: what each keeps for its size and its learning time."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from leco_plugin.chart.findings.summary import BYTES, KEPT, LEARNING, Line

OURS = "learned-occupancy"
"""The sampler whose gate is the one that this package takes by default."""


class Held(NamedTuple):
    """One representation in one run."""

    size: float
    """kB of its file, or of a grid's bits."""
    learn_seconds: float
    """Until it is there; for a grid, of the field it was made from, and its own updates."""
    kept: float
    """Percent of the volume that rays reach which it keeps when all lose equally much."""


COSTS = {"size": "size", "learning time": "learn_seconds"}
"""Those on whose fronts representations are, and the figure of each in `Held`."""


@dataclass(frozen=True)
class Representation:
    """One way to hold an occupancy, in all runs: its figures are medians over seeds."""

    name: str
    by_seed: Mapping[int, Held]
    ours: bool = False
    """Whether it is the gate that this package takes by default."""

    def of_seeds(self, figure: str) -> list[float]:
        """A figure of `Held` in each run."""
        return [getattr(held, figure) for held in self.by_seed.values()]

    def median(self, figure: str) -> float:
        """The same, over seeds."""
        return statistics.median(self.of_seeds(figure))

    @property
    def kept(self) -> float:
        """Median of what it keeps, percent."""
        return self.median("kept")

    def beats(self, other: Representation, figure: str) -> bool:
        """Whether in each seed that both have it keeps no more at no more cost, and is better in
        one of the two in some: what only some seeds show may be chance."""
        shared = [
            (held, other.by_seed[s]) for s, held in self.by_seed.items() if s in other.by_seed
        ]
        pairs = [((getattr(a, figure), a.kept), (getattr(b, figure), b.kept)) for a, b in shared]
        never_worse = all(a <= b for mine, theirs in pairs for a, b in zip(mine, theirs))
        return never_worse and any(mine != theirs for mine, theirs in pairs)

    def leads(self, other: Representation, figure: str) -> bool:
        """Whether it keeps less at no more cost in the median, which may be chance."""
        cheaper = self.median(figure) <= other.median(figure)
        return self is not other and cheaper and self.kept < other.kept


def representations_of(lines: Sequence[Line]) -> list[Representation]:
    """Learned occupancies, and grids made from the same field, that were measured in every run.

    None where all are gates of one kind: then something else is compared.
    """
    found: list[Representation] = []
    kinds: set[str] = set()
    for line in lines:
        gates = {run["seed"]: _of_gate(run) for run in line.runs}
        if any(gate is None for gate in gates.values()):
            continue
        measured = {seed: gate for seed, gate in gates.items() if gate is not None}
        found.append(Representation(line.name, measured, line.sampler == OURS))
        kinds.add(line.sampler)
        for resolution in resolutions_of(line.runs):
            grids = {run["seed"]: _of_grid(run, resolution) for run in line.runs}
            made = {seed: grid for seed, grid in grids.items() if grid is not None}
            if len(made) == len(grids):
                found.append(Representation(f"grid {resolution}³", made))
                kinds.add("grid")
    return found if len(kinds) > 1 else []


def resolutions_of(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of the grids that were made in some run, from coarse to fine."""
    made = {str(grid["resolution"]) for run in runs for grid in _grids(run)}
    return sorted(made, key=lambda resolution: (len(resolution), resolution))


def _grids(run: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    found: Sequence[Mapping[str, Any]] = run["occupancy"]["at_equal_loss"]["grids"]
    return found


def _of_gate(run: Mapping[str, Any]) -> Held | None:
    size, seconds, kept = (cost.of(run) for cost in (BYTES, LEARNING, KEPT))
    if size is None or seconds is None or kept is None:
        return None
    return Held(size, seconds, kept)


def _of_grid(run: Mapping[str, Any], resolution: str) -> Held | None:
    for grid in _grids(run):
        if str(grid["resolution"]) == resolution:
            seconds = run["learn_seconds"] + grid["update_seconds"]
            return Held(grid["bytes"] / 1e3, seconds, 100.0 * grid["kept_reached_volume"])
    return None


def fronts_of(one: Representation, all_of_them: Sequence[Representation]) -> list[str]:
    """The names of the `COSTS` on whose fronts a representation is."""
    return [
        name
        for name, figure in COSTS.items()
        if not any(other.beats(one, figure) for other in all_of_them)
    ]


def in_doubt(
    one: Representation, all_of_them: Sequence[Representation]
) -> dict[str, Representation]:
    """By names of the fronts that it is on: what leads there in the median, though not with every
    seed, and of that what keeps least."""
    leaders = {
        name: [other for other in all_of_them if other.leads(one, COSTS[name])]
        for name in fronts_of(one, all_of_them)
    }
    return {name: min(them, key=lambda o: o.kept) for name, them in leaders.items() if them}


def verdict(representations: Sequence[Representation]) -> str:
    """On which fronts ours is, what beats it where it is not, and where that is in doubt."""
    ours = next((one for one in representations if one.ours), None)
    if ours is None:
        return "our own gate has no figures here"
    held, beaten = fronts_of(ours, representations), []
    for name, figure in COSTS.items():
        better = [one for one in representations if one.beats(ours, figure)]
        if better:
            beaten.append(f"in {name} by {min(better, key=lambda one: one.kept).name}")
    doubts = in_doubt(ours, representations)
    if beaten:
        where = f"is on the front of {held[0]} only" if held else "is on neither front"
        return f"{ours.name} {where}: it is beaten {' and '.join(beaten)}"
    if doubts:
        leaders = ", ".join(f"{one.name} in {name}" for name, one in doubts.items())
        return f"nothing beats {ours.name} with every seed; in the median, {leaders}"
    return (
        f"{ours.name} is on both fronts: what keeps less space is larger, and takes longer to learn"
    )
