"""Lengths and altitudes of a dataset, found again through what its dataparser did to it."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from leco_plugin.scenes.frames import METRES_PER_UNIT, units_of


def manager(scale: float, transform: torch.Tensor, metadata: Any = None) -> SimpleNamespace:
    return SimpleNamespace(
        train_dataparser_outputs=SimpleNamespace(
            dataparser_scale=scale, dataparser_transform=transform, metadata=metadata
        )
    )


def turned(shift: tuple[float, float, float]) -> torch.Tensor:
    """[3, 4] that takes y up to z up, then moves."""
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return torch.cat([turn, torch.tensor(shift)[:, None]], dim=1)


def test_altitudes_are_those_of_the_poses_before_the_dataparser_moved_them() -> None:
    """Slow twin: points of the dataset, taken to the model by hand."""
    scale, transform = 0.25, turned((3.0, -1.0, -40.0))
    in_data = torch.randn(20, 3, generator=torch.Generator().manual_seed(0)) * 50.0
    in_model = scale * (in_data @ transform[:, :3].T + transform[:, 3])
    units = units_of(manager(scale, transform), 0.5)
    assert units is not None and units.metric and units.name == "metres"
    for place, mapped in zip(in_data, in_model):
        # y of the dataset is up, and its unit half a metre
        assert units.altitude(float(mapped[2])) == pytest.approx(0.5 * float(place[1]), abs=1e-4)
    assert units.per_scene_unit == pytest.approx(2.0)


def test_a_tilt_does_not_reach_altitudes_through_large_coordinates() -> None:
    """A hundredth of a degree is 900 m of 5,200 km of northings; the height is one of the data."""
    angle = math.radians(0.01)
    turn = torch.tensor(
        [
            [1.0, 0.0, 0.0],
            [0.0, math.cos(angle), -math.sin(angle)],
            [0.0, math.sin(angle), math.cos(angle)],
        ],
        dtype=torch.float64,
    )
    middle = torch.tensor([500_000.0, 5_200_000.0, 300.0], dtype=torch.float64)
    units = units_of(manager(0.01, torch.cat([turn, -(turn @ middle)[:, None]], dim=1)), 1.0)
    assert units is not None
    assert units.altitude(0.0) == pytest.approx(300.0, abs=1e-3)
    assert units.altitude(0.5) == pytest.approx(350.0, abs=1e-3)


def test_units_are_metres_only_where_somebody_says_so() -> None:
    eye = torch.eye(3, 4)
    unknown = units_of(manager(0.5, eye, {}))
    assert unknown is not None and not unknown.metric and unknown.per_scene_unit == 2.0
    known = units_of(manager(0.5, eye, {METRES_PER_UNIT: 1.0}))
    assert known is not None and known.metric
    by_hand = units_of(manager(0.5, eye, {METRES_PER_UNIT: 1.0}), 3.0)
    assert by_hand is not None and by_hand.per_scene_unit == 6.0


def test_a_reader_that_does_not_say_what_it_did_has_no_units() -> None:
    assert units_of(SimpleNamespace()) is None
    assert units_of(manager(0.0, torch.eye(3, 4))) is None


@pytest.mark.parametrize("metres", [0.0, -1.0, float("nan"), float("inf")])
def test_no_positive_number_of_metres_is_refused(metres: float) -> None:
    with pytest.raises(ValueError, match="positive number of metres"):
        units_of(manager(1.0, torch.eye(3, 4)), metres)
