"""What a chart compares, as plain data; how long each run trains; and how long all of them take."""

from __future__ import annotations

import copy
import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from leco_plugin.evaluation.clock import Budget
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.learning.schedule import HELD
from leco_plugin.log import counted
from leco_plugin.names import unknown_name
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import HeldOut

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig

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
    """Cells along an axis of grids made from its field and compared with its gate."""
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
    contender: Contender
    seed: int

    @property
    def name(self) -> str:
        """Of its files."""
        return f"{self.contender.key}-seed-{self.seed}"


def changed(config: Any, path: str, value: Any) -> Any:
    """A copy of a config, of dataclasses and dictionaries, with the setting of a dotted path
    changed; `ValueError` where there is none."""
    name, _, rest = path.partition(".")
    if isinstance(config, dict):
        if name not in config:
            raise ValueError(unknown_name("setting", name, config))
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

    All contenders read the scene with our parser, so that they render the same test pixels, and
    draw their rays on the clock. A host that learns its occupancy first may do so for
    `learn_seconds`.

    Raises:
        InputError: there is no such method, its reader cannot hold out a stretch, or a process of
            its own draws its rays.
        ValueError: it has no such setting.
    """
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    from leco_plugin.host_configs import guided
    from leco_plugin.hosts.guided import GuidedModelConfig
    from leco_plugin.method_configs import best_device
    from leco_plugin.models.leco_config import LecoModelConfig
    from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
    from leco_plugin.studio.dynamic_batch import clamped
    from leco_plugin.swap import registered

    config = copy.deepcopy(registered(contender.method))
    config.output_dir, config.experiment_name, config.data = folder, "chart", data
    config.machine.device_type = best_device()
    pipeline: Any = clamped(config.pipeline)
    pipeline.datamanager = in_this_process(pipeline.datamanager)
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


def in_this_process(datamanager: Any) -> Any:
    """The same data and rays from a data manager without processes of its own, whose time the clock
    does not count; `InputError` for one of a third party."""
    from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
    from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig

    if not isinstance(datamanager, ParallelDataManagerConfig):
        return datamanager
    if type(datamanager) is not ParallelDataManagerConfig:
        raise InputError(
            f"{type(datamanager).__name__} draws rays in other processes, whose time would not "
            "count: give the method a data manager without them"
        )
    names = [one.name for one in fields(VanillaDataManagerConfig) if one.name != "_target"]
    return VanillaDataManagerConfig(**{name: getattr(datamanager, name) for name in names})


def short_names(names: Sequence[str]) -> list[str]:
    """The names without the method where it is the same for all."""
    return [METHOD.sub("", name, count=1) for name in names] if shared_method(names) else [*names]


def shared_method(names: Sequence[str]) -> str | None:
    """The method with which all of several names begin; None where they differ."""
    methods = {found[1] if (found := METHOD.match(name)) else None for name in names}
    return methods.pop() if len(names) > 1 and len(methods) == 1 else None


METHOD = re.compile(r"(.*?)(?: \+ |, )")
"""What the name of a contender begins with: its method, and what separates it from the rest."""


LEARN_SHARE = 0.4
"""Most of the training time for learning an occupancy; short runs need most of that."""
SEEDS = 1 << 32
"""Seeds that numpy takes."""


@dataclass(frozen=True)
class Protocol(Budget):
    """Time or steps of a run, of which learning an occupancy has a share of its own by default, and
    what is evaluated: the same for all runs of a chart."""

    images: int = 2
    """Whole test images rendered at the end."""
    curve_points: int = 12
    """Evaluations on test pixels while training, off the clock."""
    at_once: int = 1
    """Runs at a time, which share the threads of the machine."""
    held_out: HeldOut = "spread"
    """Which photographs are tested."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seconds and self.learn_seconds and self.learn_seconds >= self.seconds:
            raise ValueError(
                f"learning an occupancy may take {self.learn_seconds:g} s of a run of "
                f"{self.seconds:g} s, which leaves nothing to be guided: give less"
            )
        counts = {"images": self.images, "curve points": self.curve_points}
        counts["runs at once"] = self.at_once
        for name, count in counts.items():
            if count < 1:
                raise ValueError(f"at least one of the {name} is needed, not {count}")

    def budget(self) -> Budget:
        """When a run is over, and its learning."""
        learning = self.learn_seconds
        if learning is None and self.seconds is not None:
            learning = LEARN_SHARE * self.seconds
        return Budget(self.seconds, self.steps, learning)

    def threads(self, of_machine: int) -> int:
        return max(1, of_machine // self.at_once)

    def describe(self) -> str:
        seconds = [] if self.seconds is None else [f"{self.seconds:g} s"]
        steps = [] if self.steps is None else [counted(self.steps, "step")]
        return " or ".join(seconds + steps)


def require_seeds(seeds: Iterable[int]) -> None:
    for seed in seeds:
        if not 0 <= seed < SEEDS:
            raise InputError(f"a seed is a whole number from 0 to {SEEDS - 1}, not {seed}")


def settings_of(
    scene: dict[str, Any], protocol: Protocol, suite: str | None, machine: dict[str, Any]
) -> dict[str, Any]:
    """What the runs of one chart share; runs with other settings are not comparable."""
    from leco_plugin import __version__

    made_on = {"machine": machine, "version": __version__, "rates_held": HELD}
    return {"format": 1, "scene": scene, "suite": suite, **asdict(protocol), **made_on}


@dataclass(frozen=True)
class Cores:
    """Seconds that the parts of a run take on two cores of one machine."""

    step: float
    """A training step where steps end a run: half of them learn an occupancy."""
    overhead: float
    """Start, evaluations and the last images of a run that skips."""
    unguided: float
    """More of that in a run that skips nothing."""
    grids: float
    """Making grids up to 512^3 from a field, and teaching small gates by it."""
    megapixel: float
    """Rendering a million pixels by a run that skips; one that does not takes `UNGUIDED` times as
    long."""


SMALL, UNGUIDED = 480 * 360 / 1e6, 5.0
"""Megapixels of a test image whose rendering is in `Cores.overhead`; see `Cores.megapixel`."""
FAST = Cores(step=0.15, overhead=30.0, unguided=23.0, grids=140.0, megapixel=13.0)
"""An AMD EPYC with AVX-512 bfloat16; cities, and surveys of 480 x 360 pixels."""
SLOW = Cores(step=0.45, overhead=45.0, unguided=60.0, grids=280.0, megapixel=40.0)
"""A Xeon with it at a third of that speed, whose caches are shared with other machines."""


def run_seconds(
    contender: Contender, protocol: Protocol, cores: Cores, megapixels: float = SMALL
) -> float:
    """Forecast of one run, from the start of its process to the end; its test images have so many
    million pixels."""
    steps = None if protocol.steps is None else protocol.steps * cores.step
    seconds = min(end for end in (protocol.seconds, steps) if end is not None) + cores.overhead
    larger = max(0.0, megapixels - SMALL) * protocol.images * cores.megapixel
    if contender.sampler in (DENSE, OWN_SAMPLER):
        seconds += cores.unguided
        larger *= UNGUIDED
    return seconds + larger + (cores.grids if contender.grids else 0.0)


def forecast_minutes(
    contenders: Iterable[Contender], protocol: Protocol, cores: Cores, megapixels: float = SMALL
) -> float:
    """Forecast of one run of each contender, as many at a time as the protocol says."""
    seconds = sum(run_seconds(one, protocol, cores, megapixels) for one in contenders)
    return seconds / protocol.at_once / 60.0


def forecast(contenders: Iterable[Contender], protocol: Protocol, megapixels: float = SMALL) -> str:
    """How long runs take, in words: on fast cores and on slow ones."""
    given = list(contenders)
    protocol = replace(protocol, at_once=min(protocol.at_once, max(1, len(given))))
    fast, slow = (
        max(1, round(forecast_minutes(given, protocol, cores, megapixels)))
        for cores in (FAST, SLOW)
    )
    if fast == slow:
        return f"about {counted(fast, 'minute')} on two CPU cores"
    return f"about {fast} to {slow} minutes on two CPU cores, by their speed"
