"""The look at the cameras before the first step."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from scene_files import refused, write_ply
from tiny_scene import camera_to_world
from torch import Tensor

from leco_plugin.log import summarize
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import write_city
from leco_plugin.scenes.frames import POINTS
from leco_plugin.scenes.learning_data import LearningData
from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.survey import (
    MOST_CAMERAS,
    SIDE,
    bright,
    covering_rays,
    lengths_inside,
    seen_beyond,
    sparse_points,
    survey,
)


def ring(count: int = 8) -> Cameras:
    """Cameras around the origin that look at it."""
    poses = torch.stack([torch.tensor(camera_to_world(i)).float()[:3] for i in range(count)])
    return Cameras(poses, 32.0, 32.0, 16.0, 16.0, 32, 32)


def cloud() -> torch.Tensor:
    """200 points in the unit cube."""
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(0))


def datamanager(cameras: Cameras, points: torch.Tensor | None = None) -> SimpleNamespace:
    metadata = {} if points is None else {POINTS: points}
    return SimpleNamespace(train_dataset=SimpleNamespace(cameras=cameras, metadata=metadata))


def test_rays_cover_each_image_and_are_of_unit_length() -> None:
    origins, directions = covering_rays(ring())
    assert origins.shape == directions.shape == (8, SIDE * SIDE, 3)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(8, SIDE * SIDE))
    poses, sizes = ring(2).camera_to_worlds, ((24, 40), (30, 20))
    cameras = Cameras(
        *(poses, torch.tensor([[30.0], [25.0]]), torch.tensor([[32.0], [20.0]])),
        *(torch.tensor([[19.0], [9.0]]), torch.tensor([[13.0], [14.0]])),
        width=torch.tensor([[40], [20]]),
        height=torch.tensor([[24], [30]]),
    )
    _, directions = covering_rays(cameras)
    for camera, row, column in itertools.product((0, 1), (0, 3, SIDE - 1), (0, 2, SIDE - 1)):
        shares = torch.tensor([row, column]) / (SIDE - 1)
        place = 0.5 + shares * (torch.tensor(sizes[camera]) - 1)
        expected = cameras.generate_rays(camera, coords=place[None]).directions[0]
        torch.testing.assert_close(directions[camera, row * SIDE + column], expected)


def test_a_ring_of_cameras_sees_its_scene() -> None:
    found = survey(datamanager(ring(), 0.6 * cloud() - 0.3))
    assert found.meeting > 0.5 and found.median_length > 0.0
    assert not any("\n" in line for line in found.lines())
    lengths = lengths_inside(found.bounds, found.origins, found.directions)
    assert len(lengths) > 0 and bool((lengths > 0.0).all())


def test_no_cameras_are_refused() -> None:
    with refused("no training cameras"):
        survey(datamanager(ring()[torch.zeros(8, dtype=torch.bool)]))


def test_rays_that_never_meet_the_scene_are_refused_in_one_line() -> None:
    """The sparse points lie behind every camera."""
    behind = cloud() + torch.tensor([0, 0, 99])
    with refused(r"no (camera sees|ray of any camera)"):
        survey(datamanager(ring(), behind))


def drone(count: int = 12) -> Cameras:
    """Cameras 9 to 10 above the origin that look straight down."""
    poses = torch.eye(4)[:3].repeat(count, 1, 1)
    poses[:, 2, 3] = torch.linspace(9.0, 10.0, count)
    poses[:, 0, 3] = torch.linspace(-5.0, 5.0, count)
    return Cameras(poses, 32.0, 30.0, 20.0, 12.0, 40, 24)


def ground(low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    return points * torch.tensor([8.0, 8.0, high - low]) + torch.tensor([-4.0, -4.0, low])


def colmap_like(cameras: Cameras, points: torch.Tensor, scale: float = 0.1) -> SimpleNamespace:
    """What nerfstudio's reader of COLMAP gives: points under its own key, and what it did."""
    metadata = {"points3D_xyz": points, "points3D_rgb": torch.zeros(len(points), 3)}
    transform = torch.eye(3, 4)
    transform[2, 3] = -30.0
    outputs = SimpleNamespace(
        dataparser_scale=scale, dataparser_transform=transform, metadata=metadata
    )
    dataset = SimpleNamespace(cameras=cameras, metadata=metadata)
    return SimpleNamespace(train_dataset=dataset, train_dataparser_outputs=outputs)


