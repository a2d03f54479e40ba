"""Exports with a scene at hand: colours of sparse points, a start for splats, a dense volume."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from ball_occupancy import CENTRE, HALF, RADIUS, WALLS, ball
from scene_files import change, described, refused
from scipy.spatial.transform import Rotation

from leco_plugin import cli
from leco_plugin.chart.theme import new_figure, save_picture
from leco_plugin.evaluation import inspection
from leco_plugin.evaluation.occupancy_picture import draw
from leco_plugin.export import export, export_folder, in_words
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.city.cameras import look_at
from leco_plugin.scenes.coloured_points import description_of_run
from leco_plugin.scenes.frames import APPLIED_EARLIER
from leco_plugin.scenes.whole_files import write_points
from leco_plugin.space import Space

ORIGIN = {"latitude": 42.0, "longitude": -76.0, "altitude": 0.0, "axes": "east, north, up"}
FRAME = [[0.5, 0.0, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.0]]
"""The run has half the size of the data."""


def raises(error: OSError) -> Callable[..., None]:
    def refuse(*_: Any, **__: Any) -> None:
        raise error

    return refuse


@pytest.fixture
def file(tmp_path: Path) -> Path:
    known = ball()
    report = known.report | {"data_frame": FRAME}
    Occupancy(known.gate, known.space, known.threshold, report=report).save(tmp_path / "o.st")
    return tmp_path / "o.st"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Red points west of the ball's middle, blue ones east of it, and one far from the ball."""
    folder = tmp_path / "scene"
    generator = np.random.default_rng(0)
    offsets = generator.normal(size=(500, 3))
    offsets *= 0.9 * RADIUS / np.linalg.norm(offsets, axis=1, keepdims=True)
    places = 2.0 * (np.array(CENTRE) + offsets)
    places = np.concatenate([places, [[500.0] * 3]]).astype(np.float32)
    colours = np.where(offsets[:, :1] < 0.0, (255, 0, 0), (0, 0, 255)).astype(np.uint8)
    write_points(folder / "points.ply", places, np.pad(colours, ((0, 1), (0, 0))))
    meta: dict[str, Any] = {"ply_file_path": "points.ply", "fl_x": 10.0}
    meta |= {"geographic_origin": ORIGIN, "metres_per_unit": 1.0}
    meta |= {"train_filenames": ["images/a.png"]}
    meta["frames"] = []
    for name, place in zip("abc", np.array(ball().report["cameras"])):
        pose = np.eye(4)
        pose[:3, 3] = 2.0 * place
        meta["frames"] += [{"file_path": f"images/{name}.png", "transform_matrix": pose.tolist()}]
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def test_points_have_photograph_colours_and_say_where_on_earth_they_lie(
    file: Path, scene: Path, tmp_path: Path
) -> None:
    facts = export(file, "ply", tmp_path / "k.ply", 32, data=scene)
    assert facts["photograph_colours"] and facts["geographic_origin"] == ORIGIN
    assert b"comment geographic_origin" in (tmp_path / "k.ply").read_bytes()[:300]
    cloud = trimesh.load(tmp_path / "k.ply")
    offsets = np.asarray(cloud.vertices) - 2.0 * np.array(CENTRE)
    clear = np.abs(offsets[:, 0]) > 0.5 * RADIUS
    red = cloud.colors[clear, 0] > cloud.colors[clear, 2]
    assert (red == (offsets[clear, 0] < 0.0)).mean() > 0.98
    assert not export(file, "ply", tmp_path / "k.ply", 32)["photograph_colours"]


