"""What nerfstudio 1.1.5 keeps to itself; its models without a network for LPIPS, and the
photographs that they are compared with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn

from leco_plugin.evaluation.metrics import LPIPS_MINIMUM_SIDE, LpipsBackbone, lpips_metric


class LazyLpipsNetwork(nn.Module):
    """Stands where torchmetrics keeps its LPIPS network, and loads that network when it is called.
    It has no parameters: a checkpoint is the same whether or not LPIPS was ever computed."""

    def __init__(self, net: LpipsBackbone = "alex", **_: Any) -> None:
        super().__init__()
        self.backbone: LpipsBackbone = net

    def forward(self, first: Tensor, second: Tensor, **options: Any) -> Tensor:
        """[N, 1, 1, 1] distances of two [N, 3, H, W] batches; NaN where LPIPS cannot be had."""
        metric = (
            lpips_metric(self.backbone) if min(first.shape[-2:]) >= LPIPS_MINIMUM_SIDE else None
        )
        if metric is None:
            return first.new_full((len(first), 1, 1, 1), math.nan)
        return metric.to(first.device).net(first, second, **options)


@contextmanager
def lazy_lpips() -> Iterator[None]:
    """While this lasts, every `LearnedPerceptualImagePatchSimilarity` that is made loads lazily:
    its network's class is exchanged, which reaches hosts that imported the metric long before."""
    from torchmetrics.image import lpip

    eager_network = lpip._NoTrainLpips
    lpip._NoTrainLpips = LazyLpipsNetwork  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        lpip._NoTrainLpips = eager_network  # type: ignore[misc]


def true_colours(host: Any, image: Tensor) -> Tensor:
    """What the host should show of pixels [..., 3 or 4]: before its own background, [..., 3]. Its
    models render premultiplied colours, and photographs have straight ones."""
    blend = getattr(getattr(host, "renderer_rgb", None), "blend_background", None)
    blended: Tensor = image[..., :3] if blend is None else blend(image)
    return blended


def outputs_of(dataset: Any) -> Any:
    """The `DataparserOutputs` that an `InputDataset` was made of: its masks and its alpha colour
    stand nowhere else, and its data manager's are of the training split."""
    return dataset._dataparser_outputs


def run_training(trainer: Any) -> None:
    """nerfstudio's training loop, which ends after its last step: without a last checkpoint, a
    banner and a viewer, which no option of `TrainerConfig` turns off together."""
    trainer._after_train = lambda: None
    trainer.train()
