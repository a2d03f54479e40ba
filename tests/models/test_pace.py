"""Claims about learning rates that a run lowers by itself."""

from __future__ import annotations

import torch

from leco_plugin.models.pace import keep_pace


def adam() -> torch.optim.Adam:
    return torch.optim.Adam([torch.nn.Parameter(torch.zeros(2))], lr=1e-2)


def rate(optimizer: torch.optim.Optimizer) -> float:
    return float(optimizer.param_groups[0]["lr"])


def test_a_rate_that_nobody_lowers_is_left_alone() -> None:
    optimizer = adam()
    keep_pace([optimizer], 1.0)
    assert rate(optimizer) == 1e-2 and not any("leco" in key for key in optimizer.param_groups[0])


def test_a_rate_that_nobody_else_sets_is_lowered_once() -> None:
    optimizer = adam()
    for _ in range(5):
        keep_pace([optimizer], 0.25)
    assert rate(optimizer) == 2.5e-3
    keep_pace([optimizer], 0.0625)
    assert rate(optimizer) == 6.25e-4


def test_a_scheduler_sets_what_is_multiplied() -> None:
    optimizer = adam()
    falling = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 0.5**step)
    for step in range(4):
        keep_pace([optimizer], 0.25)
        assert rate(optimizer) == 0.25 * 1e-2 * 0.5**step
        optimizer.step()
        falling.step()


def test_a_resumed_run_goes_on_at_its_pace() -> None:
    optimizer, resumed = adam(), adam()
    keep_pace([optimizer], 0.25)
    resumed.load_state_dict(optimizer.state_dict())
    keep_pace([resumed], 0.25)
    assert rate(resumed) == 2.5e-3
