"""A learned occupancy against each rival of the same method, seed by seed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from leco_plugin.chart.findings.summary import Line, seconds_to_pass


@dataclass(frozen=True)
class Versus:
    """What one contender gains over another, for each seed that both have run."""

    ours: str
    theirs: str
    gains: tuple[float, ...]
    """Of PSNR, dB."""
    passed: tuple[float | None, ...]
    """Seconds of training, learning included, after which it passes the other's last PSNR."""
    sooner: tuple[float | None, ...]
    """The other's training time, as far as it was given any, as a multiple of those."""
    faster: tuple[float, ...]
    """The other's time to render an image as a multiple of its own."""


def versus(ours: Line, theirs: Line, seconds: float | None) -> Versus:
    """Two contenders, seed by seed.

    Args:
        seconds: that each may train; a last step that went beyond them is nobody's gain.
    """
    others = {run["seed"]: run for run in theirs.runs}
    pairs = [(run, others[run["seed"]]) for run in ours.runs if run["seed"] in others]
    passed = tuple(seconds_to_pass(a["curve"], b["curve"][-1][1]) for a, b in pairs)
    return Versus(
        ours.name,
        theirs.name,
        tuple(a["psnr"] - b["psnr"] for a, b in pairs),
        passed,
        tuple(
            None if after is None else min(b["curve"][-1][0], seconds or math.inf) / after
            for after, (_, b) in zip(passed, pairs)
        ),
        tuple(_rendering(b) / _rendering(a) for a, b in pairs),
    )


def rivals(lines: Sequence[Line], seconds: float | None = None) -> list[Versus]:
    """Each learned occupancy against what else its method was run with, where seeds are shared;
    `seconds` as for `versus`."""
    found = [
        versus(ours, theirs, seconds)
        for ours in lines
        for theirs in lines
        if ours.learned and not theirs.learned and ours.method == theirs.method
    ]
    return [one for one in found if one.gains]


def _rendering(run: Mapping[str, Any]) -> float:
    return float(run["render_seconds_per_image"])
