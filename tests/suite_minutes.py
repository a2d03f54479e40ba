"""How long suites take together, by the forecasts of `leco chart` for what is left to do."""

from __future__ import annotations

from collections.abc import Sequence

from leco_plugin.chart.contender import Cores, Protocol, forecast_minutes
from leco_plugin.chart.methods import SUITES


def minutes_together(names: Sequence[str], cores: Cores) -> float:
    """Minutes of three seeds on two CPU cores when each takes over what others have made."""
    made: set[tuple[str, Protocol]] = set()
    minutes = 0.0
    for one in (SUITES[name] for name in names):
        new = [c for c in one.contenders if (c.alone().key, one.protocol) not in made]
        made |= {(contender.alone().key, one.protocol) for contender in new}
        minutes += 3 * forecast_minutes(new, one.on_two_cores, cores)
    return minutes