def columns(lines: list[str], name: str) -> list[float]:
    """The numbers of a row of the log."""
    (row,) = [line for line in lines if line.startswith(name)]
    return [float(word) for word in row.removeprefix(name).replace(",", " ").split() if word != "z"]


def test_points_of_colmap_bound_the_scene_and_both_units_stand_side_by_side() -> None:
    data = colmap_like(drone(), ground())
    lines = survey(data, BoundsConfig(metres_per_unit=1.0)).lines()
    assert any("scene units" in line and "metres" in line for line in lines)
    scene, metres = columns(lines, "near")
    assert metres == pytest.approx(10.0 * scene, abs=0.02)
    scene, metres = columns(lines, "highest camera")
    assert scene == pytest.approx(10.0, abs=1e-3) and metres == pytest.approx(130.0, abs=0.01)
    assert columns(lines, "lowest camera") == pytest.approx([9.0, 120.0], abs=0.01)
    found = survey(data, BoundsConfig(metres_per_unit=1.0))
    for row, value, there in (
        ("far", found.bounds.far, 10.0 * found.bounds.far),
        ("ground", float(found.bounds.aabb[2]), 10.0 * float(found.bounds.aabb[2]) + 30.0),
        ("top", float(found.bounds.aabb[5]), 10.0 * float(found.bounds.aabb[5]) + 30.0),
    ):
        assert columns(lines, row) == pytest.approx([value, there], abs=0.01)
    assert f"{found.median_length:.3f} ({10.0 * found.median_length:.1f} m)" in lines[-1]
    near, far = found.bounds.near, found.bounds.far
    said = f"{near:.3g} to {far:.3g} scene units ({10.0 * near:.3g} to {10.0 * far:.3g} metres)"
    assert said in found.summary()[1]
    assert "data units" in "".join(survey(data).lines())
    assert "100.0% of 768 rays meet the scene" in lines[-1]


def test_it_says_which_space_was_chosen_and_why() -> None:
    head = survey(colmap_like(drone(), ground())).lines()[0]
    assert "photographed from above (100% of rays go down" in head
    assert "not from above" in survey(datamanager(ring(), 0.6 * cloud() - 0.3)).lines()[0]


def test_more_cameras_than_are_looked_at_still_have_bounds() -> None:
    found = survey(datamanager(drone(MOST_CAMERAS + 44), ground()))
    assert found.bounds.kind == "box" and len(found.positions) == MOST_CAMERAS


def test_a_range_by_hand_is_what_rays_are_counted_in() -> None:
    data = datamanager(drone(), ground())
    assert survey(data, near=1.0, far=12.0).bounds.far == 12.0
    with refused(r"^0% of the rays meet the scene .*leave them out"):
        survey(data, near=0.5, far=2.0)
    with refused("0 < near < far"):
        survey(data, near=3.0, far=2.0)


def test_rays_that_miss_are_counted() -> None:
    """They enter between 8.7 and 10.7 from the camera."""
    data = datamanager(drone(), ground())
    shares = [survey(data, far=far).meeting for far in (9.0, 9.8, 20.0)]
    assert 0.0 < shares[0] < shares[1] < shares[2] == 1.0


@pytest.mark.parametrize(
    ("count", "said"), [(None, "no sparse points,"), (31, "too few sparse points, 31,"), (32, "")]
)
def test_points_that_bound_nothing_are_told_with_what_finds_more(
    count: int | None, said: str
) -> None:
    dataset: Any = type("Dataset", (list,), {"cameras": ring(20)})(range(20))
    dataset.metadata = {} if count is None else {POINTS: cloud()[:count]}
    data: Any = SimpleNamespace(manager=SimpleNamespace(train_dataset=dataset))
    lines = LearningData.doubts(data)
    assert len(lines) == bool(said)
    assert all(f"this scene has {said} so that" in line for line in lines)


