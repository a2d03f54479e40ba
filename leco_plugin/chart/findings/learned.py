"""What occupancies were learned, contender by contender, in the seeds that froze a gate."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from leco_plugin.chart.findings.summary import Line, figure_in


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
    """Whose occupancies skip most, in one sentence: where all runs had as many steps, PSNR says
    nothing of where they would end. Who does not skip more with every seed skips alike."""
    frozen = [one for one in learned if one.always_frozen]
    ranked = sorted(frozen, key=lambda one: -_skipped(one))
    if not ranked:
        return "No gate was frozen with every seed"
    alike = [one for one in ranked if not _skips_more(ranked[0], one)]
    said = f"{ranked[0].name} skips {_skipped(ranked[0]):.0%} of the candidates"
    if len(alike) > 1:
        least, most = _skipped(alike[-1]), _skipped(alike[0])
        said = f"{len(alike)} of {len(learned)} skip alike, {least:.0%} to {most:.0%}"
    elif len(ranked) > 1:
        said += f", {ranked[1].name} {_skipped(ranked[1]):.0%}"
    rest = len(learned) - len(frozen)
    return f"{said}; {rest} not frozen with every seed" if rest else said


def _skips_more(one: Learned, other: Learned) -> bool:
    shares = {facts["seed"]: facts["empty_fraction"] for facts in other.facts}
    pairs = [(facts["empty_fraction"], shares.get(facts["seed"])) for facts in one.facts]
    return all(b is not None and a > b for a, b in pairs)


def _skipped(one: Learned) -> float:
    return one.median("empty_fraction") or 0.0
