"""The space mapping: from scene positions to the cube [-1, 1]^3 in which gate and field live.

A bounded scene is centred and divided by one number; an unbounded one is also contracted
(mip-NeRF 360, eq. 10, in the max norm, so that the cube is filled and a grid wastes no corner).
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from leco_plugin.on_cpu import on_cpu

SpaceKind = Literal["box", "contraction"]

NO_WALL = 1e6
"""Stands for "no wall" in the corners of a box, scene units; infinity would meet zero in a slab
test and is no finite number in a file."""


def contract(positions: Tensor) -> Tensor:
    """Maps R^3 into the cube of half-width 2, leaving the cube of half-width 1 as it is.

    Args:
        positions: [..., 3] float.
    Returns:
        [..., 3], every coordinate in [-2, 2]. Infinitely far points have no place: they give NaN.
    """
    magnitude = positions.abs().amax(dim=-1, keepdim=True)
    outside = magnitude.clamp(min=1.0)  # the clamp keeps the untaken branch finite
    return positions * (2.0 - 1.0 / outside) / outside


def uncontract(positions: Tensor) -> Tensor:
    """Inverse of `contract` inside the open cube of half-width 2.

    Args:
        positions: [..., 3] float, coordinates in (-2, 2).
    Returns:
        [..., 3]. Points on the faces are taken as 1e-6 inside, hence finite.
    """
    magnitude = positions.abs().amax(dim=-1, keepdim=True)
    outside = magnitude.clamp(min=1.0, max=2.0 - 1e-6)
    return positions / (outside * (2.0 - outside))


class Space(nn.Module):
    """Scene positions to mapped positions and back; its three buffers travel with a checkpoint.

    Attributes:
        center: [3] scene units.
        half_extent: scalar, scene units: distance from the centre that is mapped to 1 (`box`) or to
            the border of the uncontracted cube (`contraction`).
        unbounded: bool scalar: False is `box`, True is `contraction`.
    """

    center: Tensor
    half_extent: Tensor
    unbounded: Tensor

    def __init__(
        self,
        kind: SpaceKind = "box",
        center: tuple[float, float, float] = (0.0, 0.0, 0.0),
        half_extent: float = 1.0,
    ) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3, dtype=torch.float32))
        self.register_buffer("half_extent", torch.ones((), dtype=torch.float32))
        self.register_buffer("unbounded", torch.zeros((), dtype=torch.bool))
        self.set(kind, torch.tensor(center), half_extent)

    @property
    def kind(self) -> SpaceKind:
        return "contraction" if on_cpu(self.unbounded) else "box"

    def set(self, kind: SpaceKind, center: Tensor, half_extent: float) -> None:
        """Redefines the mapping in place. ValueError if the half extent is not a positive finite
        number, or the kind is unknown."""
        if not (half_extent > 0.0 and half_extent < float("inf")):
            raise ValueError(f"a space needs a positive, finite half extent, got {half_extent}")
        if kind not in ("box", "contraction"):
            raise ValueError(f"a space is a 'box' or a 'contraction', got {kind!r}")
        self.center.copy_(center)
        self.half_extent.fill_(half_extent)
        self.unbounded.fill_(kind == "contraction")

    def map(self, positions: Tensor) -> Tensor:
        """Scene positions [..., 3] to mapped positions [..., 3].

        In a box, positions outside it leave [-1, 1]: nothing is clipped, so that "outside" stays
        visible.
        """
        scaled = (positions - self.center) / self.half_extent
        return scaled if self.kind == "box" else contract(scaled) * 0.5

    def unmap(self, mapped: Tensor) -> Tensor:
        """Inverse of `map`: mapped positions [..., 3] to scene positions [..., 3]."""
        scaled = mapped if self.kind == "box" else uncontract(mapped * 2.0)
        return scaled * self.half_extent + self.center
