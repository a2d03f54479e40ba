"""About how long runs take on two CPU cores, said before any of them is made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.methods import DENSE
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.hosts.guided_start import OWN_SAMPLER


@dataclass(frozen=True)
class Cores:
    """Seconds of parts of runs on two cores of one machine, each of which makes a run."""

    step: float
    """A training step where steps end a run: half of them learn an occupancy."""
    overhead: float
    """Start, looks and the last images of a run that skips."""
    unguided: float
    """Beyond that, of a run that skips nothing."""
    grids: float
    """Making grids from the field of a run, those of 512^3 cells among them, and teaching small
    gates by it."""


FAST = Cores(step=0.15, overhead=30.0, unguided=25.0, grids=140.0)
"""An AMD EPYC with AVX-512 bfloat16; cities, and surveys of 480 x 360 pixels."""
SLOW = Cores(step=0.45, overhead=45.0, unguided=60.0, grids=280.0)
"""A Xeon with it at a third of that speed, whose caches are shared with other machines."""


def run_seconds(contender: Contender, protocol: Protocol, cores: Cores) -> float:
    """Of one run, from the start of its process to the end."""
    ends = []
    if protocol.seconds is not None:
        ends.append(protocol.seconds)
    if protocol.steps is not None:
        ends.append(protocol.steps * cores.step)
    seconds = contender.budget * min(ends) + cores.overhead
    if contender.sampler in (DENSE, OWN_SAMPLER):
        seconds += cores.unguided
    return seconds + (cores.grids if contender.grids else 0.0)


def minutes(contenders: Iterable[Contender], protocol: Protocol, cores: Cores) -> float:
    """Of one run of each contender that is given, as many at a time as the protocol says."""
    seconds = sum(run_seconds(one, protocol, cores) for one in contenders)
    return seconds / protocol.at_once / 60.0


def about(contenders: Iterable[Contender], protocol: Protocol) -> str:
    """The same in words, for fast cores and for slow ones."""
    given = list(contenders)
    fast, slow = (max(1, round(minutes(given, protocol, cores))) for cores in (FAST, SLOW))
    if fast == slow:
        return f"about {fast} minute{'s' if fast > 1 else ''} on two CPU cores"
    return f"about {fast} to {slow} minutes on two CPU cores, by their speed"
