"""What the processes of the data-parallel tests run, in place of nerfstudio's training loop.

Meant for the forkserver of `multiprocessing`: nerfstudio is imported once, and each is a fork.
"""

from __future__ import annotations

import hashlib
import os
import random
import sys
from functools import partial
from pathlib import Path
from typing import Any

import torch
from mortal_training import collapse_once, die_after, leave_out_the_cache
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts import train as ns_train
from torch import Tensor, distributed

from leco_plugin.learning.held_out import HeldOut
from leco_plugin.learning.history import Probes
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.merging import Merging
from leco_plugin.models.compute.ranks import from_first, is_first, mean, share
from leco_plugin.models.leco import LecoModel
from leco_plugin.occupancy import Occupancy

HEALED = "healed"
"""Name of the runs whose gate is found collapsed once."""


def run(local_rank: int, world_size: int, config: Any, global_rank: int = 0) -> None:
    """Trains, and leaves what this process saw as `process-N.pt` in the run's folder."""
    folder = config.get_base_dir()
    with (folder / f"process-{global_rank}.log").open("wb") as printed:
        os.dup2(printed.fileno(), sys.stdout.fileno())
        os.dup2(printed.fileno(), sys.stderr.fileno())
    leave_out_the_cache()
    if config.timestamp == HEALED:
        collapse_once()
    if global_rank > 0:
        look_elsewhere()
        drift_before_freezing()
        need_every_expert()
    seen: dict[str, Any] = {
        "steps": [],
        "looks": [],
        "saved": [],
        "threads": torch.get_num_threads(),
    }
    record(seen)
    ns_train.train_loop(local_rank, world_size, config, global_rank)
    trainer = seen.pop("trainer")
    seen["backend"] = distributed.get_backend()
    seen["state"] = trainer.pipeline.model.state_dict()
    seen["gradients"] = gradients(trainer.pipeline.model)
    torch.save(seen, folder / f"process-{global_rank}.pt")


def lose_one(local_rank: int, world_size: int, config: Any, global_rank: int = 0) -> None:
    """Trains, in the second process up to its tenth step only."""
    folder = config.get_base_dir()
    with (folder / f"process-{global_rank}.log").open("wb") as printed:
        os.dup2(printed.fileno(), sys.stdout.fileno())
        os.dup2(printed.fileno(), sys.stderr.fileno())
    leave_out_the_cache()
    if global_rank == 1:
        die_after(Trainer, "train_iteration", lambda _, step: step == 9)
    ns_train.train_loop(local_rank, world_size, config, global_rank)


def look_elsewhere() -> None:
    """Has this process look at its gate where no other does, and find fewer places kept."""
    own_batch, own_probes = Learner._learning_batch, Probes.__init__

    def half_kept(self: Learner, step: int) -> float:
        self.progress.learning_kept = 0.5
        return own_batch(self, step)

    def elsewhere(self: Probes, *arguments: Any) -> None:
        own_probes(self, *arguments)
        self.positions = torch.rand_like(self.positions)

    Learner._learning_batch = half_kept  # type: ignore[method-assign]
    Probes.__init__ = elsewhere  # type: ignore[method-assign]


def drift_before_freezing() -> None:
    """Has the gate of this process become another one by the time it is frozen."""
    freeze = Learner._freeze

    def drifted(self: Learner, step: int) -> None:
        bias = self.mixture.gate.head.bias
        with torch.no_grad():
            bias.add_(torch.rand_like(bias))
        freeze(self, step)

    Learner._freeze = drifted  # type: ignore[method-assign]


def need_every_expert() -> None:
    """Has this process find that no scene expert may leave, if it is asked."""
    HeldOut.unneeded = lambda *_: Merging([], None)  # type: ignore[method-assign, assignment]


