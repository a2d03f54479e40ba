"""Structure from motion by pycolmap: features, matches and models, each kept once it is made.

All of it runs on the CPU. The database keeps features and matches, so that a run that was killed
goes on with what is missing; only the last part, the mapping, begins anew. A placed model is
written as transforms.json, sparse points and COLMAP's own files.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from leco_plugin.log import bar
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.poses.georeference import Placement
from leco_plugin.scenes.poses.originals import FEWEST, Photograph
from leco_plugin.scenes.poses.pairs import Pairs
from leco_plugin.scenes.whole_files import write_points, write_whole

Lens = Literal["perspective", "fisheye"]
SIMPLE: dict[Lens, str] = {"perspective": "SIMPLE_RADIAL", "fisheye": "SIMPLE_RADIAL_FISHEYE"}
"""COLMAP's lens models while it maps: one focal length, one coefficient of distortion."""
FULL: dict[Lens, str] = {"perspective": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""Lens models of lenses with enough photographs, and those that nerfstudio reads."""
ENOUGH = 20
"""Photographs from which on a lens gets its full model: fewer would let it bend the scene."""
CHUNK, PAIRS_A_CHUNK = 4, 100
"""Photographs and pairs for each thread between two looks at the progress bar."""
DATABASE, ENTERED = "colmap/database.db", "colmap/entered"
"""In the folder of the scene: features and matches, and a file that says all photographs are known
there."""
MASKS = "masks"
"""Folder of masks, named NAME.png for a photograph NAME; what is black in one has no features."""
EXTRA = "pip install 'leco_plugin[poses]'"


def load_pycolmap() -> Any:
    """The module pycolmap, quiet. ImportError, in one line, where it is not installed."""
    try:
        import_module("PIL.Image")  # after pycolmap, its PNG writer was seen to abort
        pycolmap = import_module("pycolmap")
    except ImportError as error:
        raise ImportError(f"leco poses and leco points need pycolmap ({error}): {EXTRA}") from None
    if not hasattr(pycolmap, "match_image_pairs"):  # before version 4
        raise ImportError(f"this pycolmap is too old for leco poses: {EXTRA}")
    pycolmap.logging.minloglevel = 3  # what it warns of is counted in the report
    return pycolmap


class Reconstructor:
    """pycolmap on the photographs of a scene."""

    def __init__(self, scene: Path, photographs: Sequence[Photograph], threads: int) -> None:
        """With the folder of the scene, whose `images` has all copies, and MASKS some masks."""
        self.pycolmap, self.masks = load_pycolmap(), scene / MASKS
        self.images, self.folder = scene / "images", scene / "colmap"
        self.database = scene / DATABASE
        self.photographs, self.threads = photographs, threads

    def extract(self, lens: Lens, size: int) -> None:
        """Finds features in the photographs that have none in the database.

        Args:
            lens: kind of all lenses.
            size: longest side in pixels to which a photograph is made smaller for it.
        """
        pycolmap = self.pycolmap
        self._enter(lens)
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size, options.num_threads, options.use_gpu = size, self.threads, False
        reader = pycolmap.ImageReaderOptions()
        if self.masks.is_dir():
            reader.mask_path = self.masks
        with pycolmap.Database.open(self.database) as database:
            done = {
                image.name
                for image in database.read_all_images()
                if database.exists_descriptors(image.image_id)
            }
        names = [each.name for each in self.photographs if each.name not in done]
        chunk, count = CHUNK * self.threads, len(self.photographs)
        with bar("finding features") as show:
            for at in range(0, len(names), chunk):
                pycolmap.extract_features(
                    self.database,
                    self.images,
                    names[at : at + chunk],
                    reader_options=reader,
                    extraction_options=options,
                    device=pycolmap.Device.cpu,
                )
                show((count - len(names) + at) / count)

    def _enter(self, lens: Lens) -> None:
        """Enters photographs and lenses into the database, all or none of them."""
        pycolmap, whole = self.pycolmap, self.folder / Path(ENTERED).name
        if whole.exists():
            return
        for part in self.folder.glob(f"{self.database.name}*"):
            part.unlink()  # with the journal of a run that was killed
        options = pycolmap.ImageReaderOptions()
        options.camera_model = SIMPLE[lens]
        groups: dict[Any, list[Photograph]] = {}
        for each in self.photographs:
            groups.setdefault(each.lens, []).append(each)
        pycolmap.Database.open(self.database).close()
        for group in groups.values():
            names = [each.name for each in group]
            mode = pycolmap.CameraMode.SINGLE
            pycolmap.import_images(self.database, self.images, mode, names, options)
        with pycolmap.Database.open(self.database) as database:
            for each in (group[0] for group in groups.values()):
                image = database.read_image_with_name(each.name)
                camera = database.read_camera(image.camera_id)
                if each.exif.focal is not None:  # pycolmap takes that of the picture as taken
                    camera.focal_length = each.exif.focal * max(each.size)
                    camera.has_prior_focal_length = True
                    database.update_camera(camera)
        whole.touch()

    def match(self, chosen: Pairs) -> None:
        """Compares chosen pairs of photographs, those left out that were compared before."""
        pycolmap = self.pycolmap
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads, options.use_gpu = self.threads, False
        chunk, count = PAIRS_A_CHUNK * self.threads, len(chosen.pairs)
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = self.folder / "pairs.txt"
        names = [each.name for each in self.photographs]
        with bar(f"comparing {count} pairs ({chosen.reason})") as show:
            for at in range(0, count, chunk):
                some = chosen.pairs[at : at + chunk]
                lines = "".join(f"{names[one]} {names[other]}\n" for one, other in some)
                pairing.match_list_path.write_text(lines)
                pycolmap.match_image_pairs(
                    self.database, options, pairing, device=pycolmap.Device.cpu
                )
                show(at / count)

    def map(self) -> list[Any]:
        """COLMAP's models, the one with the most photographs first.

        InputError if no photographs overlap.
        """
        pycolmap, folder = self.pycolmap, self.folder / "models"
        whole = folder / "all"
        if not whole.exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a run that was killed
            folder.mkdir()
            options = pycolmap.IncrementalPipelineOptions()
            options.num_threads, options.random_seed = self.threads, 0
            options.min_model_size = FEWEST
            placed = 0

            def count(more: int) -> None:
                nonlocal placed
                placed += more
                show(min(1.0, placed / len(self.photographs)))

            with bar("placing photographs") as show:
                pycolmap.incremental_mapping(
                    self.database,
                    self.images,
                    folder,
                    options,
                    initial_image_pair_callback=lambda: count(2),
                    next_image_callback=lambda: count(1),
                )
            whole.touch()
        paths = [path for path in folder.iterdir() if path.is_dir()]
        models = [pycolmap.Reconstruction(path) for path in paths]
        models = [model for model in models if model.num_reg_images() >= FEWEST]
        if not models:
            raise InputError(
                f"no three of the {len(self.photographs)} photographs were found to overlap: "
                "neighbours should share two thirds of what they show, from different places"
            )
        return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))

    def refine(self, model: Any, lens: Lens) -> None:
        """Gives each lens with enough photographs its full model, and adjusts all once more."""
        pycolmap = self.pycolmap
        used = [model.images[number].camera_id for number in model.reg_image_ids()]
        frequent = [number for number in model.cameras if used.count(number) >= ENOUGH]
        for number in frequent:
            camera = model.cameras[number]
            focal, x, y, distortion = camera.params
            camera.model = getattr(pycolmap.CameraModelId, FULL[lens])
            camera.params = np.array([focal, focal, x, y, distortion, 0.0, 0.0, 0.0])
        if frequent:
            options = pycolmap.BundleAdjustmentOptions()
            options.print_summary = False
            options.ceres.solver_options.num_threads = self.threads
            moved = pycolmap.BundleAdjustmentConfig()
            for number in model.reg_image_ids():
                moved.add_image(number)
            moved.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
            pycolmap.create_default_bundle_adjuster(options, moved, model).solve()
        model.update_point_3d_errors()


def available_threads() -> int:
    """Processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Array = NDArray[np.float64]
LARGE = 1e4
"""Coordinates, as of UTM, from which on points are written in float64."""
POINTS, MODEL = "sparse_pc.ply", "colmap/sparse/0"
"""In the folder of the scene, under the names that ns-process-data has for them."""
PARAMETERS = {
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL": ("fl_x", "cx", "cy", "k1"),
    "SIMPLE_RADIAL_FISHEYE": ("fl_x", "cx", "cy", "k1"),
}
"""Parameters of COLMAP's lens models, in their order, as nerfstudio names them."""


def poses_of(model: Any) -> tuple[list[str], Array]:
    """Names of a model's photographs, sorted, and their poses [C, 3, 4], OpenGL camera to world."""
    images = sorted((model.images[each] for each in model.reg_image_ids()), key=lambda i: i.name)
    found = [image.cam_from_world().inverse().matrix() for image in images]
    poses = np.array(found).reshape(-1, 3, 4) * np.array([1.0, -1.0, -1.0, 1.0])
    return [image.name for image in images], poses


def points_of(model: Any) -> tuple[Array, NDArray[np.uint8]]:
    """Sparse points [P, 3] of a model, and their colours [P, 3]."""
    points = list(model.points3D.values())
    places = np.array([point.xyz for point in points], dtype=float).reshape(-1, 3)
    return places, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def transforms_of(
    model: Any, placement: Placement, origin: tuple[float, float, float] | None
) -> dict[str, Any]:
    """What transforms.json says of a model that already is in world coordinates.

    Args:
        model: of pycolmap.
        placement: by which it came there: whether coordinates are metres.
        origin: latitude, longitude and altitude of the world's origin, if they are.
    """
    lenses = {number: intrinsics(camera) for number, camera in model.cameras.items()}
    names, poses = poses_of(model)
    used = [model.find_image_with_name(name).camera_id for name in names]
    fisheye = any("FISHEYE" in camera.model_name for camera in model.cameras.values())
    one = len({*used}) == 1
    meta: dict[str, Any] = {"camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV"}
    meta |= lenses[used[0]] if one else {}
    meta |= {"orientation_override": "none", "ply_file_path": POINTS}  # +z is up already
    meta["applied_transform"] = np.eye(3, 4).tolist()  # COLMAP's model has the same coordinates
    if placement.residuals is not None and origin is not None:
        meta["metres_per_unit"] = 1.0
        place = zip(("latitude", "longitude", "altitude"), origin)
        meta["geographic_origin"] = {**dict(place), "axes": "east, north, up"}
    meta["frames"] = [
        {
            "file_path": f"images/{name}",
            **({} if one else lenses[number]),
            "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
        }
        for name, number, pose in zip(names, used, poses)
    ]
    return meta


def intrinsics(camera: Any) -> dict[str, float]:
    """Intrinsics of a camera of pycolmap, as transforms.json has them."""
    found = dict(zip(PARAMETERS[camera.model_name], map(float, camera.params)))
    found.setdefault("fl_y", found["fl_x"])
    return {"w": camera.width, "h": camera.height, **found}


def write_scene(
    scene: Path, model: Any, meta: dict[str, Any], report: dict[str, Any], report_name: str
) -> None:
    """Writes points, COLMAP's model, the report and, last of all, transforms.json."""
    folder = scene / MODEL
    folder.mkdir(parents=True, exist_ok=True)
    model.write(folder)
    write_sparse_points(scene / POINTS, *points_of(model))
    for name, said in ((report_name, report), ("transforms.json", meta)):
        text = json.dumps(said, indent=1).encode()
        write_whole(scene / name, lambda file, text=text: file.write(text))  # type: ignore[misc]


def write_sparse_points(path: Path, places: Array, colours: NDArray[np.uint8]) -> None:
    """Writes sparse points [P, 3] with their colours [P, 3] as a PLY file."""
    kind = "<f8" if np.abs(places).max(initial=0.0) > LARGE else "<f4"
    rows = np.zeros(len(places), dtype=[("xyz", kind, 3), ("rgb", "u1", 3)])
    rows["xyz"], rows["rgb"] = places, colours
    write_points(path, rows)
