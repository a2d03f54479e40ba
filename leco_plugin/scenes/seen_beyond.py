"""What pictures show where rays miss a scene photographed from above: a sky, fog, distance."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from leco_plugin.models.objective import DARK

MOST_PICTURES = 16
"""Pictures that are looked at: those with the most rays that miss."""


def seen_beyond(dataset: Any, numbers: Tensor, misses: Tensor) -> float:
    """Share of the rays that miss the scene and show something all the same.

    Args:
        dataset: nerfstudio's `InputDataset`.
        numbers: [C] of the pictures that the rays cover.
        misses: bool [C, side, side], which rays of a grid over each picture miss.
    """
    counts = misses.flatten(1).sum(dim=1)
    most = counts.argsort(descending=True)[:MOST_PICTURES]
    shown = [bright(dataset.get_data(int(numbers[i])), misses[i]) for i in most if counts[i] > 0]
    if not shown:
        return 0.0
    return float(torch.cat(shown).float().mean() * misses.float().mean())


def bright(data: dict[str, Any], chosen: Tensor) -> Tensor:
    """Whether chosen pixels of a picture show something that no mask hides: bool [N].

    Args:
        data: of the dataset: `image` [H, W, 3 or 4] in [0, 1], and `mask` [H, W, 1] if any.
        chosen: bool [side, side], of a grid from corner to corner.
    """
    image = data["image"]
    height, width = image.shape[:2]
    places = chosen.nonzero() / (len(chosen) - 1) * torch.tensor([height - 1, width - 1])
    rows, columns = places.round().long().unbind(dim=-1)
    pixels = image[rows, columns].float()
    shown = pixels[:, :3].amax(dim=-1) * (pixels[:, 3] if pixels.shape[-1] == 4 else 1.0) > DARK
    return shown & data["mask"][rows, columns, 0].bool() if "mask" in data else shown
