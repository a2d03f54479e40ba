"""What a chart compares, as plain data: a method, a sampler, and the settings that are changed."""

from __future__ import annotations

import copy
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

    from leco_plugin.scenes.photographs import HeldOut

LEARNED, GRID, DENSE = "learned-occupancy", "occupancy-grid", "dense"
"""Samplers of the registry."""
LONG_STEPS, WITHOUT_GIFTS = "long-steps", "learned-occupancy-without-gifts"
"""Samplers of charts alone: rivals with as little as possible."""


@dataclass(frozen=True)
class Contender:
    """One line of a chart."""

    name: str
    """On the chart and in the table: the method, then the sampler."""
    method: str
    """As `ns-train` knows it."""
    sampler: str
    """As the registry of samplers knows it, or `own`."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings under `--pipeline.model.`, by their path."""
    grids: tuple[int, ...] = ()
    """Cells along an axis of grids that are made from its field and compared with its gate."""
    taught: bool = False
    """Whether its field teaches small gates that are compared with its gate."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the whole method, by their path; keys of dictionaries are steps of it too."""

    @property
    def key(self) -> str:
        """The identity of the run, whatever it is called; part of its file name."""
        what = {**asdict(self), "budget": 1.0}  # stored tables name runs by this digest
        del what["name"]
        for name in ("settings", "taught"):
            if not what[name]:
                del what[name]
        digest = hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()
        return f"{self.method}-{self.sampler}-{digest[:8]}"

    def alone(self) -> Contender:
        """The same training, without what is made from its field afterwards."""
        return replace(self, grids=(), taught=False)

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> Contender:
        """Inverse of `dataclasses.asdict`, also after JSON."""
        return Contender(**{**values, "grids": tuple(values["grids"])})


@dataclass(frozen=True)
class Job:
    """One run to be made."""

    contender: Contender
    seed: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.contender.key}-seed-{self.seed}"

    @property
    def values(self) -> dict[str, Any]:
        """What it is, as JSON values."""
        return {"contender": asdict(self.contender), "seed": self.seed}


def changed(config: Any, path: str, value: Any) -> Any:
    """A copy of a config with one setting changed.

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


def config_of(
    contender: Contender,
    data: Path,
    folder: Path,
    learn_seconds: float | None = None,
    held_out: HeldOut = "spread",
) -> TrainerConfig:
    """The config of a contender's training run.

    All contenders read the scene with our parser, so that they render the same test pixels.

    Args:
        folder: for what the run leaves.
        learn_seconds: limit for a host that learns its occupancy first.
        held_out: which photographs are tested.
    Raises:
        InputError: there is no such method, or its reader cannot hold out a stretch.
        ValueError: it has no such setting.
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from leco_plugin.host_configs import guided
    from leco_plugin.hosts.guided import GuidedModelConfig
    from leco_plugin.method_configs import best_device
    from leco_plugin.models.leco_config import LecoModelConfig
    from leco_plugin.scenes.input_error import InputError
    from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
    from leco_plugin.studio.dynamic_batch import clamped
    from leco_plugin.swap import registered

    config = copy.deepcopy(registered(contender.method))
    config.output_dir, config.experiment_name, config.data = folder, "chart", data
    config.machine.device_type = best_device()
    pipeline: Any = clamped(config.pipeline)
    pipeline.datamanager.data = data
    if type(pipeline.datamanager.dataparser) is NerfstudioDataParserConfig:
        pipeline.datamanager.dataparser = LecoPhotographsDataParserConfig()
    if isinstance(pipeline.datamanager.dataparser, LecoPhotographsDataParserConfig):
        pipeline.datamanager.dataparser.held_out = held_out
    elif held_out != "spread":
        raise InputError(f"{contender.method} has a reader of its own, which holds out no stretch")
    if not isinstance(pipeline.model, GuidedModelConfig | LecoModelConfig):
        pipeline.model = guided(pipeline.model)
    changes = dict(contender.changes)
    if isinstance(pipeline.model, GuidedModelConfig) and learn_seconds is not None:
        changes = {"occupancy.seconds": learn_seconds} | changes
    for path, value in changes.items():
        pipeline.model = changed(pipeline.model, path, value)
    config = replace(config, pipeline=pipeline)
    for path, value in contender.settings.items():
        config = changed(config, path, value)
    return config


def short_names(names: Sequence[str]) -> list[str]:
    """The names without the method where it is the same for all."""
    method = shared_method(names)
    return [_split(name)[1] if method else name for name in names]


def shared_method(names: Sequence[str]) -> str | None:
    """The method with which all of several names begin; None where they differ."""
    methods = {_split(name)[0] for name in names}
    return methods.pop() if len(names) > 1 and len(methods) == 1 else None


def _split(name: str) -> tuple[str | None, str]:
    """Method and the rest of a name, where it has both."""
    parts = re.fullmatch(r"(.*?)(?: \+ |, )(.*)", name)
    return (None, name) if parts is None else (parts[1], parts[2])
