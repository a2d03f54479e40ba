"""A sampler of your own, checked against the rules for samplers: own_sampler.py

With this folder in PYTHONPATH, hosts take it before it is registered anywhere:
leco swap instant-ngp --sampler own_sampler:SPEC --occupancy FILE -- --data SCENE
"""

import sys

import torch
from torch import Tensor

from leco_plugin.cli import main
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers.base import Estimator
from leco_plugin.samplers.registry import SamplerSpec


class Careful(Estimator):
    """Keeps a position where the occupancy keeps it, or one within `reach` of it along an axis.

    `Estimator` brings nerfacc's `sampling`: it forms the candidates along rays, asks `questions`
    about them, and drops those that cannot be seen.

    Args:
        occupancy: the frozen gate. As a submodule it goes to devices and into checkpoints.
        reach: scene units.
    """

    def __init__(self, occupancy: Occupancy, reach: float = 0.01) -> None:
        super().__init__()
        self.occupancy = occupancy
        sides = torch.cat([torch.zeros(1, 3), torch.eye(3), -torch.eye(3)])
        self.register_buffer("offsets", reach * sides)  # [7, 3]

    def occupied(self, positions: Tensor) -> Tensor:
        """Whether positions [N, 3] are kept: bool [N]."""
        around = positions[:, None] + self.offsets.to(positions)
        return self.occupancy.occupied(around.reshape(-1, 3)).view(-1, 7).any(dim=1)

    def questions(self):
        return self.occupied, None  # and no coarse question about stretches of candidates

    def bounds(self) -> Tensor | None:
        space = self.occupancy.space
        box = torch.cat([space.center - space.half_extent, space.center + space.half_extent])
        return box if space.kind == "box" else None

    def update_every_n_steps(self, *args, **kwargs) -> None:
        """Nothing: a frozen gate needs no updates."""


def build(aabb, occupancy, reach: float = 0.01) -> Careful:
    """What `SPEC` names: `aabb` is the host's box, which this sampler does not need."""
    return Careful(occupancy, reach)


SPEC = SamplerSpec("keeps the neighbours too", estimator=build, needs_occupancy=True)

if __name__ == "__main__":
    sys.exit(main(["check", "own_sampler:SPEC", *sys.argv[1:]]))
