"""`leco points`: sparse points for a scene that has poses and no points. Features are matched
between photographs, and triangulated from the poses and lenses that the scene gives."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CameraType
from numpy.typing import NDArray
from PIL import Image

from leco_plugin.log import bar, counted, for_each
from leco_plugin.scenes.bounds import FEWEST_POINTS
from leco_plugin.scenes.coloured_points import read_points
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.lenses import DISTORTIONS, MIXED, Lens
from leco_plugin.scenes.photograph_files import decode, find_file, header_of, is_turned, seen_pixels
from leco_plugin.scenes.photographs import read_scene
from leco_plugin.scenes.poses.georeference import points_of, write_sparse_points
from leco_plugin.scenes.poses.originals import FEWEST, Exif, Photograph
from leco_plugin.scenes.poses.reconstruction import (
    MASKS,
    Reconstructor,
    check_options,
    choose_posed_pairs,
    load_pycolmap,
    require_disk,
)
from leco_plugin.scenes.reading import size_of
from leco_plugin.scenes.scene_file import SceneFile, poses_in
from leco_plugin.scenes.whole_files import check_place, write_json, write_whole

Array = NDArray[np.float64]
FILE, BEFORE = "leco_points.ply", "transforms.before_points.json"
"""The points, and transforms.json as it was, in the folder of the scene; the name of another
description goes before these."""
TOLERANCE = 0.01
"""Share of a picture's longest side by which a feature may miss its point; COLMAP has 4 pixels."""
NO_POINTS = "undistort the photographs, or give bounds.altitudes, or near and far, without points"
BYTES_A_SQUARE = 2.0
"""Of a copy as PNG, over the square of its longest side: four scenes took 0.9 to 1.2."""
CONTRADICTED = 0.5
"""Share of the matched features that must agree with the poses: 94% do in a scene of nine
photographs, 12 to 15% where their poses are shuffled."""


def find_points(data: Path, size: int = 1600, threads: int = 0) -> dict[str, Any]:
    """Gives a scene (folder, or json file) sparse points, unless it has some; returns `points`,
    `photographs`, `file` and `done`: False for a scene that had points. Test photographs are left
    out where the scene lists those for training. Features are looked for at a longest side of
    `size` pixels; 0 threads are all. InputError if the scene cannot be read, or no points are
    found; ImportError without pycolmap."""
    check_options(size, threads)
    scene = read_scene(data)
    chosen = training_frames(scene)
    report: dict[str, Any] = {"format": 1, "photographs": len(chosen)}
    known = read_points(scene.meta, scene.folder)
    if known is not None and len(known.positions) >= FEWEST_POINTS:
        there = find_file(scene.folder / scene.meta["ply_file_path"])
        return report | {"points": len(known.positions), "file": str(there), "done": False}
    if len(chosen) < FEWEST:
        few = counted(len(chosen), "photograph")
        raise InputError(f"{scene.path} has {few}; {FEWEST} or more are needed")
    load_pycolmap()
    file = _beside(scene.path, FILE)
    check_place("--data", file)
    poses = poses_in(scene.frames)[chosen, :3]
    centre = poses[:, :, 3].mean(axis=0)  # pycolmap loses digits of coordinates like UTM's
    poses[:, :, 3] -= centre
    with tempfile.TemporaryDirectory() as work:
        pictures = scene.pictures()
        given = ((pictures[n], header_of(pictures[n]), scene.lenses[n]) for n in chosen)
        sizes = [size_of(path, header, lens, [*header.size], 1) for path, header, lens in given]
        sides = [min(size, max(each)) for each in sizes]
        needed = sum(BYTES_A_SQUARE * side**2 for side in sides)
        require_disk(Path(work), len(chosen), needed, "TMPDIR")
        copies = _copies(scene, chosen, Path(work) / "images", size)
        photographs, cameras = zip(*copies)
        reconstructor = Reconstructor(Path(work), photographs, threads)
        reconstructor.folder.mkdir()
        reconstructor.extract("perspective", size)
        model = _triangulate(reconstructor, cameras, poses)
        _refuse_few(model, matched_features(reconstructor), scene.path)
    places, colours = points_of(model)
    write_sparse_points(file, places + centre, colours)
    _name_points(scene.path, file.name)
    return report | {"points": len(places), "file": str(file), "done": True}


