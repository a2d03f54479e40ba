"""The part of a scene that rays of photographs reach: where an occupancy can be judged at all.

What a gate or a grid says of other places is nobody's teaching, and no ray asks.
"""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.evaluation.inspection import ViewBox, whole_box
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.rendering import Rays, backdrop_of, mapped_middles

CELLS = 64
"""Along an axis of the mapped cube: cells without a candidate of those rays are not reached."""


def mapped_box(model: LecoModel) -> ViewBox:
    """The scene's box in mapped coordinates; an unbounded scene fills the cube."""
    device = model.device
    if model.space.kind != "box":
        return ViewBox(-torch.ones(3, device=device), torch.ones(3, device=device))
    box = whole_box(model.occupancy())
    low, high = model.space.map(torch.stack([box.low, box.high]).to(device)).clamp(-1.0, 1.0)
    return ViewBox(low, high)


def reached_volume(model: LecoModel, taught: Tensor, count: int, seed: int = 0) -> Tensor:
    """Mapped positions spread evenly over what rays reach of the scene's box: [P, 3], P <= count.

    Args:
        taught: [M, 3] mapped candidates of rays.
        count: positions in the whole box.
    """
    box = whole_box(model.occupancy())
    unit = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed))
    positions = torch.lerp(box.low, box.high, unit).to(model.device)
    mapped = model.space.map(positions).clamp(-1.0, 1.0)
    return mapped[reached(taught, mapped)]


def reached(taught: Tensor, mapped: Tensor) -> Tensor:
    """Which mapped positions [P, 3] share a cell with one of those taught [M, 3]: bool [P]."""

    def cells(places: Tensor) -> Tensor:
        i, j, k = ((places + 1.0) * (CELLS / 2)).long().clamp(0, CELLS - 1).unbind(dim=-1)
        return (i * CELLS + j) * CELLS + k

    found = torch.zeros(CELLS**3, dtype=torch.bool, device=taught.device)
    found[cells(taught)] = True
    return found[cells(mapped)]


def rays_of_photographs(datamanager: Any, count: int, seed: int = 0) -> RayBundle:
    """Rays anywhere in the training photographs, whose pixels need not be read.

    Training is not disturbed: neither its pixels nor its random numbers are used.
    """
    cameras = datamanager.train_dataset.cameras.to("cpu")
    generator = torch.Generator().manual_seed(seed)
    numbers = torch.randint(len(cameras), (count, 1), generator=generator)
    sizes = torch.cat([cameras.height[numbers[:, 0]], cameras.width[numbers[:, 0]]], dim=-1)
    coordinates = torch.rand(count, 2, generator=generator) * sizes
    bundle: RayBundle = cameras.generate_rays(camera_indices=numbers, coords=coordinates)
    return bundle


@torch.no_grad()
def candidates_of(model: LecoModel, bundle: RayBundle, rays_at_once: int = 1024) -> Tensor:
    """Mapped middles [M, 3] of all candidates of rays, backdrops left out."""
    rays = model.rays_of(bundle.to(model.device))
    pieces = []
    for first in range(0, len(rays.origins), rays_at_once):
        part = slice(first, first + rays_at_once)
        some = Rays._make(None if value is None else value[part] for value in rays)
        intervals = model.intervals_of(some, guided=False, learning=False)
        middles = mapped_middles(model.space, some, intervals)
        pieces.append(middles[~backdrop_of(intervals, some)])
    return torch.cat(pieces)
