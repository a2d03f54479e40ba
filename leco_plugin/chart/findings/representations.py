"""Ways to hold an occupancy, side by side: what each keeps for its size and its learning time."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from leco_plugin.chart.contenders.methods import LEARNED
from leco_plugin.chart.findings.summary import KEPT, LEARNING, Line

OUR_KIND = "MLP"
"""Of the gate that this package takes by default."""
SMALL_OURS = "small MLP (ours)"
"""The small gate of that kind: like those of other kinds, it was taught by the field of a run whose
own gate had learned with it."""
BYTES_A_NUMBER = 2
"""In bfloat16, in which gates are asked on a CPU."""


class Held(NamedTuple):
    """One representation in one run."""

    size: float
    """kB of what it consists of: a gate's numbers in bfloat16, a grid's cells in bits. Files have a
    head besides, and `leco-occupancy` writes float32."""
    learn_seconds: float | None
    """Until it is there; None for a grid, which is made from a field that learned a gate too."""
    kept: float
    """Percent of the volume that rays reach which it keeps when all lose equally much."""
    beyond: float | None = None
    """Seconds to make it of a field that has learned a gate; None for the gate itself."""


@dataclass(frozen=True)
class Representation:
    """One way to hold an occupancy, in all runs: its figures are medians over seeds."""

    name: str
    by_seed: Mapping[int, Held]
    ours: bool = False
    """Whether it is the gate that this package takes by default, or a small one of its kind."""
    kind: str | None = None
    """Of a small gate taught after: the kind, as a suite calls the large one."""

    @property
    def is_grid(self) -> bool:
        """Whether it is an occupancy grid."""
        return not self.has("learn_seconds")

    def is_small_of(self, large: Representation) -> bool:
        """Whether it is the small gate of the kind of a large one."""
        return self.kind is not None and ((self.ours and large.ours) or self.kind == large.name)

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
        ours = line.sampler == LEARNED
        found.append(Representation(line.name, measured, ours))
        kinds.add(line.sampler)
        found += _taught(line, ours)
        for resolution in resolutions_of(line.runs):
            grids = {run["seed"]: _of_grid(run, resolution) for run in line.runs}
            made = {seed: grid for seed, grid in grids.items() if grid is not None}
            if len(made) == len(grids):
                found.append(Representation(f"grid {resolution}³", made))
                kinds.add("grid")
    return found if len(kinds) > 1 else []


def never_held_of(lines: Sequence[Line]) -> list[str]:
    """Whose gate was not frozen and measured in every run, and is left out for that."""
    gates = [line for line in lines if line.learned]
    return [line.name for line in gates if any(_of_gate(run) is None for run in line.runs)]


def resolutions_of(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Of the grids that were made in some run, from coarse to fine."""
    made = {str(grid["resolution"]) for run in runs for grid in _grids(run)}
    return sorted(made, key=lambda resolution: (len(resolution), resolution))


def _grids(run: Mapping[str, Any]) -> Sequence[Mapping[str, Any]]:
    found: Sequence[Mapping[str, Any]] = run["occupancy"]["at_equal_loss"]["grids"]
    return found


def _of_gate(run: Mapping[str, Any]) -> Held | None:
    seconds, kept = (cost.of(run) for cost in (LEARNING, KEPT))
    if seconds is None or kept is None:
        return None
    return Held(BYTES_A_NUMBER * run["occupancy"]["params"] / 1e3, seconds, kept)


def _taught(line: Line, ours: bool) -> list[Representation]:
    """The small gates that the field of a line has taught in every run."""
    by_kind: dict[str, dict[int, Held]] = {}
    for run in line.runs:
        for row in run["occupancy"]["at_equal_loss"].get("taught", ()):
            seconds = run["learn_seconds"] + row["seconds"]
            kept = 100.0 * row["kept_reached_volume"]
            held = Held(row["bytes"] / 1e3, seconds, kept, row["seconds"])
            by_kind.setdefault(row["name"], {})[run["seed"]] = held
    return [
        Representation(SMALL_OURS, held, True, kind)
        if ours and kind == OUR_KIND
        else Representation(f"small {kind}", held, kind=kind)
        for kind, held in by_kind.items()
        if len(held) == len(line.runs)
    ]


def _of_grid(run: Mapping[str, Any], resolution: str) -> Held | None:
    for grid in _grids(run):
        if str(grid["resolution"]) == resolution:
            kept = 100.0 * grid["kept_reached_volume"]
            return Held(grid["bytes"] / 1e3, None, kept, grid.get("update_seconds"))
    return None
