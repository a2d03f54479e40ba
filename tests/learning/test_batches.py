"""Claims about the rays of a batch: as many as keep the samples of a step where they were."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.learning import batches
from leco_plugin.learning.batches import Batches
from leco_plugin.learning.progress import Progress
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSampler


class Sampler(KnownDistancePixelSampler):
    """Counts how often its number of rays is set."""

    def __init__(self, rays: int) -> None:
        self.num_rays_per_batch, self.sets, self.sparse = rays, 0, None

    def set_num_rays_per_batch(self, num_rays_per_batch: int) -> None:
        self.num_rays_per_batch, self.sets = num_rays_per_batch, self.sets + 1


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Batches of 100 rays of a model that follows a gate, with one sampler and no points."""
    sizes = SimpleNamespace(learn_candidates=32, candidates=64, guided_batch=4.0)
    model: Any = SimpleNamespace(
        config=SimpleNamespace(sizes=sizes, termination=0.03),
        device=torch.device("cpu"),
        frozen=torch.tensor(False),
        learned=False,
        progress=Progress(),
        step=0,
        report={},
    )
    sampler = Sampler(100)
    monkeypatch.setattr(batches, "sampler_here", lambda manager: sampler)
    monkeypatch.setattr(batches, "sparse_points", lambda dataset: None)
    manager = SimpleNamespace(get_train_rays_per_batch=lambda: 100, train_dataset=None)
    return SimpleNamespace(batches=Batches(model, manager), model=model, sampler=sampler)


@pytest.mark.parametrize(
    ("empty_fraction", "factor"), [(0.0, 0.5), (0.75, 2.0), (0.875, 4.0), (0.999, 4.0)]
)
def test_a_guided_batch_has_the_samples_of_a_learning_one_within_limits(
    made: Any, empty_fraction: float, factor: float
) -> None:
    made.model.frozen, made.model.report = torch.tensor(True), {"empty_fraction": empty_fraction}
    made.batches.prepare(learning=False)
    assert made.sampler.num_rays_per_batch == 100 * factor


@pytest.mark.parametrize(("kept", "rays"), [(1.0, 100), (0.5, 200), (0.4, 250), (0.1, 400)])
def test_while_learning_the_rays_follow_what_is_shaded_in_eighths(
    made: Any, kept: float, rays: int
) -> None:
    made.model.progress.learning_kept = kept
    made.batches.prepare(learning=True)
    made.batches.prepare(learning=True)
    assert made.sampler.num_rays_per_batch == rays
    assert made.sampler.sets == int(rays != 100)  # not set again to what it is


def test_a_healed_gate_is_not_followed_and_its_batches_are_no_longer_for_it(made: Any) -> None:
    made.model.progress.learning_kept, made.model.progress.dense_until = 0.1, 5
    made.batches.prepare(learning=True)
    assert made.sampler.num_rays_per_batch == 100
    made.model.step = 5
    made.batches.prepare(learning=True)
    assert made.sampler.num_rays_per_batch == 100  # until it has been seen what it keeps now


def test_a_gate_that_is_never_frozen_is_not_followed_once_it_has_learned(made: Any) -> None:
    made.model.progress.learning_kept = 0.3
    made.batches.prepare(learning=True)
    assert made.sampler.num_rays_per_batch > 300
    made.model.learned = True
    made.batches.prepare(learning=False)
    assert made.sampler.num_rays_per_batch == 100


def test_known_distances_are_asked_for_only_while_learning_with_a_weight(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = object()
    made.batches.sparse = points
    for learning, weight, wanted in ((True, 0.03, points), (False, 0.03, None), (True, 0.0, None)):
        made.model.config.termination = weight
        made.batches.prepare(learning)
        assert made.sampler.sparse is wanted


def test_a_sampler_elsewhere_is_left_alone(made: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "sampler_here", lambda manager: None)
    made.model.progress.learning_kept = 0.1
    made.batches.prepare(learning=True)
    assert made.sampler.num_rays_per_batch == 100
