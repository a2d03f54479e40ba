"""What one reader checks, all of them do: each input is read rightly by all, or named."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unicodedata import normalize

import mega_nerf_scene
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.dataparsers.blender_dataparser import BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.dnerf_dataparser import DNeRFDataParserConfig
from nerfstudio.data.dataparsers.instant_ngp_dataparser import InstantNGPDataParserConfig
from nerfstudio.data.dataparsers.minimal_dataparser import MinimalDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.scannetpp_dataparser import ScanNetppDataParserConfig
from nerfstudio.data.dataparsers.sdfstudio_dataparser import SDFStudioDataParserConfig
from PIL import Image
from scene_files import change, described, refused, write_colmap

from leco_plugin.scenes.frames import POINTS, check_no_contradiction
from leco_plugin.scenes.mega_nerf import MegaNerfDataParserConfig
from leco_plugin.scenes.photographs import LecoPhotographsDataParserConfig, read_scene
from leco_plugin.scenes.reading import read_checked
from leco_plugin.scenes.scene_file import remedy_for

Edit = Callable[[dict[str, Any]], object]


def as_blender(scene: Path) -> BlenderDataParserConfig:
    meta = described(scene)
    for frame in meta["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")
    meta["camera_angle_x"] = 2.0 * float(np.arctan(0.5 * meta["w"] / meta["fl_x"]))
    (scene / "transforms_train.json").write_text(json.dumps(meta))
    return BlenderDataParserConfig(data=scene)


def as_colmap(scene: Path, camera: str = "PINHOLE 32 32 32 32 16 16") -> ColmapDataParserConfig:
    write_colmap(scene, scene / "sparse/0", camera, np.eye(2, 3))
    return ColmapDataParserConfig(data=scene, colmap_path=Path("sparse/0"))


def as_scannetpp(scene: Path) -> ScanNetppDataParserConfig:
    meta = described(scene)
    folder = scene / "dslr"
    (folder / "nerfstudio").mkdir(parents=True)
    (scene / "images").rename(folder / "resized_images")
    if (scene / "masks").is_dir():
        (scene / "masks").rename(folder / "resized_anon_masks")
    for frame in meta["frames"]:
        for name in {"file_path", "mask_path"} & {*frame}:
            frame[name] = Path(frame[name]).name
    meta["test_frames"] = [meta["frames"].pop()]
    (folder / "nerfstudio/transforms.json").write_text(json.dumps(meta))
    return ScanNetppDataParserConfig(data=scene)


def poses_of(meta: dict[str, Any]) -> np.ndarray:
    return np.array([frame["transform_matrix"] for frame in meta["frames"]], dtype=np.float32)


def as_sdfstudio(scene: Path) -> SDFStudioDataParserConfig:
    meta = described(scene)
    intrinsics = np.diag([meta["fl_x"], meta["fl_y"], 1.0, 1.0])
    intrinsics[:2, 2] = meta["cx"], meta["cy"]
    turned = poses_of(meta) * [1, -1, -1, 1]  # columns: OpenCV's axes
    frames = [
        {"rgb_path": frame["file_path"], "camtoworld": pose, "intrinsics": intrinsics.tolist()}
        for frame, pose in zip(meta["frames"], turned.tolist())
    ]
    box = {"aabb": [[-1.0] * 3, [1.0] * 3]}
    made = {"frames": frames, "scene_box": box, "height": meta["h"], "width": meta["w"]}
    (scene / "meta_data.json").write_text(json.dumps(made))
    return SDFStudioDataParserConfig(data=scene)


def as_minimal(scene: Path) -> MinimalDataParserConfig:
    meta = described(scene)
    one = np.ones((len(meta["frames"]), 1), dtype=np.float32)
    lens = {"fx": "fl_x", "fy": "fl_y", "cx": "cx", "cy": "cy"}
    cameras = {name: one * meta[field] for name, field in lens.items()}
    cameras |= {name: (one * 32).astype(int) for name in ("height", "width")}
    cameras |= {"camera_to_worlds": poses_of(meta), "camera_type": one.astype(int)}
    files = {"image_filenames": [frame["file_path"] for frame in meta["frames"]]}
    if "mask_path" in meta["frames"][0]:
        files["mask_filenames"] = [frame["mask_path"] for frame in meta["frames"]]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    np.savez(scene / "train.npz", cameras=np.array(cameras), scene_box=box, **files)
    return MinimalDataParserConfig(data=scene)


def as_mega_nerf(scene: Path) -> MegaNerfDataParserConfig:
    meta = described(scene)
    mega_nerf_scene.write_coordinates(scene, mega_nerf_scene.COORDINATES)
    poses = mega_nerf_scene.COORDINATES.to_file(mega_nerf_scene.poses(9))
    for number, frame in enumerate(meta["frames"]):
        path, split = scene / frame["file_path"], "val" if number == 4 else "train"
        lens = (32.0, 32.0, 16.0, 16.0)
        mega_nerf_scene.write_view(scene, split, path.stem, picture(path), poses[number], lens)
        shutil.copy(path, scene / split / "rgbs" / path.name)
        if "mask_path" in frame:
            with Image.open(scene / frame["mask_path"]) as mask:
                keep = np.asarray(mask.convert("L")) > 0
            mega_nerf_scene.write_mask(scene / "seen", path.stem, keep)
    names = {path.name: path.stem for path in (scene / "images").iterdir()}
    mega_nerf_scene.write_mappings(scene, names)
    seen = scene / "seen" if (scene / "seen").is_dir() else None
    return MegaNerfDataParserConfig(
        data=scene, masks=seen, train_scale_factor=1, protocol="full", check_axes=False
    )


READERS: dict[str, Callable[[Path], Any]] = {
    "leco-photographs": lambda scene: LecoPhotographsDataParserConfig(data=scene),
    "nerfstudio-data": lambda scene: NerfstudioDataParserConfig(data=scene),
    "instant-ngp-data": lambda scene: InstantNGPDataParserConfig(data=scene),
    "blender-data": as_blender,
    "scannetpp-data": as_scannetpp,
    "colmap": as_colmap,
    "sdfstudio-data": as_sdfstudio,
    "minimal-parser": as_minimal,
    "mega-nerf": as_mega_nerf,
}
OF_A_FILE = [*READERS][:5]
"""Those that read a transforms.json."""
MASKED = [name for name in READERS if name != "sdfstudio-data"]


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
    with refused(r"00.\.png is of Pillow's mode 'I;16.*8 bits"):
        read(READERS[reader](scene))


@pytest.mark.parametrize("reader", MASKED)
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
    with refused(r"makes no cameras of 1 photograph of the split.*hold out more"):
        read(config, "val")
    with refused(r"has no fl_x; .*instant-ngp-data"):
        read(LecoPhotographsDataParserConfig(data=scene))

    def rename(meta: dict[str, Any]) -> None:
        meta |= {"fovx": meta.pop("camera_angle_x"), "fovy": meta.pop("camera_angle_y")}

    change(scene, rename)  # no reader knows these
    with refused(r"has no fl_x: add it"):
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


def test_a_photograph_may_be_listed_twice_where_rounding_alone_differs() -> None:
    poses = np.stack([np.eye(4)[:3]] * 2)
    poses[:, :, 3] = 5e6  # as of UTM
    poses[1] += 1e-3 * np.array([0.0, 0.0, 0.0, 1.0])
    check_no_contradiction(poses, ["a", "a"])
    with refused("^a is given twice, and differs"):
        check_no_contradiction(poses - [0.0, 0.0, 0.0, 5e6], ["a", "a"])


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        (AssertionError(), "mend SCENE/transforms.json"),
        (EOFError(), "run it on a terminal once, and answer"),
        (KeyError("w"), "add 'w' to SCENE/transforms.json"),
        (
            ImportError("libusb-1.0.so.0: cannot open shared object file"),
            "install it (by `sudo apt-get install libusb-1.0-0`): nerfstudio-data needs it",
        ),
        (SystemExit(1), "run it on a terminal once, and answer"),
        (RuntimeError("two\nlines"), "mend SCENE/transforms.json"),
        (ValueError("int() with base 10: '\\\\ufeff#'"), "mend SCENE/transforms.json"),
        (FileNotFoundError(2, "No", "a.dat"), "put that file there, or remove what names it"),
        (OSError("a\\b.png"), "its names were written by Windows: write / for each backslash"),
        (
            NotImplementedError("FOV camera model is not supported yet!"),
            "undistort the photographs with `colmap image_undistorter`, and give that model",
        ),
    ],
)
def test_every_error_of_a_reader_is_one_line_with_its_remedy(
    error: BaseException, remedy: str, scene: Path
) -> None:
    class Failing(Nerfstudio):
        def _generate_dataparser_outputs(self, *_: Any, **__: Any) -> Any:
            raise error

    parser = read_checked(Failing(NerfstudioDataParserConfig(data=scene)))
    with refused(f"{scene} cannot .* by nerfstudio-data: .+; ") as caught:
        parser.get_dataparser_outputs("train")
    line = str(caught.value)
    assert "\n" not in line and line.endswith(f"; {remedy}".replace("SCENE", str(scene)))
    (scene / "images" / "002.png").write_bytes(b"")  # a picture that is none is the reason
    with refused(r"002\.png cannot be read as an image"):
        parser.get_dataparser_outputs("train")


def test_a_question_that_nobody_answers_has_its_answer_as_an_option(
    scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = as_colmap(scene, "PINHOLE 1800 1800 1800 1800 900 900")
    first, *others = (scene / "images").iterdir()
    Image.new("RGB", (1800, 1800)).save(first)
    for path in others:
        shutil.copyfile(first, path)
    monkeypatch.setattr("builtins.input", lambda *_: (_ for _ in ()).throw(EOFError()))
    with refused(r"scene cannot be read.*colmap --downscale-factor 1"):
        read(config)
    config.downscale_factor = 1
    assert len(read(config).image_filenames) > 0


def test_a_lens_that_nerfstudio_lacks_is_to_be_undistorted(scene: Path) -> None:
    with refused(r"FOV camera model.*image_undistorter"):
        read(as_colmap(scene, "FOV 32 32 32 32 16 16 0.1"))


def test_a_folder_of_another_reader_names_it(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_colmap(scene)
    (scene / "transforms.json").unlink()
    command = f"`ns-train leco-occupancy --data {scene} colmap --colmap-path sparse/0` reads it"
    with refused(r"holds no transforms\.json") as caught:
        read(LecoPhotographsDataParserConfig(data=scene))
    assert command in str(caught.value)
    with refused("colmap/sparse/0 does not exist") as caught:
        read(ColmapDataParserConfig(data=scene))
    assert command in str(caught.value)
    for sign, wanted in (
        ("transforms_train.json", "blender-data"),
        ("coordinates.pt", "mega-nerf"),
        ("opensfm/reconstruction.json", "ns-process-data odm"),
        ("keyframes/one.json", "ns-process-data polycam"),
        ("one.JPG", "leco poses"),
    ):
        folder = tmp_path / sign.split(".")[0].replace("/", "-") / "data"
        (folder / sign).parent.mkdir(parents=True)
        (folder / sign).write_text("{}")
        assert wanted in str(remedy_for(folder))
    for name, begin, wanted in (
        ("flight.csv", "time,latitude", "leco poses"),
        ("mission.xml", "<?xml?><kml>", "leco poses"),
        ("cameras.csv", "#name,x,y", "ns-process-data realitycapture"),
        ("cameras.xml", "<?xml?>\n<document", "ns-process-data metashape"),
    ):
        (folder / f"{name}{name[-4:]}").mkdir()  # a folder is no file of cameras
        (folder / name).write_text(begin)
        assert wanted in str(remedy_for(folder)), name
    assert remedy_for(tmp_path / "nowhere" / "at" / "all") is None
    (tmp_path / "whole" / "images").mkdir(parents=True)
    (tmp_path / "whole" / "transforms.json").write_text("{}")
    monkeypatch.setattr("sys.argv", ["leco", "points"])
    assert (
        remedy_for(tmp_path / "whole" / "images") == f"give {tmp_path / 'whole'}, which holds one"
    )
    (tmp_path / "begun" / "colmap").mkdir(parents=True)
    (tmp_path / "begun" / "images").mkdir()
    (tmp_path / "begun" / "colmap" / "asked.json").write_text("{}")
    assert "has not finished it: give the same command again" in str(remedy_for(tmp_path / "begun"))


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
        with refused(r"Windows.*backslash"):
            read(NerfstudioDataParserConfig(data=scene))


def rewrite(scene: Path, edit: Edit) -> None:
    """Changes each transforms.json of a scene, wherever its reader has it."""
    for path in [*scene.glob("*.json"), *scene.glob("dslr/nerfstudio/*.json")]:
        meta = json.loads(path.read_text())
        edit(meta)
        path.write_text(json.dumps(meta))


def set_pose(change_of: Callable[[np.ndarray], object]) -> Edit:
    def edit(meta: dict[str, Any]) -> None:
        pose = np.array(meta["frames"][3]["transform_matrix"])
        change_of(pose)
        meta["frames"][3]["transform_matrix"] = pose.tolist()

    return edit


NO_CAMERAS: dict[str, tuple[Edit, str]] = {
    "mirrored": (set_pose(lambda pose: pose[:3, 0].__imul__(-1.0)), "003.* is no rotation: remove"),
    "scaled": (set_pose(lambda pose: pose[:3, :3].__imul__(1.1)), "003.* is no rotation: remove"),
    "sheared": (set_pose(lambda pose: pose[0, :3].__iadd__(0.2)), "003.* is no rotation: remove"),
    "not finite": (set_pose(lambda pose: pose[0].fill(np.nan)), "003.* is no finite 4 x 4 matrix"),
    "no focal length": (lambda meta: meta.update(fl_x=-1.0), "fl_x is '-1.0'.*positive number"),
    "in shares": (
        lambda meta: meta.update(cx=0.5, cy=0.5),
        "000.*cx is 0.5 and cy is 0.5: give .* in pixels",
    ),
    "two poses": (
        lambda meta: meta["frames"].append(
            meta["frames"][3] | {"transform_matrix": meta["frames"][4]["transform_matrix"]}
        ),
        "003.* is given twice, and differs: remove one",
    ),
    "no size": (lambda meta: meta["frames"][2].update(w=0), "002.*w is '0'.*positive number"),
    "words": (lambda meta: meta.update(h="high"), "h is 'high'"),
    "another model": (
        lambda meta: meta.update(camera_model="FOV"),
        "camera_model 'FOV' is none of",
    ),
    "no distortion": (lambda meta: meta.update(k1=float("inf")), "k1 is 'inf'"),
    "a shutter": (lambda meta: meta.update(rolling_shutter=[0, 0, 1, 0]), "rolling_shutter"),
}


@pytest.mark.parametrize("fault", NO_CAMERAS)
@pytest.mark.parametrize("reader", OF_A_FILE)
def test_every_reader_of_a_file_refuses_what_no_camera_has(
    reader: str, fault: str, scene: Path
) -> None:
    edit, message = NO_CAMERAS[fault]
    config = READERS[reader](scene)
    rewrite(scene, edit)
    with refused(rf"transforms.*\.json.*{message}"):
        read(config)


def test_readers_of_other_files_refuse_what_no_camera_has(scene: Path, tmp_path: Path) -> None:
    config = as_colmap(Path(shutil.copytree(scene, tmp_path / "focal")), "PINHOLE 32 32 0 32 16 16")
    with refused(r"the camera of .*png has fx 0, which no camera has"):
        read(config)
    config = as_colmap(Path(shutil.copytree(scene, tmp_path / "long")))
    path = config.data / "sparse/0/images.txt"
    number, *turn = path.read_text().split(" ")
    path.write_text(" ".join([number, *(str(2 * float(part)) for part in turn[:4]), *turn[4:]]))
    with refused(r"the pose of .*png is no rotation"):
        read(config, "val")
    set_scaled = set_pose(lambda pose: pose[:3, :3].__imul__(1.1))
    change(scene, set_scaled)
    with refused(r"the pose of .*003\.png is no rotation"):
        read(as_sdfstudio(scene))


@pytest.mark.parametrize("reader", OF_A_FILE)
def test_a_byte_order_mark_null_and_poses_of_three_rows_are_read(reader: str, scene: Path) -> None:
    config = READERS[reader](Path(shutil.copytree(scene, scene.with_name("as-it-was"))))
    expected = read(config).cameras.camera_to_worlds
    config = READERS[reader](scene)

    def edit(meta: dict[str, Any]) -> None:
        for frame in meta["frames"]:
            frame |= {"mask_path": None, "transform_matrix": frame["transform_matrix"][:3]}

    rewrite(scene, edit)
    for path in [*scene.glob("*.json"), *scene.glob("dslr/nerfstudio/*.json")]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    outputs = read(config)
    assert torch.equal(outputs.cameras.camera_to_worlds, expected)
    assert outputs.mask_filenames is None


def test_a_field_of_view_of_a_frame_goes_with_the_size_of_its_picture(scene: Path) -> None:
    config = as_blender(scene)

    def edit(meta: dict[str, Any]) -> None:
        for name in ("w", "h", "fl_x", "fl_y", "cx", "cy"):
            del meta[name]
        meta["frames"][1] |= {"camera_angle_x": np.pi / 2}
        meta["frames"][2] |= {"y_fov": 60.0, "x_fov": 90.0}

    rewrite(scene, edit)
    cameras = read(config).cameras
    assert cameras.fx[:3, 0].tolist() == pytest.approx([32.0, 16.0, 16.0])
    assert cameras.fy[:3, 0].tolist() == pytest.approx([32.0, 16.0, 16.0 * 3**0.5])


@pytest.mark.filterwarnings("ignore:Starting with ImageIO:DeprecationWarning")
@pytest.mark.parametrize("of_scene", [True, False])
def test_instant_ngp_has_the_size_of_each_frame(of_scene: bool, scene: Path) -> None:
    small = scene / "images" / "001.png"
    with Image.open(small) as image:
        image.resize((16, 16)).save(small)

    def edit(meta: dict[str, Any]) -> None:
        whole = {name: meta.pop(name) for name in ("w", "h", "fl_x", "fl_y")}
        del meta["cx"], meta["cy"]
        meta |= whole if of_scene else {"camera_angle_x": 0.9}
        for number, frame in enumerate(meta["frames"]):
            frame |= {name: value / (1 + (number == 1)) for name, value in whole.items()}

    change(scene, edit)
    cameras = read(InstantNGPDataParserConfig(data=scene)).cameras
    for name in ("fx", "fy", "width", "height"):
        assert getattr(cameras, name)[:3, 0].tolist() == [32, 16, 32]
    assert cameras.cx[:3, 0].tolist() == cameras.cy[:3, 0].tolist() == [16, 8, 16]


@pytest.mark.parametrize("reader", ["leco-photographs", "nerfstudio-data", "colmap"])
def test_transparency_is_the_same_in_all_splits(reader: str, scene: Path) -> None:
    config = READERS[reader](scene)
    held_out = {path.name for path in read(config, "val").image_filenames}
    for name in held_out:
        with Image.open(scene / "images" / name) as image:
            image.convert("RGBA").save(scene / "images" / name)
    parser = read_checked(config.setup())
    parser.get_dataparser_outputs("train")
    with refused(r"of the split val has transparency.*of train has none"):
        parser.get_dataparser_outputs("val")


def test_a_circle_of_a_frame_is_read(scene: Path) -> None:
    def edit(meta: dict[str, Any]) -> None:
        for number, frame in enumerate(meta["frames"]):
            if number % 2:
                frame |= {"camera_model": "OPENCV_FISHEYE", "fisheye_crop_radius": 9}

    change(scene, edit)
    for reader in ("leco-photographs", "instant-ngp-data"):
        assert read(READERS[reader](scene)).cameras.metadata["fisheye_crop_radius"] == 9.0


def test_a_frame_has_its_lens_and_mask_however_accents_of_its_name_are_stored(scene: Path) -> None:
    def edit(meta: dict[str, Any]) -> None:
        (scene / "masks").mkdir()
        for split in ("train", "val", "test"):
            del meta[f"{split}_filenames"]
        for number, frame in enumerate(meta["frames"]):
            mask = f"masks/é{number}"
            Image.new("L", (32, 32), 255).save(scene / normalize("NFD", f"{mask}.png"))
            name = f"images/ö{number}.png"
            (scene / frame["file_path"]).rename(scene / normalize("NFD", name))
            frame |= {"file_path": name, "mask_path": mask, "fl_x": 20.0 + number}
            frame |= {"camera_model": "OPENCV_FISHEYE" if number % 3 else "OPENCV"}

    frames = change(scene, edit)["frames"]
    outputs = read(READERS["leco-photographs"](scene))
    for path, kind in zip(outputs.image_filenames, outputs.cameras.camera_type.flatten()):
        number = int(path.stem[-1])
        assert kind == (CameraType.FISHEYE if number % 3 else CameraType.PERSPECTIVE).value
    assert read_scene(scene).mask(frames[2]["mask_path"]).is_file()


@pytest.mark.parametrize(
    ("typed", "wanted"),
    [
        ("ns-train leco-ngp --data X", "`ns-train leco-ngp --data SCENE colmap --colmap-path"),
        ("ns-train --help", "`ns-train leco-occupancy --data SCENE colmap --colmap-path"),
        ("python", "`ns-train leco-occupancy --data SCENE colmap --colmap-path"),
        (
            "leco swap nerfacto --codes own -- --data X",
            "`leco swap nerfacto --codes own -- --data SCENE colmap --colmap-path",
        ),
        ("leco capacity --data X", "`leco poses SCENE/images --out"),
        ("ns-eval --load-config X", "`leco poses SCENE/images --out"),
    ],
)
def test_a_remedy_is_a_command_of_the_one_that_was_typed(
    typed: str, wanted: str, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    as_colmap(scene)
    (scene / "transforms.json").unlink()
    program, *arguments = typed.split()
    monkeypatch.setattr("sys.argv", [f"/somewhere/bin/{program}", *arguments])
    for config in (LecoPhotographsDataParserConfig, NerfstudioDataParserConfig):
        with refused(r"holds no transforms\.json; ") as caught:
            read(config(data=scene))
        assert wanted.replace("SCENE", str(scene)) in str(caught.value)


def test_pictures_of_colmap_elsewhere_are_named(scene: Path) -> None:
    as_colmap(scene)
    (scene / "transforms.json").unlink()
    (scene / "images").rename(scene / "input")
    assert "colmap --colmap-path sparse/0 --images-path input` reads" in str(remedy_for(scene))


@pytest.mark.parametrize("left", [None, b"", b"# 3D point list\n", b"1 0 0 0 9 9 9 0.5\n"])
def test_a_model_of_colmap_may_have_no_points(left: bytes | None, scene: Path) -> None:
    config = as_colmap(scene)
    file = scene / "sparse/0/points3D.txt"
    file.unlink() if left is None else file.write_bytes(left)
    outputs = read(config)
    assert len(outputs.image_filenames) == 7
    assert (POINTS in outputs.metadata) == bool(left and left[:1] == b"1")
    (scene / "sparse/0/points3D.bin").write_bytes(bytes(8))
    assert POINTS not in read(config).metadata
    for cut_off in (bytes(3), bytes([5, *bytes(7)])):  # after the number of its points
        (scene / "sparse/0/points3D.bin").write_bytes(cut_off)
        with refused(r"mend .*sparse/0$"):
            read(config)


@pytest.mark.parametrize(
    ("listed", "message"),
    [
        (["images/001.png", "002.png"], "train_filenames has 002.png, and no frame has: write"),
        ("images/001.png", "train_filenames is no list of names"),
        ([1], "train_filenames is no list of names"),
    ],
)
def test_a_list_that_names_no_frame_is_said(listed: Any, message: str, scene: Path) -> None:
    change(scene, lambda meta: meta.update(train_filenames=listed))
    for config in (LecoPhotographsDataParserConfig, NerfstudioDataParserConfig):
        with refused(message):
            read(config(data=scene))


@pytest.mark.parametrize(
    ("option", "value", "wanted"),
    [
        ("downscale_factor", 0, "1 or more"),
        ("scale_factor", 0.0, "a positive number"),
        ("scale_factor", -1.0, "a positive number"),
        ("train_split_fraction", 1.5, "from 0 to 1"),
        ("eval_interval", 0, "1 or more"),
    ],
)
def test_an_option_of_a_reader_is_a_size_or_a_share(
    option: str, value: float, wanted: str, scene: Path
) -> None:
    with refused(f"^{option} is {value}; it must be {wanted}$"):
        read(LecoPhotographsDataParserConfig(data=scene, **{option: value}))


def test_what_git_lfs_has_not_fetched_is_named(scene: Path) -> None:
    config, pointer = as_colmap(scene), "version https://git-lfs.github.com/spec/v1\n"
    for name in ("transforms.json", "images/003.png", "sparse/0/points3D.bin"):
        (scene / name).write_text(pointer)
        with refused(f"{name} is a pointer of Git LFS: `git lfs pull` fetches"):
            read(LecoPhotographsDataParserConfig(data=scene) if "json" in name else config)
        (scene / name).unlink()


def test_what_colmap_lacks_has_its_own_remedy(scene: Path) -> None:
    config = as_colmap(scene)
    (scene / "images").rename(scene / "input")
    with refused(r"images/000\.png; name the folder .*--images-path"):
        read(config)
    (scene / "input").rename(scene / "images")
    (scene / "train_list.txt").write_text("000.png\n\n")
    with refused("were not found.*; in its _list.txt, .* leave no line empty"):
        read(config)
    (scene / "train_list.txt").rename(scene / "test_list.txt")
    with refused("each of train_list.txt, val_list.txt and test_list.txt in "):
        read(config)
    (scene / "test_list.txt").unlink()
    (scene / "images/000.png").rename(scene / "images/000.PNG")
    with refused(r"images/000\.png; there is 000\.PNG, write its name like that"):
        read(config)
    (scene / "images/000.PNG").rename(scene / "images/000.png")
    of_images = scene / "sparse/0/images.txt"
    of_images.write_text("".join(of_images.read_text().splitlines(keepends=True)[:2]))
    with refused("; add photographs: a scene is seen from two places"):
        read(config)


@pytest.mark.parametrize("ending", [".png", ".JPG"])
def test_an_ending_that_the_reader_adds_is_to_be_left_off(ending: str, scene: Path) -> None:
    config = as_blender(scene)
    meta = json.loads((scene / "transforms_train.json").read_text())
    for frame in meta["frames"]:
        frame["file_path"] += ending
    (scene / "transforms_train.json").write_text(json.dumps(meta))
    with refused(rf"000{ending}\.png; blender-data adds \.png .* leave endings off$"):
        read(config)


@pytest.mark.filterwarnings("ignore:Starting with ImageIO:DeprecationWarning")
@pytest.mark.parametrize("kind", [BlenderDataParserConfig, DNeRFDataParserConfig])
def test_times_are_not_used_by_readers_without_them(
    kind: Any, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    as_blender(scene)
    meta = json.loads((scene / "transforms_train.json").read_text())
    for frame in meta["frames"]:
        frame |= {"rotation": 0.0126, "time": 0.5}
    (scene / "transforms_train.json").write_text(json.dumps(meta))
    cameras = read(kind(data=scene)).cameras
    said = " ".join(capsys.readouterr().out.split())
    assert said.endswith("not used: time") == (cameras.times is None) == ("not used" in said)


def test_a_split_without_its_file_is_to_have_a_copy(scene: Path) -> None:
    config = as_blender(scene)
    (scene / "transforms.json").unlink()
    with refused(r"no transforms_val.json; .*copy of transforms_train"):
        read(config, "val")


def test_photographs_as_they_are_stored_have_a_way_to_be_turned(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    with Image.open(scene / "images" / "001.png") as image:
        image.save(scene / "images" / "001.png", exif=exif)
    read(LecoPhotographsDataParserConfig(data=scene))
    said = " ".join(capsys.readouterr().out.split())
    assert "1 photograph is used as it is stored, though EXIF turns it: " in said
    assert "mogrify -auto-orient" in said


def test_a_smaller_picture_that_is_not_there_is_named_by_readers(scene: Path) -> None:
    for kind in (LecoPhotographsDataParserConfig, NerfstudioDataParserConfig):
        for factor in (2, 2.0):  # `ns-render dataset` has floats
            with refused(r"images_2/.*png is not there.*--downscale-factor 1"):
                read(kind(data=scene, downscale_factor=factor))
