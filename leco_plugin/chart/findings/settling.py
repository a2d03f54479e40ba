"""What runs still gained in the last third of their time.

Learning rates fall to a tenth over whatever time is given, so that every curve flattens: who still
rises has had too little, who does not may have more of it with more.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import numpy as np

from leco_plugin.chart.findings.summary import Line

ENOUGH = 0.3
"""dB in the last third of a run's time: who gains more is still rising."""
HARDLY_TRAINED = 0.4
"""Share of its time from which on a run that kept its grid up has hardly trained."""
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
    """Names of the lines that have not had enough time.

    These gained more than `ENOUGH` in the last third, or their gain is unknown, or their grid has
    skipped nothing yet or has taken the time of training.
    """
    gains = [(line, last_gain(line)) for line in lines]
    return [
        line.name
        for line, gain in gains
        if gain is None
        or round(gain, 1) > ENOUGH
        or line.warming_up
        or line.kept_up > HARDLY_TRAINED
    ]


def settling(lines: Sequence[Line]) -> str:
    """The last gain of each line, which lines still rise, and whose grid took the training time."""
    listed = ", ".join(
        f"{line.name} {'unknown' if gain is None else f'{gain:+.1f} dB'}"
        for line in lines
        for gain in [last_gain(line)]
    )
    rising = still_rising(lines)
    who = "all of them" if len(rising) == len(lines) else " and ".join(rising)
    said = f"Still rising: {who}; rates" if rising else "Rates"
    hardly = [
        f"{line.name} for {line.kept_up:.0%} of its time"
        for line in lines
        if line.kept_up > HARDLY_TRAINED
    ]
    kept_up = f" Updated its grid instead of training: {', '.join(hardly)}." if hardly else ""
    return (
        f"Gained in the last third of the time: {listed}. {said} fall to a tenth over the time "
        f"that is given, so that all may gain by more of it.{kept_up}"
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
