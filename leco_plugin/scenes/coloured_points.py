"""What a scene's files say of places: colours of points nearby, photographs that show them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from numpy.typing import NDArray
from torch import Tensor

from leco_plugin.log import say
from leco_plugin.scenes.frames import (
    METRES_PER_UNIT,
    POINTS,
    applied_in,
    from_file,
    moved,
    parsed_frame,
)
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.lenses import bend, lens_of
from leco_plugin.scenes.photograph_files import find_file
from leco_plugin.scenes.scene_file import (
    NO_SCENE,
    SceneFile,
    file_in,
    load_json,
    not_a_scene,
    poses_in,
)
from leco_plugin.scenes.whole_files import FETCH, is_pointer

CONFIG = "config.yml"
NEAREST = 3
"""Points whose colours are averaged."""
GREY = 128
LONGEST_HEADER = 1 << 16
"""Bytes of a .ply in which its number of points stands."""
COLOURS = "points3D_rgb"
"""Key of their colours, uint8 [P, 3], beside `POINTS`. nerfstudio wants both or neither."""


class PointCloud(NamedTuple):
    """Points in the coordinates of the data."""

    positions: NDArray[np.float64]
    """[P, 3], all finite."""
    colours: NDArray[np.uint8]
    """[P, 3]; [0, 3] where they have none."""


def description_of_run(file: Path) -> Path | None:
    """The transforms.json of the run in whose folder a file lies, moved or not, or None."""
    from leco_plugin.studio.checkpoints import found_around

    config = file.resolve().parent / CONFIG
    data = _data_named_in(config)
    if data is None:
        return None
    if (found := file_in(data)).is_file():
        return found
    moved = found_around(data, config.parent)
    return found if moved is not None and (found := file_in(moved)).is_file() else None


def _data_named_in(config: Path) -> Path | None:
    """The data that a run's config.yml names, or None. Nothing in the file is executed."""
    import yaml

    class Plain(yaml.SafeLoader):
        """Takes every object for its attributes, and a path for its parts."""

    def attributes(loader: Any, tag: str, node: yaml.Node) -> Any:
        if isinstance(node, yaml.MappingNode):
            return loader.construct_mapping(node, deep=True)
        is_list = isinstance(node, yaml.SequenceNode)
        return loader.construct_sequence(node, deep=True) if is_list else None

    Plain.add_multi_constructor("tag:yaml.org,2002:python/", attributes)
    try:
        manager = yaml.load(config.read_text(), Loader=Plain)["pipeline"]["datamanager"]
        return Path(*(manager.get("data") or manager["dataparser"]["data"]))
    except (OSError, yaml.YAMLError, AttributeError, KeyError, TypeError, ValueError):
        return None


def description_in(data: Path) -> Path:
    """The transforms.json that `data` means. InputError for none, or one without frames."""
    file = file_in(data)
    if not file.is_file():
        raise InputError(f"--data {data}: there is no transforms.json; give a nerfstudio scene")
    try:
        load_json(file)["frames"]
    except NO_SCENE as error:
        raise not_a_scene(file, error) from None
    return file


def read_cloud(path: Path) -> PointCloud:
    """The finite vertices of a .ply, also of a mesh. InputError if it cannot be read as points."""
    import trimesh

    try:
        if is_pointer(path):
            raise InputError(f"{path} cannot be read as sparse points: it {FETCH}")
        # as a file and not by its name: nothing else is read that it may point to
        with path.open("rb") as file:
            loaded: Any = trimesh.load(file, file_type="ply", process=False)
            file.seek(0)
            named = re.search(rb"^element vertex (\d+)", file.read(LONGEST_HEADER), re.MULTILINE)
        is_empty = isinstance(loaded, trimesh.Scene) and not loaded.geometry
        vertices = () if is_empty else loaded.vertices
        positions = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
        if named and len(positions) < int(named[1]):
            raise ValueError(f"{len(positions)} of its {int(named[1])} points are there")
        is_mesh = getattr(getattr(loaded, "visual", None), "kind", None) == "vertex"
        paint = loaded.visual.vertex_colors if is_mesh else getattr(loaded, "colors", ())
        colours = np.asarray(paint, dtype=np.uint8)
    except InputError:
        raise
    except Exception as error:  # noqa: BLE001  trimesh raises whatever its parsers meet
        why = one_line(error, 120)
        fault = f"{path} cannot be read as sparse points ({why})"
        raise InputError(f"{fault}: put a whole .ply there, or remove what names it") from None
    sound = np.isfinite(positions).all(axis=1)
    if not len(colours) == len(positions) > 0:
        return PointCloud(positions[sound], np.zeros((0, 3), np.uint8))
    return PointCloud(positions[sound], colours[sound, :3])