def training_frames(scene: SceneFile) -> list[int]:
    """Numbers of the frames that a scene trains on: all where it does not say."""
    listed = scene.meta.get("train_filenames")
    pictures = scene.pictures()[: len(scene.meta["frames"])]  # ScanNet++ lists its tests after them
    wanted = {find_file(scene.folder / str(name)) for name in listed} if listed else {*pictures}
    return [number for number, picture in enumerate(pictures) if picture in wanted]


def _triangulate(reconstructor: Reconstructor, cameras: Sequence[Any], poses: Array) -> Any:
    """A model of pycolmap with points, in the coordinates of given OpenGL poses [C, 3, 4] with
    cameras [C]; the reconstructor has found features."""
    pycolmap, work = reconstructor.pycolmap, reconstructor.folder / "triangulated"
    given = pycolmap.Reconstruction()
    with pycolmap.Database.open(reconstructor.database) as database:
        for photograph, camera, pose in zip(reconstructor.photographs, cameras, poses):
            image = database.read_image_with_name(photograph.name)
            camera.camera_id = image.camera_id
            if image.camera_id not in given.cameras:
                database.update_camera(camera)
                given.add_camera_with_trivial_rig(camera)
            to_camera = pycolmap.Rigid3d(pose * [1.0, -1.0, -1.0, 1.0]).inverse()
            placed = pycolmap.Image(image.name, image_id=image.image_id, camera_id=image.camera_id)
            given.add_image_with_trivial_frame(placed, to_camera)
    reconstructor.match(choose_posed_pairs(poses))
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = reconstructor.threads, 0
    mapper, triangulation = options.mapper, options.triangulation
    # nine photographs have few points that three of them show
    triangulation.ignore_two_view_tracks = False
    # poses are off by an angle: that is more pixels of a larger picture
    longest = max(max(each.size) for each in reconstructor.photographs)
    tolerance = max(mapper.filter_max_reproj_error, TOLERANCE * longest)
    mapper.filter_max_reproj_error = triangulation.complete_max_reproj_error = tolerance
    triangulation.merge_max_reproj_error = tolerance
    work.mkdir()
    with bar("placing points"):
        return pycolmap.triangulate_points(
            given, reconstructor.database, reconstructor.images, work, options=options
        )


def matched_features(reconstructor: Reconstructor) -> int:
    """Features of all photographs that have a match in another one."""
    with reconstructor.pycolmap.Database.open(reconstructor.database) as database:
        pairs, geometries = database.read_two_view_geometries()
    found: set[tuple[int, int]] = set()
    for pair, geometry in zip(pairs, geometries):
        for number, column in zip(reconstructor.pycolmap.pair_id_to_image_pair(pair), (0, 1)):
            found |= {(number, index) for index in geometry.inlier_matches[:, column].tolist()}
    return len(found)


def _refuse_few(model: Any, matched: int, path: Path) -> None:
    """InputError, with the cause, where there are too few points to be of use."""
    points, agreeing = model.num_points3D(), model.compute_num_observations()
    if points >= FEWEST_POINTS and agreeing >= CONTRADICTED * matched:
        return
    photographs = model.num_reg_images()
    if matched < 4 * FEWEST_POINTS:
        shared = f"the {photographs} photographs of {path} share {counted(matched, 'feature')}"
        raise InputError(f"{shared}, too few for points: add photographs between them")
    raise InputError(
        f"only {agreeing} of {matched} features that the photographs share agree with the poses "
        f"in {path}: those are of other photographs, or their lenses are; `leco poses` makes both"
    )


