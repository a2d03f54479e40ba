"""The samplers that are compared, each in a host: the same sizes, rays and steps for all of them.

A sampler is held against the dense reference of its own host: Instant-NGP for the samplers that
ask "is this place occupied?", Nerfacto for proposal networks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from leco_plugin.chart.contender import Contender
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.scenes.input_error import InputError

LEARNED, DENSE, PROPOSALS, GRID = "learned", "dense", "proposal-networks", "grid"
DENSE_PROPOSAL = "dense-proposal"
GRIDS = (128, 256)
DENSE_LEVELS = 5
"""The reference samples in a box 2^4 times as wide as the one that was guessed."""
RAYS = "pipeline.datamanager.train_num_rays_per_batch"


@dataclass(frozen=True)
class Sizes:
    """Of pictures, hosts and runs."""

    steps: int
    """Training steps of each host; learning an occupancy comes before them."""
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


FULL = Sizes(steps=720, rays=96, learn_rays=384, learn_steps=200)
"""The stored table takes two cores a few hours in these."""
QUICK = Sizes(
    steps=40, rays=64, learn_rays=64, learn_steps=20, picture=0.5, views=0.4, dense_samples=48
)
"""For a look at whether everything works; its verdicts mean little."""


@dataclass(frozen=True)
class Sampler:
    """One column of the table."""

    name: str
    """On the command line."""
    title: str
    """In the table."""
    reference: str | None
    """The dense reference of its host; None is one."""


SAMPLERS = {
    one.name: one
    for one in (
        Sampler(LEARNED, "learned occupancy", DENSE),
        *(Sampler(f"{GRID}-{n}", f"grid {n}³", DENSE) for n in GRIDS),
        Sampler(PROPOSALS, "proposal networks", DENSE_PROPOSAL),
        Sampler(DENSE, "dense (Instant-NGP)", None),
        Sampler(DENSE_PROPOSAL, "dense (Nerfacto)", None),
    )
}


def samplers_named(names: tuple[str, ...]) -> list[Sampler]:
    """The samplers of these names and the references they are held against, in the table's order.

    Raises:
        InputError: there is no sampler of a name.
    """
    unknown = [name for name in names if name not in SAMPLERS]
    if unknown:
        raise InputError(f"there is no sampler {unknown[0]!r}; there are {', '.join(SAMPLERS)}")
    return with_references(set(names or SAMPLERS))


def with_references(names: set[str]) -> list[Sampler]:
    """Samplers and the references they are held against, in the table's order."""
    references = {SAMPLERS[name].reference for name in names}
    return [one for one in SAMPLERS.values() if one.name in names | references]


def contender_of(
    sampler: Sampler,
    sizes: Sizes,
    changes: Mapping[str, Any],
    settings: Mapping[str, Any],
    grid_levels: int = 1,
) -> Contender:
    """The sampler in its host under the conditions of a case.

    Args:
        changes: settings of the model; those of learning are left out where nothing is learned.
        settings: settings of the whole method.
        grid_levels: nested boxes of occupancy grids.
    """
    name = sampler.name
    in_nerfacto = name in (PROPOSALS, DENSE_PROPOSAL)
    own: dict[str, Any] = {"occupancy.sampler": name}
    if name == LEARNED:
        own = {
            "occupancy.sampler": "learned-occupancy",
            "occupancy.rays": sizes.learn_rays,
            "occupancy.learning.schedule.learn_steps": sizes.learn_steps,
        }
    elif name == PROPOSALS:
        own = {"occupancy.sampler": OWN_SAMPLER}
    elif name == DENSE_PROPOSAL:
        own["occupancy.options"] = {"samples": sizes.dense_samples}
    elif name == DENSE:
        own["occupancy.options"] = {"levels": DENSE_LEVELS}
    else:
        cells = int(name.removeprefix(f"{GRID}-"))
        options = {"resolution": cells, "levels": grid_levels}
        own = {"occupancy.sampler": "occupancy-grid", "occupancy.options": options}
    asked = {
        path: value
        for path, value in changes.items()
        if name == LEARNED or not path.startswith("occupancy.")
    }
    host = sizes.nerfacto if in_nerfacto else sizes.ngp
    return Contender(
        sampler.title,
        "leco-nerfacto" if in_nerfacto else "leco-ngp",
        name,
        changes={**host, **own, **asked},
        settings={RAYS: sizes.rays, **settings},
    )
