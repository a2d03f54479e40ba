"""Sparse points fall on the pixels whose rays lead to them, and only where nothing hides them."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from leco_plugin.scenes.pixels.known_distances import FEWEST_POINTS, hidden, sparse_pixels
from leco_plugin.scenes.pixels.lattice import Lattice

WIDTH, HEIGHT = 160, 120


def cameras(distortion: list[float] | None = None, kind=CameraType.PERSPECTIVE) -> Cameras:
    """Two cameras ten units up, looking down, one unit apart."""
    poses = torch.eye(4)[:3].repeat(2, 1, 1)
    poses[:, 2, 3], poses[1, 0, 3] = 10.0, 1.0
    return Cameras(
        poses,
        *(torch.full((2, 1), value) for value in (140.0, 150.0, 79.0, 61.0)),
        width=torch.full((2, 1), WIDTH),
        height=torch.full((2, 1), HEIGHT),
        distortion_params=None if distortion is None else torch.tensor([distortion] * 2),
        camera_type=kind,
    )


def ground(count: int = 400) -> torch.Tensor:
    places = torch.rand(count, 2, generator=torch.Generator().manual_seed(0)) * 8 - 4
    return torch.cat([places, torch.zeros(count, 1)], dim=-1)


@pytest.mark.parametrize("distortion", [None, [0.05, -0.02, 0.0, 0.0, 0.003, -0.002]])
def test_the_ray_of_a_pixel_leads_to_its_point(distortion: list[float] | None) -> None:
    made, points = cameras(distortion), ground()
    found = sparse_pixels(made, points, Lattice())
    assert len(found.distances) > 300 and set(found.indices[:, 0].tolist()) == {0, 1}
    for image in (0, 1):
        of_image = found.indices[:, 0] == image
        coords = found.indices[of_image, 1:] + 0.5
        rays = made.generate_rays(camera_indices=image, coords=coords)
        ends = rays.origins + rays.directions * found.distances[of_image, None]
        pixel = 10.0 / 140.0
        assert float(torch.cdist(ends, points).amin(dim=1).max()) < pixel


def test_held_out_pixels_have_no_distance() -> None:
    found = sparse_pixels(cameras(), ground(20_000), Lattice())
    assert len(found.distances) > 1000
    assert not bool(Lattice().holds_out(found.indices).any())


def test_a_point_behind_a_roof_is_not_seen() -> None:
    roof = ground(400) / 4 + torch.tensor([0.0, 0.0, 4.0])
    found = sparse_pixels(cameras(), torch.cat([ground(), roof]), Lattice())
    middle = (found.indices[:, 0] == 0) & (
        (found.indices[:, 1:] - torch.tensor([61, 79])).abs().amax(dim=-1) < 15
    )
    assert bool(middle.any())
    assert float(found.distances[middle].max()) < 7.0


def test_points_behind_the_camera_other_lenses_and_few_points_give_nothing() -> None:
    behind = ground() + torch.tensor([0.0, 0.0, 20.0])
    assert len(sparse_pixels(cameras(), behind, Lattice()).distances) == 0
    assert len(sparse_pixels(cameras(kind=CameraType.FISHEYE), ground(), Lattice()).distances) == 0
    assert len(sparse_pixels(cameras(), ground(FEWEST_POINTS - 1), Lattice()).distances) == 0


def test_only_plainly_nearer_neighbours_hide_a_point() -> None:
    others = torch.cartesian_prod(torch.arange(60, 120, 4), torch.arange(0, 160, 8))
    pixels = torch.cat([torch.tensor([[5, 5], [5, 6], [6, 5], [5, 150]]), others])
    lengths = torch.full((len(pixels),), 2.0)
    lengths[0], lengths[2] = 1.0, 1.05
    assert hidden(pixels, lengths, HEIGHT, WIDTH).tolist()[:4] == [False, True, False, False]
    assert not bool(hidden(pixels, lengths, HEIGHT, WIDTH)[4:].any())


def test_large_clouds_are_thinned_the_same_way_each_time(monkeypatch) -> None:
    from leco_plugin.scenes.pixels import sparse_pixels as module

    monkeypatch.setattr(module, "MOST_POINTS", 200)
    monkeypatch.setattr(module, "MOST_PIXELS", 60)
    first, second = (
        sparse_pixels(cameras(), ground(), Lattice()),
        sparse_pixels(cameras(), ground(), Lattice()),
    )
    assert len(first.distances) == 60
    assert torch.equal(first.indices, second.indices)
