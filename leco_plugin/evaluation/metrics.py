"""PSNR, SSIM, FLIP and LPIPS of one rendered image.

FLIP and LPIPS are loaded at their first use and are never fetched: on a machine without the package
of the one or the weights of the other it is left out, with one warning that says what to do.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from leco_plugin.on_cpu import in_float64

if TYPE_CHECKING:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

LpipsBackbone = Literal["alex", "vgg", "squeeze"]

_TORCHVISION_NAMES = {"alex": "alexnet", "vgg": "vgg16", "squeeze": "squeezenet1_1"}
LPIPS_MINIMUM_SIDE = 31
"""Below this AlexNet's second pooling has nothing left to pool."""


class FigureUnavailable(UserWarning):
    """FLIP or LPIPS was asked for, and cannot be loaded on this machine."""


def image_metrics(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """The figures that ns-eval averages over images, of colours in 0..1, both [H, W, 3] float:
    `psnr` (dB), `ssim`, and `flip` and `lpips` where they are at hand. Otherwise the key is absent:
    nerfstudio turns every value into a float, and a NaN is no JSON."""
    metrics = {"psnr": psnr(predicted, truth), "ssim": ssim(predicted, truth)}
    distances = {"flip": flip(predicted, truth), "lpips": lpips(predicted, truth)}
    return metrics | {name: value for name, value in distances.items() if value is not None}


def spread_evenly(count: int, most: int) -> list[int]:
    """Up to `most` of the numbers below `count`, the first and the last among them."""
    numbers: list[int] = torch.linspace(0, count - 1, min(count, most)).round().int().tolist()
    return numbers


def decibels(squared_error: float) -> float:
    """The PSNR of a mean squared error of colours in 0..1, at most 120 dB."""
    return -10.0 * math.log10(max(squared_error, 1e-12))


def psnr(predicted: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of colours in 0..1, both [H, W, 3]; at most 120 dB."""
    return decibels(float(in_float64((predicted - truth) ** 2).mean()))


def ssim(predicted: Tensor, truth: Tensor) -> float:
    """Structural similarity of two [H, W, 3] images, at most 1, as nerfstudio's models compute it:
    they leave the data range to torchmetrics, which takes it from the two images."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    similarity = structural_similarity_index_measure(_batched(predicted), _batched(truth))
    assert isinstance(similarity, Tensor)  # a tuple only if further images are asked for
    return float(similarity)


def flip(predicted: Tensor, truth: Tensor) -> float | None:
    """Mean FLIP of two [H, W, 3] images in 0..1, at its default of 67 pixels per degree: 0 for
    equal images, at most 1; None without the package `flip-evaluator`."""
    evaluate = flip_evaluator()
    if evaluate is None:
        return None
    reference, test = (
        image.detach().float().clamp(0, 1).cpu().contiguous().numpy()
        for image in (truth, predicted)
    )
    _, mean, _ = evaluate(reference, test, "LDR", applyMagma=False)
    return float(mean)


@functools.cache
def flip_evaluator() -> Callable[..., Any] | None:
    """FLIP of two arrays, or None after one `FigureUnavailable` warning."""
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        told = f"FLIP is left out: {error}; pip install flip-evaluator"
        warnings.warn(told, FigureUnavailable, stacklevel=3)
        return None
    found: Callable[..., Any] = evaluate
    return found


def lpips(predicted: Tensor, truth: Tensor) -> float | None:
    """Learned perceptual distance (AlexNet, as in nerfstudio) of two [H, W, 3] images in 0..1; None
    where its network is not at hand or a side is under `LPIPS_MINIMUM_SIDE` pixels."""
    is_small = min(predicted.shape[:2]) < LPIPS_MINIMUM_SIDE
    if is_small or (metric := lpips_metric("alex")) is None:
        return None
    images = (_batched(image).clamp(0, 1) for image in (predicted, truth))
    with torch.no_grad():
        return float(metric.to(predicted.device).net(*images, normalize=True))


@functools.cache
def lpips_metric(backbone: LpipsBackbone) -> LearnedPerceptualImagePatchSimilarity | None:
    """torchmetrics' LPIPS from the files on this machine, or None after one `FigureUnavailable`."""
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
    warnings.warn(f"LPIPS is left out: {reason}", FigureUnavailable, stacklevel=3)
    return None


def _batched(image: Tensor) -> Tensor:
    """[H, W, 3] to the [1, 3, H, W] that torchmetrics takes."""
    return image.permute(2, 0, 1)[None]