def record(seen: dict[str, Any]) -> None:
    """Notes every step with its weights and loss, every look at the gate, every file written."""
    own_step, own_save = Trainer.train_iteration, Occupancy.save

    def train_iteration(self: Trainer, step: int) -> Any:
        seen["trainer"] = self
        if step == self._start_step:
            seen["first_step"] = step
        rays = self.pipeline.datamanager.train_pixel_sampler.num_rays_per_batch
        result = own_step(self, step)
        model = self.pipeline.model
        learns = isinstance(model, LecoModel)
        phase = (model.plan.ramped, bool(model.mixture.frozen)) if learns else (None, True)
        weights = "".join(digest(model.state_dict()).values())
        seen["steps"].append((step, rays, phase, weights, float(result[0].detach())))
        return result

    def save(self: Occupancy, path: Path) -> None:
        seen["saved"].append(str(path))
        own_save(self, path)

    own_look = Probes.logits

    def look(self: Probes) -> Tensor:
        logits = own_look(self)
        seen["looks"].append(logits.clone())
        return logits

    Probes.logits = look  # type: ignore[method-assign]
    Trainer.train_iteration = train_iteration  # type: ignore[method-assign]
    Occupancy.save = save  # type: ignore[method-assign, assignment]


def gradients(model: torch.nn.Module) -> dict[str, Tensor | None]:
    return {name: parameter.grad for name, parameter in model.named_parameters()}


def step(local_rank: int, world_size: int, config: Any, global_rank: int = 0) -> None:
    """One backward pass of a share of a batch; leaves `process-N.pt` in the run's folder."""
    leave_out_the_cache()
    torch.rand_like = without_jitter
    found = backward(config, local_rank, world_size)
    torch.save(found, config.get_base_dir() / f"process-{global_rank}.pt")


without_jitter = partial(torch.full_like, fill_value=0.5)
"""In place of `torch.rand_like`."""


def backward(config: Any, number: int, of: int) -> dict[str, Any]:
    """Loss and gradients of a share of one batch, as by nerfstudio's pipeline and trainer."""
    random.seed(0)
    torch.manual_seed(number)  # it is for DDP to give all the weights of the first one
    pipeline = set_up(config, number, of)
    torch.manual_seed(0)
    bundle, batch = pipeline.datamanager.next_train(0)
    rays = torch.arange(len(bundle)).chunk(of)[number]
    part = bundle[rays], {"image": batch["image"][rays]}
    pipeline.datamanager.next_train = lambda _: part
    _, losses, _ = pipeline.get_train_loss_dict(0)
    loss = torch.stack(list(losses.values())).sum()
    loss.backward()
    return {"loss": float(loss.detach()), "gradients": gradients(pipeline.model)}


def set_up(config: Any, number: int, of: int) -> Any:
    """A pipeline whose losses are means over rays or, as many on each ray, over samples."""
    pipeline = config.pipeline.setup(device="cpu", local_rank=number, world_size=of)
    model = pipeline.model
    if isinstance(model, LecoModel):
        mixture = model.mixture
        mixture.precision = "float32"
        model.plan = model.plan._replace(ramped=1.0)
        mixture.region.aabb.mul_(1e3)  # all rays are of one length
        if config.timestamp == "guided":
            mixture.freeze(0.5, {})
    return pipeline.train()


def agree(local_rank: int, world_size: int, config: Any, global_rank: int = 0) -> None:
    """What the processes agree on, each starting from its own number."""
    device = torch.device("cpu")
    tensors = [
        torch.full((2, 3), global_rank == 0),
        torch.tensor(global_rank + 0.5, dtype=torch.bfloat16),
        torch.full((3, 2), global_rank, dtype=torch.int64).T,
        torch.zeros(0),
    ]
    share(tensors)
    found = {
        "tensors": tensors,
        "mean": mean(float(global_rank), device),
        "object": from_first(lambda: {"rank": global_rank}, device),
        "first": is_first(),
    }
    torch.save(found, config.get_base_dir() / f"process-{global_rank}.pt")


def digest(state: dict[str, Any]) -> dict[str, str]:
    """A fingerprint of each tensor of a state, to the last bit."""
    return {
        name: hashlib.sha256(value.reshape(-1).view(torch.uint8).numpy().tobytes()).hexdigest()
        for name, value in state.items()
        if isinstance(value, Tensor)
    }
