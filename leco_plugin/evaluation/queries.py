"""Counts the positions at which fields and gates are evaluated, and the updates of grids.

Positions for pruning samples and for updating a grid count too.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from nerfstudio.fields.base_field import Field
from nerfstudio.fields.density_fields import HashMLPDensityField
from torch import Tensor, nn

from leco_plugin.evaluation.clock import Clock
from leco_plugin.models import front_to_back
from leco_plugin.models.field import HMoEField
from leco_plugin.models.rendering import Scene
from leco_plugin.occupancy import Occupancy

KINDS = ("field", "proposal", "learning", "gate")
"""Who is asked: the field that is rendered; proposal networks; another field, which learned the
occupancy; a frozen gate, where its cell cache gave no answer."""


@contextmanager
def count_queries(model: nn.Module) -> Iterator[Counter[str]]:
    """Counts, by `KINDS`, the positions at which a model's fields are evaluated in this context.

    What a routine in C asks of a field along rays is counted by its answer. Classes are wrapped
    instead of objects, so that a field created meanwhile is counted, such as the one that learns an
    occupancy for a host. A frozen gate's queries in CUDA kernels are not counted.
    """
    count = Counter(dict.fromkeys(KINDS, 0))
    own = getattr(getattr(model, "mixture", model), "field", None)
    fields: list[nn.Module] = [module for module in model.modules() if isinstance(module, Field)]
    if isinstance(own, nn.Module) and own not in fields:
        fields.append(own)
    methods: list[tuple[type, str]] = [(Occupancy, "query"), (Occupancy, "occupied")]
    for owner in {*map(type, fields), HMoEField}:
        named = (name for name in ("get_density", "density", "forward") if hasattr(owner, name))
        methods.append((owner, next(named)))
    of_model = {id(field) for field in fields}
    asking = False

    def kind(field: nn.Module) -> str:
        if isinstance(field, Occupancy):
            return "gate"
        if id(field) not in of_model:
            return "learning"
        return "proposal" if isinstance(field, HashMLPDensityField) else "field"

    def counting(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def ask(field: nn.Module, positions: Any, *args: Any, **kwargs: Any) -> Any:
            nonlocal asking
            if asking:  # a method that calls that of its parent class
                return method(field, positions, *args, **kwargs)
            asking = True
            try:
                count[kind(field)] += number_of(positions)
                return method(field, positions, *args, **kwargs)
            finally:
                asking = False

        return ask

    def counting_rays(shade: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(shade)
        def ask(scene: Scene, *args: Any) -> Any:
            shaded, seen = shade(scene, *args)
            count[kind(scene.field)] += len(seen.t_starts)
            return shaded, seen

        return ask

    asked: list[tuple[Any, str, Callable[..., Any]]] = [
        (owner, name, counting(getattr(owner, name))) for owner, name in methods
    ]
    in_c = counting_rays(front_to_back.shade_natively)
    with ExitStack() as stack:
        for owner, name, method in [*asked, (front_to_back, "shade_natively", in_c)]:
            stack.enter_context(patch.object(owner, name, method))
        yield count


def number_of(positions: Any) -> int:
    """How many there are: of a tensor [..., 3], or of nerfstudio's `RaySamples`."""
    if isinstance(positions, Tensor):
        return positions.numel() // positions.shape[-1]
    return math.prod(positions.frustums.shape)


WARM_UP = 1 / 16
"""Most of a run that the warm-up of a grid lasts: nerfacc's 256 steps are half of a short run."""


class GridUpdates:
    """Watches the occupancy grids of a model, nerfacc's or like those, from now on.

    Args:
        share_at: gives the share of the run that is over at a step. A warm-up ends with `WARM_UP`
            of the run, if not sooner. None leaves it as it is.
    """

    def __init__(self, model: nn.Module, share_at: Callable[[int], float] | None = None) -> None:
        self.share_at = share_at
        self.clock = Clock()
        """The time of all updates."""
        self.warming_up: bool | None = None
        """Whether the last update was in a grid's warm-up, when nerfacc asks all cells; None
        without a grid, or for one that does not say."""
        self.grids: list[Any] = [module for module in model.modules() if "occs" in module._buffers]
        for grid in self.grids:
            vars(grid)["update_every_n_steps"] = self._watched(grid.update_every_n_steps)

    def _watched(self, update: Callable[..., Any]) -> Callable[..., Any]:
        signature = inspect.signature(update)

        def run(*args: Any, **kwargs: Any) -> Any:
            asked = signature.bind(*args, **kwargs)
            asked.apply_defaults()
            step, until = (asked.arguments.get(name) for name in ("step", "warmup_steps"))
            if step is not None and until is not None:
                if self.share_at is not None and self.share_at(step) >= WARM_UP:
                    asked.arguments["warmup_steps"] = until = min(until, step)
                self.warming_up = step < until
            with self.clock.running():
                return update(*asked.args, **asked.kwargs)

        return run
