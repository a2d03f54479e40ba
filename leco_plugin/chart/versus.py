"""A learned occupancy against each rival of the same method, seed by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from leco_plugin.chart.summary import Line


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
    """The other's training time as a multiple of those."""
    faster: tuple[float, ...]
    """The other's time to render an image as a multiple of its own."""


def seconds_to_pass(curve: Sequence[Sequence[float]], psnr: float) -> float | None:
    """When a curve [[seconds, PSNR], ...] first reaches a PSNR, between its points; or never."""
    before = None
    for seconds, value in curve:
        if value >= psnr:
            if before is None or value == before[1]:
                return float(seconds)
            share = (psnr - before[1]) / (value - before[1])
            return float(before[0] + share * (seconds - before[0]))
        before = (seconds, value)
    return None


def versus(ours: Line, theirs: Line) -> Versus:
    """Two contenders, seed by seed."""
    others = {run["seed"]: run for run in theirs.runs}
    pairs = [(run, others[run["seed"]]) for run in ours.runs if run["seed"] in others]
    passed = tuple(seconds_to_pass(a["curve"], b["curve"][-1][1]) for a, b in pairs)
    return Versus(
        ours.name,
        theirs.name,
        tuple(a["psnr"] - b["psnr"] for a, b in pairs),
        passed,
        tuple(
            None if after is None else b["curve"][-1][0] / after
            for after, (_, b) in zip(passed, pairs)
        ),
        tuple(_rendering(b) / _rendering(a) for a, b in pairs),
    )


def rivals(lines: Sequence[Line]) -> list[Versus]:
    """Each learned occupancy against what else its method was run with, where seeds are shared."""
    found = [
        versus(ours, theirs)
        for ours in lines
        for theirs in lines
        if ours.learned and not theirs.learned and ours.method == theirs.method
    ]
    return [one for one in found if one.gains]


def _rendering(run: Mapping[str, Any]) -> float:
    return float(run["render_seconds_per_image"])
