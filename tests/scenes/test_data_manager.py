"""Methods train on photographs wherever they are: in memory, on disk, in other processes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.datamanagers.parallel_datamanager import ParallelDataManagerConfig
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from PIL import Image
from scene_files import change, refused

from leco_plugin.hosts.learn_first import learn_occupancy
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.schedule import ScheduleConfig
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.scenes import data_manager
from leco_plugin.scenes.data_manager import (
    LecoDataManager,
    LecoDataManagerConfig,
    decoded_bytes,
)
from leco_plugin.scenes.learning_data import held_out_bundle
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.pixels.held_out_pixels import Lattice, lattice_for
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSamplerConfig, sampler_here
from leco_plugin.scenes.pixels.stored_pictures import StoredPictures, picture_sizes
from leco_plugin.scenes.survey import survey


def options(scene: Path) -> dict[str, Any]:
    return {
        "dataparser": LecoPhotographsDataParserConfig(data=scene),
        "train_num_rays_per_batch": 64,
        "eval_num_rays_per_batch": 64,
        "pixel_sampler": KnownDistancePixelSamplerConfig(),
    }


def on_disk(scene: Path, folder: Path, **more: Any) -> LecoDataManagerConfig:
    return LecoDataManagerConfig(images="disk", pixels=folder, **(options(scene) | more))


def learned(config: VanillaDataManagerConfig) -> Any:
    """The report of an occupancy learned on this data manager for a few steps, and the manager."""
    small = LecoModelConfig(
        schedule=ScheduleConfig(learn_steps=6), calibration=CalibrationConfig(rays=64)
    )
    pipeline: Any = VanillaPipelineConfig(datamanager=config, model=LecoModelConfig()).setup(
        device="cpu"
    )
    return learn_occupancy(small, pipeline, rays=64).report, pipeline.datamanager


def test_a_manager_on_disk_gives_rays_and_pixels_of_the_same_places(
    tiny_scene: Path, tmp_path: Path
) -> None:
    stored: Any = on_disk(tiny_scene, tmp_path).setup(device="cpu")
    memory: Any = VanillaDataManagerConfig(**options(tiny_scene)).setup(device="cpu")
    assert isinstance(next(stored.iter_train_image_dataloader)["image"], StoredPictures)
    for bundle, batch, generator, images in (
        (*stored.next_train(0), memory.train_ray_generator, memory.train_dataset),
        (*stored.next_eval(0), memory.eval_ray_generator, memory.eval_dataset),
    ):
        expected = generator(batch["indices"])
        torch.testing.assert_close(bundle.origins, expected.origins)
        torch.testing.assert_close(bundle.directions, expected.directions)
        pictures = [images.get_data(number)["image"] for number in range(len(images))]
        colours = torch.stack([pictures[i][r, c] for i, r, c in batch["indices"].tolist()])
        torch.testing.assert_close(batch["image"], colours, atol=1e-6, rtol=0)
    camera, picture = stored.next_eval_image(0)
    assert camera.shape == (1,) and picture["image"].shape == (32, 32, 3)


@pytest.mark.parametrize("kept", [True, False])
def test_what_is_held_out_is_neither_trained_on_nor_known_by_its_distance(
    kept: bool, tiny_scene: Path, tmp_path: Path
) -> None:
    made = on_disk(tiny_scene, tmp_path) if kept else LecoDataManagerConfig(**options(tiny_scene))
    manager: Any = made.setup(device="cpu")
    lattice = manager.train_pixel_sampler.lattice
    assert lattice == lattice_for(picture_sizes(manager.train_dataset)) and lattice != Lattice()
    trained = torch.cat([manager.next_train(step)[1]["indices"] for step in range(200)])
    assert len(trained.unique(dim=0)) > 1000 and not bool(lattice.holds_out(trained).any())
    held_out = held_out_bundle(manager, 50)[0].camera_indices
    assert 0 < len(held_out) <= 50


def test_an_occupancy_is_learned_and_calibrated_from_files(
    tiny_scene: Path, tmp_path: Path
) -> None:
    report, _ = learned(on_disk(tiny_scene, tmp_path))
    assert report["held_out"] and report["calibration_rays"] > 0


@pytest.mark.parametrize("some", [{}, {"train_num_images_to_sample_from": 3}])
def test_few_photographs_stay_in_memory(tiny_scene: Path, some: dict[str, int]) -> None:
    manager: Any = LecoDataManagerConfig(**options(tiny_scene), **some).setup(device="cpu")
    assert not manager.on_disk()
    assert isinstance(next(manager.iter_train_image_dataloader)["image"], torch.Tensor)


def test_photographs_that_do_not_fit_go_to_disk(
    tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded = 9 * 32 * 32 * 12
    free = decoded / data_manager.MOST_OF_MEMORY
    for memory, expected in ((1.01 * free, False), (0.99 * free, True), (None, False)):
        monkeypatch.setattr(data_manager, "free_memory", lambda memory=memory: memory)
        config = LecoDataManagerConfig(pixels=tmp_path, **options(tiny_scene))
        manager = config.setup(device="cpu")
        assert isinstance(manager, LecoDataManager) and manager.on_disk() is expected
        assert decoded_bytes(manager.train_dataset) == 7 * 32 * 32 * 12
    monkeypatch.setattr(data_manager, "free_memory", lambda: 3.0 * free)
    manager = LecoDataManagerConfig(pixels=tmp_path, **options(tiny_scene)).setup(
        device="cpu", world_size=4
    )
    assert isinstance(manager, LecoDataManager) and manager.on_disk()


def test_a_sampler_that_needs_images_in_memory_is_named(tiny_scene: Path, tmp_path: Path) -> None:
    config = on_disk(tiny_scene, tmp_path, pixel_sampler=PixelSamplerConfig())
    with refused("pixel sampler"):
        config.setup(device="cpu")


class PlainManager:
    """The manager as on nerfstudio's main, where it is no torch module."""

    def __init__(self, module: LecoDataManager) -> None:
        self.module = module

    def to(self, device: Any) -> None:
        """For the release's pipeline; main's does not ask."""

    def __getattr__(self, name: str) -> Any:
        if hasattr(torch.nn.Module, name):
            raise AttributeError(name)
        return getattr(self.module, name)


