"""Instant-NGP's occupancy grid: nerfacc's `OccGridEstimator`, marched by the rule of this package.

Buffers, thresholds and updates are nerfacc's own (Instant-NGP, section 4 and appendix C); sampling
is that of every estimator here, and so runs on any device.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from nerfacc import OccGridEstimator
from torch import Tensor

from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.boxes import checked_box, lookup
from leco_plugin.samplers.marching import NearFn, OccupiedFn

CELLS_AT_ONCE = 1 << 18
"""Cells evaluated in one call of the host's density; nerfacc asks 2 million at once, for which a
host on a CPU needs gigabytes."""


class OccupancyGridEstimator(Estimator, OccGridEstimator):  # type: ignore[misc]
    """nerfacc's grid.

    Args:
        roi_aabb: box (min, max) of the innermost level, world units, [6].
        resolution: cells along each axis.
        levels: number of nested boxes.

    Attributes:
        aabbs: boxes of the levels, [levels, 6].
        occs: running occupancy of each cell, [levels * cells].
        binaries: which cells are marked, bool [levels, nx, ny, nz].

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
        along_axes = [resolution] * 3 if isinstance(resolution, int | float) else resolution
        sizes = [int(n) if n == int(n) else 0 for n in along_axes]
        if len(sizes) != 3 or min(sizes) < 1 or levels < 1:
            raise ValueError(
                f"a grid needs whole positive sizes, got {resolution}, {levels} levels"
            )
        super().__init__(checked_box(roi_aabb).cpu(), sizes, levels)

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

    def update_every_n_steps(
        self,
        step: int,
        occ_eval_fn: Callable[[Tensor], Tensor],
        occ_thre: float = 1e-2,
        ema_decay: float = 0.95,
        warmup_steps: int = 256,
        n: int = 16,
    ) -> None:
        """As nerfacc's, with the field asked about some of the cells at a time.

        Args:
            occ_eval_fn: positions [N, 3] to density times step size, [N] or [N, 1].

        Raises:
            RuntimeError: the estimator is in evaluation mode.
        """

        def in_parts(positions: Tensor) -> Tensor:
            values = [occ_eval_fn(part).reshape(-1, 1) for part in positions.split(CELLS_AT_ONCE)]
            return torch.cat(values).to(self.occs)

        OccGridEstimator.update_every_n_steps(
            self, step, in_parts, occ_thre, ema_decay, warmup_steps, n
        )
