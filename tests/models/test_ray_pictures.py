"""Claims about what is shown of rays: the backdrop is nothing met, and experts are not averaged."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from leco_plugin.models.figures import (
    NONE,
    before_the_backdrop,
    gate_pictures,
    leading_expert,
    with_alpha,
)
from leco_plugin.models.rendering import Intervals, Rays, Shaded, backdrop_of

EXPERTS = 4
RAYS = Rays(
    torch.zeros(5, 3),
    torch.tensor([[0.0, 0.0, 1.0]]).expand(5, 3),
    torch.zeros(5),
    torch.full((5,), 10.0),
    None,
)
INTERVALS = Intervals(
    torch.tensor([0, 0, 0, 0, 1, 2, 4, 4]),
    torch.tensor([1.0, 2.0, 3.0, 9.0, 9.0, 4.0, 1.0, 9.0]),
    torch.tensor([2.0, 3.0, 4.0, 10.0, 10.0, 5.0, 2.0, 10.0]),
)
"""Three samples and a backdrop; a backdrop alone; one sample alone; nothing; haze before one."""
WEIGHTS = torch.tensor([0.3, 0.25, 0.25, 0.2, 1.0, 0.5, 0.01, 0.99])
ROUTES = torch.tensor([1, 3, 3, 2, 2, 0, 1, 1])
OCCUPANCIES = torch.tensor([0.8, 0.9, 0.2, 0.7, 0.9])
"""Where each ray ends."""


def rendering() -> Shaded:
    logits = torch.zeros(8, 0)  # nobody asked
    counts = torch.tensor([4, 1, 1, 0, 2])
    packed_info = torch.stack([counts.cumsum(0) - counts, counts], dim=-1)
    sums = torch.tensor([1.0, 1.0, 0.5, 0.0, 1.0])
    return Shaded(
        torch.rand(5, 3), sums, torch.ones(5), WEIGHTS, WEIGHTS, logits, ROUTES, packed_info
    )


def pictures() -> dict[str, Tensor]:
    met, shown = before_the_backdrop(rendering(), INTERVALS, RAYS)
    assert backdrop_of(INTERVALS, RAYS).nonzero().flatten().tolist() == [3, 4, 7]
    return shown | gate_pictures(met, INTERVALS.ray_indices, OCCUPANCIES, EXPERTS)


def column(picture: Tensor) -> list[float]:
    assert picture.shape == (5, 1) and picture.dtype == torch.float32
    return [pytest.approx(value, abs=1e-5) for value in picture[:, 0].tolist()]


def test_a_backdrop_is_transparent_and_as_far_as_nothing() -> None:
    shown = pictures()
    assert column(shown["accumulation"]) == [0.8, 0.0, 0.5, 0.0, 0.01]
    depth = (0.3 * 1.5 + 0.25 * 2.5 + 0.25 * 3.5) / 0.8
    assert column(shown["depth"]) == [depth, 10.0, 4.5, 10.0, 10.0]


def test_occupancy_is_that_of_what_is_met() -> None:
    assert column(pictures()["occupancy"]) == [0.8, 0.0, 0.2, 0.0, 0.0]


def test_the_expert_is_the_one_with_the_greatest_weight_and_no_mean_of_numbers() -> None:
    assert column(pictures()["expert"]) == [3.0, 0.0, 0.0, 0.0, 0.0]
    met, _ = before_the_backdrop(rendering(), INTERVALS, RAYS)
    heavy = met._replace(weights=met.weights.clone())
    heavy.weights[0] = 0.6  # beside two of a quarter
    assert leading_expert(heavy, INTERVALS.ray_indices, EXPERTS)[0].tolist() == [1]


def test_no_expert_leads_where_nothing_is_met() -> None:
    met, _ = before_the_backdrop(rendering(), INTERVALS, RAYS)
    leading = leading_expert(met, INTERVALS.ray_indices, EXPERTS)
    assert leading.tolist() == [[3], [NONE], [0], [NONE], [NONE]]
    none = met._replace(
        rgb=met.rgb[:0],
        accumulation=met.accumulation[:0],
        weights=met.weights[:0],
        routes=met.routes[:0],
    )
    assert leading_expert(none, INTERVALS.ray_indices[:0], EXPERTS).shape == (0, 1)


def test_samples_are_counted_with_the_backdrop_that_was_asked_about() -> None:
    assert column(pictures()["samples_per_ray"]) == [4.0, 1.0, 1.0, 0.0, 2.0]


def test_what_was_met_is_the_alpha_of_an_image() -> None:
    outputs = {"rgb": torch.rand(5, 4, 3), "accumulation": 0.5 + 0.5 * torch.rand(5, 4, 1)}
    rgba = with_alpha(outputs, "rgb")
    assert torch.equal(rgba, torch.cat([outputs["rgb"], outputs["accumulation"]], dim=-1))


def test_an_image_of_nothing_is_said_to_be_one() -> None:
    outputs = {"rgb": torch.rand(5, 4, 3), "accumulation": torch.full((5, 4, 1), 0.1)}
    with pytest.warns(UserWarning, match="meets anything but the backdrop"):
        with_alpha(outputs, "rgb")