@pytest.mark.parametrize("kept", [False, True])
def test_an_occupancy_is_learned_where_a_manager_is_no_module(
    tiny_scene: Path, tmp_path: Path, kept: bool
) -> None:
    options_of_main = {"train_num_images_to_sample_from": float("inf")}
    made = on_disk(tiny_scene, tmp_path, **options_of_main)
    config = made if kept else LecoDataManagerConfig(**options(tiny_scene), **options_of_main)
    config._target = lambda config, **given: PlainManager(LecoDataManager(config, **given))
    report, manager = learned(config)
    assert isinstance(manager, PlainManager) and manager.on_disk() is kept
    assert report["held_out"] and report["calibration_rays"] > 0


def test_whole_images_are_refused_before_the_first_step(tiny_scene: Path) -> None:
    config = FullImageDatamanagerConfig(
        dataparser=LecoPhotographsDataParserConfig(data=tiny_scene), cache_images="cpu"
    )
    with refused("hands out whole images"):
        survey(config.setup(device="cpu"))


def test_a_sampler_in_another_process_is_not_here() -> None:
    here = SimpleNamespace(train_pixel_sampler="sampler")
    assert sampler_here(here) == "sampler"
    assert sampler_here(SimpleNamespace(train_pixel_sampler="copy", data_procs=[])) is None
    assert sampler_here(SimpleNamespace()) is None


@pytest.mark.slow
def test_an_occupancy_is_learned_from_batches_of_other_processes(tiny_scene: Path) -> None:
    report, manager = learned(ParallelDataManagerConfig(**options(tiny_scene)))
    assert report["held_out"] and report["calibration_rays"] > 0
    assert report["step"] == 5
    for process in manager.data_procs:
        process.terminate()
        process.join()


@pytest.mark.slow
def test_an_occupancy_is_learned_from_some_images_at_a_time(tiny_scene: Path) -> None:
    some = {"train_num_images_to_sample_from": 2, "train_num_times_to_repeat_images": 2}
    report, _ = learned(VanillaDataManagerConfig(**options(tiny_scene), **some))
    assert report["held_out"] and report["calibration_rays"] > 0


