"""The slow twin of a heterogeneous mixture of experts."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.models.hmoe import HMoE


def dense_hmoe(hmoe: HMoE, features: Tensor, routes: Tensor, gate_values: Tensor) -> Tensor:
    """The slow twin of `HMoE.forward`: every expert on every point, selected by a one-hot mask."""
    outputs = torch.stack(
        [
            torch.zeros_like(features) if expert is None else expert(features)
            for expert in hmoe.experts
        ]
    )
    if hmoe.config.empty_expert == "none":
        outputs = torch.cat([torch.zeros_like(outputs[:1]), outputs[1:]])
    chosen = torch.nn.functional.one_hot(routes, len(hmoe.experts)).t()[..., None]
    return (outputs * chosen).sum(dim=0) * gate_values[:, None].to(outputs.dtype)
