"""The field is the mixture that the paper writes down, whatever the dispatch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from leco_plugin.models.compute.dispatch import within_capacity
from leco_plugin.models.switch.field import (
    PAPER,
    SMALL,
    SwitchField,
    SwitchFieldConfig,
    switch_sizes_for,
)

TINY = SwitchFieldConfig(
    octaves=2, experts=3, width=8, layers=4, skip=2, color_width=8, appearance_dim=4
)


def field(**options) -> SwitchField:
    torch.manual_seed(0)
    model = SwitchField(SwitchFieldConfig(**{**vars(TINY), **options}), num_images=2)
    for layer in model.gate.hidden:  # so small a gate sends all points one way when it is new
        torch.nn.init.zeros_(layer.bias)
    return model


def points(count: int) -> Tensor:
    return torch.rand(count, 3) * 2 - 1


def expert_of(model: SwitchField, number: int, x: Tensor) -> Tensor:
    """E_i(x), layer by layer: ReLU after each, the input again before layer `skip`."""
    hidden = x
    for i, layer in enumerate(model.experts[number].layers):
        if i == model.config.skip:
            hidden = torch.cat([x, hidden])
        hidden = torch.relu(layer.weight @ hidden + layer.bias)
    return hidden


def gate_of(model: SwitchField, x: Tensor) -> Tensor:
    """G(x): MLP with ReLU between its layers, LayerNorm without, softmax."""
    hidden = x
    for i, layer in enumerate(model.gate.hidden):
        hidden = layer(hidden if i == 0 else torch.relu(hidden))
    normed = (hidden - hidden.mean()) / (hidden.var(unbiased=False) + model.gate.norm.eps).sqrt()
    return (model.gate.head(normed)).softmax(dim=-1)


def slow_field(model: SwitchField, mapped: Tensor, within: Tensor) -> tuple[Tensor, Tensor]:
    """Density and features, one point at a time."""
    sigmas, features = [], []
    for x, has_place in zip(mapped, within.tolist()):
        projected = model.projection(model.encoding(x[None])[0])
        probabilities = gate_of(model, projected)
        chosen = int(probabilities.argmax())
        feature = probabilities[chosen] * expert_of(model, chosen, projected) * has_place
        features.append(feature)
        sigmas.append(torch.nn.functional.softplus(model.density_head(feature)[0] - 1.0))
    return torch.stack(sigmas), torch.stack(features)


@pytest.mark.parametrize("skip", [None, 1, 2])
@pytest.mark.parametrize("capacity_factor", [None, 0.5])
def test_dispatch_with_skip_and_capacity_is_the_slow_mixture(skip, capacity_factor) -> None:
    model, mapped = field(skip=skip), points(40)
    answers = model(mapped, capacity_factor=capacity_factor)
    within = torch.ones(40, dtype=torch.bool)
    if capacity_factor is not None:
        values = answers.logits.softmax(dim=-1).amax(dim=-1)
        within = within_capacity(answers.routes, values, 3, capacity_factor)
        assert not bool(within.all())
    sigmas, features = slow_field(model, mapped, within)
    torch.testing.assert_close(answers.features, features, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(answers.sigmas, sigmas, atol=1e-5, rtol=1e-4)


def test_a_place_for_every_point_is_dropless() -> None:
    model, mapped = field(), points(60)
    for limited, dropless in zip(model(mapped, capacity_factor=3.0), model(mapped)):
        assert torch.equal(limited, dropless)


def test_gradients_reach_the_gate_through_its_value_and_every_chosen_expert() -> None:
    model = field()
    answers = model(points(200))
    (answers.sigmas.sum() + answers.features.square().sum()).backward()
    assert len(answers.routes.unique()) > 1
    for number in answers.routes.unique().tolist():
        assert bool(model.experts[number].layers[0].weight.grad.any())
    assert bool(model.gate.head.weight.grad.any())


def test_noise_moves_densities_and_nothing_else() -> None:
    model, mapped = field(), points(500)
    noisy, clean = model(mapped, noise=0.5), model(mapped)
    noise = torch.log(torch.expm1(noisy.sigmas)) - torch.log(torch.expm1(clean.sigmas))
    assert abs(float(noise.detach().std()) - 0.5) < 0.08
    assert torch.equal(noisy.features, clean.features)
    assert torch.equal(model(mapped).sigmas, clean.sigmas)


def test_no_points_are_answered_and_backpropagated() -> None:
    model = field()
    answers = model(points(0), noise=1.0, capacity_factor=1.0)
    assert answers.sigmas.shape == (0,) and answers.features.shape == (0, 8)
    assert answers.logits.shape == (0, 3) and answers.routes.shape == (0,)
    (answers.sigmas.sum() + answers.features.sum()).backward()


def test_logits_and_densities_are_float32_under_autocast() -> None:
    model = field()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        answers = model(points(30))
    assert answers.logits.dtype == answers.sigmas.dtype == torch.float32
    assert answers.features.dtype == torch.bfloat16


def test_the_papers_sizes_are_those_of_the_paper() -> None:
    assert (PAPER.coarse, PAPER.fine) == (256, 512)
    assert switch_sizes_for("cuda") is PAPER and switch_sizes_for("cpu") is SMALL
    model = SwitchField(PAPER.field, num_images=2)
    assert len(model.experts) == 8
    layers = [tuple(layer.weight.shape) for layer in model.experts[0].layers]
    assert layers == [(256, 512 if i == 3 else 256) for i in range(7)]
    assert model.color.appearance is not None and model.color.appearance.embedding_dim == 48
    # 75 -> 256 and twice 256 -> 256 before the LayerNorm, as its configuration has it
    gate = [*model.projection.parameters(), *model.gate.hidden.parameters()]
    assert sum(p.numel() for p in gate) == 151_040
