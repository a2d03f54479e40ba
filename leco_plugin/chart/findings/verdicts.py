"""Whether one contender is ahead of another: the rule that all charts, tables and pages follow."""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from scipy.special import stdtrit

CONFIDENCE = 0.95
"""Of the interval around a difference of means; of each comparison alone, however many are made."""


@dataclass(frozen=True)
class Verdict:
    """A difference of means, and what its interval over seeds says."""

    word: Literal["ahead", "level", "behind"] | None
    """Ahead is more. None where a side has one seed, or a figure is no number."""
    difference: float
    margin: float | None
    """Half the interval's width; None where there is none."""
    seeds: tuple[int, int]

    @property
    def by(self) -> str:
        """The number of seeds, or why there is no verdict."""
        if self.margin is None:
            return "one seed: no verdict" if min(self.seeds) < 2 else "not a number: no verdict"
        ours, theirs = self.seeds
        return f"{ours} seeds" if ours == theirs else f"{ours} and {theirs} seeds"

    def said(self, unit: str = "dB", form: str = ".2f") -> str:
        """The whole verdict, such as "ahead: +1.50 ± 0.42 dB, 3 seeds"."""
        word = f"{self.word}: " if self.word else ""
        margin = "" if self.margin is None else f" ± {self.margin:{form}}"
        return f"{word}{self.difference:+{form}}{margin} {unit}, {self.by}"


def compare(ours: Sequence[float], theirs: Sequence[float]) -> Verdict:
    """Compares a figure of two contenders by the 95% interval of Welch's t around the difference of
    their means: level where that holds zero.

    Runs with the same seed share nothing but its number, so that they are no pairs, and two
    contenders need not scatter alike.

    Args:
        ours: the figure in each run, one for a seed. Less is better for a cost: then swap the two.
        theirs: the same of the other contender.

    Raises:
        ValueError: one of them has no run.
    """
    if not ours or not theirs:
        raise ValueError(f"{len(ours)} runs cannot be compared with {len(theirs)}")
    counts = len(ours), len(theirs)
    difference = statistics.fmean(ours) - statistics.fmean(theirs)
    if min(counts) < 2 or not math.isfinite(difference):
        return Verdict(None, difference, None, counts)
    errors = [statistics.variance(values) / len(values) for values in (ours, theirs)]
    squared = sum(errors)
    margin = 0.0
    if squared > 0.0:
        freedom = squared**2 / sum(e**2 / (n - 1) for e, n in zip(errors, counts))
        margin = float(stdtrit(freedom, 0.5 + CONFIDENCE / 2)) * math.sqrt(squared)
    if abs(difference) <= margin:
        return Verdict("level", difference, margin, counts)
    return Verdict("ahead" if difference > 0.0 else "behind", difference, margin, counts)
