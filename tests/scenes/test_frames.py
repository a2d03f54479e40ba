"""What was learned in the coordinates of one reader is asked in those of another."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scene_files import refused

from leco_plugin.scenes.frames import (
    METRES_PER_UNIT,
    between,
    box_around,
    distance_from_rotations,
    found_again,
    frame_of,
    from_file,
    inverse,
    moved,
    units_of,
)


def rotation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))[0]
    return turn * torch.det(turn)


def reader(seed: int, scale: float) -> SimpleNamespace:
    """A data manager whose reader turned, moved and scaled the scene."""
    transform = torch.cat([rotation(seed), torch.full((3, 1), 0.1 * seed)], dim=1)
    return manager(scale, transform.float())


def in_model(manager: SimpleNamespace, points: torch.Tensor) -> torch.Tensor:
    """As nerfstudio's readers do it with poses: turn and move, then scale."""
    outputs = manager.train_dataparser_outputs
    transform = outputs.dataparser_transform.double()
    return outputs.dataparser_scale * (points @ transform[:, :3].T + transform[:, 3])


def test_points_of_one_reader_are_taken_to_those_of_another():
    points = torch.randn(50, 3, dtype=torch.float64)
    host, other = reader(1, 0.3), reader(2, 2.5)
    frame = between(frame_of(host), frame_of(other)).double()
    found = moved(in_model(host, points), frame)
    torch.testing.assert_close(found, in_model(other, points), rtol=1e-4, atol=1e-4)


def test_the_same_reader_is_exactly_the_identity():
    frame = frame_of(reader(3, 0.7))
    assert torch.equal(between(frame, frame), torch.eye(3, 4))


def test_a_data_manager_without_a_reader_has_no_known_frame():
    assert frame_of(SimpleNamespace()) is None


def test_an_inverse_takes_positions_back():
    frame = torch.cat([1.7 * torch.linalg.qr(torch.randn(3, 3))[0], torch.randn(3, 1)], dim=1)
    back, points = inverse(frame), torch.randn(10, 3)
    there = moved(points, frame)
    torch.testing.assert_close(there, points @ frame[:, :3].T + frame[:, 3])
    torch.testing.assert_close(moved(there, back), points)


def test_a_camera_is_found_again_within_a_thousandth_of_the_half_extent():
    known, here = torch.zeros(1, 3), torch.tensor([[5.0, 0.0, 0.0], [0.0, 0.0019, 0.0]])
    assert found_again(known, here, 2.0).tolist() == [True]
    assert found_again(known, here, 1.8).tolist() == [False]
    assert found_again(here, torch.zeros(1, 3), 2.0).tolist() == [False, True]


def test_a_turned_box_holds_the_box_and_no_more():
    box = torch.tensor([-1.0, -2.0, 0.0, 1.0, 3.0, 0.5])
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)))[0]
    frame = torch.cat([1.7 * turn, torch.tensor([[0.3], [-2.0], [1.0]])], dim=1)
    around = box_around(box, frame)
    inside = torch.lerp(box[:3], box[3:], torch.rand(2000, 3)) @ frame[:, :3].T + frame[:, 3]
    assert bool(((inside >= around[:3] - 1e-5) & (inside <= around[3:] + 1e-5)).all())
    x, y, z = (box[[i, i + 3]] for i in range(3))
    corners = torch.stack([g.flatten() for g in torch.meshgrid(x, y, z, indexing="ij")], dim=-1)
    corners = corners @ frame[:, :3].T + frame[:, 3]
    torch.testing.assert_close(around, torch.cat([corners.amin(0), corners.amax(0)]))


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_what_was_applied_before_a_file_was_written_is_undone(scale: float):
    """nerfstudio scales what it says it did by `applied_scale`, and puts the transform before."""
    applied, points = torch.cat([rotation(4), torch.ones(3, 1)], dim=1), torch.randn(20, 3).double()
    of_file = torch.cat([0.3 * rotation(1), torch.full((3, 1), 0.1)], dim=1)
    said = scale * torch.cat(
        [of_file[:, :3] @ applied[:, :3], of_file[:, :3] @ applied[:, 3:] + of_file[:, 3:]], dim=1
    )
    found = from_file(said.tolist(), applied.tolist(), scale)
    torch.testing.assert_close(moved(points.float(), found), moved(points, of_file).float())


def test_a_transform_that_squeezes_an_axis_is_undone_and_a_flat_one_is_refused():
    frame, squeezed = torch.eye(3, 4).double(), torch.ones(3, 4).double()
    squeezed[:, :3] = torch.diag(torch.tensor([1.0, 1.0, 0.1]))
    there = squeezed.sum(dim=1)[None]  # of the place (1, 1, 1)
    found = from_file(frame, squeezed.tolist(), dtype=torch.float64)
    torch.testing.assert_close(moved(there, found), there / there)
    squeezed[2, 2] = 1e-7
    with pytest.raises(ValueError, match="flat"):
        from_file(frame, squeezed.tolist())


def test_a_file_to_which_nothing_was_applied_has_the_frame_itself():
    frame = torch.tensor(frame_of(reader(3, 0.7)))
    assert torch.equal(from_file(frame, None), frame)


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
    with refused("positive number of metres"):
        units_of(manager(1.0, torch.eye(3, 4)), metres)


def test_rotations_are_at_no_distance_and_others_at_theirs() -> None:
    turn = rotation(0).numpy()
    cases = np.stack([turn, -turn, 1.1 * turn, turn @ np.diag([2, 0.5, 1])])
    distances = distance_from_rotations(cases)
    assert distances[0] < 1e-12
    np.testing.assert_allclose(distances[1:3], [2.0, 1.1**3 - 1], atol=1e-9)
    assert distances[3] > 0.5
