"""What the three hosts share: the comparison with photographs."""

from __future__ import annotations

from typing import Any

from nerfstudio.models.base_model import Model
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio


class PhotographicModel(Model):
    """A model with outputs `rgb` [..., 3], `accumulation` and `depth` [..., 1]."""

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Any]:
        truth = batch["image"].to(self.device)[..., :3]
        return {"psnr": peak_signal_noise_ratio(outputs["rgb"], truth, data_range=1.0)}

    def get_loss_dict(
        self,
        outputs: dict[str, Any],
        batch: dict[str, Tensor],
        metrics_dict: dict[str, Any] | None = None,
    ) -> dict[str, Tensor]:
        truth = batch["image"].to(self.device)[..., :3]
        return {"colour_loss": (outputs["rgb"] - truth).square().mean()}

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        return {"psnr": float(self.get_metrics_dict(outputs, batch)["psnr"])}, {
            "img": outputs["rgb"]
        }
