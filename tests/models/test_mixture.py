"""What a mixture keeps apart: its two marches, gates that were frozen and those that learn."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from small_learner import SMALLEST, small_mixture

from leco_plugin.models.gate import Gate
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.space import SpaceKind

BOX = torch.tensor([-1.0] * 3 + [1.0] * 3)


@pytest.mark.parametrize("kind", ["box", "contraction"])
def test_learning_marches_as_coarsely_as_it_has_fewer_candidates(kind: SpaceKind) -> None:
    mixture = small_mixture(replace(SMALLEST, candidates=64, learn_candidates=16))
    mixture.set_bounds(SceneBounds(kind, torch.zeros(3), 1.0, 0.5, 2.5, BOX, ""), 3.0)
    steps = []
    for coarse, candidates in ((False, 64), (True, 16)):
        cone = 0.0 if kind == "box" else 5.0 ** (1.0 / candidates) - 1.0
        steps.append(3.0 / candidates if kind == "box" else 0.5 * cone)
        assert mixture.rule(coarse) == pytest.approx((steps[-1], cone), rel=1e-5)
    up, none = torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, dtype=torch.int64)
    past = mixture.rays(9.0 * up, up, none)  # what is left of a ray that misses: a fine step
    assert float(past.t_maxs - past.t_mins) == pytest.approx(steps[0], rel=1e-4)


def test_where_a_gate_skips_the_only_scene_expert_has_all_that_is_kept() -> None:
    alone = replace(SMALLEST, gate=replace(SMALLEST.gate, scene_experts=1))
    mixture = small_mixture(alone)
    learning = mixture.scene()
    assert mixture.scene(kept=True) == learning and learning.gate is mixture.gate
    mixture.freeze(0.05, {})
    assert mixture.scene(kept=True).kept
    assert mixture.scene().routing.empty_below == pytest.approx(0.05)  # what is skipped is empty
    mixture.freeze(0.6, {})
    assert mixture.scene() == learning  # which is what the field has learned with
    small = Gate(replace(SMALLEST.gate, scene_experts=1))
    mixture.sharpen(small, 0.1, {})
    assert mixture.scene().gate is small and not mixture.scene().kept
    mixture.freeze(0.0, {})
    assert mixture.scene(kept=True) == learning  # all is kept, also what is empty


def test_a_frozen_gate_goes_on_routing_to_several_scene_experts() -> None:
    mixture = small_mixture()
    learning = mixture.scene()
    mixture.freeze(0.1, {})
    assert mixture.scene() == mixture.scene(kept=True) == learning


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


@pytest.mark.parametrize("loaded", [False, True])
def test_a_gate_that_is_frozen_again_skips_by_its_new_threshold(loaded: bool) -> None:
    mixture = small_mixture()
    for threshold in (0.3, 0.1):
        frozen = small_mixture() if loaded else mixture
        frozen.freeze(threshold, {})
        mixture.load_state_dict(frozen.state_dict())
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
