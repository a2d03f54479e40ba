"""The occupancies that were learned, and what runs still gained in the last third of their time."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from leco_plugin.chart.summary import KEPT, Line, compare, figure_in, middle_of

OURS = "(ours)"
"""Marks the contender that a suite asks about."""
AT_THE_END = 0.99
"""Share of the training time; a gate that is frozen later has guided nothing."""


class Learned(Line):
    """A contender that learns an occupancy with a gate."""

    @cached_property
    def facts(self) -> list[dict[str, Any]]:
        """Of each seed with a frozen gate: its run's `occupancy`, with figures as of the moment of
        freezing, and all as they are `at_end`; and whether it was frozen `at_the_end`."""
        return [
            {
                **run["occupancy"],
                **(run.get("at_freezing") or {}),
                "at_end": run["occupancy"],
                "at_the_end": run["freeze_seconds"] >= AT_THE_END * run["train_seconds"],
            }
            for run in self.runs
            if run.get("occupancy") and run.get("freeze_seconds") is not None
        ]

    @property
    def seeds(self) -> int:
        """How many there are, with a frozen gate or without."""
        return len(self.runs)

    @property
    def healed(self) -> int | None:
        """How often a collapsed gate was, in all seeds; None where runs did not note it."""
        names = ("recoveries", "occupancy.recoveries")  # of a host that learns first: the second
        noted = [[figure_in(run, name) for name in names] for run in self.runs]
        total = middle_of([its if own is None else own for own, its in noted], sum)
        return None if total is None else int(total)

    def figure(self, name: str) -> float | None:
        """Median over the seeds that have it, a dot into their facts; None where none has."""
        values = [value for facts in self.facts if (value := figure_in(facts, name)) is not None]
        return statistics.median(values) if values else None

    @cached_property
    def kept_by_seed(self) -> dict[int, float]:
        """Percent of the space, of each seed of which it was measured."""
        found = {run["seed"]: KEPT.of(run) for run in self.runs}
        return {seed: share for seed, share in found.items() if share is not None}

    @property
    def is_measured(self) -> bool:
        """Whether it is known of every seed what was kept."""
        return len(self.kept_by_seed) == self.seeds

    @property
    def kept(self) -> float:
        """Percent of the space, median over the seeds of which it was measured."""
        return statistics.median(self.kept_by_seed.values())

    @property
    def guided_nothing(self) -> int:
        """In how many seeds the gate was frozen as the training ended."""
        return sum(facts["at_the_end"] for facts in self.facts)


def learned_of(lines: Sequence[Line]) -> list[Learned]:
    """Of each contender that learns an occupancy with a gate, whether one was ever frozen or not;
    none where no contender's was."""
    found = [Learned(**vars(line)) for line in lines if line.learned]
    return found if any(one.facts for one in found) else []


def not_always_frozen(lines: Sequence[Line]) -> list[str]:
    """Contenders that learn an occupancy whose gate was not frozen and measured in every run."""
    return [one.name for one in learned_of(lines) if not one.is_measured]


def learned_headline(learned: Sequence[Learned], short: bool = False) -> str:
    """Space kept at equal loss and PSNR of ours, or of the first that always froze, and which other
    is better in both: medians of space and means of PSNR. A short one leaves out the other others.
    """
    known = [one for one in learned if one.is_measured]
    if not known:
        return "no gate was frozen with every seed"
    if (ours := ours_of(known)) is None:
        if ours_of(learned) is not None:
            return "ours was not frozen with every seed"
        ours = known[0]
    others = [one for one in known if one is not ours]
    if better := [one for one in others if words_of(one, ours) == {"ahead"}]:
        best = min(better, key=lambda one: one.kept)
        by = compare(best.psnrs, ours.psnrs).by
        if short:
            return f"{best.name} keeps less than {ours.name}, at more dB"
        return f"{best.name} keeps {_figures(best)}, {ours.name} {_figures(ours)} ({by})"
    said = f"{ours.name} keeps {_figures(ours)}"
    if others and not short:
        kept = sorted(one.kept for one in others)
        shares = " to ".join(dict.fromkeys(percent(share) for share in (kept[0], kept[-1])))
        said += f": {_standing_of(ours, others)}; the others keep {shares}"
    never = len(learned) - len(known)
    return said + (f"; {never} not always frozen" if never and not short else "")


