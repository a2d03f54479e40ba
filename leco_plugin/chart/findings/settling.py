"""Whether runs have had enough time: what they still gained in the last third of it."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import numpy as np

from leco_plugin.chart.findings.summary import Line

ENOUGH = 0.3
"""dB in the last third of a run's time: who gains no more has had enough of it."""


def last_gain(line: Line) -> float:
    """Mean over seeds of the PSNR gained in the last third of the training time, dB."""
    gains = []
    for run in line.runs:
        seconds, psnrs = zip(*run["curve"])
        gains.append(psnrs[-1] - float(np.interp(2.0 / 3.0 * seconds[-1], seconds, psnrs)))
    return statistics.fmean(gains)


def still_rising(lines: Sequence[Line]) -> list[str]:
    """Who gained more than `ENOUGH` at last, as far as a gain is shown."""
    return [line.name for line in lines if round(last_gain(line), 1) > ENOUGH]


def settling(lines: Sequence[Line]) -> str:
    """In two sentences, what all gained at last, and whether that is enough time."""
    gains = {line.name: last_gain(line) for line in lines}
    listed = ", ".join(f"{name} {gain:+.1f} dB" for name, gain in gains.items())
    rising = still_rising(lines)
    said = "all of them have had enough time"
    if rising:
        who = "all of them" if len(rising) == len(gains) else " and ".join(rising)
        said = f"{who} would gain by more time, and who is ahead may still change"
    return (
        f"Gained in the last third of the time: {listed}. Counting {ENOUGH} dB and less as none, "
        f"{said}."
    )
