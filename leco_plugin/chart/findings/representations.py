"""Ways to hold an occupancy, side by side: what each keeps for its size and its learning time."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from leco_plugin.chart.findings.summary import BYTES, KEPT, LEARNING, Line

OURS = "learned-occupancy"
"""The sampler whose gate is the one that this package takes by default."""


TAUGHT = "small MLP, taught after (ours)"
"""A small gate that a field has taught whose own gate was learned with it."""


class Held(NamedTuple):
    """One representation in one run."""

    size: float
    """kB of its file, or of a grid's bits."""
    learn_seconds: float | None
    """Until it is there; None for a grid, which is made from a field that learned a gate too."""
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
    """Whether it is the gate that this package takes by default, or a small one that the same field
    has taught."""

    def of_seeds(self, figure: str) -> list[float]:
        """A figure of `Held` in each run."""
        return [getattr(held, figure) for held in self.by_seed.values()]

    def has(self, figure: str) -> bool:
        """Whether it was measured."""
        return None not in self.of_seeds(figure)

    def median(self, figure: str) -> float:
        """The same, over seeds."""
        return statistics.median(self.of_seeds(figure))

    @property
    def kept(self) -> float:
        """Median of what it keeps, percent."""
        return self.median("kept")

    def leads(self, other: Representation, figure: str) -> bool:
        """Whether it keeps no more at no more cost, and is better in one of the two: medians."""
        mine, theirs = ((one.median(figure), one.kept) for one in (self, other))
        return mine != theirs and all(a <= b for a, b in zip(mine, theirs))

    def leads_always(self, other: Representation, figure: str) -> bool:
        """Whether the same holds in each seed that both have."""
        shared = [
            (held, other.by_seed[s]) for s, held in self.by_seed.items() if s in other.by_seed
        ]
        pairs = [((getattr(a, figure), a.kept), (getattr(b, figure), b.kept)) for a, b in shared]
        never_worse = all(a <= b for mine, theirs in pairs for a, b in zip(mine, theirs))
        return never_worse and any(mine != theirs for mine, theirs in pairs)


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
        ours = line.sampler == OURS
        found.append(Representation(line.name, measured, ours))
        kinds.add(line.sampler)
        taught = {run["seed"]: _of_taught(run) for run in line.runs}
        made = {seed: gate for seed, gate in taught.items() if gate is not None}
        if len(made) == len(taught):
            found.append(Representation(TAUGHT, made, ours))
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


def _of_taught(run: Mapping[str, Any]) -> Held | None:
    taught = run["occupancy"]["at_equal_loss"].get("taught")
    if taught is None:
        return None
    seconds = run["learn_seconds"] + taught["seconds"]
    return Held(taught["bytes"] / 1e3, seconds, 100.0 * taught["kept_reached_volume"])


def _of_grid(run: Mapping[str, Any], resolution: str) -> Held | None:
    for grid in _grids(run):
        if str(grid["resolution"]) == resolution:
            return Held(grid["bytes"] / 1e3, None, 100.0 * grid["kept_reached_volume"])
    return None


def fronts_of(one: Representation, all_of_them: Sequence[Representation]) -> list[str]:
    """The names of the `COSTS` on whose fronts a representation is, which are those of medians."""
    return [
        name
        for name, figure in COSTS.items()
        if one.has(figure)
        and not any(other.leads(one, figure) for other in all_of_them if other.has(figure))
    ]


def verdict(representations: Sequence[Representation]) -> str:
    """Which of ours is on which front; and where none is, what is ahead, always or mostly."""
    ours = [one for one in representations if one.ours]
    if not ours:
        return "our own gate has no figures here"
    fronts = {one.name: fronts_of(one, representations) for one in ours}
    if both := [name for name, found in fronts.items() if found == list(COSTS)]:
        least = "what keeps less space is larger, and takes longer to learn"
        return f"{both[0]} is on both fronts: {least}"
    held = [f"{name} is on the front of {found[0]}" for name, found in fronts.items() if found]
    said = [", ".join(held) or f"{ours[0].name} is on neither front"]
    for name, figure in COSTS.items():
        if not any(name in found for found in fronts.values()):
            said.append(f"in {name} {_ahead(ours[0], representations, figure)}")
    return "; ".join(said)


def _ahead(one: Representation, others: Sequence[Representation], figure: str) -> str:
    """What leads a representation and keeps least, and whether anything does so with every seed."""
    leaders = [other for other in others if other.has(figure) and other.leads(one, figure)]
    best = min(leaders, key=lambda other: other.kept)
    always = any(other.leads_always(one, figure) for other in leaders)
    return f"{best.name} is ahead" + ("" if always else ", not with every seed")
