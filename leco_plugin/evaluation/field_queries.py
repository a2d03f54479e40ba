"""How often a field is asked: every position whose density is computed, counted where it happens.

Counted are all questions, also those for pruning samples and for updating a grid; and those to a
frozen gate, but for what kernels on CUDA ask it. Classes are wrapped rather than objects, so that a
field which is made and dropped on the way, as the one that learns an occupancy for a host, is
counted too.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from nerfstudio.fields.base_field import Field
from nerfstudio.fields.density_fields import HashMLPDensityField
from torch import Tensor, nn

from leco_plugin.models.field import HMoEField
from leco_plugin.occupancy import Occupancy

Kind = Literal["field", "proposal", "learning", "gate"]


@dataclass
class FieldQueries:
    """Positions asked so far."""

    field: int = 0
    """Of the field that is rendered."""
    proposal: int = 0
    """Of proposal networks."""
    learning: int = 0
    """Of another field, which learned the occupancy."""
    gate: int = 0
    """Of a frozen gate, for what its cell cache does not know."""

    def since(self, before: FieldQueries) -> FieldQueries:
        """What has been asked since an earlier count."""
        return FieldQueries(**{k: v - getattr(before, k) for k, v in vars(self).items()})

    def copy(self) -> FieldQueries:
        """The count as it is now."""
        return FieldQueries(**vars(self))


@contextmanager
def counted(model: nn.Module) -> Iterator[FieldQueries]:
    """Counts what the fields of a model, and those that learn for it, are asked while this lasts.

    A model keeps its fields as `nn.Module`s: nerfstudio's are asked through `get_density`, others
    through `density` or, without one, by being called.
    """
    count = FieldQueries()
    own = getattr(model, "field", None)
    fields: list[nn.Module] = [module for module in model.modules() if isinstance(module, Field)]
    if isinstance(own, nn.Module) and own not in fields:
        fields.append(own)
    doors = [(owner, _door(owner)) for owner in {*map(type, fields), HMoEField}]
    doors += [(Occupancy, "query"), (Occupancy, "occupied")]
    of_model = {id(field) for field in fields}
    asking = False

    def kind(field: nn.Module) -> Kind:
        if isinstance(field, Occupancy):
            return "gate"
        if id(field) not in of_model:
            return "learning"
        return "proposal" if isinstance(field, HashMLPDensityField) else "field"

    def counting(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def ask(field: nn.Module, positions: Any, *args: Any, **kwargs: Any) -> Any:
            nonlocal asking
            if asking:  # a class that asks the one it is made from
                return method(field, positions, *args, **kwargs)
            asking = True
            try:
                name = kind(field)
                setattr(count, name, getattr(count, name) + number_of(positions))
                return method(field, positions, *args, **kwargs)
            finally:
                asking = False

        return ask

    before = []
    for owner, name in doors:
        before.append((owner, name, owner.__dict__.get(name)))
        setattr(owner, name, counting(getattr(owner, name)))
    try:
        yield count
    finally:
        for owner, name, method in before:
            if method is None:
                delattr(owner, name)
            else:
                setattr(owner, name, method)


def _door(owner: type) -> str:
    """The method through which the fields of a class are asked."""
    return next(name for name in ("get_density", "density", "forward") if hasattr(owner, name))


def number_of(positions: Any) -> int:
    """How many there are: of a tensor [..., 3], or of nerfstudio's `RaySamples`."""
    if isinstance(positions, Tensor):
        return positions.numel() // positions.shape[-1]
    return math.prod(positions.frustums.shape)
