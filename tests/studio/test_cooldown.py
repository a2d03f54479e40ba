"""Learning rates that stay full until a run is nearly over: by steps, and by a run's own length."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig

from leco_plugin.studio import trainer as studio_trainer
from leco_plugin.studio.cooldown import CooldownSchedulerConfig, ending_at
from leco_plugin.studio.trainer import AtomicTrainer

RATE = 3e-3


def rates(max_steps: int, steps: int) -> list[float]:
    """Those with which so many steps are taken."""
    weight = torch.nn.Parameter(torch.ones(1))
    optimizer = torch.optim.SGD([weight], lr=RATE)
    scheduler = CooldownSchedulerConfig(max_steps=max_steps).setup().get_scheduler(optimizer, RATE)
    taken = []
    for _ in range(steps):
        taken.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        scheduler.step()
    return taken


def test_rates_are_full_for_three_quarters_and_fall_to_zero_in_a_line() -> None:
    found = rates(max_steps=40, steps=43)
    assert found[:31] == pytest.approx([RATE] * 31)
    assert found[31:40] == pytest.approx([RATE * left / 10 for left in range(9, 0, -1)])
    assert found[40:] == [0.0] * 3


def test_without_an_end_rates_stay_full() -> None:
    assert rates(max_steps=0, steps=5) == pytest.approx([RATE] * 5)


def test_only_rates_that_name_no_step_of_their_own_end_with_the_run() -> None:
    decay = ExponentialDecaySchedulerConfig(lr_final=1e-4, max_steps=17)
    given: dict[str, Any] = {
        "open": {"optimizer": "kept", "scheduler": CooldownSchedulerConfig()},
        "named": {"scheduler": CooldownSchedulerConfig(max_steps=23)},
        "other": {"scheduler": decay},
        "none": {"scheduler": None},
    }
    made = ending_at(given, 90)
    assert {name: one["scheduler"] for name, one in made.items()} == {
        "open": CooldownSchedulerConfig(max_steps=90),
        "named": CooldownSchedulerConfig(max_steps=23),
        "other": decay,
        "none": None,
    }
    assert made["open"]["optimizer"] == "kept"
    assert given["open"]["scheduler"].max_steps == 0


@pytest.mark.parametrize("from_zero, end", [(True, 50), (False, 80)])
def test_a_resumed_run_cools_down_before_its_own_end(
    from_zero: bool, end: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = lambda config, done: config.max_num_iterations + (0 if from_zero else done)  # noqa: E731
    monkeypatch.setattr(studio_trainer, "end_of", counted)
    trainer = object.__new__(AtomicTrainer)
    settings = {"optimizer": AdamOptimizerConfig(lr=RATE), "scheduler": CooldownSchedulerConfig()}
    trainer.config = TrainerConfig(max_num_iterations=50, optimizers={"field": settings})
    trainer.done_before = 30
    weights = {"field": [torch.nn.Parameter(torch.ones(2))]}
    trainer.pipeline = SimpleNamespace(get_param_groups=lambda: weights)
    optimizers = trainer.setup_optimizers()
    factor = optimizers.schedulers["field"].lr_lambdas[0]
    assert factor(round(0.75 * end)) == pytest.approx(1.0, abs=0.05)
    assert factor(round(0.75 * end) + 5) < 0.9
    assert factor(end - 1) == pytest.approx(4 / end)
    assert factor(end) == 0.0
