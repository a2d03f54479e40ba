"""What was learned in the coordinates of one reader is asked in those of another."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from leco_plugin.scenes.frames import between, box_around, frame_of, from_file, inverse, moved


def rotation(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=generator))[0]
    return turn * torch.det(turn)


def reader(seed: int, scale: float) -> SimpleNamespace:
    """A data manager whose reader turned, moved and scaled the scene."""
    transform = torch.cat([rotation(seed), torch.full((3, 1), 0.1 * seed)], dim=1)
    return SimpleNamespace(
        train_dataparser_outputs=SimpleNamespace(
            dataparser_transform=transform.float(), dataparser_scale=scale
        )
    )


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


def test_a_file_to_which_nothing_was_applied_has_the_frame_itself():
    frame = torch.tensor(frame_of(reader(3, 0.7)))
    assert torch.equal(from_file(frame, None), frame)
