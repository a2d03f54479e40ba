"""Encodings gamma(x) of mapped positions, for the gate and for the field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from leco_plugin.models.compute.native import hash_gradients, hash_sums, suits

Kind = Literal["frequency", "hash", "vm", "k-planes", "grid"]


@dataclass(frozen=True)
class EncodingConfig:
    """Which encoding, and its size. Serialisable: it is written into `occupancy.safetensors`."""

    kind: Kind = "frequency"
    """Sines and cosines (NeRF, eq. 4), a multi-resolution hash grid (Instant-NGP, section 3),
    vector-matrix products (TensoRF, eq. 3), products of planes (K-planes, eq. 1), or a plain grid
    (DVGO, eq. 4)."""
    octaves: int = 6
    """Frequency: number of octaves, the lowest with a period of twice the cube."""
    levels: int = 8
    """Hash, K-planes: number of resolutions."""
    features: int = 2
    """Hash, K-planes, grid: features per level."""
    components: int = 8
    """VM: products of a plane and a line for each of the three pairs."""
    log2_table: int = 16
    """Hash: binary logarithm of the entries per level."""
    coarsest: int = 16
    """Hash, K-planes: cells along the cube at the coarsest level."""
    finest: int = 1024
    """Hash: cells along the cube at the finest level."""
    plane_cells: int = 128
    """VM, grid, and the finest level of K-planes: cells along the cube. Memory grows with their
    square; of a grid, with their third power."""


FRESH = {torch.float32: 4, torch.float16: 6, torch.bfloat16: 8}
"""Octaves that follow from one sine and cosine by doubling: two to four times as fast. The error
grows with each; in float32 it stays below that of the angles themselves, in halves below a
third of what rounding to them costs."""


class FrequencyEncoding(nn.Module):
    """x, sin(2^k pi x), cos(2^k pi x) for k < octaves (NeRF, eq. 4)."""

    scales: Tensor
    start: Tensor

    def __init__(self, octaves: int) -> None:
        super().__init__()
        self.out_dim = 3 + 6 * octaves
        # of lists, here and below: on the meta device, arange would first import all of sympy
        scales = [math.pi * 2.0**octave for octave in range(octaves)]
        self.register_buffer("scales", torch.tensor(scales, dtype=torch.float32), persistent=False)
        self.register_buffer("start", torch.tensor([0.0, -1.0]).view(2, 1, 1), persistent=False)

    def forward(self, mapped: Tensor, dtype: torch.dtype | None = None) -> Tensor:
        """[N, 3] in [-1, 1] to [N, 3 + 6 octaves]; `dtype` is the positions' unless given."""
        x = mapped.t().contiguous()
        dtype = dtype or x.dtype
        if x.requires_grad:  # as it is defined, which torch can differentiate
            angles = (self.scales[:, None, None] * x).flatten(0, 1)
            return torch.cat([x, angles.sin(), angles.cos()]).t().to(dtype)
        features = x.new_empty(self.out_dim, x.shape[1], dtype=dtype)
        features[:3] = x
        octaves = features[3:].view(2, len(self.scales), *x.shape).unbind(1)  # sine and cosine each
        wide = octaves if dtype == x.dtype else x.new_empty(2, 2, *x.shape).unbind()
        for octave, (scale, stored) in enumerate(zip(self.scales, octaves, strict=True)):
            waves, last = wide[octave % len(wide)], wide[(octave - 1) % len(wide)]
            if octave % FRESH.get(dtype, 1) == 0:
                angles = x * scale
                torch.sin(angles, out=waves[0])
                torch.cos(angles, out=waves[1])
            else:  # sin 2a = 2 sin a cos a, cos 2a = 2 cos a cos a - 1
                torch.addcmul(self.start, last, last[1], value=2.0, out=waves)
            if waves is not stored:
                stored.copy_(waves)
        return features.t()


PRIMES = (1, 2654435761 - 2**32, 805459861)
"""Of Instant-NGP's hash. Products wrap around in int32, of which the low bits are what is kept."""


def sum_by_row(rows: Tensor, weights: Tensor, gradient: Tensor, size: int) -> Tensor:
    """Gradient [size, features] of a table from that [M, features] of weighted sums of its rows
    [M, K] int32, on a CPU; weights [M, K]."""
    flat = rows.flatten()
    columns = [
        torch.bincount(flat, (weights * column[:, None]).flatten(), minlength=size)
        for column in gradient.unbind(dim=-1)
    ]
    return torch.stack(columns, dim=-1)


