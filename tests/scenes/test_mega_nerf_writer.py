"""What is written is Mega-NeRF's format, and comes back."""

from __future__ import annotations

from pathlib import Path

import mega_nerf_scene
import numpy as np
import pytest
import torch
from PIL import Image

from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, CityTruth, read_transforms, write_city
from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig

CITY = CityConfig(blocks=1, seed=5)
CAPTURE = CaptureConfig(40, 32, aerial_per_block=5, street_per_block=2, test_every=3)


def test_the_files_are_those_of_the_format(tmp_path: Path) -> None:
    folder = mega_nerf_scene.write(tmp_path, masks=True)
    coordinates = torch.load(folder / "coordinates.pt", weights_only=True)
    assert coordinates["origin_drb"].dtype == torch.float32
    assert coordinates["origin_drb"].tolist() == [-90.0, 12.0, -300.0]
    assert coordinates["pose_scale_factor"] == 40.0
    metadata = torch.load(folder / "val/metadata/000002.pt", weights_only=True)
    assert metadata.keys() == {"H", "W", "c2w", "intrinsics", "distortion"}
    assert (metadata["H"], metadata["W"]) == (16, 24)
    assert metadata["c2w"].shape == (3, 4) and metadata["c2w"].dtype == torch.float32
    assert metadata["intrinsics"].tolist() == [20.0, 21.0, 12.5, 7.5]
    assert (folder / "mappings.txt").read_text().splitlines()[0] == "DJI_0.JPG,000000.pt"


def test_a_camera_that_looks_down_is_written_as_the_format_says(tmp_path: Path) -> None:
    """World (down, right, back), camera (right, up, back); by hand, for one camera.

    It flies 30 m above the datum, looks down, and its picture's top is ahead.
    """
    pose = np.column_stack([np.eye(3), [7.0, 2.0, 30.0]])
    written = mega_nerf_scene.COORDINATES.to_file(pose[None])[0]
    right, top, back_of_camera, place = written.T
    np.testing.assert_array_equal(right, [0, 1, 0])
    np.testing.assert_array_equal(top, [0, 0, -1])
    np.testing.assert_array_equal(back_of_camera, [-1, 0, 0])
    np.testing.assert_allclose(place * 40 + [-90, 12, -300], [-30, 7, -2])


@pytest.fixture(scope="module")
def cities(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same city in both formats."""
    folder = tmp_path_factory.mktemp("cities")
    ours = write_city(CITY, folder / "nerfstudio", CAPTURE)
    theirs = write_city(CITY, folder / "mega", CAPTURE, layout="mega-nerf")
    return ours, theirs


def test_the_city_makes_a_round_trip(cities: tuple[Path, Path]) -> None:
    ours, theirs = cities
    transforms = read_transforms(ours)
    config = MegaNerfDataParserConfig(data=theirs, protocol="full", val_scale_factor=1)
    parser, seen = config.setup(), 0
    for split, names in (("train", "train_filenames"), ("val", "test_filenames")):
        outputs = parser.get_dataparser_outputs(split)
        poses = {f["file_path"]: np.array(f["transform_matrix"]) for f in transforms["frames"]}
        assert len(outputs.image_filenames) == len(transforms[names])
        for number, name in enumerate(transforms[names]):
            with Image.open(ours / name) as a, Image.open(outputs.image_filenames[number]) as b:
                np.testing.assert_array_equal(np.array(a), np.array(b))
            pose = poses[name]
            c2w = outputs.cameras.camera_to_worlds[number].double().numpy()
            np.testing.assert_allclose(c2w[:, :3], pose[:3, :3], atol=1e-5)
            metres = _metres(outputs, c2w[:, 3])
            np.testing.assert_allclose(metres, [-pose[2, 3], pose[0, 3], -pose[1, 3]], atol=1e-5)
            assert -metres[0] == pytest.approx(pose[2, 3], abs=1e-5)  # altitude, up is positive
            seen += 1
        lens = CAPTURE.lens
        np.testing.assert_allclose(outputs.cameras.fx.numpy(), lens.focal, rtol=1e-6)
        assert (outputs.cameras.cx == 20).all() and (outputs.cameras.cy == 16).all()
    assert seen == len(transforms["frames"]) == 7


def _metres(outputs: object, place: np.ndarray) -> np.ndarray:
    """From the model back to metres (down, right, back), by the dataparser's transform."""
    transform = outputs.dataparser_transform.double().numpy()
    return np.linalg.solve(transform[:, :3], place / outputs.dataparser_scale - transform[:, 3])


def test_the_exact_city_is_known_in_the_models_coordinates(cities: tuple[Path, Path]) -> None:
    ours, theirs = cities
    outputs = MegaNerfDataParserConfig(data=theirs).setup().get_dataparser_outputs("train")
    truth = CityTruth.from_dataparser(theirs, outputs)
    cameras = outputs.cameras.camera_to_worlds[:, :, 3]
    frames = read_transforms(ours)["frames"]
    expected = np.array([frame["transform_matrix"] for frame in frames])[:, :3, 3]
    np.testing.assert_allclose(truth.to_metres(cameras), expected, atol=1e-4)
    assert not truth.occupied(cameras).any()
