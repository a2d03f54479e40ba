"""The frozen gate as an estimator, in the place of an occupancy grid.

A host calls it like nerfacc's `OccGridEstimator`. It needs no updates and no box. A cell cache
answers in place of the gate wherever it is sure.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from leco_plugin.samplers.base import Estimator, Snapshot
from leco_plugin.samplers.boxes import cell_centers, check_positions, checked_box, intersect_box
from leco_plugin.samplers.cells.build import build_cache
from leco_plugin.samplers.cells.cache import CellCache, OccupancyLike
from leco_plugin.samplers.kernels import fused, native_march
from leco_plugin.samplers.marching import NearFn, OccupiedFn, Samples
from leco_plugin.samplers.rays import March, Rays

_log = logging.getLogger(__name__)

ANSWER_RESOLUTION = 64
"""Cells along each axis in which `binaries` and `occs` answer."""

RAYS_THAT_TELL = 32
"""Of a batch from random pixels not all look past a scene; a few rays into the sky do."""


class LearnedOccupancyEstimator(Estimator):
    """Samples where a frozen gate says that there is something.

    Box and cells follow the occupancy: after another gate was loaded into it, its threshold was
    changed or it was replaced, the next question has them made anew, in seconds; `Snapshot` says
    what goes unnoticed. A gate that is still trained is asked without cells (`cache_bytes=0`).

    Args:
        occupancy: the frozen gate with its space and threshold.
        aabb: box (min, max) to which rays are clipped, world units, [6]; None is the box of a
            bounded space, and no box for an unbounded one.
        cache_bytes: budget of the cell cache; 0 asks the gate about every candidate.
        tolerance: largest share of decisions by which the cache may differ from the gate. Where no
            cache keeps it, the gate is asked about every candidate, and the log says so.

    Raises:
        ValueError: the box is empty or not finite.
        TypeError: the occupancy is none.
    """

    levels = 1
    """Boxes in `aabbs`."""
    cells_per_lvl = ANSWER_RESOLUTION**3
    """Cells in each box of `binaries`."""
    _box: Tensor
    _snapshot: Snapshot
    _derived_from: list[Tensor]

    def __init__(
        self,
        occupancy: OccupancyLike,
        aabb: Sequence[float] | Tensor | None = None,
        *,
        cache_bytes: int = 1 << 20,
        tolerance: float = 1e-4,
    ) -> None:
        super().__init__()
        if not hasattr(occupancy, "space"):
            given = type(occupancy).__name__
            raise TypeError(f"Occupancy.load(FILE) gives an occupancy; a {given} is none")
        self.occupancy = occupancy
        self._warned = False
        self.cache_bytes, self.tolerance = cache_bytes, tolerance
        self.to(occupancy.space.center.device)
        self._box_is_given = aabb is not None
        box = torch.empty(0, 6) if aabb is None else checked_box(aabb)[None]
        self.register_buffer("_box", box.to(self.device), persistent=False)
        self.cache: CellCache | None = None
        self._derive()

    def _refresh(self) -> None:
        """Builds box and cells anew where the occupancy has changed."""
        if self._snapshot.matches(self.occupancy):
            return
        if self.cache_bytes > 0:
            # moved, or loaded once more
            if _are_equal(_state(self.occupancy), self._derived_from):
                self._snapshot = Snapshot(self.occupancy)
                return
            _log.info("the occupancy has changed: box and cells are made anew")
        self._derive()

    def _derive(self) -> None:
        """Builds what follows from the occupancy: its box and the cells."""
        snapshot = Snapshot(self.occupancy)
        if not self._box_is_given:
            bounded = self.occupancy.space.kind == "box"
            self._box = self._uncontracted_box() if bounded else self._box[:0]
        if self.cache_bytes > 0:
            state = _state(self.occupancy)
            self.cache = self._build_cache()
            self._derived_from = state
        self._snapshot = snapshot  # last: a build that is interrupted is begun anew

    def _build_cache(self) -> CellCache | None:
        try:
            with torch.autocast(self.device.type, enabled=False):  # whatever the host is in
                return build_cache(
                    self.occupancy, budget=self.cache_bytes, tolerance=self.tolerance
                )
        except ValueError as reason:
            _log.warning("no cell cache, sampling will be slower: %s", reason)
            return None

    def _uncontracted_box(self) -> Tensor:
        center, half = self.occupancy.space.center, self.occupancy.space.half_extent
        return torch.cat([center - half, center + half]).reshape(1, 6)

    def questions(self) -> tuple[OccupiedFn | None, NearFn | None]:
        self._refresh()
        return self.occupied, None if self.cache is None else self.cache.near

    def march(self, rays: Rays, rule: March) -> Samples:
        """As any estimator's, by the fused march or in C where those run."""
        self._refresh()
        samples = fused.march(self.occupancy, self.cache, rays, rule)
        if samples is None:
            samples = native_march.march(self.occupancy.occupied, self.cache, rays, rule)
        samples = super().march(rays, rule) if samples is None else samples
        if self.training and not (self._warned or self._box_is_given or len(samples[0])):
            self._warned = self._warn_of_rays_elsewhere(rays)
        return samples

    def _warn_of_rays_elsewhere(self, rays: Rays) -> bool:
        """Warns where no ray of a batch comes near: they are in other coordinates then, or end
        before they begin."""
        box = self.aabbs[0].to(rays.origins)
        enters, leaves = intersect_box(rays.origins, rays.directions, box)
        meets = enters.maximum(rays.t_mins) < leaves.minimum(rays.t_maxs)
        if len(meets) < RAYS_THAT_TELL or bool(meets.any()):
            return False
        if bool((rays.t_mins >= rays.t_maxs).all()):
            _log.warning("all of a batch of %d rays end before they begin", len(meets))
            return True
        _log.warning(
            "none of a batch of %d rays comes near what this occupancy is of, %s: rays must be in "
            "the coordinates in which it was learned (`frame` in its report leads there)",
            len(meets),
            " to ".join(str([round(x, 3) for x in corner]) for corner in box.view(2, 3).tolist()),
        )
        return True

    def bounds(self) -> Tensor | None:
        self._refresh()
        return self._box[0] if len(self._box) else None

    @torch.no_grad()
    def occupied(self, positions: Tensor) -> Tensor:
        """The gate's decision, from the cache where it is sure; positions [N, 3] to bool [N]."""
        self._refresh()
        check_positions(positions)
        cache = self.cache
        if cache is None:
            return self.occupancy.occupied(positions)
        decided, left_open = cache.decide(positions)
        if left_open.numel():
            asked = positions.T.index_select(1, left_open).T
            decided.index_copy_(0, left_open, self.occupancy.occupied(asked))
        return decided

    def update_every_n_steps(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to update: the gate is frozen."""

    def mark_invisible_cells(self, *args: Any, **kwargs: Any) -> None:
        """Nothing to mark: a gate has no cells."""

    @property
    def aabbs(self) -> Tensor:
        """Boxes as `OccGridEstimator` has them, [1, 6]; of an unbounded space the inner cube."""
        self._refresh()
        return self._box if len(self._box) else self._uncontracted_box()

    @property
    def resolution(self) -> Tensor:
        """Cells along each axis of `binaries`, int32 [3]."""
        return torch.full((3,), ANSWER_RESOLUTION, dtype=torch.int32, device=self.device)

    @property
    def occs(self) -> Tensor:
        """o at the cell centres of `aabbs`, [resolution^3]; asked anew at each call."""
        with torch.no_grad():
            return self.occupancy.query(cell_centers(self.aabbs, self.resolution))

    @property
    def binaries(self) -> Tensor:
        """Decisions at the cell centres of `aabbs`, bool [1, n, n, n]."""
        occupied = self.occs >= self.occupancy.threshold
        return occupied.view(1, *[ANSWER_RESOLUTION] * 3)


def _state(occupancy: OccupancyLike) -> list[Tensor]:
    """Copies of what an occupancy's decisions depend on, as far as its tensors hold it."""
    if not isinstance(occupancy, torch.nn.Module):
        return []
    return [value.detach().cpu().clone() for value in occupancy.state_dict().values()]


def _are_equal(some: list[Tensor], others: list[Tensor]) -> bool:
    """Whether two such lists are alike in every type and value, and hold any."""
    return 0 < len(some) == len(others) and all(
        one.dtype == other.dtype and torch.equal(one, other)
        for one, other in zip(some, others, strict=True)
    )
