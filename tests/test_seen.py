"""Space that training rays cross is seen, with a margin of a cell; the rest is empty for all."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save
from test_occupancy import occupancy
from torch import Tensor

from leco_plugin.models.region import Region
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import marching
from leco_plugin.samplers.estimator import LearnedOccupancyEstimator
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.seen import BYTES, CELLS, SeenSpace, cells_from_bytes, rays_a_side
from leco_plugin.space import NO_WALL, Space, SpaceKind

KINDS: tuple[SpaceKind, ...] = ("box", "contraction")


def fan(count: int = 2000, seed: int = 0) -> marching.Rays:
    """Rays from a corner of the cube, in a cone around the way to the opposite one."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.rand(count, 3, generator=generator) * 0.6 + 0.7
    directions = torch.nn.functional.normalize(directions, dim=-1)
    origins = torch.full((count, 3), -0.9)
    return marching.Rays(origins, directions, torch.zeros(count), torch.full((count,), 3.0))


def noted(kind: SpaceKind) -> tuple[SeenSpace, Space]:
    seen, space = SeenSpace(), Space(kind)
    seen.note(space, fan())
    return seen, space


def points_on(rays: marching.Rays) -> Tensor:
    """A random place on each ray."""
    shares = torch.rand(len(rays.origins), 1, generator=torch.Generator().manual_seed(3))
    return rays.origins + rays.directions * rays.t_maxs[:, None] * shares


@pytest.mark.parametrize("kind", KINDS)
def test_what_rays_cross_is_seen_and_what_lies_behind_the_camera_is_not(kind: SpaceKind) -> None:
    seen, space = noted(kind)
    mapped = space.map(points_on(fan(seed=1)))  # other rays of the same fan
    inside = mapped[(mapped.abs() <= 1.0).all(dim=-1)]
    assert float(seen(inside).float().mean()) > 0.99
    aside = space.map(torch.tensor([[0.9, -0.9, -0.9], [-0.9, 0.9, 0.9], [-0.9, -0.9, 0.0]]))
    assert not bool(seen(aside).any())
    assert 0.02 < float(seen.cells.float().mean()) < 0.5


@pytest.mark.parametrize(
    ("kind", "away"),
    [("contraction", 2.0), ("contraction", 12.0), ("contraction", 40.0), ("box", 2.0)],
)
def test_a_camera_far_from_the_scene_leaves_no_gaps_in_it(kind: SpaceKind, away: float) -> None:
    """A turntable seen through a long lens: sparse points, and the space with them, are small. The
    camera is as far away in half extents, and near the origin."""
    seen, half, count = SeenSpace(), 0.25, 3000
    space = Space(kind, (half * away, -0.3, 0.2), half)
    ends = 0.9 * (2.0 * torch.rand(count, 3, generator=torch.Generator().manual_seed(4)) - 1.0)
    ends = space.center + half * ends
    origins = (space.center - torch.tensor([half * away, 0.0, 0.0])).expand(count, 3)
    directions = torch.nn.functional.normalize(ends - origins, dim=-1)
    limits = torch.full((count,), 0.1 * half), torch.full((count,), half * (away + 4.0))
    seen.note(space, marching.Rays(origins, directions, *limits))
    assert bool(seen(space.map(ends)).all())


def test_before_any_ray_is_noted_all_space_is_seen() -> None:
    assert SeenSpace().everywhere and not noted("box")[0].everywhere


@pytest.mark.parametrize("kind", KINDS)
def test_unseen_space_is_empty_whatever_the_gate_says(kind: SpaceKind) -> None:
    seen, space = noted(kind)
    known = occupancy()
    asked = Occupancy(known.gate, space, 1e-6, seen=seen).eval()
    positions = space.unmap(torch.rand(4000, 3) * 2.0 - 1.0)
    inside = seen(space.map(positions))
    assert torch.equal(asked.occupied(positions), inside)
    assert not bool(asked.query(positions)[~inside].any())
    assert torch.equal(asked.unseen(positions), ~inside)
    outside = torch.tensor([[1e4, 0.0, 0.0], [float("nan"), 0.0, 0.0]])
    assert asked.unseen(outside).tolist() == [space.kind != "box", False]
    for cache_bytes in (0, 1 << 18):
        estimator = LearnedOccupancyEstimator(asked, cache_bytes=cache_bytes)
        differing = (estimator.occupied(positions) != inside).float().mean()
        assert float(differing) < 1e-3


