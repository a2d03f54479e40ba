"""The price of skipping, measured again during guided training, as the field improves.

Calibration bounds the price for the field at that moment. Afterwards the price is measured at
intervals, on a few held-out rays that calibration did not use. `PriceWatch` reports when it exceeds
its bounds, or when the gate keeps nothing at all. The caller decides what to do.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, Protocol

import torch
from torch import Tensor

from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.collapse import SUSPECTED_STEPS
from leco_plugin.learning.run import WatchState
from leco_plugin.models.compute.ranks import from_first, mean
from leco_plugin.on_cpu import in_float64

REMEMBERED = 0.8
"""How much the rays of a measurement count beside those of the next: the field goes on learning."""
SURE_AGAIN = 2.0
"""Standard errors by which a price must be beyond its bound: twice `calibration.SURE`, because many
measurements follow one another. With fewer, chance alone would lower a sound gate's threshold step
by step to nothing."""
SHARE_OF_TIME = 0.01
"""Of guided training, the largest share that measuring again may take."""


class Evidence(NamedTuple):
    """How far rays are beyond a bound on average, from sums in which older rays count less."""

    rays: float = 0.0
    total: float = 0.0
    squares: float = 0.0

    def with_rays(self, values: Tensor, most: float) -> Evidence:
        """With the excesses [R] over a bound of one more measurement; those that are not finite are
        no evidence. `most` rays there are: measured again and again they are no more evidence."""
        values = in_float64(values[values.isfinite()])
        new = (float(len(values)), float(values.sum()), float(values.square().sum()))
        sums = [REMEMBERED * old + more for old, more in zip(self, new)]
        share = min(1.0, most / max(sums[0], 1e-9))
        return Evidence(*(share * total for total in sums))

    def exceeds(self) -> bool:
        """Whether the mean is above 0 by more than `SURE_AGAIN` standard errors."""
        if self.rays <= 1.0:
            return False
        mean = self.total / self.rays
        variance = max(0.0, self.squares / self.rays - mean * mean)
        return mean > 0.0 and mean > SURE_AGAIN * math.sqrt(variance / self.rays)


class PriceSource(Protocol):
    """Renders held-out rays with and without skipping, and leaves what it renders as it was."""

    def prepare(self) -> None:
        """Called before a measurement in every process; only the first one measures."""
        return None

    def excesses(self, seed: int) -> dict[str, Tensor]:
        """By how much rays [R] are beyond the bound of each price, by its name: above 0 is too
        much."""

    def count_rays(self, limit: int) -> float:
        """How many rays there are to measure with; at least `limit` may be said as `limit`."""


class Finding(NamedTuple):
    """What a watch has found after a step."""

    kind: Literal["nothing kept", "beyond", "within"]
    why: str = ""
    """The prices that are beyond their bounds, in words."""


class PriceWatch:
    """Stands beside guided training, on the device of the process; changes its state in place."""

    def __init__(
        self,
        state: WatchState,
        source: PriceSource,
        config: CalibrationConfig,
        device: torch.device,
    ) -> None:
        self.state, self.source, self.config, self.device = state, source, config, device
        self.steps, self.seconds = 0, 0.0

    def after_step(self, step: int, seconds: float, kept: float, skips: bool) -> Finding | None:
        """Looks at a step; measures again where that is due. None is nothing to act on.

        Args:
            seconds: that the step took.
            kept: what the gate kept of its batch, in this process, in any unit: 0 is nothing.
            skips: whether it skips anything.
        """
        self.steps, self.seconds = self.steps + 1, self.seconds + seconds
        if self._keeps_nothing(step, kept) and skips:
            return Finding("nothing kept")
        if self.config.recheck_rays == 0:
            return None
        if self.state.due == 0 or (step >= self.state.due and not skips):
            self.put_off(step)
        return self._measure(step) if step >= self.state.due else None

    def put_off(self, step: int) -> None:
        """The next measurement is made after the fewest steps."""
        self.state.due = step + self.config.steps_per_recheck

    def _keeps_nothing(self, step: int, kept: float) -> bool:
        """Whether no process has kept a sample for `SUSPECTED_STEPS` steps; all say the same."""
        if mean(kept, self.device) > 0.0:
            self.state.nothing_since = -1
            return False
        if self.state.nothing_since < 0:
            self.state.nothing_since = step
        return step - self.state.nothing_since >= SUSPECTED_STEPS

    @torch.no_grad()
    def _measure(self, step: int) -> Finding:
        state, started = self.state, seconds_now()
        self.source.prepare()
        state.evidence = from_first(self._evidence, self.device)
        state.rechecks += 1
        seconds, a_step = seconds_now() - started, self.seconds / self.steps
        state.due = step + from_first(
            lambda: steps_until_next(self.config, seconds, a_step), self.device
        )
        beyond = [name for name, sums in state.evidence.items() if Evidence(*sums).exceeds()]
        return Finding("beyond" if beyond else "within", " and ".join(beyond))

    def _evidence(self) -> dict[str, tuple[float, ...]]:
        found = self.source.excesses(self.state.rechecks + 1)
        most = self.source.count_rays(math.ceil(self.config.recheck_rays / (1.0 - REMEMBERED)))
        before = self.state.evidence
        return {
            name: tuple(Evidence(*before.get(name, ())).with_rays(values, most))
            for name, values in found.items()
        }


def steps_until_next(config: CalibrationConfig, seconds: float, a_step: float) -> int:
    """Steps between two measurements, by the seconds of the last one and of a training step."""
    within_share = math.ceil(seconds / (SHARE_OF_TIME * max(a_step, 1e-9)))
    return max(config.steps_per_recheck, within_share)