def _copies(
    scene: SceneFile, chosen: Sequence[int], folder: Path, size: int
) -> list[tuple[Photograph, Any]]:
    """Photographs as their lenses mean them, in a folder, with a longest side of `size` pixels; and
    their cameras. What masks and opacity hide goes to the folder MASKS beside."""
    masks, pictures = folder.with_name(MASKS), scene.pictures()
    folder.mkdir()

    def copied(number: int) -> tuple[Photograph, Any]:
        path, lens = pictures[number], scene.lenses[number]
        header = header_of(path)
        full = (int(lens.width or header.size[0]), int(lens.height or header.size[1]))
        with decode(path, is_turned(header, full)) as image:
            copy, seen = image.convert("RGB"), _seen(scene, number, path, image)
        copy.thumbnail((size, size), Image.Resampling.LANCZOS)
        file = folder / f"{number:06d}.png"
        copy.save(file, compress_level=1)
        if seen is not None:
            masks.mkdir(exist_ok=True)
            seen.resize(copy.size, Image.Resampling.NEAREST).save(masks / f"{file.name}.png")
        camera = camera_of(lens, full, copy.size, str(path))
        lens_name = str(sorted(camera.todict().items(), key=str))  # shared by equal ones
        header = header_of(file, turned=False)
        return Photograph(file, file.name, header, Exif(camera=lens_name)), camera

    return for_each("reading photographs", chosen, copied)


def _seen(scene: SceneFile, number: int, path: Path, image: Image.Image) -> Image.Image | None:
    """White where a photograph is seen, by its mask or its opacity; None where all of it is."""
    if mask := scene.frames[number].get("mask_path"):
        shown = seen_pixels(scene.mask(str(mask)), path, image.size)
    elif header_of(path).transparent:
        shown = np.asarray(image.convert("RGBA"))[..., 3] > 0
    else:
        return None
    return Image.fromarray(shown).convert("L")


def camera_of(lens: Lens, full: tuple[int, int], size: tuple[int, int], where: str) -> Any:
    """A camera of pycolmap, for a copy of a size, of a lens in pixels of its full size (width,
    height). InputError without a focal length, or for a lens that pycolmap lacks."""
    focal = lens.focal_lengths(*full, factor=1)
    if lens.kind not in (None, *MIXED) or focal[0] is None or focal[1] is None:
        raise InputError(
            f"{where}: leco points needs a perspective or fisheye lens with a focal length: "
            f"{NO_POINTS}"
        )
    said = dict(zip(DISTORTIONS, lens.distortion or [0.0] * len(DISTORTIONS)))
    fisheye = lens.kind is CameraType.FISHEYE
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    if lacking := [name for name, value in said.items() if value and name not in names]:
        raise InputError(
            f"{where}: leco points knows no {' and '.join(lacking)} of a "
            f"{'fisheye' if fisheye else 'perspective lens'}: {NO_POINTS}"
        )
    across, down = size[0] / full[0], size[1] / full[1]
    middle = [at if at is not None else side / 2 for at, side in zip((lens.cx, lens.cy), full)]
    pinhole = [focal[0] * across, focal[1] * down, middle[0] * across, middle[1] * down]
    rational = [] if fisheye else [0.0] * 3  # terms that nerfstudio's lenses lack
    return load_pycolmap().Camera(
        model="OPENCV_FISHEYE" if fisheye else "FULL_OPENCV",
        width=size[0],
        height=size[1],
        params=[*pinhole, *(float(said[name]) for name in names), *rational],
        has_prior_focal_length=True,
    )


def _beside(path: Path, name: str) -> Path:
    """A file beside a transforms.json, or beside another description of the folder's scenes."""
    return path.with_name(name if path.name == "transforms.json" else f"{path.stem}.{name}")


def _name_points(path: Path, file: str) -> None:
    """Has a description of a scene name the points; it stays as it was under another name."""
    before, kept = path.read_bytes(), _beside(path, BEFORE)
    if not kept.exists():
        write_whole(kept, before)
    meta = json.loads(before.decode("utf-8-sig")) | {"ply_file_path": file}
    write_json(path, meta, indent=1, allow_nan=True)