def test_the_faces_of_a_space_belong_to_it_and_may_be_unseen() -> None:
    seen = SeenSpace()
    seen.cells.zero_()
    faces = torch.tensor([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [1.0, 1.0, 1.0], [1.01, 0.0, 0.0]])
    asked = Occupancy(occupancy().gate, Space("box"), 0.5, seen=seen)
    assert asked.unseen(faces).tolist() == [True, True, True, False]


def test_a_region_notes_rays_between_its_walls() -> None:
    region = Region()
    walls = torch.tensor([-NO_WALL, -NO_WALL, -0.5, NO_WALL, NO_WALL, 0.5])
    region.set(SceneBounds("box", torch.zeros(3), 1.0, 0.1, 5.0, walls, ""))
    region.note_crossed_space(torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    line = torch.tensor([[0.0, 0.0, 0.4], [0.0, 0.0, -0.4], [0.0, 0.0, 0.9], [0.3, 0.0, 0.0]])
    assert region.seen(line).tolist() == [True, True, False, False]


@pytest.mark.parametrize(("cameras", "side"), [(1, 32), (100, 32), (1000, 11), (100_000, 8)])
def test_many_cameras_are_noted_by_fewer_rays_each(cameras: int, side: int) -> None:
    assert rays_a_side(cameras) == side


def saved(path: Path) -> Occupancy:
    known = occupancy()
    made = Occupancy(known.gate, known.space, 0.3, seen=noted("box")[0])
    made.save(path)
    return made


def test_a_file_holds_the_seen_space_in_three_kilobytes(tmp_path: Path) -> None:
    path, plain = tmp_path / "o.safetensors", tmp_path / "plain.safetensors"
    made = saved(path)
    occupancy().save(plain)
    assert path.stat().st_size - plain.stat().st_size < 3000
    assert torch.equal(Occupancy.load(path).seen.cells, made.seen.cells)
    assert Occupancy.load(plain).seen.everywhere


def test_only_files_that_hold_it_have_the_second_version(tmp_path: Path) -> None:
    for name, made in (("1", occupancy()), ("2", saved(tmp_path / "o"))):
        made.save(tmp_path / "o")
        with safe_open(tmp_path / "o", framework="pt") as file:
            assert file.metadata()["version"] == name


def bad_cells(good: Tensor) -> dict[str, Tensor]:
    long = zlib.compress(bytes(BYTES + 8))
    bomb = zlib.compress(bytes(1 << 26))
    return {
        "cut": good[:-1].clone(),
        "longer": torch.cat([good, good[:3]]),
        "no bytes": good[:0].clone(),
        "zeros": torch.zeros_like(good),
        "too many cells": torch.tensor(list(long), dtype=torch.uint8),
        "a bomb": torch.tensor(list(bomb), dtype=torch.uint8),
        "floats": good.float(),
        "a matrix": good[None].clone(),
    }


def test_bad_cells_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "o.safetensors"
    good = saved(path).seen.to_bytes()
    with safe_open(path, framework="pt") as file:
        header = file.metadata()
        tensors = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
    others = bad_cells(good)
    for name, bad in others.items():
        with pytest.raises(ValueError):
            cells_from_bytes(bad)
        path.write_bytes(save(tensors | {"seen": bad}, metadata=header))
        with pytest.raises(ValueError, match=r"^[^\n]*seen[^\n]*$"):
            Occupancy.load(path)
        assert name
    flipped = cells_from_bytes(good).logical_not()
    other = SeenSpace()
    other.cells.copy_(flipped)
    for changed in ({"seen": other.to_bytes()}, {}):
        rest = {name: value for name, value in tensors.items() if name != "seen"}
        path.write_bytes(save(rest | changed, metadata=header))
        with pytest.raises(ValueError, match=r"^[^\n]+$"):
            Occupancy.load(path)


def test_a_state_of_before_leaves_all_space_seen() -> None:
    made, other = noted("box")[0], occupancy()
    state = {name: value for name, value in other.state_dict().items() if "seen" not in name}
    assert f"{CELLS}" == "64" and len(state) < len(other.state_dict())
    other.load_state_dict(state)
    assert other.seen.everywhere and not made.everywhere
