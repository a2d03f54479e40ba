"""Claims about learning rates that a run lowers by itself."""

from __future__ import annotations

import copy

import pytest
import torch

from leco_plugin.learning.run import keep_pace

RATE = 0.5


def descent() -> torch.optim.SGD:
    return torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=RATE)


def stepped(optimizer: torch.optim.Optimizer) -> float:
    """How far one step goes down a slope of 1."""
    (weight,) = optimizer.param_groups[0]["params"]
    before = float(weight.detach())
    weight.grad = torch.ones(1)
    optimizer.step()
    return before - float(weight.detach())


def test_steps_are_shorter_and_rates_are_as_they_were() -> None:
    optimizer = descent()
    for pace in (1.0, 0.25, 0.25, 0.0625):
        keep_pace([optimizer], pace)
        assert stepped(optimizer) == RATE * pace
        assert optimizer.param_groups[0]["lr"] == RATE


@pytest.mark.parametrize(
    "scheduled",
    [
        lambda one: torch.optim.lr_scheduler.LambdaLR(one, lambda step: 0.25**step),
        lambda one: torch.optim.lr_scheduler.MultiStepLR(one, [1, 2], 0.5),
        lambda one: torch.optim.lr_scheduler.CosineAnnealingLR(one, 8),
    ],
)
def test_no_scheduler_sees_it(scheduled) -> None:
    slow, asked = descent(), descent()
    schedulers = [scheduled(slow), scheduled(asked)]
    for _ in range(4):
        keep_pace([slow], 0.25)
        assert stepped(slow) == pytest.approx(0.25 * stepped(asked))
        for scheduler in schedulers:
            scheduler.step()


def test_a_checkpoint_does_not_see_it() -> None:
    slow, resumed = descent(), descent()
    before = copy.deepcopy(slow.state_dict())
    keep_pace([slow], 0.25)
    stepped(slow)
    assert slow.state_dict()["param_groups"] == before["param_groups"]
    resumed.load_state_dict(slow.state_dict())
    keep_pace([resumed], 0.25)  # as its progress says
    assert stepped(resumed) == 0.25 * RATE
