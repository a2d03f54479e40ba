"""Settings of `leco-occupancy`'s model, and its optimizer."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.models.base_model import ModelConfig

from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.merging import MergingConfig
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.learning.sharpening import SharpeningConfig
from leco_plugin.models.objective import GateLossConfig
from leco_plugin.models.sizing.sizes import SMALL, Sizes
from leco_plugin.occupancy import Precision
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.input_error import InputError, require


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam, all parameters of a group in one kernel"""

    lr: float = 1e-2
    """Learning rate."""
    eps: float = 1e-15
    """Small, because the gradients of a hash table are (Instant-NGP, section 4)."""
    fused: bool = True
    """One kernel for all parameters."""


def _model() -> type:
    from leco_plugin.models.leco import LecoModel

    return LecoModel


@dataclass
class LecoModelConfig(ModelConfig):
    """Learned occupancy: learn, freeze and calibrate, go on guided"""

    _target: type = field(default_factory=_model)
    """target class to instantiate"""
    enable_collider: bool = False
    """Rays are cut at the scene's own bounds instead."""
    eval_num_rays_per_chunk: int = 4096
    """Rays rendered at a time."""
    sizes: Sizes = field(default_factory=lambda: SMALL)
    """Sizes of gate, field and batches. Those that are 0 are chosen from scene and device."""
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)
    """When the gate is frozen."""
    gate_loss: GateLossConfig = field(default_factory=GateLossConfig)
    """What teaches the gate."""
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    """What skipping may cost."""
    merging: MergingConfig = field(default_factory=MergingConfig)
    """Which scene experts are left when the gate is frozen."""
    sharpening: SharpeningConfig = field(default_factory=SharpeningConfig)
    """How a small gate is taught by the field, and skips in place of the learned one."""
    distortion: float = 0.05
    """Weight of the distortion loss, which clears haze (mip-NeRF 360, eq. 15)."""
    termination: float = 0.03
    """Weight, while the occupancy is learned, of ending rays at the sparse points they lead to."""
    nearness: float = 0.03
    """Weight, while the occupancy is learned, of taking the farther of two explanations of a ray:
    a dark sky is no dark cloud before the camera. Comes in with the distortion loss; in a bounded
    scene for pixels that are nearly black."""
    transparency: float = 1.0
    """Weight of leaving what is seen through transparent pixels to the backdrop."""
    ground: float = 0.1
    """Weight, while the occupancy is learned in a scene from above, of meeting the ground: a ray
    that would end below the lowest sparse point ends before, or bare ground would be left to the
    backdrop. Comes in with the distortion loss; not with altitudes set by hand."""
    look_everywhere: float = 0.125
    """Share of rays that shade all candidates while the others follow the gate being learned."""
    likely_above: float = 0.05
    """o(x) from which those others shade a candidate. The log counts as kept what reaches this and
    0.1."""
    distortion_after: float = 0.04
    """Share of the distortion loss that stays when the first phase is over and detail is wanted."""
    front_to_back: bool | None = None
    """Whether rendering shades from the front, nothing behind opaque surfaces and one of two faint
    neighbours: fewer samples for the same image, and more steps to get there. None: where that was
    measured to be no slower, which is in C on a CPU and, without C, for guided batches of 2048 rays
    or more there."""
    homogeneous: bool = False
    """A mixture of scene experts only, for comparison: no empty-space expert, nothing to freeze.
    With one scene expert, as most scenes have, it mixes nothing: set `sizes.gate.scene-experts`."""
    precision: Precision | None = None
    """Of matrix products, while learning and wherever the gate is asked; None is what the device is
    fastest in. What C renders on a CPU is in float32."""
    near: float | None = None
    """Where rays begin, scene units; None is found from the data."""
    far: float | None = None
    """Where rays end, scene units; None is found from the data."""
    bounds: BoundsConfig = field(default_factory=BoundsConfig)
    """Where the scene lies, where the data do not say it right."""

    def __post_init__(self) -> None:
        everywhere, above = self.look_everywhere, self.likely_above
        require(0.0 <= everywhere <= 1.0, "look-everywhere", everywhere, "from 0 to 1")
        require(0.0 <= above < 1.0, "likely-above", above, "at least 0 and below 1")
        weights = ("distortion", "termination", "nearness", "transparency", "ground")
        for name in (*weights, "distortion_after"):
            option, weight = name.replace("_", "-"), getattr(self, name)
            require(0.0 <= weight < math.inf, option, weight, "a number, at least 0")
        if self.homogeneous and self.schedule.steps_per_record > 0:
            raise InputError(
                "schedule.steps-per-record draws how an occupancy is learned, and homogeneous "
                "learns none: leave one of them out"
            )
