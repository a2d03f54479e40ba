"""A frozen gate's decisions on cells: only positions near its boundary need the gate itself.

The cache has three levels in the mapped cube [-1, 1]^3, so that unbounded scenes are covered. A
coarse cell is empty, occupied or mixed. A mixed one owns a brick of 4^3 fine cells, each again
empty, occupied or mixed. A mixed fine cell holds a plane, the gate's logit to first order, with its
expected error. Farther from the plane than this error, the plane decides; nearer, the gate is
queried. A 2-bit state for each cell would leave 2% of the cube to the gate. A plane for each mixed
cell of half the resolution leaves 0.5% in the same memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from leco_plugin.space import Space, contract

EMPTY, OCCUPIED, MIXED = 0, 1, 2

BRICK_BITS = 2
BRICK = 1 << BRICK_BITS
"""Fine cells along a coarse one."""

COARSE_EMPTY, COARSE_OCCUPIED = -1, -2
"""Values of the coarse table beside the numbers of bricks, which are >= 0."""

UNIFORM = 2
"""Bricks in front of all others that stand for a coarse cell of one of these values, -2 first."""

FINE_EMPTY, FINE_OCCUPIED = 64, 65
"""Values of the fine table beside the numbers of planes within a brick, 0 to 63."""

FARTHEST = 15
"""Largest clearance that is stored, in half coarse cells: what four bits hold."""


class OccupancyLike(Protocol):
    """What the samplers ask of a frozen occupancy; outside a bounded space o is 0."""

    @property
    def space(self) -> Space: ...
    @property
    def threshold(self) -> float: ...
    def query(self, positions: Tensor) -> Tensor: ...
    def occupied(self, positions: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class CacheReport:
    """Figures of a built cache."""

    resolution: int
    """Coarse cells along the cube; there are four times as many fine ones."""
    bytes: int
    """Memory of the tables."""
    differing: float
    """Share of random decisions, half of them where it is not empty, that differ from the gate."""
    differing_bound: float
    """The same plus two standard deviations: what is compared with the tolerance."""
    checked: int
    """Number of decisions behind these figures."""
    asked: float
    """Share of these decisions for which the gate is still asked."""
    margin: float
    """How far from the threshold a cell's logits had to stay, in units of their spread."""
    caution: float
    """Errors of a plane, as measured, within which it does not decide."""


class Tables(NamedTuple):
    """What a cache holds."""

    coarse: Tensor
    """(resolution + 2)^3 values as above; int16 or int32, flat. Around the cube they are
    COARSE_EMPTY for a bounded space, and else a brick whose one plane never decides."""
    fine: Tensor
    """Values as above of the fine cells of each brick; uint8 [n_bricks, 64]."""
    first_plane: Tensor
    """Number of each brick's first plane, int32 [n_bricks]."""
    planes: Tensor
    """Plane a + b.u over a fine cell, u in [-1, 1]^3, and the height |a + b.u| up to which it does
    not decide, in one unit; int8 [5, n_planes], a column contiguous because each is read alone."""
    clearance: Tensor
    """How many half coarse cells are empty from each one on in every direction (maximum norm), the
    cell itself included, up to 15; two to a byte, uint8 [4 resolution^3], flat."""

    @property
    def bytes(self) -> int:
        """Memory of all tables."""
        return sum(table.numel() * table.element_size() for table in self)


