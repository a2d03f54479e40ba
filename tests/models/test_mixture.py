"""What a mixture keeps apart: its two marches, gates that were frozen and those that learn."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small_learner import SMALLEST, small_mixture

from leco_plugin.scenes.bounds import SceneBounds

BOX = torch.tensor([-1.0] * 3 + [1.0] * 3)
BOUNDS = SceneBounds("box", torch.zeros(3), 1.0, 0.5, 2.5, BOX, "")


def test_learning_marches_as_coarsely_as_it_has_fewer_candidates() -> None:
    mixture = small_mixture(replace(SMALLEST, candidates=64, learn_candidates=16))
    mixture.set_bounds(BOUNDS, median_length=2.0)
    fine, coarse = mixture.rule(), mixture.rule(coarse=True)
    assert coarse.step_size > 3.0 * fine.step_size > 0.0


def test_a_gate_of_more_experts_than_its_field_is_refused() -> None:
    with pytest.raises(ValueError, match="sends points to 8 scene experts and the field has 4"):
        small_mixture(replace(SMALLEST, gate=replace(SMALLEST.gate, scene_experts=8)))


def test_a_frozen_gate_of_a_checkpoint_does_not_learn_again() -> None:
    frozen, restored = small_mixture(), small_mixture()
    frozen.freeze(0.3, {})
    restored.load_state_dict(frozen.state_dict())
    assert not any(parameter.requires_grad for parameter in restored.gate.parameters())
    frozen.reopen()
    restored.load_state_dict(frozen.state_dict())
    assert all(parameter.requires_grad for parameter in restored.gate.parameters())


def test_a_gate_that_is_frozen_again_skips_by_its_new_threshold() -> None:
    mixture = small_mixture()
    for threshold in (0.3, 0.1):
        mixture.freeze(threshold, {})
        found = mixture.estimator().occupancy.threshold
        assert abs(found - threshold) < 1e-6


def test_a_frozen_gate_is_not_moved_by_gradients_that_were_being_gathered() -> None:
    mixture = small_mixture()
    optimizer = torch.optim.Adam(mixture.gate.parameters(), lr=0.01)
    places = torch.rand(50, 3) * 2 - 1
    mixture.gate(places).square().mean().backward()
    before = mixture.occupancies(places)
    mixture.freeze(0.1, {})
    optimizer.step()
    torch.testing.assert_close(mixture.occupancies(places), before, rtol=0.0, atol=0.0)
