"""The data parser: order, protocol, halves, masks, and what nerfstudio makes of them."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import mega_nerf_scene
import numpy as np
import pytest
import torch
import tyro
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from scene_files import refused, write_ply

from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.data_manager import LecoDataManagerConfig
from leco_plugin.scenes.frames import ALTITUDES, METRES_PER_UNIT, POINTS, between, frame_of
from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig
from leco_plugin.scenes.survey import survey


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mega_nerf_scene.write(tmp_path_factory.mktemp("scenes") / "scene")


@pytest.fixture
def masked(tmp_path: Path) -> Path:
    return mega_nerf_scene.write(tmp_path / "scene", masks=True)


def parse(data: Path, split: str = "train", **settings: Any) -> Any:
    return MegaNerfDataParserConfig(data=data, **settings).setup().get_dataparser_outputs(split)


def stems(outputs: Any) -> list[str]:
    return [path.stem[:6] for path in outputs.image_filenames]


def test_half_trains_on_all_pictures_in_order_and_masks_right_halves(scene: Path) -> None:
    outputs = parse(scene)
    assert stems(outputs) == [f"{n:06d}" for n in range(7)]
    dataset = InputDataset(outputs)
    for number in range(7):
        data = dataset.get_data(number, image_type="uint8")
        np.testing.assert_array_equal(data["image"].numpy(), mega_nerf_scene.image(number))
        assert data["mask"][:, :12].all()
        assert bool(data["mask"][:, 12:].any()) == (number not in mega_nerf_scene.VALIDATION)


def test_full_leaves_the_validation_pictures_out(scene: Path) -> None:
    outputs = parse(scene, protocol="full")
    assert stems(outputs) == ["000000", "000001", "000003", "000004", "000006"]
    assert outputs.mask_filenames is None
    scored = parse(scene, "val", protocol="full")
    assert stems(scored) == ["000002", "000005"]
    assert scored.cameras.width.flatten().tolist() == [6, 6]


@pytest.mark.parametrize(("factor", "shape", "left"), [(2, (8, 6), 6), (8, (2, 2), 1)])
def test_the_right_half_is_seen_by_a_camera_of_half_the_width(
    scene: Path, factor: int, shape: tuple[int, int], left: int
) -> None:
    """Its rays are those of the right half of the whole picture's camera: of 3 columns, 2."""
    halves = parse(scene, "test", val_scale_factor=factor)
    whole = parse(scene, "test", protocol="full", val_scale_factor=factor)
    assert halves.mask_filenames is None
    for number in range(2):
        rays = halves.cameras.generate_rays(number, keep_shape=True)
        others = whole.cameras.generate_rays(number, keep_shape=True)
        assert rays.shape == shape
        torch.testing.assert_close(rays.directions, others.directions[:, left:])
        image = InputDataset(halves).get_data(number, "uint8")["image"]
        other = InputDataset(whole).get_data(number, "uint8")["image"]
        assert torch.equal(image, other[:, left:])


def test_rays_are_those_of_the_format(scene: Path) -> None:
    """Through the middle of each pixel: [(i - cx) / fx, -(j - cy) / fy, -1], turned and unit."""
    outputs = parse(scene, protocol="full")
    rays = outputs.cameras.generate_rays(0, keep_shape=True)
    fx, fy, cx, cy = mega_nerf_scene.INTRINSICS
    row, column = 3, 17
    ray = np.array([(column + 0.5 - cx) / fx, -(row + 0.5 - cy) / fy, -1.0])
    ray = mega_nerf_scene.poses()[0, :, :3] @ ray
    ray /= np.linalg.norm(ray)
    np.testing.assert_allclose(rays.directions[row, column].numpy(), ray, atol=1e-6)


def test_up_is_up_and_cameras_look_down(scene: Path) -> None:
    poses = parse(scene).cameras.camera_to_worlds
    assert (poses[:, 2, 2] > 0.5).all()  # they look along -z of their own
    altitudes = mega_nerf_scene.poses()[:, 2, 3]
    order = poses[:, 2, 3].argsort().tolist()
    assert order == np.argsort(altitudes).tolist()


def test_frames_of_two_readings_agree_and_lead_back_to_metres(scene: Path) -> None:
    class Manager:
        train_dataparser_outputs = parse(scene)

    frame = frame_of(Manager)
    assert frame is not None
    assert torch.equal(between(frame, frame), torch.eye(3, 4))
    matrix = np.array(frame)
    metric = mega_nerf_scene.COORDINATES.to_file(mega_nerf_scene.poses())[:, :, 3] * 40
    metric += mega_nerf_scene.COORDINATES.origin_drb
    places = Manager.train_dataparser_outputs.cameras.camera_to_worlds[:, :, 3].numpy()
    np.testing.assert_allclose(metric @ matrix[:, :3].T + matrix[:, 3], places, atol=1e-5)


def test_masks_of_the_scene_are_used_and_empty_ones_leave_a_picture_out(masked: Path) -> None:
    outputs = parse(masked)
    assert stems(outputs) == [f"{n:06d}" for n in (0, 1, 2, 3, 5, 6)]
    assert len(outputs.cameras) == len(outputs.mask_filenames) == 6
    for number, place in enumerate((0, 1, 2, 3, 5, 6)):
        mask = InputDataset(outputs).get_data(number)["mask"][..., 0].numpy()
        keep = mega_nerf_scene.mask(place)
        if place in mega_nerf_scene.VALIDATION:
            keep[:, 12:] = False
        np.testing.assert_array_equal(mask, keep)