class _InterpolateTable(torch.autograd.Function):
    """Weighted sum of 4 table rows per point and level; the backward is a histogram.

    `embedding_bag` is the fastest forward that plain torch has on a CPU, but its backward sorts
    the indices; a weighted `bincount` per feature is 9 times faster there. On CUDA `index_add_` is
    right.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weights: Tensor, table: Tensor) -> Tensor:
        ctx.save_for_backward(rows, weights)
        ctx.table_shape = table.shape
        return torch.nn.functional.embedding_bag(
            rows, table, per_sample_weights=weights, mode="sum"
        )

    @staticmethod
    def backward(  # type: ignore[override]
        ctx: Any, gradient: Tensor
    ) -> tuple[None, None, Tensor]:
        rows, weights = ctx.saved_tensors
        size, features = ctx.table_shape
        if gradient.device.type == "cpu":
            return None, None, sum_by_row(rows, weights, gradient, size).to(gradient.dtype)
        spread = (weights[..., None] * gradient[:, None, :]).reshape(-1, features)
        whole = gradient.new_zeros(size, features)
        return None, None, whole.index_add_(0, rows.flatten(), spread)


class _NativeSums(torch.autograd.Function):
    """The same by `hash_grids.c`, an eighth of the time, from positions [N, 3] in [0, 1]."""

    @staticmethod
    def forward(ctx: Any, unit: Tensor, resolutions: Tensor, table: Tensor) -> Tensor:
        ctx.save_for_backward(unit, resolutions)
        ctx.rows = len(table)
        return hash_sums(unit, resolutions, table, corners=4)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[None, None, Tensor]:  # type: ignore[override]
        unit, resolutions = ctx.saved_tensors
        return None, None, hash_gradients(unit, resolutions, gradient, ctx.rows, corners=4)


class HashEncoding(nn.Module):
    """Multi-resolution hash grid (Instant-NGP, eq. 3 and 4). Positions receive no gradient.

    Features are interpolated linearly over tetrahedra: 4 rows a level, where the trilinear
    interpolation of the paper looks up 8, and half of its time on a CPU.
    """

    resolutions: Tensor
    offsets: Tensor
    primes: Tensor

    def __init__(
        self, levels: int, features: int, log2_table: int, coarsest: int, finest: int
    ) -> None:
        super().__init__()
        self.out_dim = levels * features
        self.mask = 2**log2_table - 1
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        resolutions = torch.tensor(
            [math.floor(coarsest * growth**level) for level in range(levels)], dtype=torch.float32
        )
        self.register_buffer("resolutions", resolutions, persistent=False)
        offsets = [level << log2_table for level in range(levels)]
        self.register_buffer("offsets", torch.tensor(offsets, dtype=torch.int32), persistent=False)
        self.register_buffer("primes", torch.tensor(PRIMES, dtype=torch.int32), persistent=False)
        self.table = nn.Parameter(torch.empty(levels << log2_table, features).uniform_(-1e-4, 1e-4))

    def rows_and_weights(self, mapped: Tensor) -> tuple[Tensor, Tensor]:
        """The 4 table rows of every point and level, and their weights.

        A cell is cut into six tetrahedra by the order of the three coordinates in it. From the
        lowest corner a walk adds the axis of the largest coordinate, the middle one, the smallest.

        Args:
            mapped: [N, 3] in [-1, 1].
        Returns:
            rows [N * levels, 4] int32, weights [N * levels, 4] float32, which sum to one.
        """
        unit = (mapped.detach().float() * 0.5 + 0.5).t()
        cells = unit[:, :, None] * self.resolutions  # [3, N, levels]
        corner = cells.floor()
        x, y, z = cells.sub_(corner).unbind(0)
        low = corner.to(torch.int32).mul_(self.primes[:, None, None])
        # what an exclusive or with the row's hash does to go one step along each axis
        along_x, along_y, along_z = (low ^ (low + self.primes[:, None, None])).unbind(0)
        first = low[0] ^ low[1] ^ low[2]
        x_over_y, y_over_z, x_over_z = x >= y, y >= z, x >= z
        largest = torch.where(x_over_y & x_over_z, along_x, torch.where(y_over_z, along_y, along_z))
        smallest = torch.where(
            x_over_z & y_over_z, along_z, torch.where(x_over_y, along_y, along_x)
        )
        last = first ^ along_x ^ along_y ^ along_z
        rows = torch.stack([first, first ^ largest, last ^ smallest, last], dim=-1)
        rows.bitwise_and_(self.mask).add_(self.offsets[:, None])
        most, least = torch.maximum(torch.maximum(x, y), z), torch.minimum(torch.minimum(x, y), z)
        middle = x + y + z - most - least
        weights = torch.stack([1.0 - most, most - middle, middle - least, least], dim=-1)
        return rows.view(-1, 4), weights.view(-1, 4)

    def forward(self, mapped: Tensor) -> Tensor:
        """[N, 3] in [-1, 1] to [N, levels * features] float32."""
        if suits(mapped, self.table):
            unit = mapped.detach() * 0.5 + 0.5
            features: Tensor = _NativeSums.apply(unit, self.resolutions, self.table)
            return features
        rows, weights = self.rows_and_weights(mapped)
        with torch.autocast(mapped.device.type, enabled=False):
            sums = _InterpolateTable.apply(rows, weights, self.table)
        return sums.view(len(mapped), self.out_dim)


COLUMNS, ROWS, ACROSS = [0, 0, 1], [1, 2, 2], [2, 1, 0]
"""Axes of the planes XY, XZ and YZ: along their columns, along their rows, and left out."""


def _interpolate(tables: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
    """Bilinear values of three tables at N points each; their ends lie on -1 and 1.

    One `grid_sample` for all planes of a resolution is on a CPU as fast as `embedding_bag` with a
    histogram for its backward, or twice as fast (docs/decisions.md).

    Args:
        tables: [3, F, rows, columns].
        columns, rows: [N, 3] coordinates in [-1, 1].
    Returns:
        [3, F, N].
    """
    # contiguous: with other strides grid_sample takes four times as long
    places = torch.stack([columns.t(), rows.t()], dim=-1)[:, None]
    return nn.functional.grid_sample(tables, places, align_corners=True)[:, :, 0]


def _inside(mapped: Tensor, table: Tensor) -> Tensor:
    """Positions without gradient, inside the cube, in the table's type."""
    return mapped.detach().to(table.dtype).clamp(-1.0, 1.0)


