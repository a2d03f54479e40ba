"""A scene in which everything is known: a box, rays through and past it, a slab, and a field.

The slab's occupancy is a real one, a gate whose weights are written down: it decides exactly, and
is saved and loaded like any other. Samples on the rays are compared at the end of this file.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn

from leco_plugin.conformance.rules import Broken, require
from leco_plugin.models import encodings
from leco_plugin.models.encodings import Encoding, EncodingConfig, Kind
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.samplers.marching import Samples
from leco_plugin.samplers.packed import accumulate_along_rays, render_weight_from_density
from leco_plugin.space import Space, contract

CENTRE, HALF = (0.5, -1.0, 2.0), 1.5
"""The box: neither centred nor of unit size, so that a forgotten mapping is noticed."""
DISTANCE = 2.0 * HALF
"""From the centre of the box to every ray's origin."""
FAR_AWAY = 4.0 * DISTANCE
"""From the origins of rays that leave the box to their ends."""
STEP, LONG_STEP, SHORT_STEP = 0.05, 0.25, 0.0015
"""World units. With long steps a ray has one or two samples in each part of `TWO`, with short ones
some two thousand in the box."""
MANY = 20_000
"""Rays of a batch as a host on a GPU has it: what goes wrong on few rays, or in pieces, shows."""
COUNTS = 48, 1
"""Rays of other batches: the last chunk of an image may hold a single one."""
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
        return Rays(*(tensor.to(device) for tensor in self))

    def copied(self) -> Rays:
        """The same in tensors of their own. What is kept is never handed to a sampler, which may
        write into it."""
        return Rays(*(tensor.clone() for tensor in self))


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


@functools.cache
def cut_short(n_rays: int = 48) -> Rays:
    """The same rays, which begin and end inside the box."""
    rays = crossing(n_rays)
    spread = torch.linspace(0.0, 0.4, len(rays.t_min))
    return rays._replace(t_min=DISTANCE - 0.8 + spread, t_max=DISTANCE + 0.8 - spread)


@functools.cache
def within() -> Rays:
    """Rays that begin inside the box and end outside, as in a room; the first six along the axes,
    where others divide by a direction's zeros."""
    rays = cut_short()
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    return Rays(
        rays.origins + rays.directions * rays.t_min[:, None],
        torch.cat([axes, rays.directions[len(axes) :]]),
        torch.full_like(rays.t_min, 0.05),
        torch.full_like(rays.t_max, 2.0 * DISTANCE),
    )


@functools.cache
def leaving() -> Rays:
    """The same rays, which go on far beyond the box."""
    rays = crossing()
    return rays._replace(t_max=torch.full_like(rays.t_max, FAR_AWAY))


@functools.cache
def stretched() -> Rays:
    """The rays of `crossing` with directions of length 2, as a host in other units has them."""
    rays = crossing()
    return Rays(rays.origins, 2.0 * rays.directions, rays.t_min / 2.0, rays.t_max / 2.0)


@functools.cache
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
    """Occupied is what lies in the box and within a distance of one of two parallel planes.

    Attributes:
        normal: of the planes, of length 1.
        half_width: in half extents of the box.
        offset: of each plane from the middle of the box, in half extents; 0 is one plane.
        unbounded: occupied beyond the box too, within the distance in contracted space.
    """

    normal: tuple[float, float, float]
    half_width: float
    offset: float = 0.0
    unbounded: bool = False

    def depth(self, positions: Tensor) -> Tensor:
        """How deep positions [..., 3] lie inside, world units, [...]; negative outside. Beyond the
        box of an unbounded scene it is measured in contracted space, which is shorter."""
        offsets = positions - positions.new_tensor(CENTRE)
        if self.unbounded:
            offsets = contract(offsets / HALF) * HALF
        from_middle = (offsets @ positions.new_tensor(self.normal)).abs()
        inside = self.half_width * HALF - (from_middle - self.offset * HALF).abs()
        return inside if self.unbounded else inside.minimum(HALF - offsets.abs().amax(dim=-1))

    def density(self, positions: Tensor) -> Tensor:
        """1 inside and 0 outside: [..., 3] to [..., 1], as hosts answer."""
        return (self.depth(positions) >= 0.0).to(positions.dtype)[..., None]

    def occupancy(self, kind: Kind = "frequency", frame: Tensor = HERE) -> Occupancy:
        """A frozen gate on features of a kind that says just this, in a frame's coordinates."""
        turn, shift = frame[:, :3], frame[:, 3]
        scale = float(turn.abs().max())  # turns are by right angles
        normal = turn @ torch.tensor(self.normal) / scale
        share = 0.5 if self.unbounded else 1.0  # the contracted scene is twice as wide as the box
        gate = slab_gate(normal, share * self.half_width, share * self.offset, kind)
        x, y, z = (turn @ torch.tensor(CENTRE) + shift).tolist()
        space = Space("contraction" if self.unbounded else "box", (x, y, z), scale * HALF)
        known = Occupancy(gate, space, threshold=0.5)
        return known.requires_grad_(False).eval()


