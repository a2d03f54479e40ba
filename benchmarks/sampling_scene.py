"""A gate fitted to a small city of boxes, and rays into it, for the sampling benchmark."""

from __future__ import annotations

import torch
from torch import Tensor

from leco_plugin.models.compute.device import fast_precision
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy, gate_precision
from leco_plugin.space import Space

SHELL = 0.03
"""Half the thickness of what is occupied: learned occupancy keeps surfaces, not what is inside."""


def fit_occupancy(device: str, steps: int = 300) -> Occupancy:
    """A frozen occupancy whose decisions are those of a city's surfaces, as far as it can learn.

    The gate has the default size and is trained in the device's fastest precision on the truth,
    with the contribution loss's emphasis, so that its boundary is as rough as a learned one's.
    """
    torch.manual_seed(0)
    boxes = city(device)
    gate = Gate(GateConfig()).to(device)
    precision = fast_precision(device)
    optimizer = torch.optim.Adam(gate.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1.0 / steps))
    for _ in range(steps):
        mapped = torch.rand(8192, 3, device=device) * 2.0 - 1.0
        surface = (distance(mapped, boxes).abs() < SHELL).float()
        with gate_precision(torch.device(device).type, precision):
            values = gate.occupancy(mapped).clamp(1e-6, 1.0 - 1e-6)
        loss = -(4.0 * surface * values.log() + (1.0 - surface) * (1.0 - values).log()).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return Occupancy(gate, Space().to(device), 0.1, precision).to(device)


def city(device: str) -> Tensor:
    """Centres and half sizes of sixteen towers, [16, 2, 3], standing on z = -0.35."""
    places = torch.tensor([-0.6, -0.2, 0.2, 0.6])
    x, y = torch.meshgrid(places, places, indexing="ij")
    half_heights = 0.1 + 0.25 * torch.rand(16)
    centers = torch.stack([x.flatten(), y.flatten(), half_heights - 0.35], dim=-1)
    halves = torch.stack([torch.full((16,), 0.08), torch.full((16,), 0.08), half_heights], dim=-1)
    return torch.stack([centers, halves], dim=1).to(device)


def distance(positions: Tensor, boxes: Tensor) -> Tensor:
    """Signed distance of positions [N, 3] to the ground and the towers, [N]."""
    outside = (positions[:, None] - boxes[:, 0]).abs() - boxes[:, 1]
    to_boxes = outside.clamp(min=0.0).norm(dim=-1) + outside.amax(dim=-1).clamp(max=0.0)
    return torch.minimum(positions[:, 2] + 0.35, to_boxes.amin(dim=-1))


def rays_into(space: Space, n_rays: int) -> tuple[Tensor, Tensor]:
    """Rays of cameras above the edge of a scene that look across it, [n_rays, 3] each."""
    generator = torch.Generator().manual_seed(1)
    angles = torch.rand(n_rays, generator=generator) * 2.0 * torch.pi
    origins = torch.stack(
        [0.9 * angles.cos(), 0.9 * angles.sin(), torch.full_like(angles, 0.7)], -1
    )
    spread = torch.randn(n_rays, 3, generator=generator) * torch.tensor([0.7, 0.7, 0.2])
    directions = spread - origins * 0.6 + torch.tensor([0.0, 0.0, -0.5])
    directions = torch.nn.functional.normalize(directions, dim=-1).to(space.center.device)
    scale = space.half_extent * (1.0 if space.kind == "box" else 0.5)
    return space.center + origins.to(space.center.device) * scale, directions