def coloured_points(description: Path) -> PointCloud | None:
    """Sparse points with colours that a transforms.json names, or None. InputError for bad ones."""
    name = load_json(description).get("ply_file_path")
    path = find_file(description.parent / str(name))
    if name is None or not path.is_file():
        return None
    cloud = read_cloud(path)
    return cloud if len(cloud.colours) else None


def colours_near(known: PointCloud, positions: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Mean colours [N, 3] of the `NEAREST` known points of each position [N, 3]."""
    from scipy.spatial import KDTree

    count = min(NEAREST, len(known.positions))
    _, numbers = KDTree(known.positions).query(positions, k=count)
    found = known.colours[np.asarray(numbers).reshape(len(positions), count)]
    return np.asarray(found.mean(axis=1).round().astype(np.uint8))


def camera_places(description: Path) -> NDArray[np.float64]:
    """Places [C, 3] of the cameras in a transforms.json; [0, 3] where they are no poses."""
    try:
        return poses_in(load_json(description)["frames"]).reshape(-1, 4, 4)[:, :3, 3]
    except (KeyError, TypeError, ValueError):
        return np.zeros((0, 3))


WIDER = 0.02
"""Share of its size by which an image counts as wider: no lens is known better."""


def views_of(description: Path, places: NDArray[np.float64]) -> NDArray[np.int64] | None:
    """How many photographs of a transforms.json may show places [N, 3], whatever hides them: [N];
    None where it does not say how they were taken, or by a lens that sees around corners."""
    meta = load_json(description)
    counts = np.zeros(len(places), dtype=np.int64)
    try:
        for frame in meta["frames"]:
            lens = lens_of(meta, frame, str(description))
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
            is_known = (lens.fx or lens.angle_x) is not None and np.isfinite(pose).all()
            if not is_known or lens.kind not in (None, CameraType.PERSPECTIVE):
                return None
            if lens.width is None or lens.height is None:
                return None
            size = np.array([lens.width, lens.height])
            focal = np.array(lens.focal_lengths(lens.width, lens.height, 1), dtype=np.float64)
            local = torch.from_numpy((places - pose[:3, 3]) @ pose[:3, :3])
            slopes, ahead = local[:, :2] / -local[:, 2:], local[:, 2] < 0.0
            bent, sharp = bend(slopes * torch.tensor([1.0, -1.0]), lens.distortion)
            pixels = np.array([lens.cx, lens.cy]) + focal * bent.numpy()
            inside = (pixels >= -WIDER * size) & (pixels <= (1.0 + WIDER) * size)
            counts += inside.all(axis=1) & (ahead & sharp).numpy()
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return counts


def georeference(description: Path) -> dict[str, Any]:
    """`geographic_origin` and `metres_per_unit` of a transforms.json, where it has them."""
    meta = load_json(description)
    return {name: meta[name] for name in ("geographic_origin", "metres_per_unit") if name in meta}


def read_points(meta: dict[str, Any], folder: Path) -> PointCloud | None:
    """Sparse points in the coordinates of the file, or None. A file that is named and not there, or
    empty, is said, for learning without points is slower. InputError if it cannot be read."""
    name = meta.get("ply_file_path")
    if name is None:
        return None
    path = find_file(folder / str(name))
    if not path.is_file():
        say(f"the scene names sparse points that are not there: {path}")
        return None
    points = read_cloud(path)
    if len(points.positions) == 0:
        say(f"{path} has no points; `leco points` finds some in the photographs")
        return None
    return points


def points_in_model(points: PointCloud, frame: Tensor) -> dict[str, Tensor]:
    """Sparse points and colours as metadata of nerfstudio's readers, taken to the model by a frame
    [3, 4]: splatfacto starts there, from grey ones where the file has no colours."""
    positions, colours = points
    if not len(colours):
        colours = np.full(positions.shape, GREY, np.uint8)
    in_model = moved(torch.from_numpy(positions), frame.double()).float()
    return {POINTS: in_model, COLOURS: torch.from_numpy(colours)}


def told_by(scene: SceneFile, data: Path, outputs: Any) -> dict[str, Any]:
    """Sparse points, unless the reader has read them, and metres of a transforms.json, as metadata
    of its outputs. InputError if they cannot be read."""
    meta = scene.meta
    try:
        applied, applied_scale = applied_in(meta, scene.path.parent)
        frame = from_file(parsed_frame(outputs), applied, applied_scale, torch.float64)
    except (ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"{data} cannot be read: {one_line(error, 120)}") from None
    points = None if POINTS in outputs.metadata else read_points(meta, scene.path.parent)
    told: dict[str, Any] = {} if points is None else points_in_model(points, frame)
    if "metres_per_unit" in meta:
        metres = meta["metres_per_unit"]
        if type(metres) not in (int, float) or not 0.0 < metres < float("inf"):
            raise InputError(f"{data}: metres_per_unit is {metres!r}, not a positive number")
        told[METRES_PER_UNIT] = float(metres)
    return told
