"""An occupancy with known decisions, and slow definitions of marching and rendering, for tests."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from leco_plugin.space import Space


class Balls(nn.Module):
    """Two balls: o is a sigmoid of the distance to the nearer surface, 1/2 on it.

    Answers the protocol that the samplers ask of a frozen occupancy, and counts the questions.
    """

    threshold = 0.25

    def __init__(
        self, kind: str = "box", half_extent: float = 1.0, sharpness: float = 40.0
    ) -> None:
        super().__init__()
        self.space = Space(kind, (0.1, -0.2, 0.0), half_extent)  # type: ignore[arg-type]
        self.register_buffer("centers", torch.tensor([[0.3, -0.2, 0.1], [-0.4, 0.1, -0.2]]))
        self.register_buffer("radii", torch.tensor([0.25, 0.15]))
        self.sharpness = sharpness
        self.asked = 0

    def query(self, positions: Tensor) -> Tensor:
        """o at positions [N, 3]; 0 outside a bounded space."""
        self.asked += len(positions)
        mapped = self.space.map(positions)
        inside = (mapped.abs() <= 1.0).all(dim=-1)
        distances = (positions[:, None] - self.centers.to(positions)).norm(dim=-1)
        logits = ((self.radii.to(positions) - distances) * self.sharpness).amax(dim=-1)
        return torch.sigmoid(logits) * inside

    def occupied(self, positions: Tensor) -> Tensor:
        """Whether o reaches the threshold."""
        return self.query(positions) >= self.threshold


def camera_rays(n_rays: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Origins on a sphere of radius 2 and directions towards the middle, [n_rays, 3]."""
    generator = torch.Generator().manual_seed(seed)
    origins = nn.functional.normalize(torch.randn(n_rays, 3, generator=generator), dim=-1) * 2.0
    towards = torch.randn(n_rays, 3, generator=generator) * 0.3 - origins
    return origins, nn.functional.normalize(towards, dim=-1)


def slow_march(
    origins: Tensor,
    directions: Tensor,
    t_mins: Tensor,
    t_maxs: Tensor,
    step_size: float,
    cone_angle: float,
    occupied: Callable[[Tensor], Tensor] | None = None,
    t_enters: Tensor | None = None,
) -> list[tuple[int, float, float]]:
    """(ray, start, end) of each kept candidate, one step at a time in float64."""
    found = []
    for ray in range(len(origins)):
        t = t_mins[ray].item()
        finite = origins[ray].isfinite().all() and directions[ray].isfinite().all()
        if not (finite and math.isfinite(t) and directions[ray].abs().sum() > 0):
            continue
        while t + 0.5 * (dt := max(t * cone_angle, step_size)) < t_maxs[ray].item():
            middle = t + 0.5 * dt
            if t_enters is None or middle >= t_enters[ray].item():
                found.append((ray, t, t + dt, middle))
            t += dt
    kept = [True] * len(found)
    if occupied is not None and found:
        rays = torch.tensor([ray for ray, *_ in found])
        middles = torch.tensor([middle for *_, middle in found], dtype=directions.dtype)
        kept = occupied(origins[rays] + directions[rays] * middles[:, None]).tolist()
    return [tuple(one[:3]) for one, keep in zip(found, kept, strict=True) if keep]


def slow_weights(
    depths: Tensor, ray_indices: Tensor
) -> tuple[list[float], list[float], list[float]]:
    """(weights, transmittance, opacities) of samples with optical depths, one at a time."""
    weights, trans, alphas = [], [], []
    light, last = 1.0, -1
    for depth, ray in zip(depths.tolist(), ray_indices.tolist(), strict=True):
        light = 1.0 if ray != last else light
        alpha = 1.0 - math.exp(-depth)
        weights.append(light * alpha)
        trans.append(light)
        alphas.append(alpha)
        light, last = light * math.exp(-depth), ray
    return weights, trans, alphas
