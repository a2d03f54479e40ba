"""The history of a gate: its decisions at fixed positions, and its weights, while it learns."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from leco_plugin.learning.run import folder_of
from leco_plugin.log import say
from leco_plugin.models.compute.ranks import share
from leco_plugin.models.gate import Gate, GateConfig, check_sizes
from leco_plugin.models.losses import expert_statistics
from leco_plugin.models.mixture import Mixture
from leco_plugin.occupancy import Occupancy, gate_precision
from leco_plugin.scenes.whole_files import write_whole

if TYPE_CHECKING:
    from leco_plugin.scenes.survey import Survey

FILE_NAME = "occupancy_history.safetensors"
FORMAT = "leco_plugin.history"
GATE = "gate."
"""Before names of the gate's state in a history."""
PROBES = 16384
"""Positions at which the gate's decisions are compared between two checks."""


class Probes:
    """A mixture at fixed positions along rays that cover the training images."""

    def __init__(self, mixture: Mixture, seen: Survey) -> None:
        self.mixture = mixture
        region, device = mixture.region, mixture.device
        rays = region.cut(seen.origins.to(device), seen.directions.to(device))
        hits = (rays.t_maxs > rays.t_mins).nonzero()[:, 0]
        generator = torch.Generator().manual_seed(0)
        which = hits[torch.randint(len(hits), (PROBES,), generator=generator).to(device)]
        along = torch.rand(PROBES, generator=generator).to(device)
        distance = torch.lerp(rays.t_mins[which], rays.t_maxs[which], along)
        positions = rays.origins[which] + rays.directions[which] * distance[:, None]
        self.positions = region.space.map(positions).clamp(-1.0, 1.0)
        """[P, 3] in [-1, 1]."""

    @torch.no_grad()
    def logits(self) -> Tensor:
        """The gate's logits [P, 1 + n], the same ones in every process."""
        with gate_precision(self.mixture.device.type, self.mixture.precision):
            logits: Tensor = self.mixture.gate(self.positions)
        share([logits])
        return logits

    def routes_and_densities(self) -> tuple[Tensor, Tensor]:
        """The expert of each position [P] int64, and densities there [P] per half extent."""
        answers = self.mixture.answers(self.positions)
        return answers.routes, answers.sigmas


def as_learned(occupancy: Occupancy) -> Occupancy:
    """An occupancy with a gate of the learned shape, and the learned threshold, where a small gate
    has taken over. Its weights are new: a history holds the learned ones. ValueError if the report
    is damaged."""
    learned = occupancy.report.get("learned")
    if learned is None or learned == "along":  # by a host, with no larger gate before
        return occupancy
    try:
        config, threshold = GateConfig.from_dict(learned["gate"]), float(learned["threshold"])
        check_sizes(config)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"the occupancy's report names no gate as `learned` ({error})") from None
    gate = Gate(config).requires_grad_(False)
    return occupancy.with_gate(gate, threshold, occupancy.report).eval()


@dataclass
class GateHistory:
    """Looks at a gate, one after the other."""

    looks: list[dict[str, Tensor]] = field(default_factory=list)
    """By names of the file: `steps`; `seconds` of learning until then; `shares` [1 + n] of the
    probe positions that each expert gets, the empty-space expert first, and their mean `densities`
    [1 + n], per half extent of the scene, 0 where an expert gets none; and the gate's state."""

    def __len__(self) -> int:
        return len(self.looks)

    def all(self, name: str) -> Tensor:
        """What all looks have under a name, [looks, ...]."""
        return torch.stack([look[name] for look in self.looks])

    @property
    def steps(self) -> list[int]:
        return [int(look["steps"]) for look in self.looks]

    def weights(self, number: int) -> dict[str, Tensor]:
        """The gate's state at a look."""
        found = self.looks[number].items()
        return {name.removeprefix(GATE): value for name, value in found if name.startswith(GATE)}

    def look(self, step: int, seconds: float, gate: Gate, routes: Tensor, sigmas: Tensor) -> None:
        """Remembers the gate after a step; routes and sigmas as of `routes_and_densities`."""
        shares, densities = expert_statistics(routes, sigmas, 1 + gate.config.scene_experts)
        passed = torch.tensor(seconds, dtype=torch.float64)
        seen = {"steps": torch.tensor(step), "seconds": passed}
        seen |= {"shares": shares, "densities": densities}
        seen |= {GATE + name: value for name, value in gate.state_dict().items()}
        self.looks.append({name: value.detach().cpu().clone() for name, value in seen.items()})

    @classmethod
    def load_before(cls, checkpoint: Path, step: int, gate: Gate) -> GateHistory:
        """The looks of a run, given by a checkpoint or its folder of checkpoints, before the step
        at which it resumes; none if it stored none of this gate."""
        try:
            looks = cls.load(folder_of(checkpoint) / FILE_NAME, gate).looks
        except (OSError, ValueError):
            return cls()
        return cls([look for look in looks if look["steps"] < step])

    def save(self, folder: Path) -> Path:
        """Writes `occupancy_history.safetensors` in a folder, whole or not at all; ValueError if
        there was no look yet."""
        if not self.looks:
            raise ValueError("a history without a single look cannot be written")
        tensors = {name: self.all(name) for name in self.looks[0]}
        path = folder / FILE_NAME
        write_whole(path, save(tensors, metadata={"format": FORMAT}))
        return path

    def leave(self, folder: Path) -> None:
        """Saves it; a disk that is full is said in one line."""
        try:
            self.save(folder)
        except OSError as error:
            say(f"the history of the gate could not be written ({error})")

    @classmethod
    def load(cls, path: Path, gate: Gate) -> GateHistory:
        """Reads what `save` wrote of a gate, given as it became. OSError if there is no such file;
        ValueError if it is no history, or that of a gate of another shape."""
        try:
            with safe_open(path, framework="pt", device="cpu") as file:
                header = file.metadata() or {}
                tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        except SafetensorError as error:
            raise ValueError(f"{path} is not a whole safetensors file: {error}") from None
        if header.get("format") != FORMAT:
            raise ValueError(f"{path} is not a history of leco_plugin")
        state, experts = gate.state_dict(), (1 + gate.config.scene_experts,)
        expected: dict[str, tuple[int, ...]] = {"steps": (), "seconds": ()}
        expected |= {"shares": experts, "densities": experts}
        expected |= {GATE + name: tuple(value.shape) for name, value in state.items()}
        looks = len(tensors.get("steps", ()))
        shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if not looks or shapes != {name: (looks, *each) for name, each in expected.items()}:
            raise ValueError(f"{path} is the history of another gate than that of the occupancy")
        return cls([{name: tensors[name][look] for name in tensors} for look in range(looks)])
