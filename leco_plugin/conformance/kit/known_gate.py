"""Gates whose weights are written down instead of learned, on each kind of features.

Every encoding here can hold a linear function of the position: interpolation between the corners of
a cell keeps it. From there two hidden layers make a slab.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from leco_plugin.models.encodings import (
    Encoding,
    EncodingConfig,
    FrequencyEncoding,
    HashEncoding,
    Kind,
    KPlanesEncoding,
    VectorMatrixEncoding,
)
from leco_plugin.models.gate import Gate, GateConfig

SMALLEST: dict[Kind, EncodingConfig] = {
    "frequency": EncodingConfig("frequency", octaves=1),
    "hash": EncodingConfig("hash", levels=1, features=1, log2_table=16, coarsest=2, finest=2),
    "vm": EncodingConfig("vm", components=2, plane_cells=1),
    "k-planes": EncodingConfig("k-planes", levels=1, features=2, coarsest=1, plane_cells=1),
}
"""The least of each kind that holds a linear function."""


@torch.no_grad()
def slab_gate(normal: Tensor, half_width: float, kind: Kind = "frequency") -> Gate:
    """A gate with o(x) >= 1/2 where |normal.x| <= half_width, for mapped positions x.

    The hidden layers make u = relu(|n.x| - w) and v = relu(w - |n.x|), so small that the LayerNorm
    is nearly linear between them; the logit of o is proportional to v - u.
    """
    gate = Gate(GateConfig(SMALLEST[kind], width=2, layers=2, scene_experts=1))
    for parameter in gate.parameters():
        parameter.zero_()
    small, steepness = 2e-3, 50.0
    first, second = gate.hidden
    assert isinstance(first, nn.Linear) and isinstance(second, nn.Linear)
    signs = torch.tensor([1.0, -1.0])
    first.weight.copy_(signs[:, None] * write_linear(gate.encoding, normal))
    second.weight.copy_((small * signs)[:, None].expand(2, 2))
    second.bias.copy_(-small * half_width * signs)
    gate.norm.weight.fill_(1.0)
    gate.head.weight[1] = -steepness * signs
    return gate


def write_linear(encoding: Encoding, normal: Tensor) -> Tensor:
    """Writes into an encoding of `SMALLEST` what makes n.x a weighted sum of its features.

    Returns:
        the weights, [out_dim].
    """
    weights = torch.zeros(encoding.out_dim)
    ends = torch.tensor([-1.0, 1.0])
    across = normal[0] * ends + normal[1] * ends[:, None]  # rows are along y, columns along x
    if isinstance(encoding, FrequencyEncoding):
        weights[:3] = normal
    elif isinstance(encoding, HashEncoding):
        axis = torch.linspace(-1.0, 1.0, int(encoding.resolutions[0]) + 1)
        corners = torch.cartesian_prod(axis, axis, axis)
        rows = encoding.rows_and_weights(corners)[0][:, 0].long()
        encoding.table[rows, 0] = corners @ normal
        weights[0] = 1.0
    elif isinstance(encoding, VectorMatrixEncoding):
        encoding.planes[0, 0], encoding.lines[0, 0] = across, 1.0
        encoding.planes[0, 1], encoding.lines[0, 1, :, 0] = 1.0, normal[2] * ends
        weights[:2] = 1.0
    elif isinstance(encoding, KPlanesEncoding):
        (planes,) = encoding.planes
        planes.fill_(1.0)
        planes[0, 0], planes[1, 1] = across, normal[2] * ends[:, None]
        weights[:2] = 1.0
    return weights
