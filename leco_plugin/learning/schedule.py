"""When the first phase of a run ends, and how far its late losses have come in by then."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torch import Tensor

from leco_plugin.learning.run import Progress
from leco_plugin.scenes.input_error import require

KEPT_ABOVE = 0.1
"""o(x) from which a sample counts as kept before there is a calibrated threshold."""
MOST_EXTENSIONS = 2
"""How often a gate that has not settled is given more steps."""

LONGEST = 4
"""Times `learn_steps` that a long run learns for at most: longer phases were not tried."""

RATES = {"encoding": 2e-2, "field": 1e-2, "gate": 5e-3}
"""Learning rates of `leco-occupancy` for each of its parameter groups."""
HELD = 0.75
"""Share of a run through which learning rates stay full; then they fall to zero in a line."""


def rate_at(share: float) -> float:
    """Factor of learning rates at a share of a run, in [0, 1] (a cooldown, arXiv 2405.18392)."""
    return min(1.0, max(0.0, (1.0 - share) / (1.0 - HELD)))


@dataclass(frozen=True)
class ScheduleConfig:
    """When the gate is frozen."""

    freeze: bool = True
    """Whether the gate is ever frozen; False is the plain HMoE, for comparison."""
    restart: bool = False
    """Whether the field starts anew when the gate is frozen, for comparison; else it goes on from
    what it has learned."""
    learn_steps: int = 200
    """Steps after which the gate is frozen even if a few of its decisions still change; of a long
    run `learn_share` makes them more."""
    learn_share: float = 0.0
    """Of leco-occupancy: share of the run's steps in which the gate is learned, where those are
    more than `learn_steps`; at most four times as many. From 0 to 0.5. The options below then mean
    these steps by `learn_steps`."""
    settled: float = 0.92
    """Share of probe positions whose decision must be the same in the last two checks; else the
    gate learns on for a quarter of `learn_steps`, at most twice."""
    earliest: float = 0.85
    """Share of `learn_steps` before which it is never frozen."""
    ramp_from: float = 0.3
    """Share of `learn_steps` at which the distortion loss begins to come in."""
    ramp_to: float = 0.7
    """Share of `learn_steps` from which it has its full weight."""
    steps_per_record: int = 0
    """Of leco-occupancy: steps between two entries of `occupancy_history.safetensors` in the run's
    folder, from which `leco inspect` draws how the occupancy was learned; 0 writes none."""
    steps_per_check: int = 25
    """Steps between two checks of whether the gate has settled."""
    agreement: float = 0.99
    """Share of probe positions whose decision is the same in two checks running, from which on the
    gate is frozen, after `earliest`."""

    def __post_init__(self) -> None:
        require(self.learn_steps >= 1, "schedule.learn-steps", self.learn_steps, "at least 1")
        often = self.steps_per_check
        require(often >= 1, "schedule.steps-per-check", often, "at least 1")
        for name in ("settled", "earliest", "ramp_from", "ramp_to", "agreement"):
            share = getattr(self, name)
            require(0.0 <= share <= 1.0, f"schedule.{name.replace('_', '-')}", share, "from 0 to 1")
        share = self.learn_share
        require(0.0 <= share <= 0.5, "schedule.learn-share", share, "from 0 to 0.5")
        start, end = self.ramp_from, self.ramp_to
        require(start <= end, "schedule.ramp-from", start, f"at most ramp-to, {end}")
        every = self.steps_per_record
        require(every >= 0, "schedule.steps-per-record", every, "at least 0")


def ramp(step: int, config: ScheduleConfig) -> float:
    """How far the distortion loss has come in, and what comes in with it, at a step since
    `Progress.began`: in [0, 1].

    From the first step on it would press all weight onto the ends of the rays: a flat picture
    behind the scene. First the views have to find the surfaces.
    """
    start, end = (share * config.learn_steps for share in (config.ramp_from, config.ramp_to))
    return min(1.0, max(0.0, (step - start) / max(1.0, end - start)))


def converged(step: int, agreement: float, config: ScheduleConfig) -> bool:
    """Whether to freeze at this check, so many steps after `Progress.began`; `agreement` is the
    share of probe decisions equal to those of the check before, 0 at the first."""
    early = step + 1 < config.earliest * config.learn_steps
    return step + 1 >= config.learn_steps or (not early and agreement >= config.agreement)


def steps_in(end: float, config: ScheduleConfig) -> int:
    """Steps of the first phase in a run of `end` steps, infinite where nobody knows how many."""
    share = config.learn_share * end if math.isfinite(end) else 0.0
    return int(min(max(config.learn_steps, share), LONGEST * config.learn_steps))


def steps_of_an_extension(learn_steps: int) -> int:
    """Steps of an extension, for a gate that has not settled after so many steps of learning."""
    return max(1, learn_steps // 4)


def schedule_since(schedule: ScheduleConfig, progress: Progress) -> ScheduleConfig:
    """The schedule with `learn_steps` counted from `progress.began`, extensions included."""
    return replace(schedule, learn_steps=progress.learn_steps - progress.began)


def is_unsettled(step: int, agreement: float, config: ScheduleConfig, extensions: int) -> bool:
    """Whether a gate at its step limit should learn on; step and agreement as for `converged`.
    `extensions` says how often it has done so already."""
    looked_often = step + 1 >= 4 * config.steps_per_check
    return looked_often and agreement < config.settled and extensions < MOST_EXTENSIONS


def decisions_agree(before: Tensor, now: Tensor) -> float:
    """Share of equal decisions of two bool [P] tensors; 0 when there were none before."""
    if len(before) != len(now) or len(now) == 0:
        return 0.0
    return float((before == now).float().mean())
