"""What is compared, as plain data: a method with a sampler and a few settings changed."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any


@dataclass(frozen=True)
class Contender:
    """One line of a chart."""

    name: str
    """A few words, on the chart and in the table: of the method, then of the sampler."""
    method: str
    """As `ns-train` knows it."""
    sampler: str
    """As the registry of samplers knows it, or `own`."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings under `--pipeline.model.`, by their path."""
    budget: float = 1.0
    """Multiple of the chart's time and steps that it is given."""
    grids: tuple[int, ...] = ()
    """Cells along each axis of occupancy grids that are made from its field when it freezes, and
    compared with its gate."""
    taught: bool = False
    """Whether small gates are taught by its field when it freezes, and compared with its gate."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the whole method, by their path; keys of dictionaries are steps of it too."""

    @property
    def key(self) -> str:
        """The same for what would run alike, whatever it is called: file name and identity."""
        what = {name: value for name, value in asdict(self).items() if name != "name"}
        if not self.settings:
            del what["settings"]  # charts that are stored were made before there were any
        if not self.taught:
            del what["taught"]
        digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
        return f"{self.method}-{self.sampler}-{digest[:8]}"

    def alone(self) -> Contender:
        """The same training: what is compared with its gate is made after it."""
        return replace(self, grids=(), taught=False)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Contender:
        """Inverse of `dataclasses.asdict`, also after JSON."""
        return Contender(**{**values, "grids": tuple(values["grids"])})


def changed(config: Any, path: str, value: Any) -> Any:
    """A config with one setting of it changed; the config given is left as it is.

    Args:
        config: a dataclass of dataclasses and dictionaries.
        path: names of fields, and keys, with dots between them.
    Raises:
        ValueError: there is no such field or key.
    """
    name, _, rest = path.partition(".")
    if isinstance(config, dict):
        if name not in config:
            raise ValueError(f"there is no setting {name!r}; there are {', '.join(config)}")
        return {**config, name: changed(config[name], rest, value) if rest else value}
    if name not in getattr(config, "__dataclass_fields__", {}):
        raise ValueError(f"{type(config).__name__} has no setting {name!r}")
    return replace(config, **{name: changed(getattr(config, name), rest, value) if rest else value})


def short_names(names: Sequence[str]) -> list[str]:
    """The names without the method where it is the same for all."""
    method = shared_method(names)
    return [_split(name)[1] if method else name for name in names]


def shared_method(names: Sequence[str]) -> str | None:
    """The method with which all of several names begin; None where there is no such."""
    methods = {_split(name)[0] for name in names}
    return methods.pop() if len(names) > 1 and len(methods) == 1 else None


def _split(name: str) -> tuple[str | None, str]:
    """Method and the rest of a name, where it has both."""
    parts = re.fullmatch(r"(.*?)(?: \+ |, )(.*)", name)
    return (None, name) if parts is None else (parts[1], parts[2])
