"""Claims about learning rates of a run that is given a time."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import nn

from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.timed_run import TimedRun, _Course, _never_sharpen
from leco_plugin.hosts.guided_start import OccupancyConfig
from leco_plugin.models.leco_config import LecoModelConfig

RATE = 0.01


def course_of(model: Any) -> tuple[_Course, Any]:
    """A run of 100 s of a model, and the group of its optimizer."""
    optimizer = torch.optim.Adam([nn.Parameter(torch.zeros(1))], lr=RATE)
    trainer: Any = SimpleNamespace(
        pipeline=SimpleNamespace(model=model),
        optimizers=SimpleNamespace(optimizers={"fields": optimizer}),
        callbacks=[],
    )
    run = TimedRun("method", "sampler", 0)
    course = _Course(trainer, Budget(100.0), run, Counter(), 0, None, None)
    return course, optimizer.param_groups[0]


def rate_at(course: _Course, group: Any, seconds: float, step: int) -> float:
    course.clock.seconds = seconds
    course.before(step)
    return float(group["lr"])


def test_rates_of_a_host_that_learns_first_decay_from_its_own_first_step() -> None:
    host = nn.Linear(1, 1)
    host.leco_guide = nn.Module()
    host.leco_guide.occupancy = None
    course, group = course_of(host)
    assert rate_at(course, group, 0.0, 0) == RATE
    host.leco_guide.occupancy = SimpleNamespace(report={})
    course.clock.seconds = 40.0  # learning is a part of the first step
    course.begun(0)
    assert course.run.learn_seconds == pytest.approx(40.0, abs=1.0)
    assert rate_at(course, group, 40.0, 1) == pytest.approx(RATE, rel=0.02)
    assert rate_at(course, group, 70.0, 100) == pytest.approx(RATE * 0.1**0.5, rel=0.02)
    assert rate_at(course, group, 100.0, 200) == pytest.approx(RATE * 0.1, rel=0.02)


def test_rates_of_a_model_that_goes_on_with_what_it_learned_decay_over_all_of_its_time() -> None:
    model = nn.Linear(1, 1)
    course, group = course_of(model)
    model.mixture = nn.Module()
    model.mixture.frozen = True
    course.clock.seconds = 40.0
    course.begun(50)
    assert course.run.learn_seconds == pytest.approx(40.0, abs=1.0)
    assert rate_at(course, group, 50.0, 51) == pytest.approx(RATE * 0.1**0.5)


def test_whoever_learns_an_occupancy_is_not_sharpened_in_a_time() -> None:
    own, guided = LecoModelConfig(), SimpleNamespace(occupancy=OccupancyConfig())
    for model in (own, guided, SimpleNamespace()):
        _never_sharpen(model)
    assert own.sharpening.steps == guided.occupancy.learning.sharpening.steps == 0
    assert LecoModelConfig().sharpening.steps > 0