@pytest.mark.parametrize("frame", ["data", "run"])
def test_only_what_two_photographs_show_is_exported_whatever_the_frame(
    frame: Any, tmp_path: Path
) -> None:
    """Two cameras look at the east of the ball from above, one by a lens of its own; the run has
    the data turned, halved and moved."""
    known = ball()
    turn = Rotation.from_euler("zx", [70.0, 25.0], degrees=True).as_matrix()
    shift = np.array([0.3, -0.2, 0.1])
    aim = np.array(CENTRE) + RADIUS * np.array([0.8, 0.0, 0.6])
    eyes = aim + np.array([[2.0, 0.0, 2.0], [1.0, 0.5, 2.0]])
    report = known.report | {"cameras": eyes.tolist()}
    report["data_frame"] = np.column_stack([0.5 * turn, shift]).tolist()
    Occupancy(known.gate, known.space, known.threshold, report=report).save(tmp_path / "o.st")
    frames = []
    for eye in eyes:
        pose = look_at(eye, aim)
        pose = np.column_stack([turn.T @ pose[:, :3], turn.T @ (pose[:, 3] - shift) / 0.5])
        frames.append({"file_path": "a.png", "transform_matrix": [*pose.tolist(), [0, 0, 0, 1]]})
    frames[0]["fl_x"] = 500.0
    meta = {
        "w": 100,
        "h": 100,
        "fl_x": 5.0,  # which sees all of the ball
        "cx": 50.0,
        "cy": 50.0,
        "frames": frames,
    }
    (tmp_path / "transforms.json").write_text(json.dumps(meta))
    options: Any = {"resolution": 48, "frame": frame}
    export(tmp_path / "o.st", "ply", tmp_path / "all.ply", **options)
    export(tmp_path / "o.st", "ply", tmp_path / "some.ply", data=tmp_path, **options)
    files = (tmp_path / "all.ply", tmp_path / "some.ply")
    every, some = (np.asarray(trimesh.load(file).vertices) for file in files)
    if frame == "data":
        every, some = (0.5 * part @ turn.T + shift for part in (every, some))
    near = np.linalg.norm(every - aim, axis=1) < 0.2
    assert 5 < near.sum() < 0.3 * len(every)
    far = np.linalg.norm(some - aim, axis=1)
    assert len(some) >= near.sum() and far.max() < 0.6


def test_a_start_for_splats_is_a_copy_of_the_scene_with_kept_points(
    file: Path, scene: Path, tmp_path: Path
) -> None:
    out = scene / "splats.json"
    facts = export(file, "splat-init", out, 32, data=scene)
    made, known = json.loads(out.read_text()), described(scene)
    assert made == known | {"ply_file_path": "splats.ply"}
    points = np.asarray(trimesh.load(scene / "splats.ply").vertices)
    assert facts["points"] == len(points) > facts["sparse_points"] > 400
    assert np.linalg.norm(points - 2.0 * np.array(CENTRE), axis=1).max() < 2.6 * RADIUS
    export(file, "splat-init", tmp_path / "else" / "t.json", 32, data=scene)
    made = json.loads((tmp_path / "else" / "t.json").read_text())
    photograph = "../scene/images/a.png"
    assert made["frames"][0]["file_path"] == made["train_filenames"][0] == photograph


def test_a_volume_is_what_the_occupancy_says_in_its_box(tmp_path: Path) -> None:
    """Walls cut it to three sides of different lengths, and leave the ball aside of its middle."""
    known, far = ball(), 1e6
    walls = torch.tensor([-0.25, -far, -0.75, far, far, 2.0])
    report = {"data_frame": FRAME}
    made = Occupancy(known.gate, known.space, known.threshold, report=report, walls=walls)
    made.save(tmp_path / "o.st")
    facts = export(tmp_path / "o.st", "npz", tmp_path / "v.npz", 32)
    assert facts["shape"] == [26, 32, 22]  # of 3.25, 4 and 2.75
    with np.load(tmp_path / "v.npz") as volume:
        assert list(volume["o"].shape) == facts["shape"] and volume["seen"].all()
        assert np.array_equal(volume["kept"], volume["o"] >= volume["threshold"])
        assert np.allclose(volume["to_data"], 2.0 * np.eye(3, 4))
        shares = (np.argwhere(volume["kept"]).mean(axis=0) + 0.5) / volume["o"].shape
        middle = volume["low"] + shares * (volume["high"] - volume["low"])
    assert np.abs(middle - np.array(CENTRE)).max() < 0.1