def test_masks_of_a_cluster_come_from_their_folder(masked: Path, tmp_path: Path) -> None:
    cluster = (masked / "masks").rename(tmp_path / "cluster-3")
    assert parse(masked, protocol="full").mask_filenames is None
    outputs = parse(masked, protocol="full", masks=cluster)
    assert stems(outputs) == ["000000", "000001", "000003", "000006"]
    with refused(r"there is no folder .*cluster-4"):
        parse(masked, masks=tmp_path / "cluster-4")


def test_masks_that_keep_nothing_at_all_are_named(masked: Path) -> None:
    for number in range(7):
        mega_nerf_scene.write_mask(masked / "masks", f"{number:06d}", np.zeros((16, 24), bool))
    with refused("leave no pixel to train on"):
        parse(masked)


def test_pictures_are_written_to_the_cache_that_is_asked_for(scene: Path, tmp_path: Path) -> None:
    outputs = parse(scene, "val", cache=tmp_path / "cache")
    assert {path.parent for path in outputs.image_filenames} == {tmp_path / "cache"}


def test_a_scale_factor_of_zero_is_refused(scene: Path) -> None:
    with refused("whole numbers from 1 on"):
        parse(scene, val_scale_factor=0)


def test_nerfstudio_never_draws_a_pixel_of_a_right_half(scene: Path) -> None:
    manager = VanillaDataManagerConfig(
        dataparser=MegaNerfDataParserConfig(data=scene), train_num_rays_per_batch=512
    ).setup(device="cpu")
    drawn = torch.cat([manager.next_train(step)[1]["indices"] for step in range(8)])
    validation = torch.isin(drawn[:, 0], torch.tensor(mega_nerf_scene.VALIDATION))
    assert validation.any() and int(drawn[validation][:, 2].max()) == 11
    assert int(drawn[~validation][:, 2].max()) == 23


def test_leco_occupancy_trains_on_it_without_a_flag(scene: Path, tmp_path: Path) -> None:
    from leco_plugin.evaluation.timed_run import psnr_on_rays
    from leco_plugin.learning.calibration import CalibrationConfig
    from leco_plugin.method_configs import leco_occupancy
    from leco_plugin.studio.host_models import run_training

    config = copy.deepcopy(leco_occupancy.config)
    config.pipeline.datamanager.dataparser = MegaNerfDataParserConfig(data=scene)
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    config.pipeline.model.calibration = CalibrationConfig(rays=64)
    config.output_dir, config.vis, config.max_num_iterations = tmp_path, "tensorboard", 3
    config.steps_per_eval_image = 0
    config.logging.local_writer.enable = False
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    run_training(trainer)
    assert psnr_on_rays(trainer, 50) > 0


def test_sparse_points_in_metres_arrive_where_the_cameras_are(tmp_path: Path) -> None:
    """Points 100 m below two cameras, in the files' axes: (down, right, back)."""
    folder = mega_nerf_scene.write(tmp_path / "scene")
    places = mega_nerf_scene.poses()[:2, :, 3]
    below = np.stack([[-up + 100.0, right, -forward] for right, forward, up in places])
    write_ply(folder / "points.ply", below)
    outputs = MegaNerfDataParserConfig(data=folder).setup().get_dataparser_outputs("train")
    metres = mega_nerf_scene.COORDINATES.metres
    frame = outputs.dataparser_transform
    drb = torch.tensor([[-up, right, -forward] for right, forward, up in places]).float()
    expected = (drb @ frame[:, :3].T + frame[:, 3]) / metres - torch.tensor([0, 0, 100.0 / metres])
    torch.testing.assert_close(outputs.metadata[POINTS], expected, atol=1e-4, rtol=0)
    assert outputs.metadata[METRES_PER_UNIT] == 1.0


def test_altitudes_of_mega_nerfs_configurations_cut_the_rays(scene: Path) -> None:
    """Its datum is 90 m above the origin, a unit 40 m: z is (-90 - metres down) / 40."""
    parser = MegaNerfDataParserConfig(data=scene, ray_altitude_range=(-30.0, 10.0))
    manager = LecoDataManagerConfig(dataparser=parser).setup(device="cpu")
    assert manager.train_dataset.metadata[ALTITUDES] == (-2.5, -1.5)
    found = survey(manager)
    assert found.bounds.kind == "box" and found.bounds.aabb[[2, 5]].tolist() == [-2.5, -1.5]
    rows = {line[:9]: line.split() for line in found.lines()}
    assert rows["ground, z"][-1] == "-10.00" and rows["top, z   "][-1] == "30.00"  # metres, up
    by_hand = survey(manager, BoundsConfig(altitudes=(-2.0, -1.75)))
    assert by_hand.bounds.aabb[[2, 5]].tolist() == [-2.0, -1.75]


def test_altitudes_above_the_datum_are_negative_on_the_command_line() -> None:
    arguments = ["--ray-altitude-range", "-38", "15.5"]
    parsed = tyro.cli(MegaNerfDataParserConfig, args=arguments)
    assert parsed.ray_altitude_range == (-38.0, 15.5)


@pytest.mark.parametrize("levels", [(10.0, -30.0), (1.0, 1.0), (0.0, float("inf"))])
def test_altitudes_in_another_order_are_refused(levels: tuple[float, float], scene: Path) -> None:
    with refused("the top and then the ground"):
        parse(scene, ray_altitude_range=levels)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": Path("none.ply")}, "there is no file none.ply"),
        ({"val_scale_factor": 5}, "a scale factor of 5 does not divide"),
    ],
)
def test_a_wrong_option_is_refused_before_pictures_are_resized(
    settings: dict[str, Any], message: str, tmp_path: Path
) -> None:
    folder = mega_nerf_scene.write(tmp_path / "scene")
    with refused(message):
        parse(folder, train_scale_factor=2, **settings)
    assert not (folder / "leco-cache").exists()
