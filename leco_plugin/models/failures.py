"""What ends a training run before its time, and the likely cause of a loss that is not finite."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn


class TrainingStopped(RuntimeError):
    """A run cannot go on; the message says at which step, why, and what is left of it.

    `AtomicTrainer` and nerfstudio's launcher raise it. A loop of one's own can catch it; `ns-*`
    commands end with its one line and status 1, see `studio.commands`.
    """


def first_non_finite(losses: dict[str, Tensor]) -> str | None:
    """Name of the first loss that is not finite, or None; waits for the device once.

    Args:
        losses: of any shapes; hosts also give plain numbers.
    """
    tensors = [torch.as_tensor(loss).detach() for loss in losses.values()]
    device = next((loss.device for loss in tensors if loss.device.type != "cpu"), "cpu")
    values = torch.stack([loss.float().sum().to(device) for loss in tensors]).tolist()
    return next((name for name, value in zip(losses, values) if not math.isfinite(value)), None)


def require_finite(
    losses: dict[str, Tensor], model: nn.Module, outputs: dict[str, Any], image: Tensor
) -> None:
    """Refuses losses that are not finite, before a step is taken with them.

    Args:
        outputs: of the batch; where they hold `rays` and `shaded`, these are suspects too.
        image: what the batch was compared with.
    Raises:
        FloatingPointError: says which loss, and the likely cause.
    """
    name = first_non_finite(losses)
    if name is not None:
        raise FloatingPointError(explain_non_finite(name, model, outputs, image))


def explain_non_finite(name: str, model: nn.Module, outputs: dict[str, Any], image: Tensor) -> str:
    """One line: which loss, and the first thing on its way that was not finite."""
    rays, shaded = outputs.get("rays"), outputs.get("shaded")
    suspects = [("the training image holds values that are not finite", image)]
    if rays is not None:
        suspects += [
            ("a ray is not finite: check the camera poses", rays.directions),
            ("a ray is not finite: check the camera poses", rays.origins),
        ]
    suspects += [
        (f"parameter {key} is not finite: the learning rate is probably too high", value)
        for key, value in model.named_parameters()
        if value.numel()
    ]
    if shaded is not None:
        suspects += [
            ("the gate's logits overflowed", shaded.logits),
            ("a density overflowed: the learning rate is probably too high", shaded.sigmas),
            ("a colour overflowed", shaded.rgb),
        ]
    cause = next(
        (text for text, value in suspects if not bool(torch.isfinite(value).all())),
        "all inputs and parameters are finite; the loss itself overflowed",
    )
    return f"{name} is not finite: {cause}."
