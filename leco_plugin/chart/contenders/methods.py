"""From the names that a user gives to contenders: methods of `ns-train`, samplers of the registry.

Both join a chart by being registered; nothing has to be known here. A method whose model is a host
is charted with any sampler, one that learns its occupancy itself with any kind of gate.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.switch.config import SwitchNerfModelConfig
from leco_plugin.samplers.registry import samplers as registered_samplers
from leco_plugin.scenes.input_error import InputError
from leco_plugin.swap import registered

LEARNED, GRID, DENSE = "learned-occupancy", "occupancy-grid", "dense"
SIZED_GRID = re.compile(rf"{GRID}-(\d+)")

SKIPPING_NOTHING = {"schedule.freeze": False, "front_to_back": True}
"""Never frozen, and rendered as fast as it can be: guided images go front to back by themselves."""
NEVER_FROZEN = Contender("LeCO, never frozen", "leco-occupancy", DENSE, SKIPPING_NOTHING)
VARIANTS = {
    "leco-occupancy-never-frozen": NEVER_FROZEN,
    "leco-occupancy-retrained": Contender(
        "LeCO, frozen, then from scratch", "leco-occupancy", LEARNED, {"schedule.restart": True}
    ),
    "leco-occupancy-homogeneous": Contender(
        "LeCO, equal experts, no gate",
        "leco-occupancy",
        DENSE,
        SKIPPING_NOTHING | {"homogeneous": True},
    ),
}
"""Methods for the chart only: `leco-occupancy` with its phases changed."""

METHOD_NAMES = {
    "leco-occupancy": "LeCO",
    "leco-ngp": "Instant-NGP",
    "leco-nerfacto": "Nerfacto",
    "leco-switch-nerf": "Switch-NeRF",
}
"""What a guided host is called when its sampler is named beside it; others go by their own name."""

SAMPLER_NAMES = {
    LEARNED: "learned occupancy",
    "learned-occupancy-hash": "hash-grid gate",
    "learned-occupancy-vm": "TensoRF gate",
    "learned-occupancy-k-planes": "K-planes gate",
    DENSE: "every sample",
}


def contenders(methods: Sequence[str], samplers: Sequence[str] = ()) -> list[Contender]:
    """Each method with each sampler that it can use; without samplers, with its usual ones.

    Raises:
        InputError: a name is unknown, or fits none of the others.
    """
    if not methods:
        raise InputError(
            "nothing to chart: name methods with --methods or a comparison with --suite"
        )
    for sampler in samplers:
        _check_sampler(sampler)
    found: dict[str, Contender] = {}
    used: set[str] = set()
    for method in dict.fromkeys(methods):
        usual, allowed = _samplers_of(method)
        fitting = {name: _contender(method, name) for name in samplers or usual}
        made = {name: one for name, one in fitting.items() if one is not None}
        if not made:
            raise InputError(
                f"{method} has none of the samplers {', '.join(samplers)}; it has {allowed}"
            )
        used |= set(made)
        found |= {one.key: one for one in made.values()}
    unused = [name for name in samplers if name not in used]
    if unused:
        raise InputError(f"the sampler {unused[0]!r} fits none of {', '.join(methods)}")
    return list(found.values())


def _check_sampler(name: str) -> None:
    known = [*registered_samplers(), f"{GRID}-128", OWN_SAMPLER]
    if name not in known and not SIZED_GRID.fullmatch(name):
        raise InputError(f"there is no sampler {name!r}; there are {', '.join(sorted(known))}")


def _samplers_of(method: str) -> tuple[list[str], str]:
    """The usual samplers of a method, and all of them in words."""
    if method in VARIANTS:
        return [VARIANTS[method].sampler], VARIANTS[method].sampler
    model = _model(method)
    if isinstance(model, LecoModelConfig):
        kinds = [name for name, spec in registered_samplers().items() if spec.needs_occupancy]
        return [LEARNED], ", ".join([*kinds, DENSE])
    every = ", ".join([*registered_samplers(), OWN_SAMPLER])
    usual = [LEARNED, OWN_SAMPLER] if isinstance(model, GuidedModelConfig) else [OWN_SAMPLER]
    return usual, every


def _model(method: str) -> Any:
    try:
        return registered(method).pipeline.model
    except InputError as error:
        raise InputError(f"{error}; and for charts {', '.join(VARIANTS)}") from None


def _contender(method: str, sampler: str) -> Contender | None:
    """None where the method cannot use the sampler."""
    if method in VARIANTS:
        return VARIANTS[method] if VARIANTS[method].sampler == sampler else None
    model = _model(method)
    if isinstance(model, LecoModelConfig):
        return _learning(method, sampler)
    return _hosting(method, sampler, model.host if isinstance(model, GuidedModelConfig) else model)


def _learning(method: str, sampler: str) -> Contender | None:
    """A method that learns its occupancy itself."""
    called = METHOD_NAMES.get(method, method)
    name = f"{called} + {SAMPLER_NAMES.get(sampler, sampler)}"
    if sampler == DENSE:
        return replace(NEVER_FROZEN, name=f"{called}, never frozen", method=method)
    spec = registered_samplers().get(sampler)
    if spec is None or not spec.needs_occupancy:
        return None
    kind = spec.gate_encoding
    return Contender(name, method, sampler, {"sizes.gate.encoding.kind": kind} if kind else {})


def _hosting(method: str, sampler: str, host: Any) -> Contender | None:
    """A host, which takes any sampler of its kind."""
    proposes = hasattr(host, "num_proposal_samples_per_ray")
    called = METHOD_NAMES.get(method, method)
    if sampler == OWN_SAMPLER:
        name = f"{called} + {_own_sampling(host)}"
        return Contender(name, method, sampler, {"occupancy.sampler": OWN_SAMPLER})
    sized = SIZED_GRID.fullmatch(sampler)
    spec = registered_samplers()[GRID if sized else sampler]
    if (spec.proposal if proposes else spec.estimator) is None:
        return None
    if sized or sampler == GRID:
        cells = int(sized[1]) if sized else _own_cells(host) or 128
        return Contender(f"{called} + grid {cells}³", method, sampler, _grid(host, cells))
    changes = {"occupancy.sampler": sampler}
    if spec.gate_encoding is not None:
        changes["occupancy.learning.sizes.gate.encoding.kind"] = spec.gate_encoding
    name = f"{called} + {SAMPLER_NAMES.get(sampler, sampler)}"
    return Contender(name, method, sampler, changes)


def _own_sampling(host: Any) -> str:
    """What a host does when it is left as it is, in words."""
    if isinstance(host, SwitchNerfModelConfig) and host.sampling == "coarse-fine":
        return "coarse and fine samples"
    if hasattr(host, "num_proposal_samples_per_ray"):
        return "proposal networks"
    cells = _own_cells(host)
    return "own sampling" if cells is None else f"own grid {cells}³"


def _own_cells(host: Any) -> int | None:
    """Cells along each axis of the grid that a host has by itself."""
    owner = host.sizes if isinstance(host, SwitchNerfModelConfig) else host
    cells = getattr(owner, "grid_resolution", None)
    return cells if isinstance(cells, int) else None


def _grid(host: Any, cells: int) -> dict[str, Any]:
    """Changes that have a host ask an occupancy grid of so many cells along each axis."""
    if isinstance(host, SwitchNerfModelConfig):  # its grid follows the bounds that it finds
        return {
            "occupancy.sampler": OWN_SAMPLER,
            "host.sampling": "occupancy-grid",
            "host.sizes.grid_resolution": cells,
        }
    levels = getattr(host, "grid_levels", 1)
    return {
        "occupancy.sampler": GRID,
        "occupancy.options": {"resolution": cells, "levels": levels},
    }
