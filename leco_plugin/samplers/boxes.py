"""Axis-aligned boxes, and the grids of cells in them: checks, intersections and look-ups.

A box is (min, max), [6]. Levels of a grid are nested boxes, each twice as wide as the one inside
it; a position is looked up in the innermost box that holds it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def checked_box(aabb: Sequence[float] | Tensor) -> Tensor:
    """A box as float32 [6] of (min, max), on the device it came from. ValueError if it is not six
    finite numbers, or empty."""
    try:
        box = torch.as_tensor(aabb).detach().float().reshape(-1)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"aabb must be a finite box (min, max), got {aabb!r}") from None
    if box.shape != (6,) or not bool((box[:3] < box[3:]).all() and box.isfinite().all()):
        raise ValueError(f"aabb must be a finite box (min, max), got {box.tolist()}")
    return box


def check_positions(positions: Tensor) -> None:
    """TypeError unless positions are a tensor, ValueError unless it is [N, 3]."""
    if not isinstance(positions, Tensor):
        raise TypeError(f"positions must be a tensor, got {type(positions).__name__}")
    if positions.dim() != 2 or positions.shape[-1] != 3:
        raise ValueError(f"positions must be [N, 3], got {list(positions.shape)}")


def nested_boxes(box: Sequence[float] | Tensor, levels: int) -> list[Tensor]:
    """A box [6] and others around it, each twice as wide as the one before. ValueError if the box
    is empty or not finite, or there is not even one level."""
    if levels < 1:
        raise ValueError(f"there is at least one box, not {levels}")
    inner = checked_box(box)
    center, half = (inner[:3] + inner[3:]) / 2, (inner[3:] - inner[:3]) / 2
    return [torch.cat([center - half * 2**i, center + half * 2**i]) for i in range(levels)]


def intersect_box(origins: Tensor, directions: Tensor, aabb: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box (the slab method).

    Args:
        origins, directions: [n_rays, 3].
        aabb: (min, max) corners, [6].

    Returns:
        t of entry and of exit, [n_rays]. A ray that misses enters after it leaves. Entry is
        negative where the origin lies inside.
    """
    to_low, to_high = (aabb[:3] - origins) / directions, (aabb[3:] - origins) / directions
    # 0/0 on a face that the ray runs along: neither bound on this axis.
    near = torch.minimum(to_low, to_high).nan_to_num(nan=-torch.inf)
    far = torch.maximum(to_low, to_high).nan_to_num(nan=torch.inf)
    return near.amax(dim=-1), far.amin(dim=-1)


def cell_centers(aabbs: Tensor, resolution: Tensor) -> Tensor:
    """Centres of the cells of boxes [n_boxes, 6], z fastest, [n_boxes * cells, 3]; `resolution` has
    the cells along each axis, int [3]."""
    kind, device = aabbs.dtype, aabbs.device
    axes = [(torch.arange(n, dtype=kind, device=device) + 0.5) / n for n in resolution.tolist()]
    units = torch.cartesian_prod(*axes)
    low, high = aabbs[:, None, :3], aabbs[:, None, 3:]
    return (low + units * (high - low)).view(-1, 3)


def lookup(binaries: Tensor, innermost: Tensor, positions: Tensor) -> Tensor:
    """Whether nested grids mark positions: bool [N], False outside the outermost box.

    Args:
        binaries: bool [levels, nx, ny, nz].
        innermost: box of level 0, [6].
        positions: [N, 3].
    """
    index, inside = cells_of(binaries.shape, innermost, positions)
    return binaries.view(-1).index_select(0, index).logical_and_(inside)


def cells_of(shape: Sequence[int], innermost: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
    """The cells of nested grids that hold positions.

    Args:
        shape: (levels, nx, ny, nz).
        innermost: box of level 0, [6].
        positions: [N, 3].

    Returns:
        int32 [N] into the flattened grids, and bool [N] whether there is such a cell.
    """
    levels, *sizes = shape
    low, high = innermost.to(positions).view(2, 3, 1)
    # Within +-0.5 in the innermost box; each level is half as large in these units.
    units = torch.addcmul(-0.5 * (low + high) / (high - low), positions.T, 1.0 / (high - low))
    widest = units.abs().amax(dim=0)
    inside = widest <= 0.5 * 2 ** (levels - 1)
    level = None
    if levels > 1:
        level = torch.zeros_like(widest)
        for inner in range(levels - 1):
            level += widest > 0.5 * 2**inner
        units *= torch.exp2(-level)
    ends = positions.new_tensor(sizes)[:, None]
    cells = torch.addcmul(0.5 * ends, units, ends).nan_to_num_(nan=-1.0)
    # Inside by the comparison above, yet on the last face or a rounding away from one.
    cells = torch.minimum(cells.clamp_(min=0.0), ends - 1.0).to(torch.int32)
    index = cells[0] if level is None else cells[0] + level.to(torch.int32) * sizes[0]
    return (index * sizes[1] + cells[1]) * sizes[2] + cells[2], inside