def test_an_image_that_is_cut_off_is_named_in_one_line(scene: Path, tmp_path: Path) -> None:
    manager: Any = on_disk(scene, tmp_path / "pixels").setup(device="cpu")
    for dataset in (manager.train_dataset, manager.eval_dataset):
        path = dataset.image_filenames[1]
        content = path.read_bytes()
        path.write_bytes(content[: len(content) // 2])
        with refused(f"{path.name} cannot be read"):
            dataset.get_data(1)


@pytest.mark.parametrize("reader", [NerfstudioDataParserConfig, BlenderDataParserConfig])
def test_a_folder_that_is_not_there_is_one_line_of_any_reader(reader: Any, tmp_path: Path) -> None:
    config = LecoDataManagerConfig(dataparser=reader(data=tmp_path / "nowhere"))
    with refused(r"there is no folder .*nowhere: put it"):
        config.setup(device="cpu")


@pytest.mark.parametrize("kept", ["memory", "disk"])
@pytest.mark.parametrize("by_hand", [False, True])
def test_a_fisheye_is_read_as_far_as_its_lens_shows(
    kept: Any, by_hand: bool, scene: Path, tmp_path: Path
) -> None:
    radius = 3 if by_hand else 20  # what is given by hand goes before it
    fisheye = {"camera_model": "OPENCV_FISHEYE", "fisheye_crop_radius": radius}
    change(scene, lambda meta: meta.update(fisheye))
    config = LecoDataManagerConfig(
        images=kept, pixels=tmp_path, camera_res_scale_factor=0.5, **options(scene)
    )
    if by_hand:
        config.pixel_sampler.fisheye_crop_radius = 10.0
    manager: Any = config.setup(device="cpu")
    drawn = torch.cat([manager.next_train(step)[1]["indices"] for step in range(50)])
    drawn = torch.cat([drawn, manager.next_eval(0)[1]["indices"]])
    held_out = manager.train_pixel_sampler.sample_held_out(
        next(manager.iter_train_image_dataloader), 500, seed=0
    )["indices"]
    # half of 32 pixels, and half of the radius
    for pixels in (drawn, held_out):
        distances = (pixels[:, 1:] + 0.5 - 8.0).norm(dim=-1)
        assert 7.0 < float(distances.max()) <= 10.0


@pytest.mark.parametrize("kept", ["memory", "disk"])
@pytest.mark.parametrize("sizes", ["one size", "two sizes"])
def test_beside_fisheyes_perspective_photographs_are_read_as_a_whole(
    kept: Any, sizes: str, scene: Path, tmp_path: Path
) -> None:
    def mix(meta: dict[str, Any]) -> None:
        own = {key: meta.pop(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        meta["fisheye_crop_radius"] = 6
        for number, frame in enumerate(meta["frames"]):
            frame |= own | {"camera_model": ("OPENCV_FISHEYE" if number % 3 else "OPENCV")}
            if sizes == "two sizes" and number % 3 == 0:
                path = scene / frame["file_path"]
                Image.open(path).resize((16, 16)).save(path)
                frame |= {key: value / 2 for key, value in own.items()} | {"w": 16, "h": 16}

    change(scene, mix)
    config = LecoDataManagerConfig(images=kept, pixels=tmp_path, **options(scene))
    manager: Any = config.setup(device="cpu")
    held_out = manager.train_pixel_sampler.sample_held_out(
        next(manager.iter_train_image_dataloader), 500, seed=0
    )["indices"]
    drawn = torch.cat([manager.next_train(step)[1]["indices"] for step in range(20)])
    evaluated = torch.cat([manager.next_eval(step)[1]["indices"] for step in range(8)])
    for pixels, dataset in (
        (drawn, manager.train_dataset),
        (held_out, manager.train_dataset),
        (evaluated, manager.eval_dataset),
    ):
        cameras = dataset.cameras[pixels[:, 0]]
        middle = torch.cat([cameras.height, cameras.width], dim=-1) / 2
        distances = (pixels[:, 1:] + 0.5 - middle).norm(dim=-1)
        fisheyes = (cameras.camera_type == CameraType.FISHEYE.value).flatten()
        assert bool((distances[fisheyes] <= 6.0).all())
        corner = (distances / middle[:, 0])[~fisheyes].max()
        assert bool(fisheyes.any()) and float(corner) > 0.8
    assert manager.config.pixel_sampler.fisheye_crop_radius is None


def test_a_photograph_that_is_tested_and_trained_on_is_said(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = LecoDataManagerConfig(**options(scene))
    config.setup(device="cpu")
    assert "trained on too" not in capsys.readouterr().out
    change(scene, lambda meta: meta["val_filenames"].append(meta["train_filenames"][0]))
    config.setup(device="cpu")
    assert "1 test photograph is trained on too: " in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("kept", ["memory", "disk"])
@pytest.mark.parametrize("reader", [LecoPhotographsDataParserConfig, NerfstudioDataParserConfig])
def test_all_photographs_may_train(
    reader: Any, kept: Any, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    splits = ("train_filenames", "val_filenames", "test_filenames")
    change(scene, lambda meta: [meta.pop(name) for name in splits])
    parser = reader(data=scene, train_split_fraction=1.0)
    made = {**options(scene), "dataparser": parser}
    config = LecoDataManagerConfig(images=kept, pixels=tmp_path, **made)
    manager: Any = config.setup(device="cpu")
    assert len(manager.train_dataset) == 9 and not manager.eval_dataset
    assert manager.next_train(0)[1]["image"].shape == (64, 3)
    assert capsys.readouterr().out.count("no test image: the run trains on all 9") == 1
    manager = config.setup(device="cpu", test_mode="test")
    for ask in (len, iter, lambda loader: manager.next_eval_image(0)):
        with refused("no test image in this run"):
            ask(manager.fixed_indices_eval_dataloader)
    assert "no test image" not in capsys.readouterr().out
