"""How long suites take on two CPU cores, by the forecasts of `leco chart`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from leco_plugin.chart.contender import Cores, Protocol, forecast_minutes
from leco_plugin.chart.methods import SUITES, Suite

CPU_STEPS = 400
"""Of a run on a CPU, in suites that ask what was learned."""


def on_two_cores(suite: Suite) -> Protocol:
    """The protocol of a suite on two CPU cores, for forecasts on any machine."""
    steps = CPU_STEPS if suite.seconds is None else None
    return replace(suite.protocol, steps=steps, at_once=2)


def minutes_of(suite: Suite, cores: Cores, seeds: int = 3) -> float:
    """Forecast of all its runs."""
    return seeds * forecast_minutes(suite.contenders, on_two_cores(suite), cores)


def minutes_together(names: Sequence[str], cores: Cores) -> float:
    """Minutes of three seeds on two CPU cores when each takes over what others have made."""
    made: set[tuple[str, Protocol]] = set()
    minutes = 0.0
    for one in (SUITES[name] for name in names):
        new = [c for c in one.contenders if (c.alone().key, one.protocol) not in made]
        made |= {(contender.alone().key, one.protocol) for contender in new}
        minutes += 3 * forecast_minutes(new, on_two_cores(one), cores)
    return minutes
