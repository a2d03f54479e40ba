"""How small the smallest things are that photographs resolve, in their pixels.

A photograph that is hardly changed by being made coarser shows nothing as small as a pixel: it is
blurred, enlarged, or of smooth things.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

PICTURES = "leco_pictures"
"""Key of the metadata that a data manager hands to a model: the training photographs, nerfstudio's
`InputDataset`. They are opened only where somebody asks."""
MOST_PICTURES = 16
"""That are looked at, evenly spread."""
SIDES = (2, 4, 8, 16)
"""Pixels a side that are made one."""
UNSEEN = 1e-3
"""Mean squared error, 30 dB, that a picture may have by being coarser; radiance fields of large
scenes end far above it."""


def pixels_resolved(dataset: Any) -> float:
    """Pixels along the side of the smallest things that photographs resolve, from 1 to 16.

    Args:
        dataset: nerfstudio's `InputDataset`.
    Returns:
        The side of the squares of pixels whose means make pictures with an error of `UNSEEN`,
        between the powers of two along a line in logarithms; 1 where there are no pictures.
    """
    count = len(dataset)
    chosen = torch.linspace(0, count - 1, min(count, MOST_PICTURES)).long().unique().tolist()
    found = [errors_when_coarser(_colours(dataset.get_data(i))) for i in chosen]
    found = [errors for errors in found if len(errors) == len(SIDES)]
    if not found:
        return 1.0
    return side_with_error(torch.tensor(found).mean(dim=0).tolist())


def errors_when_coarser(picture: Tensor) -> list[float]:
    """Mean squared errors of a picture [H, W, 3] in [0, 1] by being coarser, one for each of
    `SIDES`; fewer where it has not so many pixels a side."""
    planes = picture.movedim(-1, 0)[None]
    errors = []
    for side in SIDES:
        height, width = (side * (size // side) for size in planes.shape[2:])
        if min(height, width) < 2 * side:
            break
        cut = planes[:, :, :height, :width]
        coarse = functional.avg_pool2d(cut, side)
        again = functional.interpolate(coarse, scale_factor=side, mode="bilinear")
        errors.append(float((again - cut).square().mean()))
    return errors


def side_with_error(errors: list[float]) -> float:
    """The side at which errors, one for each of `SIDES`, come to `UNSEEN`.

    Below the first side the line through the first two goes on.
    """
    points = [(math.log2(side), math.log2(max(error, 1e-12))) for side, error in zip(SIDES, errors)]
    wanted = math.log2(UNSEEN)
    if wanted >= points[-1][1]:
        return float(SIDES[-1])
    (x, y), (next_x, next_y) = next(
        (pair for pair in pairwise(points) if pair[1][1] > wanted), (points[0], points[1])
    )
    if next_y <= y:  # no coarser picture is worse
        return float(SIDES[0]) if y > wanted else 2.0**next_x
    return float(max(1.0, 2.0 ** (x + (wanted - y) / (next_y - y) * (next_x - x))))


def _colours(data: dict[str, Any]) -> Tensor:
    """[H, W, 3] of what a dataset has for a picture; black where it shows nothing."""
    image: Tensor = data["image"].float()
    return image[..., :3] * image[..., 3:] if image.shape[-1] == 4 else image
