"""Claims about what representations are measured on."""

from __future__ import annotations

import torch

from leco_plugin.capacity.field import CELLS, reached


def test_volume_is_what_taught_rays_reach() -> None:
    generator = torch.Generator().manual_seed(0)
    taught = torch.rand(1 << 17, 3, generator=generator) * torch.tensor([1.0, 2.0, 2.0]) - 1.0
    volume = torch.rand(1000, 3, generator=generator) * 2.0 - 1.0
    found = reached(taught, volume)
    assert not found[volume[:, 0] > 0.0].any()
    assert float(found[volume[:, 0] < 0.0].float().mean()) > 0.6


def test_faces_of_the_cube_belong_to_it() -> None:
    corners = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
    assert reached(corners, corners).all()
    assert not reached(corners[:1], corners[1:]).any()
    assert reached(corners[:1], corners[:1] + 1.0 / CELLS).all()
