"""PSNR, SSIM and LPIPS of one rendered image.

LPIPS is loaded at its first use and is never fetched: on a machine without its weights it is
left out, with one warning that says what to put where.
"""

from __future__ import annotations

import functools
import math
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

LpipsBackbone = Literal["alex", "vgg", "squeeze"]

_TORCHVISION_NAMES = {"alex": "alexnet", "vgg": "vgg16", "squeeze": "squeezenet1_1"}

# Below this AlexNet's second pooling has nothing left to pool.
LPIPS_MINIMUM_SIDE = 31


class LpipsUnavailable(UserWarning):
    """LPIPS was asked for, and its network cannot be loaded on this machine."""


def image_metrics(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """The figures that ns-eval averages over images.

    Args:
        predicted: [H, W, 3] float, colours in 0..1.
        truth: [H, W, 3] float, colours in 0..1, on the same device.
    Returns:
        `psnr` (dB), `ssim`, and `lpips` where its network is at hand. The key is absent
        otherwise, because nerfstudio turns every value into a float and a NaN is no JSON; a
        report of ours writes null in its place.
    """
    metrics = {"psnr": psnr(predicted, truth), "ssim": ssim(predicted, truth)}
    distance = lpips(predicted, truth)
    if distance is not None:
        metrics["lpips"] = distance
    return metrics


def psnr(predicted: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of colours in 0..1, both [H, W, 3]; infinite if equal."""
    squared_error = torch.mean((predicted - truth) ** 2, dtype=torch.float64).item()
    return -10.0 * math.log10(squared_error) if squared_error > 0 else math.inf


def ssim(predicted: Tensor, truth: Tensor) -> float:
    """Structural similarity of two [H, W, 3] images, at most 1, as nerfstudio's models compute it.

    They leave the data range to torchmetrics, which takes it from the two images: kept, so that a
    figure of ours stands beside one of a built-in method.
    """
    from torchmetrics.functional.image import structural_similarity_index_measure

    similarity = structural_similarity_index_measure(_batched(predicted), _batched(truth))
    assert isinstance(similarity, Tensor)  # a tuple only if further images are asked for
    return float(similarity)


def lpips(predicted: Tensor, truth: Tensor) -> float | None:
    """Learned perceptual distance (AlexNet, as in nerfstudio) of two [H, W, 3] images in 0..1.

    Returns:
        A distance >= 0, or None where its network is not at hand or a side is under
        `LPIPS_MINIMUM_SIDE` pixels.
    """
    if min(predicted.shape[:2]) < LPIPS_MINIMUM_SIDE:
        return None
    metric = lpips_metric("alex")
    if metric is None:
        return None
    with torch.no_grad():
        distance = metric.to(predicted.device).net(
            _batched(predicted).clamp(0, 1), _batched(truth).clamp(0, 1), normalize=True
        )
    return float(distance)


@functools.cache
def lpips_metric(backbone: LpipsBackbone) -> LearnedPerceptualImagePatchSimilarity | None:
    """Loads LPIPS from the files on this machine, once a process.

    Returns:
        torchmetrics' metric, or None after one `LpipsUnavailable` warning.
    """
    try:
        import torchvision
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        url = torchvision.models.get_model_weights(_TORCHVISION_NAMES[backbone]).DEFAULT.url
        weights = Path(torch.hub.get_dir()) / "checkpoints" / url.rsplit("/", 1)[-1]
        if weights.is_file():
            return LearnedPerceptualImagePatchSimilarity(net_type=backbone)
        reason = f"its weights are not on this machine; put {url} at {weights}"
    # Whatever is wrong with the file or with torchvision (an operator that does not match, a
    # truncated archive), a missing figure must not end a training run.
    except Exception as error:  # noqa: BLE001
        first_line = (str(error).strip() or "no reason given").splitlines()[0]
        reason = f"{type(error).__name__}: {first_line}"
    warnings.warn(f"LPIPS is left out: {reason}", LpipsUnavailable, stacklevel=3)
    return None


def _batched(image: Tensor) -> Tensor:
    """[H, W, 3] to the [1, 3, H, W] that torchmetrics takes."""
    return image.permute(2, 0, 1)[None]
