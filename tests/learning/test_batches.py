"""Claims about the rays of a batch: as many as keep the samples of a step where they were."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from small_learner import small_learner

from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.scenes import learning_data
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.learning_data import LearningData
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSampler


class Sampler(KnownDistancePixelSampler):
    """Counts how often its number of rays is set."""

    def __init__(self, rays: int) -> None:
        self.num_rays_per_batch, self.sets, self.sparse = rays, 0, None

    def set_num_rays_per_batch(self, num_rays_per_batch: int) -> None:
        self.num_rays_per_batch, self.sets = num_rays_per_batch, self.sets + 1


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A learner with batches of 100 rays, one sampler and no points."""
    sampler = Sampler(100)
    monkeypatch.setattr(learning_data, "sampler_here", lambda manager: sampler)
    monkeypatch.setattr(learning_data, "sparse_points", lambda dataset: None)
    monkeypatch.setattr(learning_data, "survey", lambda *_: None)
    manager = SimpleNamespace(get_train_rays_per_batch=lambda: 100, train_dataset=None)
    data = LearningData(manager, BoundsConfig(), None, None)
    learner = small_learner(
        data=data, schedule=ScheduleConfig(freeze=False, learn_steps=7), termination=0.03
    )
    return SimpleNamespace(learner=learner, sampler=sampler, progress=learner.progress)


@pytest.mark.parametrize("frozen", [False, True])
def test_only_a_gate_that_is_being_learned_leaves_out_what_it_calls_empty(frozen: bool) -> None:
    """A gate that was frozen early, with all kept, is followed no longer while the ramp goes on."""
    learner = small_learner(schedule=ScheduleConfig(learn_steps=100, ramp_to=1.0))
    if frozen:
        learner.mixture.freeze(0.0, {"empty_fraction": 0.0})
    assert (learner.before_step(90).following is None) == frozen


@pytest.mark.parametrize(
    ("empty_fraction", "factor"), [(0.0, 0.5), (0.75, 2.0), (0.875, 4.0), (0.999, 4.0)]
)
def test_a_guided_batch_has_as_many_samples(
    made: Any, empty_fraction: float, factor: float
) -> None:
    made.learner.mixture.freeze(0.5, {"empty_fraction": empty_fraction})
    made.learner.before_step(0)
    assert made.sampler.num_rays_per_batch == 100 * factor


def test_a_guided_batch_has_half_of_the_rays_at_least(made: Any) -> None:
    mixture = made.learner.mixture
    mixture.sizes = replace(mixture.sizes, candidates=4 * mixture.sizes.learn_candidates)
    mixture.freeze(0.0, {"empty_fraction": 0.0})
    made.learner.before_step(0)
    assert made.sampler.num_rays_per_batch == 50


@pytest.mark.parametrize(
    ("kept", "rays"), [(1.0, 100), (0.5, 200), (0.49, 200), (0.4, 250), (0.1, 400)]
)
def test_while_learning_rays_follow_what_is_shaded(made: Any, kept: float, rays: int) -> None:
    made.progress.learning_kept = kept
    made.learner.before_step(0)
    made.learner.before_step(1)
    assert made.sampler.num_rays_per_batch == rays
    assert made.sampler.sets == int(rays != 100)  # not set again to what it is


def test_a_healed_gate_is_not_followed_and_its_batches_are_no_longer_for_it(made: Any) -> None:
    made.progress.learning_kept, made.progress.dense_until = 0.1, 5
    for step in (0, 5):  # also then, until it has been seen what it keeps now
        made.learner.before_step(step)
        assert made.sampler.num_rays_per_batch == 100


def test_a_gate_that_is_never_frozen_is_not_followed_once_it_has_learned(made: Any) -> None:
    made.progress.learning_kept = 0.3
    made.learner.before_step(6)
    assert made.sampler.num_rays_per_batch > 300
    plan = made.learner.before_step(7)
    assert made.sampler.num_rays_per_batch == 100
    assert made.learner.past_learning and plan.following is None


@pytest.mark.parametrize(
    ("step", "weight", "wanted"), [(0, 0.03, True), (7, 0.03, False), (0, 0.0, False)]
)
def test_distances_are_for_learning_alone(
    made: Any, step: int, weight: float, wanted: bool
) -> None:
    made.learner.data.sparse = points = object()
    made.learner.config.termination = weight
    made.learner.before_step(step)
    assert made.sampler.sparse is (points if wanted else None)


@pytest.mark.parametrize(
    ("options", "frozen", "aside"),
    [
        ({}, False, 9),
        ({}, True, 0),
        ({"homogeneous": True}, False, 0),
        ({"schedule": ScheduleConfig(freeze=False)}, False, 0),
    ],
)
def test_photographs_vouch_while_a_gate_is_learned_and_train_afterwards(
    options: dict[str, Any], frozen: bool, aside: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = small_learner(**options)
    if frozen:
        learner.mixture.freeze(0.5, {"empty_fraction": 0.0})
    asked: list[int] = []
    monkeypatch.setattr(
        learner.data, "prepare_batch", lambda *_, set_aside, **__: asked.append(set_aside)
    )
    learner.before_step(0)
    assert asked == [aside]


def test_a_sampler_elsewhere_is_left_alone(made: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learning_data, "sampler_here", lambda manager: None)
    made.progress.learning_kept = 0.1
    made.learner.before_step(0)
    assert made.sampler.num_rays_per_batch == 100
