"""Space that training rays cross: cells of the mapped cube, one bit each in a file.

No photograph says anything about the rest. It is empty for all who ask an occupancy.
"""

from __future__ import annotations

import math
import zlib
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool3d

from leco_plugin.samplers import marching
from leco_plugin.samplers.base import midpoints
from leco_plugin.space import Space

CELLS = 64
"""Along each axis of the mapped cube."""
BYTES = CELLS**3 // 8
"""Of all cells as bits, before they are compressed."""
RAYS_AT_ONCE = 1 << 12


class SeenSpace(nn.Module):
    """Which cells of the mapped cube [-1, 1]^3 training rays cross or touch; all, until noted."""

    cells: Tensor
    """bool [n, n, n], n = `CELLS`."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("cells", torch.ones(CELLS, CELLS, CELLS, dtype=torch.bool))

    @property
    def everywhere(self) -> bool:
        """Whether all space counts as seen."""
        return bool(self.cells.all())

    @torch.no_grad()
    def note(self, space: Space, rays: marching.Rays) -> None:
        """Notes the rays that cover all training images, from where they enter the scene to where
        they leave it, in place of those noted before; `space` is on their device.

        A cell beside a crossed one counts as seen: rays are lines, and pixels have a width.
        """
        crossed = torch.zeros(CELLS**3, dtype=torch.bool, device=self.cells.device)
        for first in range(0, len(rays.origins), RAYS_AT_ONCE):
            part = marching.Rays(*(each[first : first + RAYS_AT_ONCE] for each in rays[:4]))
            rule = _rule_for(space, part.origins)
            samples = marching.march(part, rule)
            mapped = space.map(midpoints(samples, part.origins, part.directions))
            inside = mapped.abs().amax(dim=-1) <= 1.0
            crossed[cells_at(mapped[inside])] = True
        grid = crossed.view(1, 1, *self.cells.shape).float()
        self.cells.copy_(max_pool3d(grid, 3, stride=1, padding=1)[0, 0] > 0.0)

    def forward(self, mapped: Tensor) -> Tensor:
        """Whether mapped positions [N, 3] in [-1, 1] lie in seen cells: bool [N]."""
        return self.cells.view(-1).index_select(0, cells_at(mapped))

    def to_bytes(self) -> Tensor:
        """The cells as bits, compressed: uint8 [K]."""
        bits = np.packbits(self.cells.cpu().numpy()).tobytes()
        return torch.tensor(list(zlib.compress(bits, 9)), dtype=torch.uint8)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """A state without cells changes nothing: files of occupancies keep them apart."""
        if f"{prefix}cells" in state_dict:
            super()._load_from_state_dict(state_dict, prefix, *rest)


def _rule_for(space: Space, origins: Tensor) -> marching.March:
    """By which rays from these origins [N, 3], N > 0, meet each cell that they cross, or one beside
    it."""
    cell, half = 2.0 / CELLS, float(space.half_extent)
    if space.kind == "box":
        return marching.March(cell * half)
    # beyond the inner cube mapped steps shrink at least as fast as distance grows; in it they are
    # two cells at most, also from far away
    away = float((origins - space.center).norm(dim=-1).max()) / half
    return marching.March(cell * half, cell * min(1.0, 4.0 / (1.0 + away)))


def cells_at(mapped: Tensor) -> Tensor:
    """Flat numbers of the cells at mapped positions [N, 3] in [-1, 1]: int32 [N]."""
    # by coordinate, as `Occupancy.query` has them: rows of three numbers are slow on a CPU
    places = mapped.T.add(1.0).mul_(0.5 * CELLS).clamp_(0.0, CELLS - 1.0).to(torch.int32)
    return places[0].mul_(CELLS).add_(places[1]).mul_(CELLS).add_(places[2])


def cells_from_bytes(data: Tensor) -> Tensor:
    """The cells that `SeenSpace.to_bytes` compressed: bool [n, n, n]. ValueError for other data."""
    if data.dtype != torch.uint8 or data.dim() != 1 or len(data) > 2 * BYTES:
        raise ValueError(f"cells are at most {2 * BYTES} bytes in a row")
    reader = zlib.decompressobj()
    try:
        bits = reader.decompress(data.numpy().tobytes(), BYTES + 1)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if len(bits) != BYTES or not reader.eof or reader.unused_data:
        raise ValueError(f"they are {len(bits)} bytes and should be {BYTES}")
    cells = np.unpackbits(np.frombuffer(bits, np.uint8)).astype(bool)
    return torch.from_numpy(cells).view(CELLS, CELLS, CELLS)


def rays_a_side(cameras: int, most_rays: int = 1 << 17, fewest: int = 8, most: int = 32) -> int:
    """Rays along each side of an image with which so many cameras are noted."""
    return min(most, max(fewest, math.isqrt(most_rays // max(cameras, 1))))
