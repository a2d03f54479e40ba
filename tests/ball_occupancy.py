"""An occupancy that is known: a ball, whose gate was fitted to it in a second or two."""

from __future__ import annotations

import functools

import torch
from tiny_scene import BALL_CENTRE, BALL_RADIUS

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig, occupancy_logit
from leco_plugin.occupancy import Occupancy
from leco_plugin.space import Space

CENTRE, RADIUS, HALF = (1.0, 2.0, 0.5), 1.0, 2.0
BOX = torch.tensor([-1.0, -1.0, -1.0, 3.0, 4.0, 2.0])
"""Of a host, around much of the ball's space."""
MARCH = {"render_step_size": 0.05, "near_plane": 0.0, "far_plane": 8.0}
"""Of `rays`, through and past the ball."""


ENCODINGS = {
    "frequency": EncodingConfig("frequency", octaves=2),
    "hash": EncodingConfig("hash", levels=3, log2_table=13, coarsest=8, finest=32),
    "vm": EncodingConfig("vm", components=4, plane_cells=32),
    "k-planes": EncodingConfig("k-planes", levels=3, coarsest=8, plane_cells=32),
    "grid": EncodingConfig("grid", plane_cells=32),
}
WALLS = torch.tensor([-1e6, -1e6, -1.0, 1e6, 1e6, 2.0])


@functools.cache
def ball(kind: str = "frequency") -> Occupancy:
    """Kept within `RADIUS` of `CENTRE`, to some hundredths; its report names walls and cameras.

    Args:
        kind: of the features that its gate is on.
    """
    torch.manual_seed(0)
    gate = Gate(GateConfig(ENCODINGS[kind], 32, 2, 2))
    optimizer = torch.optim.Adam(gate.parameters(), 1e-2)
    for _ in range(200):
        mapped = 2.0 * torch.rand(1024, 3) - 1.0
        inside = (mapped.norm(dim=-1) < RADIUS / HALF).float()
        loss = torch.nn.functional.binary_cross_entropy_with_logits(
            occupancy_logit(gate(mapped)), inside
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    report = {
        "aabb": WALLS.tolist(),
        "cameras": [[1.0, 0.5, 1.8], [2.5, 2.0, 1.8], [1.0, 3.5, 1.8]],
        "empty_fraction": 0.9,
    }
    return Occupancy(gate, Space("box", CENTRE, HALF), 0.5, report=report, walls=WALLS).eval()


SCENE_FRAME = torch.eye(3, 4).tolist()
THEIR_MARCH = {"near": 0.05, "far": 2.0, "step_size": 0.02, "cone_angle": 0.0}
"""How rays of the tiny scene are marched, in its coordinates."""


def ball_of_the_tiny_scene(frame: list[list[float]] = SCENE_FRAME) -> Occupancy:
    """The ball of `tiny_scene`, as if it had been learned in the coordinates of `frame`.

    Args:
        frame: [3, 4], a rotation times a scale, and a translation, from the scene's coordinates.
    """
    turn, shift = torch.tensor(frame).split([3, 1], dim=1)
    x, y, z = (turn @ torch.tensor(BALL_CENTRE).float() + shift[:, 0]).tolist()
    half = BALL_RADIUS / (RADIUS / HALF) * float(turn.norm()) / 3.0**0.5
    space = Space("box", (x, y, z), half)
    return Occupancy(ball().gate, space, 0.5, report={"frame": frame}).eval()


def rays(count: int = 30) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins and directions [count, 3] of rays from outside towards the ball and beside it."""
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor(CENTRE) + torch.tensor([0.0, 0.0, 4.0])
    aims = torch.tensor(CENTRE) + 1.5 * torch.randn(count, 3, generator=generator)
    directions = torch.nn.functional.normalize(aims - origins, dim=-1)
    return origins.expand(count, 3).contiguous(), directions
