"""nerfstudio loads the city by name, and the truth follows it into model coordinates."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from scene_files import refused

from leco_plugin.scenes.city.folder import CityTruth
from leco_plugin.scenes.city_dataparser import LecoCityDataParserConfig, leco_city_dataparser
from leco_plugin.scenes.frames import METRES_PER_UNIT, POINTS
from leco_plugin.scenes.mega_nerf import mega_nerf_dataparser


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> LecoCityDataParserConfig:
    folder = tmp_path_factory.mktemp("scenes") / "city"
    return LecoCityDataParserConfig(data=folder, blocks=1, seed=5, width=40, height=30)


@pytest.fixture(scope="module")
def outputs(config: LecoCityDataParserConfig) -> DataparserOutputs:
    return config.setup().get_dataparser_outputs("train")


@pytest.fixture(scope="module")
def truth(config: LecoCityDataParserConfig, outputs: DataparserOutputs) -> CityTruth:
    return CityTruth.from_dataparser(config.folder(), outputs)


def test_the_city_is_written_and_loaded(
    config: LecoCityDataParserConfig, outputs: DataparserOutputs
) -> None:
    held_out = config.setup().get_dataparser_outputs("test")
    assert len(outputs.image_filenames) > 4 * len(held_out.image_filenames) > 0
    assert all(path.is_file() for path in outputs.image_filenames)
    assert int(outputs.cameras.width[0]) == 40
    assert len(outputs.metadata["depth_filenames"]) == len(outputs.image_filenames)


def test_its_sparse_points_and_its_metres_come_along(outputs: DataparserOutputs) -> None:
    assert outputs.metadata[METRES_PER_UNIT] == 1.0
    points = outputs.metadata[POINTS]
    assert points.shape[1] == 3 and len(points) > 500


def test_by_default_each_kind_of_city_has_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folders = {
        LecoCityDataParserConfig(**change).folder()
        for change in ({}, {"blocks": 2}, {"seed": 1}, {"sky": True}, {"width": 200})
    }
    assert len(folders) == 5
    assert all(folder.parent == Path("data/leco-city") for folder in folders)


def test_up_stays_up(outputs: DataparserOutputs) -> None:
    torch.testing.assert_close(outputs.dataparser_transform[:, :3], torch.eye(3))


def test_model_coordinates_lead_back_to_metres(truth: CityTruth) -> None:
    metres = torch.rand(50, 3, dtype=torch.float64) * 60 - 30
    model = truth.to_model(metres.numpy())
    torch.testing.assert_close(
        torch.from_numpy(truth.to_metres(model)), metres, atol=1e-4, rtol=1e-5
    )


def test_visible_points_lie_on_the_surface_and_cameras_in_the_air(
    truth: CityTruth, outputs: DataparserOutputs
) -> None:
    surface = truth.visible_surface("test")
    assert len(surface) > 500
    assert truth.distance(surface).max() < 1e-3
    cameras = outputs.cameras.camera_to_worlds[:, :, 3]
    assert not truth.occupied(cameras).any()
    assert truth.distance(cameras).min() > 0.5
    assert truth.occupied(cameras[:, None]).shape == (len(cameras), 1)


def test_points_below_the_visible_ground_are_matter(truth: CityTruth) -> None:
    surface = truth.visible_surface("train")
    metres = truth.to_metres(surface)
    ground = surface[abs(metres[:, 2]) < 1e-3]
    assert len(ground) > 100
    down = torch.tensor([0.0, 0.0, 0.1 * truth.scale])
    assert truth.occupied(ground - down).all()


def test_the_entry_points_are_light_to_import() -> None:
    """Every ns-* command imports this one and that of Mega-NeRF: nothing that reads, draws or
    builds may come along."""
    code = (
        "import sys; of = lambda: {m for m in sys.modules if m[:12] == 'leco_plugin.'};"
        "import leco_plugin.scenes.mega_nerf; first = of();"
        "print(*first, 'trimesh' in sys.modules);"
        "import leco_plugin.scenes.city_dataparser; print(*of() - first, 'trimesh' in sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=True
    )
    mega_nerf, city = map(str.split, loaded.stdout.splitlines())
    scenes = "leco_plugin.scenes"
    assert set(mega_nerf) == {scenes, f"{scenes}.mega_nerf", "False"}
    light = {f"{scenes}.city_dataparser", f"{scenes}.input_error", "False"}
    assert {name for name in city if name.startswith(scenes) or "." not in name} == light
    assert isinstance(leco_city_dataparser, DataParserSpecification)
    assert isinstance(mega_nerf_dataparser, DataParserSpecification)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"blocks": 0}, "1 to 64 blocks"), ({"width": 0}, "no city could be written: ")],
)
def test_a_city_that_cannot_be_built_ends_a_command_in_one_line(
    options: dict[str, int], message: str, tmp_path: Path
) -> None:
    with refused(message):
        LecoCityDataParserConfig(data=tmp_path / "city", **options).setup()
    assert not (tmp_path / "city").exists()
