"""The frozen gate in the place of an occupancy grid.

A host calls it as it calls nerfacc's `OccGridEstimator`; there is nothing to update, no box to
guess, and the cells of a cache answer for the gate wherever they are sure.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.cells.build import build_cache
from leco_plugin.samplers.cells.cache import CellCache, OccupancyLike
from leco_plugin.samplers.changes import Seen
from leco_plugin.samplers.kernels import fused
from leco_plugin.samplers.marching import NearFn, OccupiedFn, Samples, number
from leco_plugin.samplers.marching.rays import checked_box, intersect_box

_log = logging.getLogger(__name__)

ANSWER_RESOLUTION = 64
"""Cells along each axis in which `binaries` and `occs` answer."""

RAYS_THAT_TELL = 32
"""Of a batch from random pixels not all look past a scene; a few rays into the sky do."""


class LearnedOccupancyEstimator(Estimator):
    """Samples where a frozen gate says that there is something.

    Box and cells follow the occupancy: after another gate was loaded into it, its threshold was
    changed or it was replaced, the next question has them made anew, in seconds; `Seen` says what
    goes unnoticed. A gate that is still trained is asked without cells (`cache_bytes=0`).

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

    _box: Tensor
    _seen: Seen
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

    def _follow(self) -> None:
        """Derives box and cells anew where the occupancy is no longer what they are of."""
        if self._seen.is_still(self.occupancy):
            return
        if self.cache_bytes > 0:
            # moved, or loaded once more
            if _same(_decisive(self.occupancy), self._derived_from):
                self._seen = Seen(self.occupancy)
                return
            _log.info("the occupancy has changed: box and cells are made anew")
        self._derive()

    def _derive(self) -> None:
        """Builds what follows from the occupancy: its box and the cells."""
        seen = Seen(self.occupancy)
        if not self._box_is_given:
            bounded = self.occupancy.space.kind == "box"
            self._box = self._uncontracted_box() if bounded else self._box[:0]
        if self.cache_bytes > 0:
            decisive = _decisive(self.occupancy)
            self.cache = self._built()
            self._derived_from = decisive
        self._seen = seen  # last: what is stopped on the way is begun anew

    def _built(self) -> CellCache | None:
        try:
            with torch.autocast(self.device.type, enabled=False):  # whatever the host is in
                return build_cache(
                    self.occupancy, budget=self.cache_bytes, tolerance=self.tolerance
                )
        except ValueError as reason:
            _log.warning("no cell cache, sampling will be slower: %s", reason)
            return None

    def _uncontracted_box(self) -> Tensor:
        space = self.occupancy.space
        return torch.cat(
            [space.center - space.half_extent, space.center + space.half_extent]
        ).reshape(1, 6)

    def questions(self) -> tuple[OccupiedFn | None, NearFn | None]:
        self._follow()
        return self.occupied, None if self.cache is None else self.cache.near

    def kept(
        self,
        rays_o: Tensor,
        rays_d: Tensor,
        t_mins: Tensor,
        t_maxs: Tensor,
        step_size: float,
        cone_angle: float,
        jitter: Tensor | None,
        t_enters: Tensor | None,
    ) -> Samples:
        """As any estimator's, by the fused march where it runs."""
        rays = rays_o, rays_d, t_mins, t_maxs, step_size, cone_angle, jitter, t_enters
        self._follow()
        samples = fused.march(self.occupancy, self.cache, rays_o.device, lambda: number(*rays))
        samples = super().kept(*rays) if samples is None else samples
        if self.training and not (self._warned or self._box_is_given or len(samples[0])):
            self._warned = self._warn_of_rays_elsewhere(rays_o, rays_d, t_mins, t_maxs)
        return samples

    def _warn_of_rays_elsewhere(
        self, rays_o: Tensor, rays_d: Tensor, t_mins: Tensor, t_maxs: Tensor
    ) -> bool:
        """Says so where no ray of a batch comes near: they are in other coordinates then."""
        box = self.aabbs[0].to(rays_o)
        enters, leaves = intersect_box(rays_o, rays_d, box)
        meets = enters.maximum(t_mins) < leaves.minimum(t_maxs)
        if len(rays_o) < RAYS_THAT_TELL or bool(meets.any()):
            return False
        _log.warning(
            "none of a batch of %d rays comes near what this occupancy is of, %s: rays must be in "
            "the coordinates in which it was learned (`frame` in its report leads there)",
            len(rays_o),
            " to ".join(str([round(x, 3) for x in corner]) for corner in box.view(2, 3).tolist()),
        )
        return True

    def bounds(self) -> Tensor | None:
        self._follow()
        return self._box[0] if len(self._box) else None

    @torch.no_grad()
    def occupied(self, positions: Tensor) -> Tensor:
        """The gate's decision, from the cache where it is sure; positions [N, 3] to bool [N]."""
        self._follow()
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

    @property
    def aabbs(self) -> Tensor:
        """Boxes as `OccGridEstimator` has them, [1, 6]; of an unbounded space the inner cube."""
        self._follow()
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


def cell_centers(aabbs: Tensor, resolution: Tensor) -> Tensor:
    """Centres of the cells of boxes [n_boxes, 6], z fastest: [n_boxes * cells, 3].

    Args:
        resolution: cells along each axis, int [3].
    """
    axes = [(torch.arange(cells, device=aabbs.device) + 0.5) / cells for cells in resolution]
    units = torch.cartesian_prod(*axes)
    low, high = aabbs[:, None, :3], aabbs[:, None, 3:]
    return (low + units * (high - low)).view(-1, 3)


def _decisive(occupancy: OccupancyLike) -> list[Tensor]:
    """Copies of what an occupancy's decisions depend on, as far as its tensors hold it."""
    if not isinstance(occupancy, torch.nn.Module):
        return []
    return [value.detach().cpu().clone() for value in occupancy.state_dict().values()]


def _same(some: list[Tensor], others: list[Tensor]) -> bool:
    """Whether two such lists are alike in every type and value, and hold any."""
    return 0 < len(some) == len(others) and all(
        one.dtype == other.dtype and torch.equal(one, other)
        for one, other in zip(some, others, strict=True)
    )
