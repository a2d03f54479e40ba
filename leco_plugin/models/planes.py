"""Encodings that factor the cube into planes: TensoRF's vector-matrix form, and K-planes.

Both interpolate all planes of one resolution in one `grid_sample`, which on a CPU is as fast as
`embedding_bag` with a histogram for its backward, or twice as fast (docs/decisions.md).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

COLUMNS, ROWS, ACROSS = [0, 0, 1], [1, 2, 2], [2, 1, 0]
"""Axes of the planes XY, XZ and YZ: along their columns, along their rows, and left out."""


def _interpolate(tables: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
    """Bilinear values of three tables at N points each; their ends lie on -1 and 1.

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