class CellCache(nn.Module):
    """Lookup of cell decisions; build one with `cells.build.build_cache`.

    Args:
        tables: the cells.
        space: the mapping of the occupancy that they were judged by.
        report: what building found.
    """

    def __init__(self, tables: Tables, space: Space, report: CacheReport) -> None:
        super().__init__()
        self.report, self.resolution = report, report.resolution
        self.contracted = space.kind == "contraction"
        center, half_extent = (x.detach().cpu().view(-1) for x in (space.center, space.half_extent))
        scale = torch.full((1,), report.resolution / 2.0)
        shift = torch.full((3,), report.resolution / 2.0 + 1.0)
        if not self.contracted:
            # An affine mapping folds into the scaling to cells.
            scale = scale / half_extent
            shift = shift - center * scale
        uniform = torch.tensor([[FINE_OCCUPIED], [FINE_EMPTY]], dtype=torch.uint8)
        uniform = uniform.to(tables.fine.device).expand(UNIFORM, BRICK**3)
        # No buffers: data-parallel training sends every buffer to all ranks before each step, and
        # its back ends know no int16. Each rank derives the same from the gate.
        self.held = tables._replace(fine=torch.cat([uniform, tables.fine]))
        """The tables, with `UNIFORM` bricks in front of the others."""
        self.frame = torch.cat([scale, shift, center, half_extent]).float()
        """Scale and shift [3] to coarse cells, centre [3] and half extent of the space: [8]."""
        self.to(tables.coarse.device)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> CellCache:
        """What moving a module does to its tensors (`to`, `cpu`, `cuda`)."""
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        self.held, self.frame = Tables(*map(fn, self.held)), fn(self.frame)
        return self

    def tables(self) -> Tables:
        """The tables, where they are now."""
        return self.held._replace(fine=self.held.fine[UNIFORM:])

    def decide(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Decisions as far as cells know them.

        Args:
            positions: world units, [N, 3].

        Returns:
            occupied bool [N], False where open; and the indices of positions that are left open,
            int64 [n_open]: the gate's to answer.
        """
        tables, cells = self.held, self._cells(positions, BRICK)
        corners = cells.to(torch.int32)
        coarse = _flat(corners >> BRICK_BITS, self.resolution + 2)
        brick = tables.coarse.index_select(0, coarse).to(torch.int32)
        at = torch.add(_flat(corners.bitwise_and_(BRICK - 1), BRICK), brick, alpha=BRICK**3)
        known = tables.fine.view(-1).index_select(0, at.add_(UNIFORM * BRICK**3))
        # An answer in the type of what is compared is found ten times faster on a CPU than a bool.
        occupied = torch.eq(known, FINE_OCCUPIED, out=torch.empty_like(known)).view(torch.bool)
        mixed = torch.lt(known, FINE_EMPTY, out=torch.empty_like(known)).view(torch.bool)
        chosen = mixed.nonzero()[:, 0]
        if chosen.numel() == 0:
            return occupied, chosen

        plane = tables.first_plane.index_select(0, brick.index_select(0, chosen))
        plane = tables.planes.index_select(1, plane.add_(known.index_select(0, chosen))).float()
        offset, *slopes, error = plane
        within = cells.index_select(1, chosen).frac_().mul_(2.0).sub_(1.0)
        for slope, along in zip(slopes, within, strict=True):
            offset.addcmul_(slope, along)
        occupied.index_copy_(0, chosen, offset > 0.0)
        return occupied, chosen.index_select(0, (offset.abs_() <= error).nonzero()[:, 0])

    def near(self, positions: Tensor, radii: Tensor) -> Tensor:
        """Whether anything within `radii` of `positions` may be occupied (the coarse question).

        Args:
            positions: world units, [N, 3].
            radii: half widths of cubes around them, world units, [N].

        Returns:
            bool [N]; False is certain as far as the cells are.
        """
        halves = self._cells(positions, 2).sub_(2.0)
        width = 2 * self.resolution
        inner = halves.clamp(0.0, width - 1.0).floor_()
        index = _flat(inner, width).to(torch.int32)
        # From the middle of the cell that answers, in cells: over 1/2 outside the cube.
        aside = halves.sub_(inner).sub_(0.5).abs_().amax(dim=0)
        pair = self.held.clearance.index_select(0, index >> 1)
        clear = pair.bitwise_right_shift_((index & 1).mul_(4).to(torch.uint8)).bitwise_and_(15)
        # The cell itself is the first of the empty ones that are counted.
        reach = (radii * self._stretch(positions, radii)).mul_(2.0)
        return reach.add_(aside).add_(0.5) >= clear

    def _stretch(self, positions: Tensor, radii: Tensor) -> Tensor:
        """Bound on cells per world unit (maximum norm) within the balls.

        The contraction f(x) = x (2 - 1/m) / m, m = max|x|, has Jacobian rows whose absolute sum is
        at most (4m - 3) / m^2, which grows to 4/3 at m = 3/2 and falls after.
        """
        scale, half_extent = self.frame[0], self.frame[7]
        if not self.contracted:
            return scale
        distance = (positions.T - self.frame[4:7, None]).abs().amax(dim=0)
        inner = ((distance - radii) / half_extent).clamp(min=1.5)
        return (0.5 / half_extent) * scale * (4.0 * inner - 3.0) / inner.square()

    def _cells(self, positions: Tensor, parts: int) -> Tensor:
        """Coordinates in so many parts of coarse cells, a power of two; [3, N].

        The border is the first and the last coarse cell.
        """
        if self.contracted:
            positions = contract((positions - self.frame[4:7]) / self.frame[7]) * 0.5
        scale, shift = self.frame[0], self.frame[1:4, None]
        cells = torch.addcmul(shift * parts, positions.T, scale * parts)
        return cells.nan_to_num_(nan=0.0).clamp_(0.0, parts * (self.resolution + 1.5))


def _flat(corners: Tensor, width: int) -> Tensor:
    """Index of cells [3, N] in a flat table; whole floats are exact up to a width of 256."""
    index = torch.add(corners[1], corners[0], alpha=width)
    return torch.add(corners[2], index, alpha=width)
