"""What Switch-NeRF is taught by a batch, and the figures that the log carries."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.models.losses import balance_loss, expert_shares
from leco_plugin.models.rendering import Shaded


def switch_losses(shaded: Shaded, truth: Tensor, balance: float) -> dict[str, Tensor]:
    """Colour loss and balanced gate loss (Switch-NeRF, section 3.3).

    Args:
        truth: [R, 3] colours of the pixels.
        balance: weight of the balanced gate loss.
    """
    losses = {"rgb_loss": torch.nn.functional.mse_loss(shaded.rgb, truth)}
    if len(shaded.routes) > 0:
        probabilities = shaded.logits.softmax(dim=-1)
        losses["gate_loss"] = balance * balance_loss(probabilities, shaded.routes)
    return losses


@torch.no_grad()
def switch_statistics(shaded: Shaded, truth: Tensor) -> dict[str, Tensor]:
    """PSNR of the batch, its number of samples, and the share of points of each expert from 1."""
    error = torch.nn.functional.mse_loss(shaded.rgb, truth)
    figures = {
        "psnr": -10.0 * torch.log10(error.clamp(min=1e-12)),
        "num_samples_per_batch": shaded.packed_info[:, 1].sum().float(),
    }
    shares = expert_shares(shaded.routes, shaded.logits.shape[-1])
    return figures | {f"share_expert_{i + 1}": share for i, share in enumerate(shares)}
