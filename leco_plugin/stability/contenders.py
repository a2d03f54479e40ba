"""The samplers that are compared, each in a host: the same sizes, rays and steps for all of them.

A sampler is held against the dense reference of its own host: Instant-NGP for the samplers that
ask "is this place occupied?", Nerfacto for proposal networks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from leco_plugin.chart.contender import Contender
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.scenes.input_error import InputError
from leco_plugin.stability.sizes import Sizes

LEARNED, DENSE, PROPOSALS, GRID = "learned", "dense", "proposal-networks", "grid"
DENSE_PROPOSAL = "dense-proposal"
GRIDS = (128, 256)
DENSE_LEVELS = 5
"""The reference samples in a box 2^4 times as wide as the one that was guessed."""


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
OURS = LEARNED
"""Whose failures matter most."""


def samplers_named(names: tuple[str, ...]) -> list[Sampler]:
    """The samplers of these names and the references they are held against, in the table's order.

    Raises:
        InputError: there is no sampler of a name.
    """
    unknown = [name for name in names if name not in SAMPLERS]
    if unknown:
        raise InputError(f"there is no sampler {unknown[0]!r}; there are {', '.join(SAMPLERS)}")
    wanted = set(names or SAMPLERS)
    wanted |= {one.reference for one in SAMPLERS.values() if one.name in wanted and one.reference}
    return [one for one in SAMPLERS.values() if one.name in wanted]


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
    learns = sampler.name == LEARNED
    changes = {
        path: value
        for path, value in changes.items()
        if learns or not path.startswith("occupancy.")
    }
    settings = {"pipeline.datamanager.train_num_rays_per_batch": sizes.rays, **settings}
    if sampler.name in (PROPOSALS, DENSE_PROPOSAL):
        own: dict[str, Any] = {"occupancy.sampler": OWN_SAMPLER}
        if sampler.name == DENSE_PROPOSAL:
            options = {"samples": sizes.dense_samples}
            own = {"occupancy.sampler": DENSE_PROPOSAL, "occupancy.options": options}
        base = Contender(sampler.title, "leco-nerfacto", sampler.name, {**sizes.nerfacto, **own})
    else:
        own = _packed(sampler, grid_levels)
        if learns:
            own = {**own, **sizes.learning}
        base = Contender(sampler.title, "leco-ngp", sampler.name, {**sizes.ngp, **own})
    return replace(base, changes={**base.changes, **changes}, settings=settings)


def _packed(sampler: Sampler, grid_levels: int) -> dict[str, Any]:
    """Settings of Instant-NGP's sampler."""
    if sampler.name == LEARNED:
        return {"occupancy.sampler": "learned-occupancy"}
    if sampler.name == DENSE:
        return {"occupancy.sampler": "dense", "occupancy.options": {"levels": DENSE_LEVELS}}
    cells = int(sampler.name.removeprefix(f"{GRID}-"))
    options = {"resolution": cells, "levels": grid_levels}
    return {"occupancy.sampler": "occupancy-grid", "occupancy.options": options}
