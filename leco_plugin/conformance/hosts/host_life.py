"""Checks of a guided host beyond one process: config, checkpoint, resuming, data parallel."""

from __future__ import annotations

import copy
import functools
import io
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from leco_plugin.conformance.hosts.host_case import HostCase, build, callbacks, loss_of
from leco_plugin.conformance.hosts.host_images import rendered
from leco_plugin.conformance.kit.host_scene import batch, bundle
from leco_plugin.conformance.kit.scene import SLAB
from leco_plugin.conformance.kit.two_processes import on_two_ranks
from leco_plugin.conformance.rule import require

if TYPE_CHECKING:
    from nerfstudio.engine.callbacks import TrainingCallbackLocation
    from nerfstudio.engine.trainer import TrainerConfig

ROUNDING = 1e-3
"""Share of a step, or of a gradient, by which sums in another order may differ."""


def state_and_yaml_round_trip(case: HostCase) -> None:
    """A run folder is all that it takes: its config.yml, its checkpoint, and no other file."""
    import yaml  # type: ignore[import-untyped]

    model = case.shared()
    expected = rendered(model, bundle())
    with TemporaryDirectory() as folder:
        config = copy.deepcopy(case.config)
        config.pipeline.model.occupancy.path = Path(folder) / case.file.name  # type: ignore[attr-defined]
        case.occupancy(SLAB).save(config.pipeline.model.occupancy.path)  # type: ignore[attr-defined]
        written = yaml.dump(config)
    read: Any = yaml.load(written, Loader=yaml.Loader)
    restored = build(read.pipeline.model, seed=1)
    restored.update_to_step(1)
    restored.load_state_dict(saved(model.state_dict()), strict=True)
    for name, value in rendered(restored, bundle()).items():
        require(
            value.equal(expected[name]),
            f"the output {name!r} of a model that was restored is not that of the one it is of",
        )


def saved(state: Any) -> Any:
    """What is read of a checkpoint of this state."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, map_location="cpu", weights_only=True)


class Run:
    """A training run as nerfstudio's trainer makes it, of the same batch in every step."""

    def __init__(self, config: TrainerConfig, seed: int) -> None:
        from nerfstudio.engine.optimizers import Optimizers

        self.model = build(config.pipeline.model, seed)
        groups = self.model.get_param_groups()
        self.optimizers = Optimizers(copy.deepcopy(config.optimizers), groups)
        self.callbacks = callbacks(self.model, self.optimizers)

    def step(self, step: int) -> float:
        """Takes a step, with random numbers of its own; returns the loss."""
        from nerfstudio.engine.callbacks import TrainingCallbackLocation as Location

        torch.manual_seed(step)
        self.model.train()
        self._call(step, Location.BEFORE_TRAIN_ITERATION)
        self.optimizers.zero_grad_all()
        loss = loss_of(self.model, bundle(), batch())
        loss.backward()  # type: ignore[no-untyped-call]
        self.optimizers.optimizer_step_all()
        for scheduler in self.optimizers.schedulers.values():
            scheduler.step()
        self._call(step, Location.AFTER_TRAIN_ITERATION)
        return float(loss.detach())

    def _call(self, step: int, location: TrainingCallbackLocation) -> None:
        for callback in self.callbacks:
            callback.run_callback_at_location(step, location)

    def state(self) -> dict[str, Any]:
        """What a checkpoint holds."""
        held = self.optimizers
        return {
            "model": self.model.state_dict(),
            "optimizers": {name: each.state_dict() for name, each in held.optimizers.items()},
            "schedulers": {name: each.state_dict() for name, each in held.schedulers.items()},
        }

    def resume(self, state: dict[str, Any], step: int) -> None:
        """Goes on from the checkpoint of a step."""
        self.model.update_to_step(step)
        self.model.load_state_dict(state["model"], strict=True)
        self.optimizers.load_optimizers(state["optimizers"])
        self.optimizers.load_schedulers(state["schedulers"])

    def parameters(self) -> dict[str, Tensor]:
        """Copies of the parameters."""
        return {name: p.detach().clone() for name, p in self.model.named_parameters()}


def resumes_where_it_stopped(case: HostCase) -> None:
    """The step after a checkpoint is the same, whether or not the run was interrupted."""
    run, resumed = Run(case.config, seed=0), Run(case.config, seed=1)
    run.step(0)
    state, before = saved(run.state()), run.parameters()
    expected = run.step(1)
    resumed.resume(state, step=0)
    found = resumed.step(1)
    require(
        abs(found - expected) <= ROUNDING * abs(expected),
        f"the loss after resuming is {found:.6g}; uninterrupted it is {expected:.6g}",
    )
    after = resumed.parameters()
    for name, value in run.parameters().items():
        step, apart = (value - before[name]).norm(), (value - after[name]).norm()
        require(
            bool(apart <= ROUNDING * step),
            f"the first step after resuming moves {name} otherwise than without interruption",
        )


def two_processes_step_alike(case: HostCase) -> None:
    """Two ranks with half a batch each get the gradients of one process with all of it."""
    config = case.config.pipeline.model  # type: ignore[attr-defined]
    model = build(config)
    callbacks(model)
    for rank in range(2):
        _half_a_batch(model, rank).backward()  # type: ignore[no-untyped-call]
    alone = {name: gradient / 2.0 for name, gradient in _gradients(model).items()}
    one, other = on_two_ranks(functools.partial(gradients_of_rank, config), case.imports)
    for name, parameter in model.named_parameters():
        nothing = torch.zeros_like(parameter)
        first, second, expected = (found.get(name, nothing) for found in (one, other, alone))
        require(first.equal(second), f"the ranks' gradients of {name} differ")
        apart, length = (first - expected).norm(), expected.norm()
        require(
            bool(apart <= ROUNDING * length),
            f"the gradient of {name} differs by {float(apart):.2g} from that of one process, which "
            f"is {float(length):.2g} long",
        )


def gradients_of_rank(config: Any, rank: int) -> dict[str, Tensor]:
    """Gradients that a rank of data-parallel training gets from its half of the batch."""
    from torch.nn.parallel import DistributedDataParallel

    model = build(config, seed=rank)
    callbacks(model)
    parallel = DistributedDataParallel(model, find_unused_parameters=True)
    _half_a_batch(model, rank, parallel).backward()  # type: ignore[no-untyped-call]
    return _gradients(model)


def _half_a_batch(model: Any, rank: int, forward: Any = None) -> Tensor:
    """The loss of every second ray, in training, with the rank's own random numbers."""
    rendered(model, bundle()[rank::2])  # whatever is built at first use is built
    torch.manual_seed(rank)
    half = {name: values[rank::2] for name, values in batch().items()}
    return loss_of(model.train(), bundle()[rank::2], half, forward)


def _gradients(model: Any) -> dict[str, Tensor]:
    named = ((name, parameter.grad) for name, parameter in model.named_parameters())
    return {name: gradient for name, gradient in named if gradient is not None}
