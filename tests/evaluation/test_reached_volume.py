"""Claims about the part of a scene that rays of photographs reach."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from leco_plugin.evaluation.equal_loss import CELLS, is_reached, rays_of_photographs


def slow_reached(taught: Tensor, mapped: Tensor) -> list[bool]:
    """Place by place: whether any taught one lies in the same cell of the cube."""

    def cell(place: Tensor) -> tuple[int, ...]:
        return tuple(min(int((float(x) + 1.0) / 2.0 * CELLS), CELLS - 1) for x in place)

    known = {cell(place) for place in taught}
    return [cell(place) in known for place in mapped]


@pytest.mark.parametrize("seed", range(3))
def test_a_place_is_reached_where_a_taught_one_shares_its_cell(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    taught = 0.1 * torch.rand(300, 3, generator=generator)
    mapped = 0.1 * torch.rand(500, 3, generator=generator)
    found = is_reached(taught, mapped)
    assert found.tolist() == slow_reached(taught, mapped)
    assert 0 < int(found.sum()) < 500


def test_faces_of_the_cube_belong_to_it() -> None:
    corners = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    assert is_reached(corners, corners).all()
    assert not is_reached(corners[:1], corners[1:]).any()
    assert is_reached(corners[:1], corners[:1] + 1.0 / CELLS).all()


def photographs() -> SimpleNamespace:
    """A data manager with two cameras of different sizes at different places, both looking down."""
    poses = torch.eye(4)[None, :3].repeat(2, 1, 1)
    poses[1, 0, 3] = 5.0
    cameras = Cameras(
        poses,
        fx=torch.tensor([[20.0], [20.0]]),
        fy=torch.tensor([[20.0], [20.0]]),
        cx=torch.tensor([[20.0], [5.0]]),
        cy=torch.tensor([[10.0], [5.0]]),
        width=torch.tensor([[40], [10]]),
        height=torch.tensor([[20], [10]]),
    )
    return SimpleNamespace(train_dataset=SimpleNamespace(cameras=cameras))


def test_rays_fill_the_photographs_and_stay_inside_them() -> None:
    rays = rays_of_photographs(photographs(), 4000)
    second = rays.origins[:, 0] > 1.0
    assert 0.4 < float(second.float().mean()) < 0.6
    slopes = rays.directions[:, :2] / -rays.directions[:, 2:]
    for chosen, width, height in ((~second, 1.0, 0.5), (second, 0.25, 0.25)):
        ends = torch.tensor([width, height])
        assert bool((slopes[chosen].abs() <= ends + 1e-4).all())
        assert bool((slopes[chosen].amax(dim=0) > 0.95 * ends).all())
        assert bool((slopes[chosen].amin(dim=0) < -0.95 * ends).all())


def test_rays_are_the_same_each_time_and_use_no_random_numbers_of_training() -> None:
    state = torch.random.get_rng_state()
    first, again = (rays_of_photographs(photographs(), 50) for _ in range(2))
    torch.testing.assert_close(first.directions, again.directions)
    assert not torch.equal(first.directions, rays_of_photographs(photographs(), 50, 1).directions)
    assert torch.equal(torch.random.get_rng_state(), state)
