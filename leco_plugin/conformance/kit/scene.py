"""A scene in which everything is known: a box, rays through and past it, a slab, and a field.

The slab's occupancy is a real one: it decides exactly, costs nothing, and is saved and loaded like
any other.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from leco_plugin.conformance.kit.known_gate import slab_gate
from leco_plugin.models.encodings import Kind
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import accumulate_along_rays, render_weight_from_density
from leco_plugin.space import Space

CENTRE, HALF = (0.5, -1.0, 2.0), 1.5
"""The box: neither centred nor of unit size, so that a forgotten mapping is noticed."""
DISTANCE = 2.0 * HALF
"""From the centre of the box to every ray's origin."""
STEP = 0.05
MARGIN = 0.08
"""World units. Deeper than this inside what is kept is plainly inside, farther off is plainly
outside: wider than a cell of a grid of 128, and than what a rounding decides."""
BACKGROUND = (0.2, 0.5, 0.8)
HERE = torch.eye(3, 4)
MOVED = torch.tensor([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, -0.5], [0.0, 0.0, 2.0, 0.25]])
"""Frames [3, 4], which take a host's coordinates to those of an occupancy: the same ones; and
others, turned by a right angle, twice as large and shifted."""


def box() -> Tensor:
    """The host's box, (min, max), [6]."""
    centre = torch.tensor(CENTRE)
    return torch.cat([centre - HALF, centre + HALF])


class Rays(NamedTuple):
    """Rays of a host, world units."""

    origins: Tensor
    directions: Tensor
    t_min: Tensor
    t_max: Tensor

    def at(self, ray_indices: Tensor, t: Tensor) -> Tensor:
        """Positions [N, 3] at distances t [N] along rays [N]."""
        return self.origins[ray_indices] + self.directions[ray_indices] * t[:, None]

    def to(self, device: torch.device) -> Rays:
        """The same on another device."""
        return Rays(*(tensor.to(device) for tensor in self))


@functools.cache
def crossing(n_rays: int = 48) -> Rays:
    """From all around through the box, with ends well outside it."""
    generator = torch.Generator().manual_seed(0)
    outward = nn.functional.normalize(torch.randn(n_rays, 3, generator=generator), dim=-1)
    aim = 0.3 * torch.randn(n_rays, 3, generator=generator)
    directions = nn.functional.normalize(aim - DISTANCE * outward, dim=-1)
    t_min = 0.2 + 0.4 * torch.rand(n_rays, generator=generator)
    t_max = 2.0 * DISTANCE - torch.rand(n_rays, generator=generator)
    return Rays(torch.tensor(CENTRE) + DISTANCE * outward, directions, t_min, t_max)


def cut_short() -> Rays:
    """The same rays, which begin and end inside the box."""
    rays = crossing()
    spread = torch.linspace(0.0, 0.4, len(rays.t_min))
    return rays._replace(t_min=DISTANCE - 0.8 + spread, t_max=DISTANCE + 0.8 - spread)


def stretched() -> Rays:
    """The rays of `crossing` with directions of length 2, as a host in other units has them."""
    rays = crossing()
    return Rays(rays.origins, 2.0 * rays.directions, rays.t_min / 2.0, rays.t_max / 2.0)


def without_samples() -> dict[str, Rays]:
    """Rays on which there is nothing to sample, by why."""
    rays = crossing()
    return {
        "no rays": Rays(*(tensor[:0] for tensor in rays)),
        "rays that miss the box": rays._replace(directions=-rays.directions),
        "rays that end before they begin": rays._replace(t_min=rays.t_max, t_max=rays.t_min),
    }


@dataclass(frozen=True)
class Slab:
    """Occupied is what lies in the box and within a distance of a plane through its middle.

    Attributes:
        normal: of the plane, of length 1.
        half_width: in half extents of the box.
    """

    normal: tuple[float, float, float]
    half_width: float

    def depth(self, positions: Tensor) -> Tensor:
        """How deep positions [..., 3] lie inside, world units, [...]; negative outside."""
        offsets = positions - positions.new_tensor(CENTRE)
        from_plane = (offsets @ positions.new_tensor(self.normal)).abs()
        return torch.minimum(self.half_width * HALF - from_plane, HALF - offsets.abs().amax(dim=-1))

    def density(self, positions: Tensor) -> Tensor:
        """1 inside and 0 outside: [..., 3] to [..., 1], as hosts answer."""
        return (self.depth(positions) >= 0.0).to(positions.dtype)[..., None]

    def occupancy(self, kind: Kind = "frequency", frame: Tensor = HERE) -> Occupancy:
        """A frozen gate on features of a kind that says just this, in a frame's coordinates."""
        turn, shift = frame[:, :3], frame[:, 3]
        scale = float(turn.abs().max())  # turns are by right angles
        gate = slab_gate(turn @ torch.tensor(self.normal) / scale, self.half_width, kind)
        x, y, z = (turn @ torch.tensor(CENTRE) + shift).tolist()
        known = Occupancy(gate, Space("box", (x, y, z), scale * HALF), threshold=0.5)
        return known.requires_grad_(False).eval()


SLAB = Slab((0.6, 0.64, 0.48), 0.4)
OTHER = Slab((0.0, 0.0, 1.0), 0.25)
EVERYTHING = Slab((0.0, 0.0, 1.0), 100.0)


class Field(nn.Module):
    """A fog with a colour: the least that can be learned by rendering."""

    def __init__(self) -> None:
        super().__init__()
        self.log_density = nn.Parameter(torch.tensor(-1.0))
        self.colour = nn.Parameter(torch.tensor([0.9, 0.1, 0.4]))

    def density(self, positions: Tensor) -> Tensor:
        """Density of positions [..., 3]: [...]."""
        return self.log_density.exp() * (1.0 + 0.1 * positions.square().sum(dim=-1))

    def colours(self, positions: Tensor) -> Tensor:
        """Colour of positions [..., 3]: [..., 3]."""
        return self.colour.expand(positions.shape)


def render(field: Field, rays: Rays, samples: Samples) -> Tensor:
    """Colours of rays in front of `BACKGROUND`, as a host renders packed samples: [n_rays, 3]."""
    ray_indices, t_starts, t_ends = samples
    n_rays = len(rays.origins)
    positions = rays.at(ray_indices, (t_starts + t_ends) / 2.0)
    weights, _, _ = render_weight_from_density(
        t_starts, t_ends, field.density(positions), ray_indices=ray_indices, n_rays=n_rays
    )
    colours = accumulate_along_rays(weights, field.colours(positions), ray_indices, n_rays)
    opacity = accumulate_along_rays(weights, None, ray_indices, n_rays)
    return colours + (1.0 - opacity) * colours.new_tensor(BACKGROUND)
