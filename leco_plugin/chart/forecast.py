"""About how long runs take on two CPU cores, said before any of them is made."""

from __future__ import annotations

from collections.abc import Iterable

from leco_plugin.chart.contender import Contender
from leco_plugin.chart.methods import DENSE
from leco_plugin.chart.protocol import Protocol
from leco_plugin.models.hosts.guided_start import OWN_SAMPLER

STEP_SECONDS = 0.15
"""Of a training step where steps end a run: 200 that learn an occupancy and 200 guided ones take
45 s of two threads, and 1.38 times that with one, beside another run."""
OVERHEAD_SECONDS = 30.0
"""Start, looks and the last images of a run that skips, with one thread; 18 to 23 with two."""
UNGUIDED_SECONDS = 25.0
"""Beyond that, of a run that skips nothing: 15 with two threads on cities, 30 on surveys."""
GRIDS_SECONDS = 100.0
"""Making grids from the field of a run, those of 512^3 cells among them."""


def run_seconds(contender: Contender, protocol: Protocol) -> float:
    """Of one run, from the start of its process to the end."""
    ends = []
    if protocol.seconds is not None:
        ends.append(protocol.seconds)
    if protocol.steps is not None:
        ends.append(protocol.steps * STEP_SECONDS)
    seconds = contender.budget * min(ends) + OVERHEAD_SECONDS
    if contender.sampler in (DENSE, OWN_SAMPLER):
        seconds += UNGUIDED_SECONDS
    return seconds + (GRIDS_SECONDS if contender.grids else 0.0)


def minutes(contenders: Iterable[Contender], protocol: Protocol) -> float:
    """Of one run of each contender that is given, as many at a time as the protocol says."""
    return sum(run_seconds(one, protocol) for one in contenders) / protocol.at_once / 60.0