def test_what_does_not_go_together_is_refused_in_one_line_before_the_gate_is_asked(
    file: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = scene / "transforms.json"
    monkeypatch.setattr("leco_plugin.export.kept_surface", lambda *_: pytest.fail("asked"))
    for options, said in (
        (("splat-init", own, 24, None, None, scene), "^--out .*s.json is a file that"),
        (
            ("ply", scene / "points.ply", 24, None, None, scene),
            "^--out .*points.ply is a file that",
        ),
        (
            ("splat-init", scene / "points.json", 24, None, None, scene),
            "^the points of --out",
        ),
        (("splat-init", tmp_path / "t.ply", 24, None, None, scene), "end it so"),
        (("splat-init", tmp_path / "t.json", 24), "give --data"),
        (("splat-init", tmp_path / "t.json", 24, None, "run", scene), "lies in the data"),
        (("npz", tmp_path / "v.npz", 1), "at least 2 cells"),
        (("npz", tmp_path / "v.npz", 24, None, None, scene), "nothing of the scene"),
        (("ply", tmp_path / "k.ply", 24, None, None, tmp_path), "no transforms.json"),
    ):
        with pytest.raises(ValueError, match=said) as error:
            export(file, *options)
        assert "\n" not in str(error.value)
    assert len(trimesh.load(scene / "points.ply").vertices) == 501


def test_a_folder_has_everything_and_says_what_each_part_is_for(
    file: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "new" / "all"
    asked: list[str] = []

    def noted(said: str) -> nullcontext[Callable[[float], None]]:
        asked.append(said)
        return nullcontext(lambda share: None)

    for room in ("export", "log"):
        monkeypatch.setattr(f"leco_plugin.{room}.bar", noted)
    parts, doubted = export_folder(file, folder, 32, scene)
    # the pictures, the surface once, for points and splats, and the volume
    gate = "Asking the gate about cells of 1/32"
    assert asked == ["Drawing pictures", gate, "Looking along rays", gate]
    names = ["occupancy.png", "occupancy.html", "kept.ply", "splats.json", "volume.npz"]
    assert [part.name for part in parts if part.facts] == names and not doubted
    assert {path.name for path in folder.iterdir()} == {*names, "splats.ply"}
    said = "\n".join(in_words(folder, parts, doubted))
    for words in ("colours: of the sparse points", "origin on earth", "leco-photographs"):
        assert words in said
    assert "not written" not in said
    points, splats = (dict(part.facts or {}) for part in parts if part.name[:4] in ("kept", "spla"))
    assert said.count(f" {points['points']:,} points on the surface of what is kept") == 2
    assert points["points"] + splats["sparse_points"] == splats["points"]
    assert f" and {splats['sparse_points']:,} sparse points that are kept, in splats.ply" in said


@pytest.mark.parametrize("format", [None, "ply"])
def test_the_command_takes_colours_from_the_scene_that_is_named(
    format: str | None, file: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("draw", "write_page"):  # seconds
        monkeypatch.setattr(f"leco_plugin.export.{name}", lambda *_, **__: None)
    out, report = tmp_path / "out", tmp_path / "out.json"
    asked = ["export", file, "--out", out, "--json", report, "--data", scene, "--resolution", 16]
    asked += [] if format is None else ["--format", format]
    assert cli.main(list(map(str, asked))) == 0
    facts = json.loads(report.read_text())
    points = facts["parts"]["kept.ply"] if format is None else facts
    assert points["photograph_colours"] and points["resolution"] == 16


def test_a_part_that_cannot_be_made_is_one_line_and_the_others_are_written(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("draw", "write_page"):  # seconds, and the test before has drawn
        monkeypatch.setattr(f"leco_plugin.export.{name}", lambda *_, **__: None)
    parts, _ = export_folder(file, tmp_path / "all", 32)
    lines = in_words(tmp_path / "all", parts, [])
    assert len(lines) == 6 and sum("colours: o(x)" in line for line in lines) == 1
    assert lines[-1].startswith("not written: splats.json: ") and "--data" in lines[-1]
    assert not (tmp_path / "all" / "splats.json").exists()
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr("leco_plugin.export.write_ply", raises(full))
    lines = in_words(tmp_path / "all", export_folder(file, tmp_path / "all", 32)[0], [])
    assert (
        "not written: kept.ply: [Errno 28] No space left on device; the older one is left" in lines
    )
    with pytest.raises(ValueError, match="is a file"):
        export_folder(file, file, 32)
    with pytest.raises(ValueError, match="no transforms"):
        export_folder(file, tmp_path / "all", 32, tmp_path)


def test_points_and_volume_of_a_folder_are_as_fine_as_each_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between walls a volume is flat, and has more cells along its sides than a cube."""
    for name in ("draw", "write_page"):  # seconds
        monkeypatch.setattr(f"leco_plugin.export.{name}", lambda *_, **__: None)
    monkeypatch.setattr("leco_plugin.export_surface.CELLS", 16)
    known, unbounded = ball(), Space("contraction", CENTRE, HALF)
    Occupancy(known.gate, unbounded, known.threshold, walls=WALLS).save(tmp_path / "o.st")
    parts, _ = export_folder(tmp_path / "o.st", tmp_path / "all")
    cells = {part.name: part.facts["resolution"] for part in parts[2:] if part.facts}
    alone = export(tmp_path / "o.st", "npz", tmp_path / "v.npz")["resolution"]
    assert cells == {"kept.ply": 16, "volume.npz": alone} and alone == 18


def run_config(file: Path, data: Path) -> None:
    """Writes the config of a run beside its occupancy, as another version of the package did."""
    parts = "".join(f"    - {part}\n" for part in data.parts[1:])
    file.with_name("config.yml").write_text(
        "!!python/object:leco_plugin.trainer_of_old.Config\n"
        "optimizer: !!python/object/apply:os.mkdir\n- executed\n"
        "pipeline: !!python/object:leco_plugin.pipeline_of_old.Config\n"
        "  datamanager: !!python/object:leco_plugin.manager_of_old.Config\n"
        f"    data: !!python/object/apply:pathlib.PosixPath\n    - /\n{parts}"
    )


def test_the_scene_of_a_run_is_known_where_it_lay_or_was_moved_to(
    file: Path, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run_config(file, scene)
    assert description_of_run(file) == scene / "transforms.json"
    assert not (tmp_path / "executed").exists()
    run_config(file, Path("/gone/before") / scene.name)
    assert description_of_run(file) == scene / "transforms.json"
    run_config(file, Path("/gone/before/other"))
    assert description_of_run(file) is None


def test_another_scene_gives_no_colours_and_no_start_for_splats(
    file: Path, scene: Path, tmp_path: Path
) -> None:
    run_config(file, scene)
    assert export(file, "ply", tmp_path / "k.ply", 16)["photograph_colours"]
    frames = described(scene)["frames"]
    for frame in frames:
        frame["transform_matrix"][0][3] += 7.0
    change(scene, lambda meta: meta.update(frames=frames))
    for format, out in (("ply", "k.ply"), ("splat-init", "s.json")):
        with pytest.raises(ValueError, match="0 of the 3 cameras that the occupancy names are in"):
            export(file, format, tmp_path / out, 16, data=scene)
    assert not export(file, "ply", tmp_path / "k.ply", 16)["photograph_colours"]


@pytest.mark.parametrize(("named", "left", "is_known"), [(3, 2, True), (3, 1, False), (2, 1, True)])
def test_a_scene_with_half_of_the_cameras_is_that_of_the_run(
    named: int, left: int, is_known: bool, file: Path, scene: Path
) -> None:
    frames, occupancy = described(scene)["frames"], Occupancy.load(file)
    occupancy.report["cameras"] = occupancy.report["cameras"][:named]
    change(scene, lambda meta: meta.update(frames=frames[:left]))
    with nullcontext() if is_known else refused("1 of the 3 cameras that the occupancy names"):
        assert inspection.scene_of(occupancy, file, scene) is not None


def test_a_copy_says_what_its_scene_leaves_to_a_folder_beside_it(
    file: Path, scene: Path, tmp_path: Path
) -> None:
    (scene / "colmap/sparse/0").mkdir(parents=True)
    export(file, "splat-init", tmp_path / "s.json", 16, data=scene)
    assert json.loads((tmp_path / "s.json").read_text())["applied_transform"] == APPLIED_EARLIER


@pytest.mark.parametrize("said", ["", "{", "[1]", '{"frames": null}'])
def test_a_scene_that_is_none_is_named(said: str, file: Path, scene: Path, tmp_path: Path) -> None:
    (scene / "transforms.json").write_text(said)
    ball().save(tmp_path / "silent.st")  # says nothing of its cameras' places in the data
    for known in (file, tmp_path / "silent.st"):
        with refused(r"scene/transforms\.json is not a scene in nerfstudio's format \("):
            export(known, "ply", tmp_path / "k.ply", 16, data=scene)


def test_a_picture_that_a_full_disk_cuts_off_replaces_no_older_one(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut_off(_: Any, target: Any, **__: Any) -> None:
        with nullcontext(target) if hasattr(target, "write") else Path(target).open("wb") as out:
            out.write(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    picture = tmp_path / "out" / "occupancy.png"
    picture.parent.mkdir()
    picture.write_bytes(b"older")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", cut_off)
    for save in (
        lambda: draw(Occupancy.load(file), picture),
        lambda: save_picture(new_figure((1.0, 1.0)), picture, {}, 10),
    ):
        with pytest.raises(OSError, match="No space left"):
            save()
        assert picture.read_bytes() == b"older" and [*picture.parent.iterdir()] == [picture]
