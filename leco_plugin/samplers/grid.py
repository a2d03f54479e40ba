"""The baselines: no skipping at all, and Instant-NGP's occupancy grid with nerfacc's semantics.

The grid is nerfacc's `OccGridEstimator` (0.5.2) in plain torch: same constructor, buffers,
thresholds and updates, marched by the rule of this package. Levels are nested boxes, each twice
as wide as the one inside it; a position is looked up in the innermost box that holds it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.marching import NearFn, OccupiedFn
from leco_plugin.samplers.marching.rays import checked_box

CELLS_AT_ONCE = 1 << 18
"""Cells evaluated in one call of the host's density; nerfacc asks 2 million at once, for which a
host on a CPU needs gigabytes."""


def nested_boxes(box: Sequence[float] | Tensor, levels: int) -> list[Tensor]:
    """A box [6] of (min, max), and around it others, each twice as wide as the one before.

    Raises:
        ValueError: the box is empty or not finite, or there is not even one level.
    """
    if levels < 1:
        raise ValueError(f"there is at least one box, not {levels}")
    inner = checked_box(box)
    center, half = (inner[:3] + inner[3:]) / 2, (inner[3:] - inner[:3]) / 2
    return [torch.cat([center - half * 2**i, center + half * 2**i]) for i in range(levels)]


class DenseEstimator(Estimator):
    """Keeps every candidate: the reference that skipping is measured against.

    Args:
        aabb: box (min, max) to which rays are clipped, [6]; None marches from near to far.

    Raises:
        ValueError: the box is empty or not finite.
    """

    aabbs: Tensor

    def __init__(self, aabb: Sequence[float] | Tensor | None = None) -> None:
        super().__init__()
        boxes = torch.empty(0, 6) if aabb is None else checked_box(aabb)[None]
        self.register_buffer("aabbs", boxes)

    def questions(self) -> tuple[OccupiedFn | None, NearFn | None]:
        return None, None

    def bounds(self) -> Tensor | None:
        return self.aabbs[-1] if len(self.aabbs) else None

    def update_every_n_steps(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to learn."""


