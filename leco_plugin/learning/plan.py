"""What one training step does: how it samples, and what it teaches."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.collapse import annealed, is_dense
from leco_plugin.learning.merging import MergingConfig
from leco_plugin.learning.progress import Progress
from leco_plugin.learning.schedule import ScheduleConfig, ramp, schedule_since
from leco_plugin.learning.sharpening import SharpeningConfig
from leco_plugin.models.mixture import Following
from leco_plugin.models.objective import GateLossConfig


class LearnerConfig(Protocol):
    """What a learner reads of the settings of a method; see `LecoModelConfig`."""

    schedule: ScheduleConfig
    gate_loss: GateLossConfig
    calibration: CalibrationConfig
    merging: MergingConfig
    sharpening: SharpeningConfig
    termination: float
    look_everywhere: float
    likely_above: float
    homogeneous: bool


class StepPlan(NamedTuple):
    """How one training step samples and what it teaches."""

    step: int
    coarse: bool
    """Whether rays are marched in the coarse steps of the first phase."""
    ramped: float
    """How far the distortion loss has come in, in [0, 1]."""
    following: Following | None
    """Which candidates the gate being learned leaves out; None leaves out none."""
    gate_loss: GateLossConfig | None
    """What teaches the gate; None once it is frozen."""


def plan_of(
    step: int, config: LearnerConfig, progress: Progress, learning: bool, frozen: bool
) -> StepPlan:
    """How a step samples and what it teaches.

    Args:
        learning: whether the occupancy is still learned.
        frozen: whether the gate is frozen.
    """
    ramped = ramp(step - progress.began, schedule_since(config.schedule, progress))
    coarse = learning or ramped < 1.0
    # a homogeneous gate is taught nothing about emptiness
    follows = coarse and ramped > 0.0 and not is_dense(progress, step) and not config.homogeneous
    return StepPlan(
        step,
        coarse,
        ramped,
        Following(config.likely_above, config.look_everywhere) if follows else None,
        None if frozen else annealed(config.gate_loss, progress, step),
    )