SLAB = Slab((0.6, 0.64, 0.48), 0.4)
OTHER = Slab((0.0, 0.0, 1.0), 0.25)
EVERYTHING = Slab((0.0, 0.0, 1.0), 100.0)
TWO = Slab((0.48, 0.6, 0.64), 0.15, offset=0.4)
"""Two thin slabs, with a gap between them."""
AROUND = Slab(SLAB.normal, 0.8, unbounded=True)
"""A slab that goes on beyond the box, without end."""
NOTHING, KEEPS_NOTHING = Slab((0.0, 0.0, 1.0), -1.0), "an occupancy that keeps nothing"
"""A scene in which all is empty, and what is said of its occupancy."""


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


SMALLEST: dict[Kind, EncodingConfig] = {
    "frequency": EncodingConfig("frequency", octaves=1),
    "hash": EncodingConfig("hash", levels=1, features=1, log2_table=16, coarsest=2, finest=2),
    "vm": EncodingConfig("vm", components=2, plane_cells=1),
    "k-planes": EncodingConfig("k-planes", levels=1, features=2, coarsest=1, plane_cells=1),
    "grid": EncodingConfig("grid", features=1, plane_cells=1),
}
"""The least of each kind that holds a linear function."""


@torch.no_grad()
def slab_gate(normal: Tensor, half_width: float, offset: float, kind: Kind) -> Gate:
    """A gate with o(x) >= 1/2 where d = ||normal.x| - offset| <= half_width, for mapped x.

    The hidden layers make |n.x|, d, and of it u = relu(d - w) and v = relu(w - d), so small that
    the LayerNorm is nearly linear between them; the logit of o is proportional to v - u.
    """
    gate = Gate(GateConfig(SMALLEST[kind], width=2, layers=3, scene_experts=1))
    for parameter in gate.parameters():
        parameter.zero_()
    small, steepness = 2e-3, 50.0
    first, *others = cast(Sequence[nn.Linear], gate.hidden)
    signs = torch.tensor([1.0, -1.0])
    first.weight.copy_(signs[:, None] * write_linear(gate.encoding, normal))
    for layer, scale, bound in zip(others, (1.0, small), (offset, half_width), strict=True):
        layer.weight.copy_((scale * signs)[:, None].expand(2, 2))
        layer.bias.copy_(-scale * bound * signs)
    gate.norm.weight.fill_(1.0)
    gate.head.weight[1] = -steepness * signs
    return gate


def write_linear(encoding: Encoding, normal: Tensor) -> Tensor:
    """Writes into an encoding of `SMALLEST` what makes n.x a weighted sum of its features; returns
    the weights, [out_dim]."""
    weights = torch.zeros(encoding.out_dim)
    ends = torch.tensor([-1.0, 1.0])
    across = normal[0] * ends + normal[1] * ends[:, None]  # rows are along y, columns along x
    if isinstance(encoding, encodings.FrequencyEncoding):
        weights[:3] = normal
    elif isinstance(encoding, encodings.HashEncoding):
        axis = torch.linspace(-1.0, 1.0, int(encoding.resolutions[0]) + 1)
        corners = torch.cartesian_prod(axis, axis, axis)
        rows = encoding.rows_and_weights(corners)[0][:, 0].long()
        encoding.table[rows, 0] = corners @ normal
        weights[0] = 1.0
    elif isinstance(encoding, encodings.VectorMatrixEncoding):
        encoding.planes[0, 0], encoding.lines[0, 0] = across, 1.0
        encoding.planes[0, 1], encoding.lines[0, 1, :, 0] = 1.0, normal[2] * ends
        weights[:2] = 1.0
    elif isinstance(encoding, encodings.KPlanesEncoding):
        (planes,) = encoding.planes
        planes.fill_(1.0)
        planes[0, 0], planes[1, 1] = across, normal[2] * ends[:, None]
        weights[:2] = 1.0
    elif isinstance(encoding, encodings.GridEncoding):
        encoding.table[0, 0] = across + normal[2] * ends[:, None, None]
        weights[0] = 1.0
    return weights


