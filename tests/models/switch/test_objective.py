"""Colour loss and balanced gate loss of a batch."""

from __future__ import annotations

import math

import torch

from leco_plugin.models.rendering import Shaded
from leco_plugin.models.switch.rendering import switch_losses, switch_statistics


def shaded(routes: list[int], experts: int = 4) -> Shaded:
    numbers = torch.tensor(routes, dtype=torch.int64)
    logits = 20.0 * torch.nn.functional.one_hot(numbers, experts).float()
    rays = 2
    return Shaded(
        rgb=torch.full((rays, 3), 0.5),
        accumulation=torch.ones(rays),
        depth=torch.ones(rays),
        weights=torch.zeros(len(routes)),
        sigmas=torch.zeros(len(routes)),
        logits=logits.requires_grad_(),
        routes=numbers,
        packed_info=torch.tensor([[0, len(routes)], [len(routes), 0]]),
    )


def test_the_gate_loss_is_its_weight_at_balance_and_the_number_of_experts_at_collapse() -> None:
    truth = torch.full((2, 3), 0.4)
    balanced = switch_losses(shaded([0, 1, 2, 3]), truth, 5e-4)
    collapsed = switch_losses(shaded([1, 1, 1, 1]), truth, 5e-4)
    torch.testing.assert_close(balanced["rgb_loss"], torch.tensor(0.01))
    torch.testing.assert_close(balanced["gate_loss"], torch.tensor(5e-4))
    torch.testing.assert_close(collapsed["gate_loss"], torch.tensor(2e-3))


def test_without_samples_only_the_colours_are_compared() -> None:
    assert switch_losses(shaded([]), torch.zeros(2, 3), 5e-4).keys() == {"rgb_loss"}


def test_statistics_count_samples_and_shares() -> None:
    figures = switch_statistics(shaded([0, 0, 0, 2]), torch.full((2, 3), 0.4))
    assert math.isclose(float(figures["psnr"]), 20.0, rel_tol=1e-4)
    assert float(figures["num_samples_per_batch"]) == 4.0
    shares = [float(figures[f"share_expert_{i}"]) for i in range(1, 5)]
    assert shares == [0.75, 0.0, 0.25, 0.0]