class OccupancyGridEstimator(Estimator):
    """Instant-NGP's occupancy grid (section 4 and appendix C), as nerfacc has it.

    Args:
        roi_aabb: box (min, max) of the innermost level, world units, [6].
        resolution: cells along each axis.
        levels: number of nested boxes.

    Raises:
        ValueError: the box is empty or not finite, or a size is not positive.
    """

    resolution: Tensor
    aabbs: Tensor
    occs: Tensor
    binaries: Tensor

    def __init__(
        self,
        roi_aabb: Sequence[float] | Tensor,
        resolution: int | Sequence[int] | Tensor = 128,
        levels: int = 1,
    ) -> None:
        super().__init__()
        along_axes = [resolution] * 3 if isinstance(resolution, int | float) else resolution
        sizes = [int(n) if n == int(n) else 0 for n in along_axes]
        if len(sizes) != 3 or min(sizes) < 1 or levels < 1:
            raise ValueError(
                f"a grid needs whole positive sizes, got {resolution}, {levels} levels"
            )
        boxes = nested_boxes(roi_aabb, levels)
        self.levels = levels
        self.cells_per_lvl = sizes[0] * sizes[1] * sizes[2]
        self.sizes = sizes
        self.register_buffer("resolution", torch.tensor(sizes, dtype=torch.int32))
        self.register_buffer("aabbs", torch.stack(boxes).cpu())
        self.register_buffer("occs", torch.zeros(levels * self.cells_per_lvl))
        self.register_buffer("binaries", torch.zeros([levels, *sizes], dtype=torch.bool))

    def questions(self) -> tuple[OccupiedFn | None, NearFn | None]:
        return self.occupied, None

    def bounds(self) -> Tensor | None:
        return self.aabbs[-1]

    def alpha_cap(self, alphas: Tensor) -> Tensor:
        """nerfacc's cap: the mean of the running occupancies."""
        return self.occs.mean()

    def occupied(self, positions: Tensor) -> Tensor:
        """Whether the cell that holds a position is marked; positions [N, 3] to bool [N].

        Outside the outermost box nothing is.
        """
        return lookup(self.binaries, self.aabbs[0], positions)

    def values(self, positions: Tensor) -> Tensor:
        """The running occupancy of the cell that holds a position, 0 outside; [N, 3] to [N]."""
        index, inside = cells_of(self.binaries.shape, self.aabbs[0], positions)
        return self.occs.index_select(0, index) * inside

    def update_every_n_steps(
        self,
        step: int,
        occ_eval_fn: Callable[[Tensor], Tensor],
        occ_thre: float = 1e-2,
        ema_decay: float = 0.95,
        warmup_steps: int = 256,
        n: int = 16,
    ) -> None:
        """Refresh the grid from the field, every `n` steps.

        Args:
            step: training step.
            occ_eval_fn: positions [N, 3] to density times step size, [N] or [N, 1].
            occ_thre: cells above min(this, mean) are occupied.
            ema_decay: an old value fades by this factor when its cell is asked again.
            warmup_steps: until then all cells are asked, afterwards a quarter at random and as
                many of the occupied ones.

        Raises:
            RuntimeError: the estimator is in evaluation mode.
        """
        if not self.training:
            raise RuntimeError("the occupancy grid is updated in training only")
        if step % n == 0:
            self._update(occ_eval_fn, occ_thre, ema_decay, everything=step < warmup_steps)

    @torch.no_grad()
    def _update(
        self,
        occ_eval_fn: Callable[[Tensor], Tensor],
        occ_thre: float,
        ema_decay: float,
        everything: bool,
    ) -> None:
        occs = self.occs.view(self.levels, -1)
        for level in range(self.levels):
            cells = self._all_cells() if everything else self._some_cells(level)
            for part in cells.split(CELLS_AT_ONCE):
                values = occ_eval_fn(self._random_points(level, part)).reshape(-1).to(occs)
                occs[level, part] = torch.maximum(occs[level, part] * ema_decay, values)
        threshold = self.occs.mean().clamp(max=occ_thre)
        torch.gt(self.occs.view_as(self.binaries), threshold, out=self.binaries)

    def _all_cells(self) -> Tensor:
        return torch.arange(self.cells_per_lvl, device=self.device)

    def _some_cells(self, level: int) -> Tensor:
        count = self.cells_per_lvl // 4
        uniform = torch.randint(self.cells_per_lvl, (count,), device=self.device)
        occupied = self.binaries[level].view(-1).nonzero()[:, 0]
        if len(occupied) > count:
            occupied = occupied[torch.randint(len(occupied), (count,), device=self.device)]
        return torch.cat([uniform, occupied])

    def _random_points(self, level: int, cells: Tensor) -> Tensor:
        _, height, depth = self.sizes
        corners = [cells // (height * depth), cells // depth % height, cells % depth]
        units = torch.stack(corners, dim=-1) + torch.rand(len(cells), 3, device=self.device)
        low, high = self.aabbs[level].view(2, 3)
        return low + units / self.resolution * (high - low)


def lookup(binaries: Tensor, innermost: Tensor, positions: Tensor) -> Tensor:
    """Ask nested grids about positions.

    Args:
        binaries: bool [levels, nx, ny, nz].
        innermost: box of level 0, [6] of (min, max).
        positions: [N, 3].

    Returns:
        bool [N], False outside the outermost box.
    """
    index, inside = cells_of(binaries.shape, innermost, positions)
    return binaries.view(-1).index_select(0, index).logical_and_(inside)


def cells_of(shape: Sequence[int], innermost: Tensor, positions: Tensor) -> tuple[Tensor, Tensor]:
    """The cells of nested grids that hold positions.

    Args:
        shape: (levels, nx, ny, nz).
        innermost: box of level 0, [6] of (min, max).
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
