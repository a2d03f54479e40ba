"""How large everything is: so that the stored table takes two cores a few hours."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Sizes:
    """Of pictures, hosts and runs."""

    steps: int
    """Training steps of each host; what learns its occupancy first does that before them."""
    rays: int
    """Of a batch."""
    learn_rays: int
    """Of a batch while the occupancy is learned."""
    learn_steps: int
    """Most steps of learning."""
    picture: float = 1.0
    """Multiple of the pictures' width and height."""
    views: float = 1.0
    """Multiple of the number of training pictures, where a case does not fix it."""
    dense_samples: int = 192
    """Of a ray of the dense reference of proposal hosts."""
    table: int = 15
    """Binary logarithm of the entries of the hosts' hash tables."""

    @property
    def ngp(self) -> dict[str, Any]:
        """Instant-NGP: rays end well beyond the scene, with steps that grow with the distance."""
        return {
            "host.log2_hashmap_size": self.table,
            "host.max_res": 512,
            "host.grid_levels": 1,
            "host.cone_angle": 1 / 32,
            "host.far_plane": 20.0,
        }

    @property
    def nerfacto(self) -> dict[str, Any]:
        """Nerfacto in the same sizes."""
        return {
            "host.log2_hashmap_size": self.table,
            "host.max_res": 512,
            "host.far_plane": 20.0,
            "host.use_appearance_embedding": False,
        }

    @property
    def learning(self) -> dict[str, Any]:
        """What learns the occupancy."""
        return {
            "occupancy.rays": self.learn_rays,
            "occupancy.learning.schedule.learn_steps": self.learn_steps,
        }


FULL = Sizes(steps=720, rays=96, learn_rays=384, learn_steps=200)
QUICK = Sizes(
    steps=40, rays=64, learn_rays=64, learn_steps=20, picture=0.5, views=0.4, dense_samples=48
)
"""For a look at whether everything works; its verdicts mean little."""
