"""The updates of occupancy grids in a run: what they cost, and whether they still ask all cells."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch

from leco_plugin.evaluation.clock import Clock, timed


class GridUpdates:
    """Watches the grids of a model, nerfacc's or like those, from now on.

    Args:
        model: whatever holds the grids.
    """

    def __init__(self, model: torch.nn.Module) -> None:
        self.clock = Clock()
        """The time of all updates."""
        self.warming_up: bool | None = None
        """Whether the last step asked for an update in a grid's warm-up, when nerfacc asks all of
        its cells; None where there is no grid, or one that does not say."""
        self.grids: list[Any] = [module for module in model.modules() if "occs" in module._buffers]
        for grid in self.grids:
            vars(grid)["update_every_n_steps"] = self._watched(grid.update_every_n_steps)

    def _watched(self, update: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(update)
        counted = timed(update, self.clock)

        def run(*args: Any, **kwargs: Any) -> Any:
            asked = signature.bind(*args, **kwargs)
            asked.apply_defaults()
            step, until = (asked.arguments.get(name) for name in ("step", "warmup_steps"))
            if step is not None and until is not None:
                self.warming_up = step < until
            return counted(*args, **kwargs)

        return run
