"""Claims about what is known of the updates of a model's occupancy grids."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from leco_plugin.evaluation.grid_updates import GridUpdates
from leco_plugin.samplers.grid import OccupancyGridEstimator


class Host(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.grid = OccupancyGridEstimator([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0], 8, 1)


def density(positions: torch.Tensor) -> torch.Tensor:
    return (positions.norm(dim=-1) < 0.5).float()


@pytest.mark.parametrize(
    ("step", "said", "warming_up"),
    [(255, {}, True), (256, {}, False), (63, {"warmup_steps": 64}, True)],
)
def test_the_warm_up_is_what_the_host_says_and_else_that_of_the_grid(
    step: int, said: dict[str, Any], warming_up: bool
) -> None:
    host = Host()
    updates = GridUpdates(host)
    assert updates.grids == [host.grid] and updates.warming_up is None
    host.grid.update_every_n_steps(step=step, occ_eval_fn=density, **said)
    assert updates.warming_up is warming_up


def test_updates_are_made_and_their_time_is_counted() -> None:
    host = Host()
    updates = GridUpdates(host)
    host.grid.update_every_n_steps(0, density)
    assert 0 < int(host.grid.binaries.sum()) < 512
    assert updates.clock.seconds > 0.0


def test_a_model_without_a_grid_says_nothing() -> None:
    updates = GridUpdates(torch.nn.Linear(2, 2))
    assert updates.grids == [] and updates.warming_up is None and updates.clock.seconds == 0.0


def test_a_grid_that_does_not_say_when_it_is_warm_is_updated_all_the_same() -> None:
    calls: list[int] = []
    host = Host()
    vars(host.grid)["update_every_n_steps"] = lambda step, occ_eval_fn: calls.append(step)
    updates = GridUpdates(host)
    host.grid.update_every_n_steps(3, density)
    assert calls == [3] and updates.warming_up is None
