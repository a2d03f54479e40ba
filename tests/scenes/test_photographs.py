"""What is wrong with a folder of photographs is said in one line, before anything is loaded."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from PIL import Image
from scene_files import change, refused

from leco_plugin.scenes.coloured_points import coloured_points, read_cloud, read_points
from leco_plugin.scenes.frames import (
    APPLIED_EARLIER,
    METRES_PER_UNIT,
    POINTS,
    data_frame_of,
    inverse,
    moved,
    parsed_frame,
    units_of,
)
from leco_plugin.scenes.photographs import (
    LecoPhotographsDataParserConfig,
    describe_scene,
    read_scene,
    taken_from_above,
)
from leco_plugin.scenes.poses.georeference import write_sparse_points
from leco_plugin.scenes.poses.points import find_points
from leco_plugin.scenes.reading import with_checks
from leco_plugin.scenes.whole_files import write_points

LISTS = ("train_filenames", "val_filenames", "test_filenames")


def set_pose(value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda meta: meta["frames"][1].update(transform_matrix=value)


def stand_still(meta: dict[str, Any], rounded_by: float = 0.0) -> None:
    for number, frame in enumerate(meta["frames"]):
        for row in frame["transform_matrix"][:3]:
            row[3] = 0.5 + number * rounded_by


def repeat(meta: dict[str, Any]) -> None:
    """A photograph under another spelling, with the pose of another one."""
    meta["frames"].append(meta["frames"][1] | {"file_path": "./images/000.png"})


def transpose(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        frame["transform_matrix"] = [*map(list, zip(*frame["transform_matrix"]))]


def add_masks(scene: Path, values: list[int]) -> None:
    """Gives each image a mask of one value, of its size."""
    (scene / "masks").mkdir()

    def add(meta: dict[str, Any]) -> None:
        for number, (frame, value) in enumerate(zip(meta["frames"], values)):
            with Image.open(scene / frame["file_path"]) as image:
                Image.new("L", image.size, value).save(scene / "masks" / f"{number}.png")
            frame["mask_path"] = f"masks/{number}.png"

    change(scene, add)


def shrink(scene: Path, name: str) -> None:
    """Halves an image, and gives each frame intrinsics of its own."""
    Image.new("RGB", (16, 16)).save(scene / "images" / name)

    def give(meta: dict[str, Any]) -> None:
        own = {key: meta.pop(key) for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
        for frame in meta["frames"]:
            half = 2 if frame["file_path"].endswith(name) else 1
            frame |= {key: value // half for key, value in own.items()}

    change(scene, give)


def outputs_of(scene: Path, split: str = "train") -> Any:
    return LecoPhotographsDataParserConfig(data=scene).setup().get_dataparser_outputs(split)


BAD_MEASURES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no such folder": (shutil.rmtree, "there is no folder"),
    "no transforms.json": (lambda s: (s / "transforms.json").unlink(), "holds no transforms.json"),
    "transforms.json is no json": (
        lambda s: (s / "transforms.json").write_text("{\n\n"),
        "not a scene in nerfstudio's format.*mend it, or make it anew .* with leco poses",
    ),
    "transforms.json is no mapping": (
        lambda s: (s / "transforms.json").write_text("[]"),
        "not a scene in nerfstudio's format",
    ),
    "transforms.json is no text": (
        lambda s: (s / "transforms.json").write_bytes(b"\xff\xfe\x00"),
        "not a scene in nerfstudio's format",
    ),
    "zero frames": (lambda s: change(s, lambda m: m.update(frames=[])), "no cameras.*leco poses"),
    "no frames": (lambda s: change(s, lambda m: m.pop("frames")), "not a scene in nerf"),
    "a frame without a pose": (
        lambda s: change(s, lambda m: m["frames"][0].pop("transform_matrix")),
        "not a scene in nerfstudio's format",
    ),
    "a missing image": (
        lambda s: (s / "images" / "003.png").unlink(),
        "1 of 9 images is not there, the first is .*003.png",
    ),
    "an image that is none": (
        lambda s: (s / "images" / "003.png").write_bytes(b"nothing"),
        "003.png cannot be read as an image",
    ),
    "an image of another size": (
        lambda s: Image.new("RGB", (16, 31)).save(s / "images" / "003.png"),
        "003.png has 16 x 31 pixels, its intrinsics are for 32 x 32: put photographs of that size",
    ),
    "no image size": (lambda s: change(s, lambda m: m.pop("w")), "000.png has no w"),
    "no principal point": (lambda s: change(s, lambda m: m.pop("cx")), "000.png has no cx"),
    "a pose of another shape": (lambda s: change(s, set_pose([[1.0]])), "transforms.json"),
    "one image": (
        lambda s: change(s, lambda m: m.update(frames=m["frames"][:1])),
        "has one image: add photographs from two places",
    ),
    "a panorama": (lambda s: change(s, stand_still), "has 9 images from one place"),
    "a panorama but for rounding": (
        lambda s: change(s, lambda m: stand_still(m, 1e-15)),
        "has 9 images from one place",
    ),
    "a photograph twice, by two spellings": (
        lambda s: change(s, repeat),
        "images/000.png is given twice, and differs",
    ),
    "poses by columns": (lambda s: change(s, transpose), "000.png has its place in the last row"),
    "masks for some images": (
        lambda s: (add_masks(s, [255] * 9), change(s, lambda m: m["frames"][0].pop("mask_path"))),
        "8 of 9 images have a mask_path",
    ),
    "a mask that is none": (
        lambda s: (add_masks(s, [255] * 9), (s / "masks" / "3.png").write_bytes(b"nothing")),
        "3.png cannot be read as an image",
    ),
    "an empty mask among images of many sizes": (
        lambda s: (shrink(s, "001.png"), add_masks(s, [255] * 3 + [0] + [255] * 5)),
        "the mask .*3.png leaves no pixel",
    ),
    "poses of words": (lambda s: change(s, set_pose("north")), "not a scene in nerfstudio"),
}


@pytest.mark.parametrize("name", BAD_MEASURES)
def test_bad_input_gets_one_line(name: str, scene: Path) -> None:
    spoil, message = BAD_MEASURES[name]
    spoil(scene)
    with refused(message):
        outputs_of(scene)


def test_one_empty_mask_among_images_of_one_size_is_no_error(scene: Path) -> None:
    add_masks(scene, [255, 0, *[255] * 7])
    outputs_of(scene)


def test_a_sound_scene_passes_as_a_folder_and_as_a_file(scene: Path) -> None:
    assert len(read_scene(scene).meta["frames"]) == 9
    assert read_scene(scene / "transforms.json").meta == read_scene(scene).meta


IN_MILLIMETRES = (1e-3 * np.eye(3, 4)).tolist()
APPLIED = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.2], [0.0, -1.0, 0.0, 0.0]]
FOUR_ROWS = [*APPLIED, [0.0, 0.0, 0.0, 1.0]]


def earlier(scene: Path) -> None:
    """As ns-process-data left scenes before it wrote down what it had applied."""
    (scene / "colmap/sparse/0").mkdir(parents=True)


@pytest.mark.parametrize(
    "process",
    [
        lambda scene: None,
        lambda scene: change(scene, lambda m: m.update(applied_transform=APPLIED)),
        lambda scene: change(scene, lambda m: m.update(applied_scale=2.5)),
        lambda scene: change(scene, lambda m: m.update(applied_transform=IN_MILLIMETRES)),
        earlier,
    ],
    ids=["as it was", "transformed", "scaled", "in millimetres", "transformed and not said"],
)
def test_sparse_points_follow_the_cameras_into_model_coordinates(
    scene: Path, process: Callable[[Path], None]
) -> None:
    """A point at each camera's position lies at that camera's position after parsing, by whatever
    reader of the format: a host of any data manager learns its occupancy with these points."""
    meta = read_scene(scene).meta
    places = np.array([frame["transform_matrix"] for frame in meta["frames"]])[:, :3, 3]
    trimesh.PointCloud(places).export(scene / "points.ply")
    change(scene, lambda m: m.update(ply_file_path="points.ply"))
    process(scene)
    stock: Any = with_checks(NerfstudioDataParserConfig(data=scene)).setup()
    for outputs in (outputs_of(scene), stock.get_dataparser_outputs()):
        distances = torch.cdist(outputs.cameras.camera_to_worlds[:, :, 3], outputs.metadata[POINTS])
        assert len(outputs.metadata[POINTS]) == 9
        assert float(distances.amin(dim=1).max()) < 1e-5


@pytest.mark.parametrize(
    "process",
    [earlier, lambda scene: change(scene, lambda m: m.update(applied_transform=FOUR_ROWS))],
    ids=["transformed and not said", "four rows"],
)
def test_a_scene_has_one_frame_by_its_folder_and_by_its_file(
    scene: Path, process: Callable[[Path], object]
) -> None:
    process(scene)
    frames = [
        parsed_frame(with_checks(config(data=data)).setup().get_dataparser_outputs())
        for data in (scene, scene / "transforms.json")
        for config in (LecoPhotographsDataParserConfig, NerfstudioDataParserConfig)
    ]
    turn = torch.tensor(APPLIED_EARLIER if process is earlier else FOUR_ROWS)[:3, :3]
    for frame in frames:
        torch.testing.assert_close(frame, frames[0])
        torch.testing.assert_close(frame[:, :3] / frame[:, :3].det() ** (1 / 3), turn.double())


def test_a_held_out_stretch_leaves_the_way_back_to_the_file_as_it_is(scene: Path) -> None:
    def add(meta: dict[str, Any]) -> None:
        for number, frame in enumerate(meta["frames"][:3]):
            name = f"images/more{number}{Path(frame['file_path']).suffix}"
            shutil.copyfile(scene / frame["file_path"], scene / name)
            moved_on = np.array(frame["transform_matrix"]) + 0.5 * np.eye(4, 4, 3)
            meta["frames"].append({"file_path": name, "transform_matrix": moved_on.tolist()})

    change(scene, add)
    earlier(scene)
    config = LecoPhotographsDataParserConfig(data=scene, held_out="stretch")
    outputs = config.setup().get_dataparser_outputs("train")
    frame = data_frame_of(SimpleNamespace(train_dataparser_outputs=outputs))
    back = inverse(torch.tensor(frame, dtype=torch.float64))
    found = moved(outputs.cameras.camera_to_worlds[:, :, 3].double(), back).numpy()
    frames = read_scene(scene).meta["frames"]
    places = {Path(one["file_path"]).name: one["transform_matrix"] for one in frames}
    for path, place in zip(outputs.image_filenames, found):
        np.testing.assert_allclose(place, np.array(places[path.name])[:3, 3], atol=1e-4)


@pytest.mark.parametrize(
    "applied",
    [
        {"applied_transform": np.zeros((3, 4)).tolist()},
        {"applied_transform": [[1.0, 0.0], [0.0, 1.0]]},
        {"applied_transform": [[1.0, 0.0, 0.0, float("nan")], *np.eye(3, 4).tolist()[1:]]},
        {"applied_scale": 0.0},
    ],
    ids=["flat", "too small", "no number", "no scale"],
)
def test_an_applied_transform_that_cannot_be_undone_is_said_in_a_line(
    scene: Path, applied: dict[str, Any]
) -> None:
    trimesh.PointCloud(np.eye(3)).export(scene / "points.ply")
    change(scene, lambda m: m.update(ply_file_path="points.ply", **applied))
    with refused("cannot be read"):
        outputs_of(scene)


def test_a_file_that_holds_no_points_is_named(scene: Path) -> None:
    (scene / "points.ply").write_bytes(b"ply\nnothing of use\n")
    with refused(r"points\.ply cannot be read as sparse points"):
        read_points({"ply_file_path": "points.ply"}, scene)


def test_a_file_that_is_cut_off_between_two_points_is_named(scene: Path) -> None:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    head = f"ply\nformat ascii 1.0\nelement vertex 3\n{axes}end_header\n"
    (scene / "cut.ply").write_text(head + "0 1 2\n" * 2)
    with refused(r"cut\.ply cannot be read .* \(2 of its 3 points .* put a whole \.ply there"):
        read_cloud(scene / "cut.ply")


def test_a_scene_without_points_has_none_and_missing_ones_are_said(
    scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert read_points({}, scene) is None and not capsys.readouterr().out
    assert read_points({"ply_file_path": "[of]/nowhere.ply"}, scene) is None
    said = capsys.readouterr().out
    assert "names sparse points that are not there" in " ".join(said.split())
    assert "[of]/nowhere.ply" in "".join(said.split())  # wherever the line was broken


@pytest.mark.parametrize("format", ["ascii", "binary_little_endian"])
def test_a_file_with_no_points_is_a_scene_without_them(
    format: str, scene: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    text = f"ply\nformat {format} 1.0\nelement vertex 0\n{axes}end_header\n"
    (scene / "none.ply").write_text(text)
    assert read_points({"ply_file_path": "none.ply"}, scene) is None
    assert "points; `leco points` finds some" in " ".join(capsys.readouterr().out.split())


def test_a_mesh_gives_all_its_vertices_and_their_colours(scene: Path) -> None:
    positions, colours = (
        np.random.default_rng(0).random((5, 3)),
        np.arange(15, dtype=np.uint8).reshape(5, 3),
    )
    mesh = trimesh.Trimesh(positions, [[0, 1, 2]], vertex_colors=colours, process=False)
    mesh.export(scene / "mesh.ply")
    found = read_cloud(scene / "mesh.ply")
    np.testing.assert_allclose(found.positions, positions, atol=1e-6)
    np.testing.assert_array_equal(found.colours, colours)


@pytest.mark.parametrize(
    "name", ["applied_transform", "k1", "camera_model", "orientation_override"]
)
def test_nulls_of_a_scene_are_as_if_they_were_not_there(name: str, scene: Path) -> None:
    expected = outputs_of(scene)
    change(scene, lambda meta: meta.update({name: None}))
    found = outputs_of(scene)
    assert found.image_filenames == expected.image_filenames
    assert torch.equal(found.cameras.camera_to_worlds, expected.cameras.camera_to_worlds)
    change(scene, lambda meta: meta.update(dict.fromkeys(LISTS)))
    assert len(outputs_of(scene).image_filenames) > 0


def test_lists_that_leave_nothing_say_what_to_do(scene: Path) -> None:
    change(scene, lambda meta: meta.update(train_filenames=[]))
    with refused("no image is left .*: list some in train_filenames, or remove it"):
        outputs_of(scene)
    meta = change(scene, lambda meta: meta.update(dict.fromkeys(LISTS)))
    some = [frame["file_path"] for frame in meta["frames"][:5]]
    for given, lacks in (("train_filenames", "val"), ("test_filenames", "train")):
        lists = dict.fromkeys(LISTS) | {given: some}
        change(scene, lambda meta, lists=lists: meta.update(lists))
        with refused("in each of train_filenames, val_filenames and test_filenames, or remove"):
            outputs_of(scene, lacks)


def test_only_cameras_that_look_down_are_above() -> None:
    down = np.tile(np.eye(4), (8, 1, 1))  # a camera looks along its -z
    across = down.copy()
    across[:, :3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    assert taken_from_above(down)
    assert not taken_from_above(across)


def test_a_scene_may_say_how_many_metres_a_unit_of_its_poses_is(scene: Path) -> None:
    assert METRES_PER_UNIT not in outputs_of(scene).metadata
    change(scene, lambda meta: meta.update(metres_per_unit=2))
    assert outputs_of(scene).metadata[METRES_PER_UNIT] == 2.0
    change(scene, lambda meta: meta.update(metres_per_unit=None))  # as if it were not there
    assert METRES_PER_UNIT not in outputs_of(scene).metadata
    for wrong in (0, -1.0, "one", []):
        change(scene, lambda meta, wrong=wrong: meta.update(metres_per_unit=wrong))
        with refused("metres_per_unit"):
            outputs_of(scene)


def test_units_are_those_of_the_poses_whatever_scale_was_applied_to_these(scene: Path) -> None:
    def found(by_hand: float | None = None, **said: float) -> Any:
        change(scene, lambda meta: meta.update(metres_per_unit=None) or meta.update(said))
        return units_of(SimpleNamespace(train_dataparser_outputs=outputs_of(scene)), by_hand)

    bare, metric = found(), found(metres_per_unit=3.0)
    assert metric.per_scene_unit == pytest.approx(3.0 * bare.per_scene_unit)
    assert found(applied_scale=4.0) == bare
    assert found(applied_scale=4.0, metres_per_unit=3.0) == metric
    assert found(by_hand=3.0, applied_scale=4.0) == metric


def test_scenes_are_told_apart_by_what_is_in_them(tiny_scene: Path, tmp_path: Path) -> None:
    seen = describe_scene(tiny_scene)
    assert seen == describe_scene(tiny_scene / "transforms.json")
    assert seen["name"] == tiny_scene.name and seen["images"] == 9
    moved = tmp_path / tiny_scene.name
    moved.mkdir()
    (moved / "images").symlink_to(tiny_scene / "images")
    text = (tiny_scene / "transforms.json").read_text()
    (moved / "transforms.json").write_text(text.replace('"fl_x": 32.0', '"fl_x": 33.0'))
    assert describe_scene(moved)["digest"] != seen["digest"]


def test_splatfacto_starts_from_the_sparse_points_and_their_colours(scene: Path) -> None:
    """In its own data manager, in the model's coordinates; open3d is not asked."""
    from nerfstudio.configs.method_configs import method_configs

    xyz = np.random.default_rng(0).normal(size=(40, 3))
    write_points(scene / "points.ply", xyz, np.full((40, 3), (250, 128, 3), np.uint8))
    change(scene, lambda meta: meta.update(ply_file_path="points.ply"))
    config = replace(
        method_configs["splatfacto"].pipeline.datamanager,
        dataparser=LecoPhotographsDataParserConfig(data=scene, load_3D_points=True),
        cache_images="gpu",  # which is where the model is: on the CPU here
    )
    manager: Any = config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)
    outputs = manager.train_dataparser_outputs
    places, colours = (outputs.metadata[f"points3D_{name}"] for name in ("xyz", "rgb"))
    expected = moved(torch.from_numpy(xyz), parsed_frame(outputs).double())
    assert torch.allclose(places, expected.float(), atol=1e-5)
    assert colours.dtype == torch.uint8 and colours.tolist() == [[250, 128, 3]] * 40
    assert manager.next_train(0)[1]["image"].shape == (32, 32, 3)


def test_coloured_points_are_found_under_a_name_as_windows_writes_it(scene: Path) -> None:
    (scene / "sparse").mkdir()
    places = np.random.default_rng(0).random((40, 3))
    write_sparse_points(scene / "sparse" / "points.ply", places, np.full((40, 3), 9, np.uint8))
    change(scene, lambda meta: meta.update(ply_file_path="sparse\\points.ply"))
    found = coloured_points(scene / "transforms.json")
    assert found is not None and len(found.positions) == 40
    report = find_points(scene)
    assert not report["done"] and Path(report["file"]).is_file()