@pytest.mark.parametrize("far", [False, True])
def test_photographs_far_off_or_without_a_point_in_view_are_named_once(far: bool) -> None:
    cameras = ring(20)
    files = [f"{number}.png" for number in range(20)]
    dataset: Any = type("Dataset", (list,), {"cameras": cameras})(range(20))
    dataset.metadata, dataset.image_filenames = {POINTS: cloud() - 0.5}, files
    data: Any = SimpleNamespace(manager=SimpleNamespace(train_dataset=dataset))
    assert LearningData.doubts(data) == []
    cameras.camera_to_worlds[3:5, :, :3] *= torch.tensor([-1.0, 1.0, -1.0])  # they look away
    cameras.camera_to_worlds[4, :, 3] *= 1e4 if far else 1.0
    *of_far, away = LearningData.doubts(data)
    blind = "3.png" if far else "3.png, 4.png"
    assert away.startswith(f"in view of no sparse point: {blind}; the bounds become as wide as")
    assert len(of_far) == far
    assert all("as most cameras: 4.png; the others share" in line for line in of_far)
    assert away.endswith("; if their poses are wrong, leave their frames out or mend them")


def test_points_of_no_kind_are_none() -> None:
    assert sparse_points(SimpleNamespace(metadata=None)) is None
    assert sparse_points(SimpleNamespace(metadata={"points3D_rgb": torch.zeros(1, 3)})) is None


@pytest.fixture(scope="module")
def cities(tmp_path_factory: pytest.TempPathFactory) -> dict[str, SimpleNamespace]:
    """One city in both formats, each through its own reader; sparse points for both."""
    folder = tmp_path_factory.mktemp("cities")
    capture = CaptureConfig(24, 18, aerial_per_block=6.0, street_per_block=0.0)
    city = CityConfig(blocks=2)
    plain = write_city(city, folder / "plain", capture)
    mega = write_city(city, folder / "mega", capture, layout="mega-nerf")
    upright = LecoPhotographsDataParserConfig(data=plain).setup().get_dataparser_outputs("train")
    transform, scale = upright.dataparser_transform, upright.dataparser_scale
    in_metres = (upright.metadata[POINTS] / scale - transform[:, 3]) @ transform[:, :3]
    drb = torch.stack([-in_metres[:, 2], in_metres[:, 0], -in_metres[:, 1]], dim=-1)
    write_ply(mega / "points.ply", drb.numpy())
    config = MegaNerfDataParserConfig(data=mega, val_scale_factor=1, protocol="full")
    outputs = {"plain": upright, "mega": config.setup().get_dataparser_outputs("train")}
    return {
        name: SimpleNamespace(
            train_dataparser_outputs=out,
            train_dataset=SimpleNamespace(cameras=out.cameras, metadata=out.metadata),
        )
        for name, out in outputs.items()
    }


def test_one_city_in_two_formats_has_the_same_bounds_in_metres(
    cities: dict[str, SimpleNamespace],
) -> None:
    found = {name: survey(data) for name, data in cities.items()}
    assert {seen.bounds.kind for seen in found.values()} == {"box"}
    for row in ("near", "far", "ground", "top", "lowest camera", "highest camera"):
        plain, mega = (columns(found[name].lines(), row)[1] for name in ("plain", "mega"))
        assert plain == pytest.approx(mega, abs=0.05), row
    lines = found["mega"].lines()
    assert columns(lines, "lowest camera")[1] > columns(lines, "ground")[1] + 30.0


def test_every_line_reaches_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr("leco_plugin.log.note", said.append)
    found = survey(datamanager(drone(), ground()))
    summarize(found.summary(), found.lines())
    assert said == found.lines()


PIXELS = 32
DOWN = (-0.55, -1.5)
"""z of where cameras look in turn: the upper row of each second picture goes over the horizon."""


class Pictures:
    """A dataset of pictures that show one colour in their upper rows and another below."""

    def __init__(self, cameras: Cameras, points: Tensor, above: list[float], rows: int) -> None:
        self.cameras, self.metadata = cameras, {POINTS: points}
        self.image = torch.zeros(PIXELS, PIXELS, len(above))
        self.image[rows:, :, :] = 0.5
        self.image[:rows] = torch.tensor(above)
        self.asked: list[int] = []

    def get_data(self, number: int) -> dict[str, Any]:
        self.asked.append(number)
        return {"image": self.image}


