"""What nerfstudio logs of a rendered image: figures, and pictures beside the truth."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.evaluation.metrics import image_metrics


def image_figures(
    outputs: dict[str, Tensor], truth: Tensor
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Figures of one image (see `image_metrics`), and pictures for the log.

    Args:
        outputs: `rgb` [H, W, 3], `accumulation` and `depth` [H, W, 1].
        truth: [H, W, 3] behind the method's own background.
    """
    from nerfstudio.utils import colormaps

    predicted = outputs["rgb"].clamp(0.0, 1.0)
    pictures = {
        "img": torch.cat([truth, predicted], dim=1),
        "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
        "depth": colormaps.apply_depth_colormap(
            outputs["depth"], accumulation=outputs["accumulation"]
        ),
    }
    return image_metrics(predicted, truth), pictures
