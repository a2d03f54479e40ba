"""What one reader checks, all of them do: each input is read rightly by all, or named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from scipy.spatial.transform import Rotation

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.known_folders import remedy_for
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig
from leco_plugin.scenes.reading import in_one_line, read_checked

# nerfstudio leaves images open that it has read
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
Edit = Callable[[dict[str, Any]], object]


@pytest.fixture
def scene(tiny_scene: Path, tmp_path: Path) -> Path:
    return shutil.copytree(tiny_scene, tmp_path / "scene")


def change(scene: Path, edit: Edit) -> dict[str, Any]:
    path = scene / "transforms.json"
    meta: dict[str, Any] = json.loads(path.read_text())
    edit(meta)
    path.write_text(json.dumps(meta))
    return meta


def as_blender(scene: Path) -> BlenderDataParserConfig:
    meta = change(scene, lambda meta: None)
    for frame in meta["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    meta["camera_angle_x"] = 2.0 * float(np.arctan(0.5 * meta["w"] / meta["fl_x"]))
    (scene / "transforms_train.json").write_text(json.dumps(meta))
    return BlenderDataParserConfig(data=scene)


def as_colmap(scene: Path, camera: str = "PINHOLE 32 32 32 32 16 16") -> ColmapDataParserConfig:
    model = scene / "sparse/0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"1 {camera}\n")
    lines = []
    for number, frame in enumerate(change(scene, lambda meta: None)["frames"]):
        pose = np.array(frame["transform_matrix"])
        pose[:3, 1:3] *= -1
        x, y, z, w = Rotation.from_matrix(pose[:3, :3].T).as_quat()
        place = " ".join(str(value) for value in -pose[:3, :3].T @ pose[:3, 3])
        name = Path(frame["file_path"]).name
        lines.append(f"{number + 1} {w} {x} {y} {z} {place} 1 {name}\n\n")
    (model / "images.txt").write_text("".join(lines))
    (model / "points3D.txt").write_text("1 0 0 0 9 9 9 0.1\n2 1 0 0 9 9 9 0.1\n")
    return ColmapDataParserConfig(data=scene, colmap_path=Path("sparse/0"))


READERS: dict[str, Callable[[Path], Any]] = {
    "leco-photographs": lambda scene: LecoPhotographsDataParserConfig(data=scene),
    "nerfstudio-data": lambda scene: NerfstudioDataParserConfig(data=scene),
    "instant-ngp-data": lambda scene: InstantNGPDataParserConfig(data=scene),
    "blender-data": as_blender,
    "colmap": as_colmap,
}
OF_A_FILE = ["leco-photographs", "nerfstudio-data", "instant-ngp-data", "blender-data"]


def read(config: Any, split: str = "train") -> Any:
    """A split as our data manager has it."""
    return read_checked(config.setup()).get_dataparser_outputs(split)


def picture(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_has_a_palette_for_its_colours(reader: str, scene: Path) -> None:
    expected = {}
    for path in (scene / "images").iterdir():
        with Image.open(path) as image:
            image.convert("P", palette=Image.Palette.ADAPTIVE).save(path)
        expected[path.stem] = picture(path)
    for path in read(READERS[reader](scene)).image_filenames:
        with Image.open(path) as image:
            assert image.mode == "RGB"
        np.testing.assert_array_equal(picture(path), expected[path.stem.split("-")[0]])


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_names_a_deep_photograph(reader: str, scene: Path) -> None:
    for path in (scene / "images").iterdir():
        Image.fromarray(np.full((32, 32), 9000, dtype=np.uint16)).save(path)
    with pytest.raises(InputError, match=r"00.\.png is of Pillow's mode 'I;16.*8 bits") as caught:
        read(READERS[reader](scene))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_reads_masks_or_takes_them_from_the_file(reader: str, scene: Path) -> None:
    (scene / "masks").mkdir()
    for number in range(9):
        mask = Image.new("P", (32, 32), 1)
        mask.putpalette([255, 255, 255, 0, 0, 0])
        mask.paste(0, (0, 0, 8, 32))
        mask.save(scene / "masks" / f"{number:03d}.png")

    def add(meta: dict[str, Any]) -> None:
        for number, frame in enumerate(meta["frames"]):
            frame["mask_path"] = f"masks/{number:03d}.png"

    change(scene, add)
    config = READERS[reader](scene)
    if reader == "colmap":
        config.masks_path = Path("masks")
    for path in read(config).mask_filenames:
        with Image.open(path) as image:
            values = np.asarray(image)
        assert bool((values[:, :8] == 255).all()) and not values[:, 8:].any()


@pytest.mark.parametrize("reader", OF_A_FILE)
def test_every_reader_of_a_file_has_the_lens_of_each_frame(reader: str, scene: Path) -> None:
    def mix(meta: dict[str, Any]) -> None:
        for number, frame in enumerate(meta["frames"]):
            frame |= {"fl_x": 30.0 + number, "fl_y": 20.0, "k1": 0.01 * number}
            frame["camera_model"] = ("OPENCV", "OPENCV_FISHEYE")[number % 2]

    meta = change(scene, mix)
    numbers = {Path(f["file_path"]).stem: n for n, f in enumerate(meta["frames"])}
    outputs = read(READERS[reader](scene))
    cameras = outputs.cameras
    for row, path in enumerate(outputs.image_filenames):
        number = numbers[path.stem]
        kind = (CameraType.PERSPECTIVE, CameraType.FISHEYE)[number % 2]
        assert int(cameras.camera_type[row]) == kind.value
        assert float(cameras.fx[row]) == 30.0 + number and float(cameras.fy[row]) == 20.0
        assert float(cameras.distortion_params[row, 0]) == pytest.approx(0.01 * number)
    assert bool(cameras.generate_rays(torch.tensor([[0]])).directions.isfinite().all())


def test_fields_of_view_go_for_both_axes(scene: Path) -> None:
    def leave_out(meta: dict[str, Any]) -> None:
        del meta["fl_x"], meta["fl_y"]
        meta |= {"camera_angle_x": np.pi / 2, "camera_angle_y": np.pi / 3, "k2": 0.5}

    change(scene, leave_out)
    config = InstantNGPDataParserConfig(data=scene, train_split_fraction=0.7)
    cameras = read(config, "val").cameras
    assert float(cameras.fx[1]) == pytest.approx(16.0)
    assert float(cameras.fy[1]) == pytest.approx(16.0 * 3**0.5)
    assert cameras.distortion_params[1].tolist() == [0.0, 0.5, 0.0, 0.0, 0.0, 0.0]
    config.train_split_fraction = 0.85  # of one photograph nerfstudio makes four half cameras
    with pytest.raises(InputError, match=r"makes no cameras of 1 photographs.*hold out more"):
        read(config, "val")
    with pytest.raises(InputError, match=r"has no fl_x; .*instant-ngp-data"):
        read(LecoPhotographsDataParserConfig(data=scene))


@pytest.mark.parametrize("reader", OF_A_FILE)
def test_every_reader_of_a_file_reads_is_fisheye(reader: str, scene: Path) -> None:
    change(scene, lambda meta: (meta.pop("camera_model", None), meta.update(is_fisheye=True)))
    change(scene, lambda meta: meta.update(fisheye_crop_radius=9))
    cameras = read(READERS[reader](scene)).cameras
    assert set(cameras.camera_type.flatten().tolist()) == {CameraType.FISHEYE.value}
    assert cameras.metadata["fisheye_crop_radius"] == 9


def test_a_photograph_is_turned_where_its_intrinsics_are_for_that(scene: Path) -> None:
    Image.effect_noise((20, 32), 90).convert("RGB").save(scene / "images" / "upright.png")
    stored = Image.fromarray(picture(scene / "images" / "upright.png")).rotate(90, expand=True)
    exif = Image.Exif()
    exif[0x0112] = 6
    stored.save(scene / "images" / "001.png", exif=exif)
    (scene / "images" / "upright.png").rename(scene / "upright.png")

    def tall(meta: dict[str, Any]) -> None:
        own = {key: meta.pop(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        for frame in meta["frames"]:
            narrow = {"w": 20} if frame["file_path"].endswith("001.png") else {}
            frame |= own | narrow

    change(scene, tall)
    outputs = read(LecoPhotographsDataParserConfig(data=scene))
    row = next(n for n, path in enumerate(outputs.image_filenames) if path.stem[:3] == "001")
    np.testing.assert_array_equal(
        picture(outputs.image_filenames[row]), picture(scene / "upright.png")
    )
    assert int(outputs.cameras.width[row]) == 20 and int(outputs.cameras.height[row]) == 32


@pytest.mark.parametrize(
    "error",
    [
        AssertionError(),
        EOFError(),
        KeyError("w"),
        SystemExit(1),
        RuntimeError("two\nlines"),
        NotImplementedError("FOV camera model is not supported yet!"),
    ],
)
def test_every_error_of_a_reader_is_one_line_with_a_remedy(
    error: BaseException, scene: Path
) -> None:
    def fail(**_: Any) -> Any:
        raise error

    config = NerfstudioDataParserConfig(data=scene)
    with pytest.raises(InputError, match=f"{scene} cannot .* by nerfstudio-data: .+; .+") as caught:
        in_one_line(fail, config)("train")
    assert "\n" not in str(caught.value)


def test_a_question_that_nobody_answers_has_its_answer_as_an_option(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = as_colmap(scene, "PINHOLE 1800 1800 1800 1800 900 900")
    for path in (scene / "images").iterdir():
        with Image.open(path) as image:
            image.resize((1800, 1800)).save(path)
    monkeypatch.setattr("builtins.input", lambda *_: (_ for _ in ()).throw(EOFError()))
    with pytest.raises(InputError, match=r"scene cannot be read.*colmap --downscale-factor 1"):
        read(config)
    config.downscale_factor = 1
    assert len(read(config).image_filenames) > 0


def test_a_lens_that_nerfstudio_lacks_is_to_be_undistorted(scene: Path) -> None:
    with pytest.raises(InputError, match=r"FOV camera model.*image_undistorter"):
        read(as_colmap(scene, "FOV 32 32 32 32 16 16 0.1"))


def test_a_folder_of_another_reader_names_it(scene: Path, tmp_path: Path) -> None:
    as_colmap(scene)
    (scene / "transforms.json").unlink()
    command = f"`ns-train leco-occupancy --data {scene} colmap --colmap-path sparse/0` reads it"
    with pytest.raises(InputError, match=r"holds no transforms\.json") as caught:
        read(LecoPhotographsDataParserConfig(data=scene))
    assert command in str(caught.value)
    with pytest.raises(InputError, match="colmap/sparse/0 does not exist") as caught:
        read(ColmapDataParserConfig(data=scene))
    assert command in str(caught.value)
    for sign, wanted in (
        ("transforms_train.json", "blender-data"),
        ("coordinates.pt", "mega-nerf"),
        ("opensfm/reconstruction.json", "ns-process-data odm"),
        ("keyframes/one.json", "ns-process-data polycam"),
        ("one.JPG", "ns-process-data images"),
    ):
        folder = tmp_path / sign.split(".")[0].replace("/", "-") / "data"
        (folder / sign).parent.mkdir(parents=True)
        (folder / sign).write_text("{}")
        assert wanted in str(remedy_for(folder))
    assert remedy_for(tmp_path / "nowhere" / "at" / "all") is None


@pytest.mark.parametrize("windows", [True, False])
def test_names_with_backslashes_are_read_or_said(windows: bool, scene: Path) -> None:
    def write(meta: dict[str, Any]) -> None:
        names = ("train_filenames", "val_filenames", "test_filenames")
        for owner, key in [(frame, "file_path") for frame in meta["frames"]]:
            owner[key] = owner[key].replace("/", "\\")
        for name in names:
            meta[name] = [path.replace("/", "\\") for path in meta[name]]

    change(scene, write)
    if windows:
        assert read(LecoPhotographsDataParserConfig(data=scene)).image_filenames[0].is_file()
    else:
        with pytest.raises(InputError, match=r"Windows.*backslash"):
            read(NerfstudioDataParserConfig(data=scene))