def tilted(above: list[float], count: int = 20) -> SimpleNamespace:
    """Cameras 3 above a flat ground with pictures of 64 degrees."""
    right, poses = torch.tensor([0.0, -1.0, 0.0]), torch.zeros(count, 3, 4)
    for number in range(count):
        ahead = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, DOWN[number % 2]]), dim=0)
        poses[number, :, :3] = torch.stack([right, torch.linalg.cross(right, ahead), -ahead], dim=1)
    poses[:, 2, 3] = 3.0
    poses[:, 1, 3] = torch.linspace(-2.0, 2.0, count)
    cameras = Cameras(poses, 25.6, 25.6, 16.0, 16.0, PIXELS, PIXELS)
    points = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    points = points * torch.tensor([14.0, 8.0, 0.5]) + torch.tensor([0.5, -4.0, 0.0])
    return SimpleNamespace(train_dataset=Pictures(cameras, points, above, rows=8))


@pytest.mark.parametrize("above", [[0.6, 0.8, 1.0], [0.6, 0.6, 0.6, 0.5]])
def test_a_sky_raises_the_bounds_over_the_cameras(above: list[float]) -> None:
    data = tilted(above)
    bounds = survey(data).bounds
    low, high = bounds.aabb.view(2, 3)
    assert bounds.kind == "box" and "raised" in bounds.reason and "\n" not in bounds.reason
    assert float(high[2]) > 3.0 and float(low[2]) < 0.0
    assert bounds.near <= 0.05 * bounds.far
    cube = torch.stack([bounds.center - bounds.half_extent, bounds.center + bounds.half_extent])
    assert bool((low >= cube[0] - 1e-4).all()) and bool((high <= cube[1] + 1e-4).all())
    assert len(data.train_dataset.asked) <= 16  # not every picture of a large scene


@pytest.mark.parametrize("above", [[0.02, 0.05, 0.09], [0.9, 0.9, 0.9, 0.0]])
def test_darkness_and_nothing_raise_none(above: list[float]) -> None:
    bounds = survey(tilted(above)).bounds
    assert "raised" not in bounds.reason and float(bounds.aabb[5]) < 3.0


@pytest.mark.parametrize(("columns", "raised"), [(PIXELS // 2, True), (PIXELS // 4, False)])
def test_half_a_percent_of_the_rays_raises_the_bounds(columns: int, raised: bool) -> None:
    """A lamp over the horizon of one picture is met by eight of 1280 rays, or by four."""
    data = tilted([0.0, 0.0, 0.0])
    dark, lit = data.train_dataset.image, data.train_dataset.image.clone()
    lit[:8, :columns] = 1.0
    data.train_dataset.get_data = lambda number: {"image": lit if number == 0 else dark}
    assert ("raised" in survey(data).bounds.reason) == raised


def test_altitudes_by_hand_stay() -> None:
    data = tilted([0.6, 0.8, 1.0])
    bounds = survey(data, BoundsConfig(altitudes=(-1.0, 1.0))).bounds
    assert float(bounds.aabb[5]) == 1.0 and data.train_dataset.asked == []


def test_what_a_mask_hides_shows_nothing() -> None:
    chosen = torch.zeros(8, 8, dtype=torch.bool)
    chosen[0], chosen[7, 7] = True, True
    image, mask = torch.full((12, 20, 3), 0.5), torch.ones(12, 20, 1)
    assert int(bright({"image": image}, chosen).sum()) == 9
    mask[0] = 0.0
    assert int(bright({"image": image, "mask": mask}, chosen).sum()) == 1
    lamp, grid = torch.zeros(12, 20, 3), torch.zeros(8, 8, dtype=torch.bool)
    lamp[5, 14] = 1.0  # rows 3 / 7 of 11, columns 5 / 7 of 19
    grid[3, 5] = grid[5, 3] = True
    assert bright({"image": lamp}, grid).tolist() == [True, False]


def test_rays_that_all_meet_the_scene_open_no_picture() -> None:
    data = tilted([1.0, 1.0, 1.0]).train_dataset
    assert seen_beyond(data, torch.arange(20), torch.zeros(20, 8, 8, dtype=torch.bool)) == 0.0
    assert data.asked == []
