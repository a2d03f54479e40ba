"""What teaches the gate is put together from the right samples."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from leco_plugin.models.gate import occupancy_from_logits
from leco_plugin.models.losses import (
    balance_loss,
    contribution_loss,
    density_loss,
    imbalanced_gate_loss,
    widen,
)
from leco_plugin.models.objective import GateLossConfig, gate_losses
from leco_plugin.models.rendering import Intervals, Rays, Shaded, backdrop_of
from leco_plugin.samplers.packed import pack_info

RAYS = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.zeros(2), torch.full((2,), 5.0), None)
ON_BACKDROP = torch.tensor([0, 0, 0, 0, 1, 0, 0, 0, 0, 1]).bool()


def batch() -> tuple[Shaded, Intervals]:
    """Two rays of four samples and a backdrop each, with random logits, weights and densities."""
    starts = torch.arange(5.0).repeat(2)
    intervals = Intervals(torch.arange(2).repeat_interleave(5), starts, starts + 1.0)
    torch.manual_seed(0)
    logits = (3.0 * torch.randn(10, 4)).requires_grad_()
    nothing = torch.zeros(2)
    shaded = Shaded(
        *(torch.zeros(2, 3), nothing, nothing),
        *(torch.rand(10), torch.rand(10), logits, logits.argmax(dim=-1)),
        pack_info(intervals.ray_indices, 2),
    )
    return shaded, intervals


def losses_of(config: GateLossConfig, shaded: Shaded, intervals: Intervals):
    half_extent = torch.tensor(2.0)
    return gate_losses(config, shaded, intervals, RAYS, half_extent, homogeneous=False, ramped=0.6)


@pytest.mark.parametrize("form", ["logit", "paper"])
def test_the_backdrop_does_not_teach_the_gate(form: str) -> None:
    shaded, intervals = batch()
    assert torch.equal(backdrop_of(intervals, RAYS), ON_BACKDROP)
    config = GateLossConfig(form=form, balance=0.0)  # type: ignore[arg-type]
    sum(losses_of(config, shaded, intervals).values()).backward()  # type: ignore[union-attr]
    assert shaded.logits.grad is not None
    taught = shaded.logits.grad.abs().sum(dim=-1) > 0
    assert torch.equal(taught, ~ON_BACKDROP)


def test_the_papers_form_is_its_two_losses_of_all_samples_before_the_backdrop() -> None:
    shaded, intervals = batch()
    config = GateLossConfig(form="paper", imbalance=0.3, empty_ratio=0.7, density=2.0)
    found = losses_of(config, shaded, intervals)
    probabilities = shaded.logits[~ON_BACKDROP].softmax(dim=-1)
    routes = shaded.routes[~ON_BACKDROP]
    alphas = 1.0 - torch.exp(-shaded.sigmas[~ON_BACKDROP] / 2.0)  # each is one unit of two long
    expected = {
        "gate_loss": 0.3 * imbalanced_gate_loss(probabilities, routes, 0.7),
        "density_loss": 2.0 * density_loss(probabilities[:, 0], alphas),
    }
    assert found.keys() == expected.keys()
    for name in expected:
        torch.testing.assert_close(found[name], expected[name])


def test_the_logit_form_is_its_losses_with_their_own_numbers() -> None:
    shaded, intervals = batch()
    torch.manual_seed(1)
    weights = 0.2 * torch.rand(10)
    config = GateLossConfig(contribution=0.3, weight_at_full=0.1, emphasis=5.0, balance=2.0)
    found = losses_of(config, shaded._replace(weights=weights), intervals)
    wide = widen(weights[~ON_BACKDROP], torch.arange(1, 8) != 4)
    contribution = contribution_loss(shaded.logits[~ON_BACKDROP], wide, 0.1, 5.0)
    torch.testing.assert_close(found["contribution_loss"], 0.3 * contribution)
    on_scene = shaded.routes > 0
    among = shaded.logits[on_scene, 1:].softmax(dim=-1), shaded.routes[on_scene] - 1
    assert bool(on_scene.any()) and not bool(on_scene.all())
    torch.testing.assert_close(found["balance_loss"], 2.0 * balance_loss(*among))


@pytest.mark.parametrize(("experts", "balanced"), [(1, False), (2, True)])
def test_one_scene_expert_is_balanced_with_none(experts: int, balanced: bool) -> None:
    shaded, intervals = batch()
    few = shaded._replace(
        logits=shaded.logits[:, : 1 + experts], routes=shaded.routes.clamp(max=experts)
    )
    found = losses_of(GateLossConfig(), few, intervals)["balance_loss"]
    assert (float(found.detach()) > 0.0) == balanced


def test_without_a_target_ratio_all_experts_are_to_get_equally_many_points() -> None:
    shaded, intervals = batch()
    open_ratio, equal = (
        losses_of(GateLossConfig(form="paper", empty_ratio=ratio), shaded, intervals)
        for ratio in (None, 1.0 / shaded.logits.shape[-1])
    )
    torch.testing.assert_close(open_ratio, equal)


@pytest.mark.parametrize("form", ["logit", "paper"])
def test_each_weight_scales_its_own_loss(form: str) -> None:
    shaded, intervals = batch()
    config = GateLossConfig(form=form)  # type: ignore[arg-type]
    weights = {
        "logit": ("contribution", "agreement", "balance"),
        "paper": ("imbalance", "density"),
    }[form]
    before = losses_of(config, shaded, intervals)
    for weight in weights:
        doubled = replace(config, **{weight: 2.0 * getattr(config, weight)})
        after = losses_of(doubled, shaded, intervals)
        changed = [name for name in before if not torch.equal(before[name], after[name])]
        assert len(changed) == 1
        torch.testing.assert_close(after[changed[0]], 2.0 * before[changed[0]])


def test_what_the_field_gives_up_is_a_mean_over_rays_not_over_samples() -> None:
    shaded, intervals = batch()
    torch.manual_seed(1)
    weights = torch.rand(10)
    config = GateLossConfig(agreement=3.0, empty_below=0.9)
    found = losses_of(config, shaded._replace(weights=weights), intervals)["agreement_loss"]
    occupied = occupancy_from_logits(shaded.logits.detach())
    doubt = (1.0 - occupied / 0.9).clamp(min=0.0) * ~ON_BACKDROP
    a_ray = (weights * doubt).sum() / len(RAYS.origins)
    torch.testing.assert_close(found.detach(), 3.0 * 0.6 * a_ray)
