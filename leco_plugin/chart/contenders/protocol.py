"""How long every run of a chart trains, and how it is looked at: the same for all of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from leco_plugin.evaluation.clock import Budget
from leco_plugin.scenes.input_error import InputError

LEARN_SHARE = 0.4
"""Of the training time, at most, for learning an occupancy; short runs need most of that."""
SEEDS = 1 << 32
"""As many as numpy takes."""


@dataclass(frozen=True)
class Protocol:
    """Time or steps, and what is evaluated."""

    seconds: float | None = None
    """Training time of a run."""
    steps: int | None = None
    """Training steps of a run; the run ends with the first of the two."""
    learn_seconds: float | None = None
    """Most of it that learning an occupancy may take, about; None is a share of `seconds`."""
    images: int = 2
    """Whole test images that are rendered at the end."""
    curve_points: int = 6
    """Looks at the test images while training, off the clock."""
    at_once: int = 1
    """Runs beside each other, which share the threads of the machine."""

    def __post_init__(self) -> None:
        self.budget()
        counts = {
            "images": self.images,
            "curve points": self.curve_points,
            "runs at once": self.at_once,
        }
        if (
            self.seconds is not None
            and self.learn_seconds is not None
            and self.learn_seconds >= self.seconds
        ):
            raise ValueError(
                f"learning an occupancy may take {self.learn_seconds:g} s of a run of "
                f"{self.seconds:g} s, which leaves nothing to be guided: give less"
            )
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"at least one of the {name} is needed, not {count}")

    def budget(self, times: float = 1.0) -> Budget:
        """Of a run that is given a multiple of the time and the steps; learning is not prolonged.

        Raises:
            ValueError: a time or a number of steps is missing or not positive.
        """
        learning = self.learn_seconds
        if learning is None and self.seconds is not None:
            learning = LEARN_SHARE * self.seconds
        return Budget(
            None if self.seconds is None else times * self.seconds,
            None if self.steps is None else round(times * self.steps),
            learning,
        )

    def threads(self, of_machine: int) -> int:
        """Of each run."""
        return max(1, of_machine // self.at_once)

    def describe(self) -> str:
        """In a few words."""
        parts = []
        if self.seconds is not None:
            parts.append(f"{self.seconds:g} s")
        if self.steps is not None:
            parts.append(f"{self.steps} steps")
        return " or ".join(parts)


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
