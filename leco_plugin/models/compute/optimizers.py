"""The optimizer of `leco-occupancy`, as nerfstudio configures it."""

from __future__ import annotations

from dataclasses import dataclass

from nerfstudio.engine.optimizers import AdamOptimizerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam, all parameters of a group in one kernel"""

    lr: float = 1e-2
    """Learning rate."""
    eps: float = 1e-15
    """Small, because the gradients of a hash table are (Instant-NGP, section 4)."""
    fused: bool = True
    """One kernel for all parameters."""
