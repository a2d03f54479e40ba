"""The history of a gate: its decisions at fixed positions, and its weights, while it learns."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
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

    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    """Seconds of learning until each look."""
    shares: list[Tensor] = field(default_factory=list)
    """[1 + n] share of the probe positions that each expert gets; 0 is the empty-space expert."""
    densities: list[Tensor] = field(default_factory=list)
    """[1 + n] mean density of those, per half extent of the scene; 0 where an expert gets none."""
    weights: list[dict[str, Tensor]] = field(default_factory=list)
    """State dicts of the gate."""

    def __len__(self) -> int:
        return len(self.steps)

    def look(self, step: int, seconds: float, gate: Gate, routes: Tensor, sigmas: Tensor) -> None:
        """Remembers the gate after a step; routes and sigmas as of `routes_and_densities`."""
        shares, densities = expert_statistics(routes, sigmas, 1 + gate.config.scene_experts)
        self.steps.append(step)
        self.seconds.append(seconds)
        self.shares.append(shares.cpu())
        self.densities.append(densities.cpu())
        state = gate.state_dict()
        self.weights.append({name: value.detach().cpu().clone() for name, value in state.items()})

    @classmethod
    def load_before(cls, checkpoint: Path, step: int, gate: Gate) -> GateHistory:
        """The looks of a run, given by a checkpoint or its folder of checkpoints, before the step
        at which it resumes; none if it stored none of this gate."""
        try:
            found = cls.load(folder_of(checkpoint) / FILE_NAME, gate)
        except (OSError, ValueError):
            return cls()
        looks = sum(look < step for look in found.steps)
        return cls(*(getattr(found, each.name)[:looks] for each in fields(cls)))

    def save(self, folder: Path) -> Path:
        """Writes `occupancy_history.safetensors` in a folder, whole or not at all; ValueError if
        there was no look yet."""
        if not self.steps:
            raise ValueError("a history without a single look cannot be written")
        tensors = {
            "steps": torch.tensor(self.steps),
            "seconds": torch.tensor(self.seconds, dtype=torch.float64),
            "shares": torch.stack(self.shares),
            "densities": torch.stack(self.densities),
        }
        for name in self.weights[0]:
            tensors[f"gate.{name}"] = torch.stack([state[name] for state in self.weights])
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
        expected |= {f"gate.{name}": tuple(value.shape) for name, value in state.items()}
        looks = len(tensors.get("steps", ()))
        shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if not looks or shapes != {name: (looks, *each) for name, each in expected.items()}:
            raise ValueError(f"{path} is the history of another gate than that of the occupancy")
        return cls(
            tensors["steps"].tolist(),
            tensors["seconds"].tolist(),
            list(tensors["shares"]),
            list(tensors["densities"]),
            [{name: tensors[f"gate.{name}"][look] for name in state} for look in range(looks)],
        )
