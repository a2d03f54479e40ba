"""What a run knows of its own progress travels with a checkpoint."""

from __future__ import annotations

import io

import torch

from leco_plugin.learning.run import Progress, WatchState


def test_a_new_run_learns_as_long_as_configured_unless_it_is_short() -> None:
    long, short = Progress(), Progress()
    long.begin(200, most=2000)
    short.begin(200, most=15)
    assert (long.learn_steps, short.learn_steps) == (200, 15)


def test_a_resumed_run_keeps_its_schedule_however_few_steps_are_left() -> None:
    progress = Progress()
    progress.begin(200, most=2000)
    progress.learn_steps = 300  # healed
    resumed = Progress.from_dict(progress.to_dict())
    resumed.begin(200, most=10)
    assert resumed.learn_steps == 300


def test_a_run_resumed_with_another_schedule_takes_that_one() -> None:
    progress = Progress(learn_steps=300, configured=200, recoveries=1)
    progress.begin(400, most=2000)
    assert progress.learn_steps == 400 and progress.recoveries == 1
    anew = Progress(learn_steps=501, configured=200, recoveries=2, began=301)
    anew.begin(400, most=2000)
    assert anew.learn_steps == 701  # counted from where gate and field began anew
    healed = Progress(learn_steps=5091, configured=200, recoveries=1, healed_at=4990)
    healed.begin(400, most=2000)
    assert healed.learn_steps == 5391  # or from its new last layer


def test_a_learning_phase_is_counted_from_where_it_began() -> None:
    assert Progress().since == 0
    assert Progress(began=301, healed_at=20).since == 301
    assert Progress(began=301, healed_at=4990).since == 4991


def test_progress_is_read_back_without_unsafe_loading() -> None:
    watch = WatchState(800, 4, {"a price": (1.0, 2.0, 3.0)}, 7, 0.25)
    progress = Progress(
        *(300, 200, 150, 2, 12.5, 1, 2),
        decisions=torch.tensor([True, False]),
        suspected_since=7,
        watch=watch,
    )
    buffer = io.BytesIO()
    torch.save(progress.to_dict(), buffer)
    buffer.seek(0)
    found = Progress.from_dict(torch.load(buffer, weights_only=True))
    assert torch.equal(found.decisions, progress.decisions) and found.watch == watch
    assert {**found.to_dict(), "decisions": None} == {**progress.to_dict(), "decisions": None}