def _standing_of(one: Learned, others: Sequence[Learned]) -> str:
    found = [words_of(one, other) for other in others]
    fewest = min(others, key=lambda other: other.seeds)
    by = compare(one.psnrs, fewest.psnrs).by
    if any(None in words for words in found):
        return by
    best = all(words == {"ahead"} for words in found)
    return f"{'the least, at the highest PSNR' if best else 'none is better in both'} ({by})"


def words_of(one: Learned, other: Learned) -> set[str | None]:
    """The verdicts on space, of which less is better, and on PSNR: one where they agree."""
    mine, theirs = (list(some.kept_by_seed.values()) for some in (one, other))
    return {compare(theirs, mine, close=None).word, compare(one.psnrs, other.psnrs).word}


def ours_of(learned: Sequence[Learned]) -> Learned | None:
    return next((one for one in learned if OURS in one.name), None)


def _figures(one: Learned) -> str:
    return f"{percent(one.kept)} of the space at {one.psnr:.1f} dB"


def percent(value: float) -> str:
    """Percent with as many digits as mean something."""
    return f"{value:.1f}%" if value < 10.0 else f"{value:.0f}%"


ENOUGH = 0.3
"""dB in the last third of a run's time: who gains more is still rising."""
HARDLY_TRAINED = 0.4
"""Share of its time from which on updates of a grid have left no time to train."""
FALL = 0.3
"""dB below the best point of a run's own curve from which on its end is said to have fallen."""


def last_gain(line: Line) -> float | None:
    """Mean over seeds of the PSNR gained in the last third of the training time, dB; None where the
    curve of one has no point before that."""
    gains = []
    for run in line.runs:
        seconds, psnrs = zip(*run["curve"])
        before = 2.0 / 3.0 * seconds[-1]
        if seconds[0] > before:
            return None
        gains.append(psnrs[-1] - float(np.interp(before, seconds, psnrs)))
    return statistics.fmean(gains)


def still_rising(lines: Sequence[Line]) -> list[str]:
    """Names of lines that gained more than `ENOUGH` in the last third, as far as is known, or whose
    grid has skipped nothing yet or has taken the time of training."""

    def rises(line: Line) -> bool:
        gain = last_gain(line)
        gained = gain is None or round(gain, 1) > ENOUGH
        return gained or line.warming_up or line.kept_up > HARDLY_TRAINED

    return [line.name for line in lines if rises(line)]


def settling(lines: Sequence[Line], held: float | None = None) -> str:
    """The last gain of each line, which lines still rise, and whose grid took the training time.

    Args:
        held: share of the time through which rates were full, before they fell to zero; None in
            charts of before December 2026, in which they fell to a tenth all along.
    """
    listed = ", ".join(
        f"{line.name} {'unknown' if gain is None else f'{gain:+.1f} dB'}"
        for line in lines
        for gain in [last_gain(line)]
    )
    rising = still_rising(lines)
    who = "all of them" if len(rising) == len(lines) else " and ".join(rising)
    said = f"Still rising: {who}; rates" if rising else "Rates"
    took = [line for line in lines if line.kept_up > HARDLY_TRAINED]
    hardly = [f"{line.name} for {line.kept_up:.0%} of its time" for line in took]
    kept_up = f" Updated its grid instead of training: {', '.join(hardly)}." if hardly else ""
    full = "" if held is None else f"are full for {held:.0%} of the time that is given, and then "
    end = "to a tenth over the time that is given" if held is None else "to zero"
    return (
        f"Gained in the last third of the time: {listed}. {said} {full}fall {end}, so that all may "
        f"gain by more of it.{kept_up}"
    )


def falls(lines: Sequence[Line]) -> str | None:
    """Which lines have runs that end more than `FALL` below their own best point, in how many runs,
    and by how much at most; None without any."""
    fallen = []
    for line in lines:
        below = [max(psnr for _, psnr in run["curve"]) - run["curve"][-1][1] for run in line.runs]
        if count := sum(fall > FALL for fall in below):
            by = f"{'up to ' if count > 1 else ''}{max(below):.1f} dB"
            of_all = f" in {count} of {len(below)} runs" if len(below) > 1 else ""
            fallen.append(f"{line.name} fell by {by} from its best{of_all}")
    return "; ".join(fallen) or None
