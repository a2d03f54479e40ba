"""When the first phase ends."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
import torch

from leco_plugin.learning.run import Progress
from leco_plugin.learning.schedule import (
    ScheduleConfig,
    converged,
    decisions_agree,
    is_unsettled,
    ramp,
    schedule_since,
    steps_in,
    steps_of_an_extension,
)

SCHEDULE = ScheduleConfig(learn_steps=1000, earliest=0.5, ramp_from=0.2, ramp_to=0.6)


def test_the_ramp_rises_from_zero_to_one_between_its_ends() -> None:
    values = [ramp(step, SCHEDULE) for step in range(1000)]
    assert values[:201] == [0.0] * 201 and values[600:] == [1.0] * 400
    assert all(before < after for before, after in pairwise(values[200:601]))


def test_a_ramp_that_would_end_before_it_begins_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ramp-from is 0\.8.*at most ramp-to, 0\.7"):
        ScheduleConfig(ramp_from=0.8)
    ScheduleConfig(ramp_from=0.7)  # at once


def test_a_gate_that_begins_anew_has_the_schedule_of_the_steps_from_there() -> None:
    first, anew = (Progress(learn_steps=began + 600, began=began) for began in (0, 2000))
    assert schedule_since(SCHEDULE, anew) == schedule_since(SCHEDULE, first)
    assert schedule_since(SCHEDULE, anew).learn_steps == 600


@pytest.mark.parametrize(
    ("end", "steps"),
    [(1999, 200), (2900, 290), (8000, 800), (8001, 800), (10_000_000, 800), (math.inf, 200)],
)
def test_a_long_run_learns_for_its_share_up_to_four_times(end: float, steps: int) -> None:
    assert steps_in(end, ScheduleConfig(learn_steps=200, learn_share=0.1)) == steps
    assert steps_in(end, ScheduleConfig(learn_steps=200)) == 200


@pytest.mark.parametrize("share", [-0.1, 0.51, math.nan])
def test_a_share_of_a_run_that_is_none_is_refused(share: float) -> None:
    with pytest.raises(ValueError, match=r"schedule\.learn-share is .*from 0 to 0\.5"):
        ScheduleConfig(learn_share=share)
    ScheduleConfig(learn_share=0.5)


@pytest.mark.parametrize(
    ("phase", "extensions", "longer"), [(200, 0, True), (200, 1, False), (150, 0, False)]
)
def test_only_a_phase_of_usual_length_grows_with_its_run(
    phase: int, extensions: int, longer: bool
) -> None:
    """One that was shortened keeps to its time, and one that was extended has had its steps."""
    progress = Progress(learn_steps=phase + 7, phase=phase, configured=200, extensions=extensions)
    progress.lengthen(300)
    assert (progress.phase, progress.learn_steps) == ((300, 307) if longer else (phase, phase + 7))
    progress.lengthen(250)
    assert progress.phase == (300 if longer else phase), "it never shrinks"


@pytest.mark.parametrize("learn_steps", [1, 2, 10])
def test_the_ramp_of_a_short_run_stays_between_zero_and_one(learn_steps: int) -> None:
    values = [ramp(step, ScheduleConfig(learn_steps=learn_steps)) for step in range(20)]
    assert values == sorted(values) and values[-1] == 1.0 and min(values) >= 0.0


def test_a_gate_is_frozen_when_its_decisions_have_settled_or_at_the_step_limit() -> None:
    assert not converged(498, 1.0, SCHEDULE)
    assert converged(499, 1.0, SCHEDULE)
    assert not converged(499, SCHEDULE.agreement - 1e-3, SCHEDULE)
    assert converged(499, SCHEDULE.agreement, SCHEDULE)
    assert converged(999, 0.0, SCHEDULE)


def test_a_gate_that_changes_its_mind_at_the_step_limit_learns_on_twice() -> None:
    below = SCHEDULE.settled - 1e-3
    assert [is_unsettled(999, below, SCHEDULE, times) for times in range(4)] == [
        *(True, True, False, False)
    ]
    assert not is_unsettled(999, SCHEDULE.settled, SCHEDULE, 0)
    assert not is_unsettled(4 * SCHEDULE.steps_per_check - 2, below, SCHEDULE, 0)  # a short run
    assert is_unsettled(4 * SCHEDULE.steps_per_check - 1, below, SCHEDULE, 0)


def test_an_extension_is_a_quarter_and_a_step_at_least() -> None:
    assert [steps_of_an_extension(steps) for steps in (3, 11, 200)] == [1, 2, 50]


def test_agreement_is_the_share_of_equal_decisions() -> None:
    before = torch.tensor([True, True, False, False])
    assert decisions_agree(before, torch.tensor([True, False, False, False])) == 0.75
    assert decisions_agree(before, before) == 1.0
    assert decisions_agree(torch.zeros(0, dtype=torch.bool), before) == 0.0
