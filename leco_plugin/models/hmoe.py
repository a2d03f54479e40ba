"""The heterogeneous mixture of experts: large scene experts and a tiny empty-space expert.

Dispatch is top-1 and dropless: every point goes through the expert it is routed to.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from leco_plugin.models.compute.dispatch import dispatch
from leco_plugin.models.compute.grouped import grouped_dispatch, may_group


@dataclass(frozen=True)
class HMoEConfig:
    """The shape of the experts."""

    scene_experts: int = 4
    """n: number of scene experts."""
    width: int = 64
    """Units of each layer of a scene expert, and of its output."""
    layers: int = 2
    """Layers of a scene expert."""
    skip: int | None = None
    """Layer that sees the input again (3 in Switch-NeRF), or None."""
    residual: bool = True
    """Whether a scene expert adds to its input, starting from adding nothing: it is then the
    identity at first, as the empty-space expert is, and a point that changes experts does not
    jump."""
    empty_expert: Literal["identity", "mlp", "none"] = "identity"
    """What points of empty space go through: the identity, a small MLP, or nothing (zero features
    and zero density)."""
    empty_layers: int = 1
    """Layers of the empty-space expert when it is an MLP."""


class Expert(nn.Module):
    """An MLP of constant width, as it is or added to its input; [M, width] to [M, width]."""

    def __init__(
        self, width: int, layers: int, skip: int | None = None, residual: bool = False
    ) -> None:
        super().__init__()
        self.skip = skip
        self.residual = residual
        linears = [nn.Linear(2 * width if i == skip else width, width) for i in range(layers)]
        self.layers = nn.ModuleList(linears)
        if residual:
            nn.init.zeros_(linears[-1].weight)
            nn.init.zeros_(linears[-1].bias)

    def forward(self, features: Tensor) -> Tensor:
        hidden = features
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            if i == self.skip:
                hidden = torch.cat([features, hidden], dim=-1)
            hidden = layer(hidden)
            if i < last or not self.residual:
                hidden = torch.relu(hidden)
        return features + hidden if self.residual else hidden


class HMoE(nn.Module):
    """h(x) = G_i*(x) E_i*(x): each point through the one expert it is routed to.

    Attributes:
        left: bool [n], which scene experts are left over: not dropped. Saved in the state dict.
    """

    left: Tensor

    def __init__(self, config: HMoEConfig) -> None:
        super().__init__()
        self.config = config
        empty: nn.Module = nn.Identity()
        if config.empty_expert == "mlp":
            empty = Expert(config.width, config.empty_layers)
        scene = (self._scene_expert() for _ in range(config.scene_experts))
        self.experts = nn.ModuleList([empty, *scene])
        self.register_buffer("left", torch.ones(config.scene_experts, dtype=torch.bool))

    def _scene_expert(self) -> Expert:
        config = self.config
        return Expert(config.width, config.layers, config.skip, config.residual)

    def drop(self, number: int) -> nn.Module:
        """Takes a scene expert out, parameters and all; the others keep their numbers.

        Args:
            number: in [1, n], of an expert that is left.
        Returns:
            The expert, for `put_back`.
        """
        expert = self.experts[number]
        self.experts[number] = None  # type: ignore[assignment]
        self.left[number - 1] = False
        return expert

    def put_back(self, number: int, expert: nn.Module) -> None:
        """Undoes `drop`."""
        self.experts[number] = expert
        self.left[number - 1] = True

    def remaining_experts(self) -> Tensor | None:
        """`left`, or None while no expert has been dropped; nothing waits for the device."""
        return self.left if any(expert is None for expert in self.experts) else None

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Called by torch, before it reads the experts' values: takes on those that there are.

        nerfstudio reads a checkpoint twice, the second time without the model's part.
        """
        left = state_dict.get(f"{prefix}left", self.left).tolist()
        for number, is_left in enumerate(left[: len(self.left)], 1):
            if not is_left and self.experts[number] is not None:
                self.drop(number)
            elif is_left and self.experts[number] is None:
                self.put_back(number, self._scene_expert().to(self.left.device))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def forward(self, features: Tensor, routes: Tensor, gate_values: Tensor) -> Tensor:
        """Dispatches, applies the experts, and brings the points back in order.

        No capacity factor: a dropped 3-D point would be a hole.

        Args:
            features: [N, width] A gamma(x).
            routes: [N] int64 in [0, n], of experts that are left.
            gate_values: [N] factor of the features, in the precision of the gate; see
                `rendering.gate_values_and_routes`.
        Returns:
            [N, width] in the dtype of the experts' output.
        """
        empty, *scene = self.experts
        if may_group(features, len(scene), self.config.width):
            hidden = self._grouped(features, routes)
        else:
            experts = [None if self.config.empty_expert == "none" else empty, *scene]
            hidden = dispatch(features, routes, experts)
        return hidden * gate_values[:, None].to(hidden.dtype)

    def _grouped(
        self, features: Tensor, routes: Tensor, dtype: torch.dtype | None = None
    ) -> Tensor:
        """As `dispatch`, without a wait for the device; the empty-space expert sees all points."""
        empty, *scene = (expert for expert in self.experts if expert is not None)
        if len(scene) < len(self.left):
            numbers = torch.cat([self.left.new_zeros(1), self.left]).cumsum(0)
            routes = numbers.index_select(0, routes)
        features = features.to(torch.bfloat16 if dtype is None else dtype)
        with torch.autocast(features.device.type, enabled=False):
            hidden = grouped_dispatch(features, routes, scene)  # type: ignore[arg-type]
        if self.config.empty_expert == "none":
            return hidden
        return torch.where((routes == 0)[:, None], empty(features).to(hidden.dtype), hidden)