PARTS = ("ray_indices", "t_starts", "t_ends")
"""Of packed samples, in this order."""

ROUNDING = 1e-4
"""World units that two ways to compute an edge may differ by."""


@functools.lru_cache(maxsize=32)
def dense(
    rays: Rays, cone_angle: float = 0.0, step: float = STEP, unbounded: bool = False
) -> Samples:
    """Every candidate by the one ray-marching rule, in the box or all along the rays. The same rays
    are marched once."""
    return DenseEstimator(None if unbounded else box()).sampling(
        rays.origins,
        rays.directions,
        t_min=rays.t_min,
        t_max=rays.t_max,
        render_step_size=step,
        cone_angle=cone_angle,
    )


def _chosen(samples: Samples, order: Tensor) -> Samples:
    ray_indices, t_starts, t_ends = (part[order] for part in samples)
    return ray_indices, t_starts, t_ends


def in_order(samples: Samples) -> Samples:
    """Samples sorted by ray, then by where they begin."""
    return _chosen(samples, _keys(samples[0], samples[1]).argsort())


def among(wanted: Samples, samples: Samples) -> Tensor:
    """Which of the wanted samples are there, with both ends within a thousandth of a step: bool
    [n_wanted]."""
    tolerance = 1e-3 * STEP
    if len(samples[0]) == 0:
        return torch.zeros_like(wanted[0], dtype=torch.bool)
    keys, order = _keys(samples[0], samples[1]).sort()
    ends = samples[2][order]
    sought = _keys(wanted[0], wanted[1])
    at = torch.searchsorted(keys, sought - tolerance).clamp(max=len(keys) - 1)
    return ((keys[at] - sought).abs() <= tolerance) & ((ends[at] - wanted[2]).abs() <= tolerance)


def covered(ray_indices: Tensor, t: Tensor, samples: Samples) -> Tensor:
    """Which points (ray, t) [N] lie in a sample's interval: bool [N]."""
    if len(samples[0]) == 0:
        return torch.zeros_like(ray_indices, dtype=torch.bool)
    keys, order = _keys(samples[0], samples[1]).sort()
    rays, ends = samples[0][order], samples[2][order]
    at = (torch.searchsorted(keys, _keys(ray_indices, t), right=True) - 1).clamp(min=0)
    return (rays[at] == ray_indices) & (ends[at] >= t) & (keys[at] <= _keys(ray_indices, t))


def same(first: Samples, second: Samples) -> bool:
    """Whether two sets of samples are equal to the last bit."""
    return all(map(torch.equal, first, second))


def check_intervals(rays: Rays, samples: Samples) -> None:
    """Raises unless samples are sorted and disjoint along each ray, and inside its ends."""
    check_order(samples)
    check_inside(rays, samples)


def check_order(samples: Samples) -> None:
    """Raises unless samples follow one another along each ray."""
    require(len(samples[0]) > 0, "there are no samples on rays that cross what is occupied")
    _, t_starts, t_ends = samples = _chosen(samples, samples[0].argsort(stable=True))
    _hold(t_ends > t_starts, samples, "does not end behind its beginning")
    follows = torch.ones_like(t_starts, dtype=torch.bool)
    follows[1:] = t_starts[1:] >= t_ends[:-1] - ROUNDING
    follows[1:] |= samples[0][1:] != samples[0][:-1]
    _hold(follows, samples, "overlaps the one before it, or lies before it")


def check_inside(rays: Rays, samples: Samples) -> None:
    """Raises unless samples begin and have their middles between the ends of their rays."""
    ray_indices, t_starts, t_ends = samples
    begins = t_starts >= rays.t_min[ray_indices] - ROUNDING
    _hold(begins, samples, "begins before the ray's near end")
    ends = (t_starts + t_ends) / 2.0 <= rays.t_max[ray_indices] + ROUNDING
    _hold(ends, samples, "has its middle beyond the ray's far end")


def _hold(holds: Tensor, samples: Samples, problem: str) -> None:
    """Raises unless something holds for all samples; the message shows the first of the others."""
    for at in holds.logical_not().nonzero()[:1, 0].tolist():
        ray, start, end = (part[at].item() for part in samples)
        raise Broken(f"ray {ray}: the sample [{start:.4f}, {end:.4f}] {problem}")


def _keys(ray_indices: Tensor, t: Tensor) -> Tensor:
    """One number for ray and distance that sorts by both."""
    return ray_indices.double() * 1e3 + t.double()
