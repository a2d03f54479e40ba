"""How long each run of a chart trains, how it is evaluated, and a forecast of how long it takes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from leco_plugin.chart.contender import DENSE, Contender
from leco_plugin.evaluation.clock import Budget
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import HeldOut

LEARN_SHARE = 0.4
"""Most of the training time for learning an occupancy; short runs need most of that."""
SEEDS = 1 << 32
"""Seeds that numpy takes."""


@dataclass(frozen=True)
class Protocol:
    """Training time or steps, and what is evaluated: the same for all runs of a chart."""

    seconds: float | None = None
    """Training time of a run."""
    steps: int | None = None
    """Training steps of a run; the run ends with the first of the two."""
    learn_seconds: float | None = None
    """Limit, about, for learning an occupancy; None is a share of `seconds`."""
    images: int = 2
    """Whole test images rendered at the end."""
    curve_points: int = 6
    """Evaluations on test pixels while training, off the clock."""
    at_once: int = 1
    """Runs at a time, which share the threads of the machine."""
    held_out: HeldOut = "spread"
    """Which photographs are tested."""

    def __post_init__(self) -> None:
        self.budget()
        if self.seconds and self.learn_seconds and self.learn_seconds >= self.seconds:
            raise ValueError(
                f"learning an occupancy may take {self.learn_seconds:g} s of a run of "
                f"{self.seconds:g} s, which leaves nothing to be guided: give less"
            )
        counts = {
            "images": self.images,
            "curve points": self.curve_points,
            "runs at once": self.at_once,
        }
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"at least one of the {name} is needed, not {count}")

    def budget(self) -> Budget:
        """When a run is over.

        Raises:
            ValueError: a time or a number of steps is missing or not positive.
        """
        learning = self.learn_seconds
        if learning is None and self.seconds is not None:
            learning = LEARN_SHARE * self.seconds
        return Budget(self.seconds, self.steps, learning)

    def threads(self, of_machine: int) -> int:
        """Threads of each run."""
        return max(1, of_machine // self.at_once)

    def describe(self) -> str:
        """Time and steps in a few words."""
        seconds = [] if self.seconds is None else [f"{self.seconds:g} s"]
        steps = [] if self.steps is None else [f"{self.steps} steps"]
        return " or ".join(seconds + steps)


def require_seeds(seeds: Iterable[int]) -> None:
    """Refuses what numpy does not take as a seed.

    Raises:
        InputError: one is no such number.
    """
    for seed in seeds:
        if not 0 <= seed < SEEDS:
            raise InputError(f"a seed is a whole number from 0 to {SEEDS - 1}, not {seed}")


def settings_of(
    scene: dict[str, Any], protocol: Protocol, suite: str | None, machine: dict[str, Any]
) -> dict[str, Any]:
    """What the runs of one chart share; runs with other settings are not comparable."""
    from leco_plugin import __version__

    return {
        "format": 1,
        "scene": scene,
        "suite": suite,
        **asdict(protocol),
        "machine": machine,
        "version": __version__,
    }


@dataclass(frozen=True)
class Cores:
    """Seconds that the parts of a run take on two cores of one machine."""

    step: float
    """A training step where steps end a run: half of them learn an occupancy."""
    overhead: float
    """Start, evaluations and the last images of a run that skips."""
    unguided: float
    """More of that in a run that skips nothing."""
    grids: float
    """Making grids up to 512^3 from the field of a run, and teaching small gates by it."""


FAST = Cores(step=0.15, overhead=30.0, unguided=25.0, grids=140.0)
"""An AMD EPYC with AVX-512 bfloat16; cities, and surveys of 480 x 360 pixels."""
SLOW = Cores(step=0.45, overhead=45.0, unguided=60.0, grids=280.0)
"""A Xeon with it at a third of that speed, whose caches are shared with other machines."""


def run_seconds(contender: Contender, protocol: Protocol, cores: Cores) -> float:
    """Forecast of one run, from the start of its process to the end."""
    ends = []
    if protocol.seconds is not None:
        ends.append(protocol.seconds)
    if protocol.steps is not None:
        ends.append(protocol.steps * cores.step)
    seconds = min(ends) + cores.overhead
    if contender.sampler in (DENSE, OWN_SAMPLER):
        seconds += cores.unguided
    return seconds + (cores.grids if contender.grids else 0.0)


def forecast_minutes(contenders: Iterable[Contender], protocol: Protocol, cores: Cores) -> float:
    """Forecast of one run of each contender, as many at a time as the protocol says."""
    seconds = sum(run_seconds(one, protocol, cores) for one in contenders)
    return seconds / protocol.at_once / 60.0


def forecast(contenders: Iterable[Contender], protocol: Protocol) -> str:
    """The same in words, for fast cores and for slow ones."""
    given = list(contenders)
    fast, slow = (max(1, round(forecast_minutes(given, protocol, one))) for one in (FAST, SLOW))
    if fast == slow:
        return f"about {fast} minute{'s' if fast > 1 else ''} on two CPU cores"
    return f"about {fast} to {slow} minutes on two CPU cores, by their speed"
