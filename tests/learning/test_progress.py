"""What a run knows of its own progress travels with a checkpoint."""

from __future__ import annotations

import io

import pytest
import torch

from leco_plugin.learning.run import Progress, WatchState


@pytest.mark.parametrize(
    ("progress", "configured", "most", "learn_steps"),
    [
        (Progress(), 200, 2000, 200),
        (Progress(), 200, 15, 15),
        # resumed, however few steps are left
        (Progress(learn_steps=300, configured=200), 200, 10, 300),
        # with another schedule: counted from where gate and field began anew, or a new last layer
        (Progress(learn_steps=300, configured=200, recoveries=1), 400, 2000, 400),
        (Progress(learn_steps=501, configured=200, recoveries=2, began=301), 400, 2000, 701),
        (Progress(learn_steps=5091, configured=200, recoveries=1, healed_at=4990), 400, 2000, 5391),
    ],
)
def test_a_run_learns_as_long_as_configured(progress, configured, most, learn_steps) -> None:
    healed = progress.recoveries
    progress = Progress.from_dict(progress.to_dict())
    progress.begin(configured, most=most)
    assert (progress.learn_steps, progress.recoveries) == (learn_steps, healed)


def test_a_learning_phase_is_counted_from_where_it_began() -> None:
    assert Progress().since == 0
    assert Progress(began=301, healed_at=20).since == 301
    assert Progress(began=301, healed_at=4990).since == 4991


def test_what_is_shaded_is_a_mean_over_some_ten_batches() -> None:
    progress = Progress()
    for share, mean in ((0.5, 0.95), (0.05, 0.86)):
        progress.has_shaded(share)
        assert progress.learning_kept == pytest.approx(mean)


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
