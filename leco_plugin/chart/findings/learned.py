"""What occupancies were learned, contender by contender, in the seeds that froze a gate."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from leco_plugin.chart.findings.summary import Line, figure_in

OURS = "(ours)"
"""In the name of the contender that a suite asks about."""
ALIKE = 0.01
"""Of the candidates: less than that is not told apart."""


@dataclass(frozen=True)
class Learned:
    """The occupancies of one contender."""

    name: str
    facts: tuple[Mapping[str, Any], ...]
    """Of each seed with a frozen gate, as it was frozen: as a run's `occupancy`, and its `seed`."""
    seeds: int
    healed: int | None
    """How often a collapsed gate was, in all seeds together; None where runs did not note it."""

    def median(self, name: str) -> float | None:
        """A figure over the seeds that have one, a dot into their facts; None where none has."""
        values = [value for facts in self.facts if (value := figure_in(facts, name)) is not None]
        return statistics.median(values) if values else None

    @property
    def always_frozen(self) -> bool:
        """Whether there is an occupancy with every seed."""
        return len(self.facts) == self.seeds


def learned_of(lines: Sequence[Line]) -> list[Learned]:
    """Of each contender that learns an occupancy with a gate, whether it was ever frozen or not;
    none where nothing was."""
    found = [_learned(line) for line in lines if line.learned]
    return found if any(one.facts for one in found) else []


def _learned(line: Line) -> Learned:
    facts = [
        {
            **run["occupancy"],
            **(run.get("at_freezing") or {}),
            "at_end": run["occupancy"],
            "seed": run["seed"],
        }
        for run in line.runs
        if run.get("occupancy") and run.get("freeze_seconds") is not None
    ]
    healed = [run.get("recoveries", figure_in(run, "occupancy.recoveries")) for run in line.runs]
    known = [int(count) for count in healed if count is not None]
    return Learned(
        line.name,
        tuple(facts),
        len(line.runs),
        sum(known) if len(known) == len(line.runs) else None,
    )


def learned_headline(learned: Sequence[Learned]) -> str:
    """What ours, or else the first that always froze, skips, and who of the others skips more or
    less than it: with every seed, and by `ALIKE` in the median.

    Where all runs had as many steps, PSNR says nothing of where they would end.
    """
    frozen = [one for one in learned if one.always_frozen]
    if not frozen:
        return "no gate was frozen with every seed"
    ours = next((one for one in frozen if OURS in one.name), frozen[0])
    others = [one for one in frozen if one is not ours]
    more = [one for one in others if _skips_more(one, ours)]
    less = [one for one in others if _skips_more(ours, one)]
    alike = [one for one in others if one not in more and one not in less]
    never = [one for one in learned if not one.facts]
    parts = [
        _counted(more, "more", max),
        _counted(alike, "alike", None),
        _counted(less, "less", min),
        _counted(
            [one for one in learned if one.facts and one not in frozen], "partly frozen", None
        ),
        _counted(never, "never frozen", None),
    ]
    said = f"{ours.name} skips {_skipped(ours):.0%} of the candidates"
    return ": ".join([said, ", ".join(part for part in parts if part)]).removesuffix(": ")


def _counted(
    some: Sequence[Learned], what: str, extreme: Callable[..., Learned] | None
) -> str | None:
    """Who does what, by name if it is one, and the share of the one that does it most."""
    if not some:
        return None
    who = some[0].name if len(some) == 1 else str(len(some))
    if extreme is None:
        return f"{who} {what}"
    reach = "up to" if extreme is max else "down to"
    share = f"{_skipped(extreme(some, key=_skipped)):.0%}"
    return f"{who} {what}, {share if len(some) == 1 else f'{reach} {share}'}"


def _skips_more(one: Learned, other: Learned) -> bool:
    shares = {facts["seed"]: facts["empty_fraction"] for facts in other.facts}
    pairs = [(facts["empty_fraction"], shares.get(facts["seed"])) for facts in one.facts]
    gains = [a - b for a, b in pairs if b is not None]
    enough = len(gains) == len(pairs) and statistics.median(gains) >= ALIKE
    return enough and min(gains) > 0.0


def _skipped(one: Learned) -> float:
    return one.median("empty_fraction") or 0.0