class VectorMatrixEncoding(nn.Module):
    """VM decomposition: products of a plane and the line across it (Chen et al. 2022, eq. 3 and 4).

    A_r(x) = M_r^XY(x, y) v_r^Z(z) and likewise for the other two pairs, for r < R; not summed, so
    that the gate weighs them, as TensoRF does for colour. Positions receive no gradient.
    """

    def __init__(self, components: int, cells: int) -> None:
        super().__init__()
        self.out_dim = 3 * components
        points = cells + 1
        self.planes = nn.Parameter(0.1 * torch.randn(3, components, points, points))
        self.lines = nn.Parameter(0.1 * torch.randn(3, components, points, 1))

    def forward(self, mapped: Tensor) -> Tensor:
        """[N, 3] in [-1, 1] to [N, 3 components] float32."""
        with torch.autocast(mapped.device.type, enabled=False):
            x = _inside(mapped, self.planes)
            across = x[:, ACROSS]
            matrices = _interpolate(self.planes, x[:, COLUMNS], x[:, ROWS])
            vectors = _interpolate(self.lines, torch.zeros_like(across), across)
            return (matrices * vectors).flatten(0, 1).t()


class KPlanesEncoding(nn.Module):
    """K-planes of a static scene (Fridovich-Keil et al. 2023, eq. 1 to 3).

    f(x) = f^XY(x, y) f^XZ(x, z) f^YZ(y, z), elementwise, at several resolutions, concatenated.
    Positions receive no gradient.
    """

    def __init__(self, levels: int, features: int, coarsest: int, finest: int) -> None:
        super().__init__()
        self.out_dim = levels * features
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        self.resolutions = [round(coarsest * growth**level) for level in range(levels)]
        # a product of three factors that start near zero would hardly learn
        self.planes = nn.ParameterList(
            nn.Parameter(torch.empty(3, features, cells + 1, cells + 1).uniform_(0.9, 1.1))
            for cells in self.resolutions
        )

    def forward(self, mapped: Tensor) -> Tensor:
        """[N, 3] in [-1, 1] to [N, levels * features] float32."""
        with torch.autocast(mapped.device.type, enabled=False):
            x = _inside(mapped, self.planes[0])
            columns, rows = x[:, COLUMNS], x[:, ROWS]
            levels = (_interpolate(planes, columns, rows) for planes in self.planes)
            return torch.cat([level[0] * level[1] * level[2] for level in levels]).t()


class GridEncoding(nn.Module):
    """Features at the corners of one grid of cells, interpolated in between (Sun et al. 2022, DVGO,
    eq. 4): an occupancy grid that learns as a gate does. Positions receive no gradient."""

    def __init__(self, features: int, cells: int) -> None:
        super().__init__()
        self.out_dim = features
        points = [cells + 1] * 3
        self.table = nn.Parameter(torch.empty(1, features, *points).uniform_(-1e-4, 1e-4))

    def forward(self, mapped: Tensor) -> Tensor:
        """[N, 3] in [-1, 1] to [N, features] float32."""
        with torch.autocast(mapped.device.type, enabled=False):
            places = _inside(mapped, self.table).view(1, 1, 1, -1, 3)
            found = nn.functional.grid_sample(self.table, places, align_corners=True)
            return found.view(self.out_dim, -1).t()


Encoding = FrequencyEncoding | HashEncoding | VectorMatrixEncoding | KPlanesEncoding | GridEncoding


def build_encoding(config: EncodingConfig) -> Encoding:
    """The module that `config` describes."""
    levels, features, coarsest = config.levels, config.features, config.coarsest
    if config.kind == "hash":
        return HashEncoding(levels, features, config.log2_table, coarsest, config.finest)
    if config.kind == "vm":
        return VectorMatrixEncoding(config.components, config.plane_cells)
    if config.kind == "k-planes":
        return KPlanesEncoding(levels, features, coarsest, config.plane_cells)
    if config.kind == "grid":
        return GridEncoding(features, config.plane_cells)
    return FrequencyEncoding(config.octaves)
