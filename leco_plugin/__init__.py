"""Learned occupancy for nerfstudio: a small frozen network in place of occupancy grids."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from leco_plugin.hosts.proposal import LearnedOccupancySampler
    from leco_plugin.occupancy import Occupancy
    from leco_plugin.samplers.estimator import LearnedOccupancyEstimator

__all__ = [
    "LearnedOccupancyEstimator",
    "LearnedOccupancySampler",
    "Occupancy",
    "__version__",
]

# nerfstudio imports every plugin whenever one of its commands starts, so that nothing is loaded
# here before somebody asks for it.
_HOMES = {
    "LearnedOccupancyEstimator": "leco_plugin.samplers.estimator",
    "LearnedOccupancySampler": "leco_plugin.hosts.proposal",
    "Occupancy": "leco_plugin.occupancy",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return __all__
