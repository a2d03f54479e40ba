"""What teaches the field beside colours comes in and goes when it should."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from leco_plugin.models.losses import distortion_loss, termination_loss
from leco_plugin.models.objective import field_losses
from leco_plugin.models.rendering import Intervals, Rays, Shaded
from leco_plugin.samplers.packed import pack_info

NEAR, FAR = 1.0, 5.0
RAYS = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.ones(2), torch.full((2,), FAR), None)
WEIGHTS = SimpleNamespace(
    distortion=0.5,
    distortion_after=0.1,
    termination=0.3,
    nearness=0.2,
    transparency=0.7,
    ground=0.4,
)


def found(ramped: float, learning: bool, unbounded: bool = True, **given: Any) -> dict[str, Tensor]:
    """Losses of two rays of four samples, the pixels of which are nearly black and bright."""
    starts = torch.arange(1.0, 5.0).repeat(2)
    intervals = Intervals(torch.arange(2).repeat_interleave(4), starts, starts + 1.0)
    torch.manual_seed(0)
    packed_info, depth = pack_info(intervals.ray_indices, 2), torch.tensor([2.0, 4.0])
    nothing, weights = torch.zeros(8), torch.rand(8)
    shaded = Shaded(
        *(torch.zeros(2, 3), torch.ones(2), depth, weights, nothing, nothing, nothing),
        packed_info,
    )
    options: dict[str, Any] = {"opacities": None, "distances": None} | given
    options.setdefault("grounded", torch.tensor([False, False]))
    truth = torch.tensor([[0.0, 0.06, 0.02], [0.9, 0.9, 0.9]])
    losses = field_losses(
        WEIGHTS,
        *(shaded, intervals, RAYS, truth),
        **options,
        span=(torch.tensor(NEAR), torch.tensor(FAR)),
        unbounded=torch.tensor(unbounded),
        learning=learning,
        ramped=ramped,
    )
    units = ((t - NEAR) / (FAR - NEAR) for t in intervals[1:])
    return losses | {
        "raw distortion": distortion_loss(weights, *units, packed_info),
        "behind": weights[[3, 7]],
        "raw termination": termination_loss(weights, intervals, torch.tensor([2.5, 0.0])),
    }


@pytest.mark.parametrize("ramped", [0.25, 1.0])
def test_distortion_and_nearness_come_in_together(ramped: float) -> None:
    losses = found(ramped, learning=True)
    torch.testing.assert_close(losses["distortion_loss"], 0.5 * ramped * losses["raw distortion"])
    # of depths 2 and 4 between 1 and 5: three quarters and one quarter
    torch.testing.assert_close(losses["nearness_loss"], torch.tensor(0.2 * ramped * 0.5))


def test_in_a_bounded_scene_only_a_dark_pixel_prefers_to_be_far() -> None:
    losses = found(1.0, learning=True, unbounded=False)
    torch.testing.assert_close(losses["nearness_loss"], torch.tensor(0.2 * 0.4 * 0.75 / 2.0))


def test_after_learning_only_a_part_of_distortion_is_left() -> None:
    losses = found(1.0, learning=False, distances=torch.tensor([2.5, 0.0]))
    torch.testing.assert_close(losses["distortion_loss"], 0.05 * losses["raw distortion"])
    assert not {"nearness_loss", "termination_loss", "transparency_loss"} & losses.keys()


def test_known_distances_end_rays_while_an_occupancy_is_learned() -> None:
    losses = found(0.0, learning=True, distances=torch.tensor([2.5, 0.0]))
    torch.testing.assert_close(losses["termination_loss"], 0.3 * losses["raw termination"])
    assert "distortion_loss" not in losses  # before its ramp begins


def test_a_ray_that_meets_ground_leaves_nothing_to_its_backdrop() -> None:
    ground = torch.tensor([True, True])
    losses = found(0.5, True, grounded=ground)
    # behind the nearly black pixel of the first ray there may be nothing at all
    squares = losses["behind"].square()
    expected = 0.4 * 0.5 * (0.6 * squares[0] + squares[1]) / 2.0
    torch.testing.assert_close(losses["ground_loss"], expected)
    assert "ground_loss" not in found(0.0, True, grounded=ground)  # before its ramp begins
    assert "ground_loss" not in found(1.0, False, grounded=ground)  # the gate is frozen
    one = found(1.0, True, grounded=torch.tensor([True, False]))["ground_loss"]
    torch.testing.assert_close(one, 0.4 * 0.6 * squares[0] / 2.0)
    assert found(1.0, True)["ground_loss"].item() == 0.0


def test_a_transparent_pixel_shows_no_ground() -> None:
    opacities = torch.tensor([1.0, 0.95])
    losses = found(1.0, True, grounded=torch.tensor([True, True]), opacities=opacities)
    behind = losses["behind"]
    torch.testing.assert_close(losses["ground_loss"], 0.4 * 0.6 * behind[0] ** 2 / 2.0)
    torch.testing.assert_close(losses["transparency_loss"], 0.7 * (behind[1] - 0.05) ** 2 / 2.0)
