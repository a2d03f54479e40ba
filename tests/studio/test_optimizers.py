"""Claims about optimizers of a model that loses parameters."""

from __future__ import annotations

import copy
from typing import Any

import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch import nn

from leco_plugin.studio.run_folder import drop_missing_parameters
from leco_plugin.studio.trainer import PrunedOptimizers

CONFIG = {
    name: {"optimizer": AdamOptimizerConfig(lr=0.1, max_norm=1.0), "scheduler": None}
    for name in ("field", "gate")
}


class Pipeline(nn.Module):
    """Two linear maps and a gate; `parts` may lose one."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.parts = nn.ModuleList(nn.Linear(2, 2) for _ in range(2))
        self.gate = nn.Linear(2, 1)

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        return {"field": list(self.parts.parameters()), "gate": list(self.gate.parameters())}


def step(pipeline: Pipeline, optimizers: PrunedOptimizers) -> None:
    optimizers.zero_grad_all()
    sum((parameter**2).sum() for parameter in pipeline.parameters()).backward()
    optimizers.optimizer_step_all()


def reduced() -> tuple[Pipeline, PrunedOptimizers]:
    """After a step, without the first part, and after another step."""
    pipeline = Pipeline()
    optimizers = PrunedOptimizers(CONFIG, pipeline)
    step(pipeline, optimizers)
    pipeline.parts[0] = None
    drop_missing_parameters(optimizers, pipeline.get_param_groups())
    step(pipeline, optimizers)
    return pipeline, optimizers


def test_what_has_gone_is_forgotten_and_the_rest_goes_on() -> None:
    pipeline, optimizers = reduced()
    whole = Pipeline()
    others = PrunedOptimizers(CONFIG, whole)
    step(whole, others)
    step(whole, others)
    optimizer: Any = optimizers.optimizers["field"]
    assert [id(p) for p in optimizer.param_groups[0]["params"]] == [
        id(p) for p in pipeline.parts[1].parameters()
    ]
    assert len(optimizer.state) == 2 and len(optimizers.parameters["field"]) == 2
    assert len(optimizers.optimizers["gate"].state) == 2
    for ours, theirs in zip(pipeline.gate.parameters(), whole.gate.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs)


def test_a_resumed_run_has_the_optimizer_of_what_is_left() -> None:
    pipeline, optimizers = reduced()
    saved = copy.deepcopy({k: one.state_dict() for k, one in optimizers.optimizers.items()})
    again = Pipeline()
    resumed = PrunedOptimizers(CONFIG, again)  # made before the checkpoint is read
    again.parts[0] = None
    again.load_state_dict(pipeline.state_dict())
    resumed.load_optimizers(saved)
    step(pipeline, optimizers)
    step(again, resumed)
    for ours, theirs in zip(again.parameters(), pipeline.parameters(), strict=True):
        assert torch.equal(ours, theirs)
