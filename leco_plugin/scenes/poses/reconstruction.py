"""Structure from motion by pycolmap, on the CPU: features, matches and models.

The database keeps features and matches: a run that goes on after it was killed makes those that are
missing. Only the mapping begins anew.
Compared are photographs that are near by GPS, next ones in order, or all.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Sequence
from importlib import import_module
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from leco_plugin.evaluation.report import usable_cores
from leco_plugin.log import bar, counted
from leco_plugin.scenes.input_error import InputError, require
from leco_plugin.scenes.poses.originals import FEWEST, Exif, Photograph

Lens = Literal["perspective", "fisheye"]
SIMPLE: dict[Lens, str] = {"perspective": "SIMPLE_RADIAL", "fisheye": "SIMPLE_RADIAL_FISHEYE"}
"""COLMAP's lens models while it maps: one focal length, one coefficient of distortion."""
FULL: dict[Lens, str] = {"perspective": "OPENCV", "fisheye": "OPENCV_FISHEYE"}
"""Lens models of lenses with enough photographs, and those that nerfstudio reads."""
ENOUGH = 20
"""Photographs from which on a lens gets its full model: fewer would let it bend the scene."""
CHUNK, PAIRS_A_CHUNK = 4, 100
"""Photographs and pairs for each thread between two looks at the progress bar."""
DATABASE, ENTERED, MODELS = "colmap/database.db", "colmap/entered", "colmap/models"
"""In the folder of the scene: features and matches, a file that says all photographs are known
there, and COLMAP's models."""
BYTES_A_PHOTOGRAPH = 1_000_000
"""Of disk for features and matches: a survey of 800 pixels took 0.74 million."""
MASKS = "masks"
"""Folder of masks, named NAME.png for a photograph NAME; what is black in one has no features."""
EXTRA = "pip install 'pycolmap>=4' pillow-heif"


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


def check_options(size: int, threads: int) -> None:
    """InputError unless features can be looked for at that size, by so many threads."""
    require(size >= 100, "size", size, "100 pixels or more")
    require(threads >= 0, "threads", threads, "0 for all, or a number of them")


class Reconstructor:
    """pycolmap on the photographs of a scene."""

    def __init__(self, scene: Path, photographs: Sequence[Photograph], threads: int) -> None:
        """`scene` has copies in `images`, and may have masks in MASKS; 0 threads are all."""
        self.pycolmap, self.scene, self.images = load_pycolmap(), scene, scene / "images"
        self.folder, self.database = scene / "colmap", scene / DATABASE
        self.photographs, self.threads = photographs, threads or usable_cores()

    def extract(self, lens: Lens, size: int) -> None:
        """Finds features, at a longest side of `size` pixels, in photographs that have none yet."""
        pycolmap = self.pycolmap
        self._enter(lens)
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size, options.num_threads, options.use_gpu = size, self.threads, False
        reader = pycolmap.ImageReaderOptions()
        if (self.scene / MASKS).is_dir():
            reader.mask_path = self.scene / MASKS
        with pycolmap.Database.open(self.database) as database:
            images, known = database.read_all_images(), database.exists_descriptors
            done = {image.name for image in images if known(image.image_id)}
        names = [each.name for each in self.photographs if each.name not in done]
        chunk, count = CHUNK * self.threads, len(self.photographs)
        given: dict[str, Any] = {"reader_options": reader, "extraction_options": options}
        given["device"] = pycolmap.Device.cpu
        with bar("finding features") as show:
            for at in range(0, len(names), chunk):
                some = names[at : at + chunk]
                pycolmap.extract_features(self.database, self.images, some, **given)
                show((count - len(names) + at) / count)

    def _enter(self, lens: Lens) -> None:
        """Enters photographs and lenses into the database, all or none of them."""
        pycolmap, whole = self.pycolmap, self.scene / ENTERED
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
        mode = pycolmap.CameraMode.SINGLE
        for group in groups.values():
            names = [each.name for each in group]
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
        pycolmap, cpu = self.pycolmap, self.pycolmap.Device.cpu
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads, options.use_gpu = self.threads, False
        chunk, count = PAIRS_A_CHUNK * self.threads, len(chosen.pairs)
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = self.folder / "pairs.txt"
        names = [each.name for each in self.photographs]
        with bar(f"comparing {counted(count, 'pair')} ({chosen.reason})") as show:
            for at in range(0, count, chunk):
                some = chosen.pairs[at : at + chunk]
                lines = "".join(f"{names[one]} {names[other]}\n" for one, other in some)
                pairing.match_list_path.write_text(lines)
                pycolmap.match_image_pairs(self.database, options, pairing, device=cpu)
                show(at / count)

    def map(self) -> list[Any]:
        """COLMAP's models, the largest first. InputError if no photographs overlap."""
        pycolmap, folder = self.pycolmap, self.scene / MODELS
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

            calls: dict[str, Any] = {"initial_image_pair_callback": lambda: count(2)}
            calls["next_image_callback"] = lambda: count(1)
            with bar("placing photographs") as show:
                pycolmap.incremental_mapping(self.database, self.images, folder, options, **calls)
            whole.touch()
        paths = [path for path in folder.iterdir() if path.is_dir()]
        models = [pycolmap.Reconstruction(path) for path in paths]
        models = [model for model in models if model.num_reg_images() >= FEWEST]
        if not models:
            none = f"no three of the {len(self.photographs)} photographs were found to overlap"
            wanted = "neighbours should share two thirds of what they show, from different places"
            raise InputError(f"{none}: {wanted}")
        return sorted(models, key=lambda model: (-model.num_reg_images(), -model.num_points3D()))

    def refine(self, model: Any, lens: Lens) -> None:
        """Gives each lens with enough photographs its full model, and adjusts all once more."""
        pycolmap = self.pycolmap
        used = [model.images[number].camera_id for number in model.reg_image_ids()]
        frequent = [number for number in model.cameras if used.count(number) >= ENOUGH]
        for camera in (model.cameras[number] for number in frequent):
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
            with bar("adjusting lenses and poses"):
                pycolmap.create_default_bundle_adjuster(options, moved, model).solve()
        model.update_point_3d_errors()


def require_disk(scene: Path, photographs: int, copies: float, option: str) -> None:
    """InputError if the disk of a scene's folder, given as `option`, is too full for features of so
    many photographs and for bytes of copies: pycolmap would abort the process in the middle."""
    database = scene / DATABASE
    known = database.stat().st_size if database.exists() else 0
    needed = copies + max(0, BYTES_A_PHOTOGRAPH * photographs - known)
    free = shutil.disk_usage(scene).free
    if free < needed:
        room = f"{free / 1e6:.0f} MB are free on its disk, and {needed / 1e6:.0f} are needed"
        remedy = "free some, or give a folder on another disk"
        raise InputError(f"{option} {scene}: {room}: {remedy}")


FEW = 40
"""Up to so many photographs are all compared: 780 pairs, two minutes of one core."""
NEIGHBOURS = 16
"""Nearest photographs by position that each is compared with."""
SECTORS, IN_A_SECTOR = 8, 2
"""Directions around each photograph, and nearest photographs in each of them that it is compared
with too: where photographs of a line lie much closer than lines do, all nearest are of one line."""
WIDE = 20.0
"""Metres from their middle, in the median, from which on positions tell who sees the same."""
ASTRAY = 0.7
"""Median distance of one photograph to the next in order, as a multiple of that of any two, from
which on order and GPS contradict each other."""
NEXT = 10
"""Photographs in order that each is compared with, and one at each power of two beyond."""
ANCHORS = 100
"""Of an ordered survey, so many photographs, evenly spread, are all compared: they close loops."""


class Pairs(NamedTuple):
    """Pairs of photographs that are compared, by number, and why those."""

    pairs: list[tuple[int, int]]
    reason: str


def choose_pairs(names: Sequence[str], exifs: Sequence[Exif], places: NDArray[np.float64]) -> Pairs:
    """The pairs to compare of photographs by name, EXIF and place [N, 3] in metres, or nan."""
    count = len(names)
    everything = combinations(range(count), 2)  # of 10,000 a list would take gigabytes
    order = capture_order(names, exifs)
    steps = {*range(1, NEXT + 1), *(2**power for power in range(count.bit_length()))}
    known = np.isfinite(places[:, 0])
    numbers = known.nonzero()[0]
    if count > FEW and known.mean() >= 0.5 and _spread(places[known, :2]) >= WIDE:
        near = _near(places[numbers, :2], np.arange(NEIGHBOURS)) | _around(places[numbers, :2])
        found = {(int(numbers[one]), int(numbers[other])) for one, other in near}
        contradict = order is not None and _is_astray(places[order, :2])
        found |= _in_order(order or [], steps if contradict else (1, 2))
        lost, around = {*(~known).nonzero()[0].tolist()}, _in_order(order or [], steps)
        found |= {pair for pair in (around if order else everything) if not lost.isdisjoint(pair)}
        also = ", and next in order, which GPS contradicts" if contradict else ""
        return Pairs(sorted(found), f"{NEIGHBOURS} nearest by GPS{also}")
    if order is None or count <= ANCHORS:  # few are all compared
        return Pairs(list(everything), "all pairs")
    anchors = order[:: -(-count // ANCHORS)]
    loops = {(min(pair), max(pair)) for pair in combinations(anchors, 2)}
    return Pairs(sorted(_in_order(order, steps) | loops), f"{NEXT} next in order, and loops")


def _spread(places: NDArray[np.float64]) -> float:
    """Median distance of places [N, 2] from their middle."""
    return float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1)))


def _is_astray(places: NDArray[np.float64]) -> bool:
    """Whether photographs at places [N, 2], in order, are hardly nearer to the next than to any."""
    known = places[np.isfinite(places[:, 0])]
    if len(known) < 3:
        return False
    of_next = np.linalg.norm(np.diff(known, axis=0), axis=1)
    others = np.random.default_rng(0).permutation(len(known))  # all pairs are too many to hold
    of_any = np.linalg.norm(known - known[others], axis=1)
    return bool(np.median(of_next) > ASTRAY * np.median(of_any))


def choose_posed_pairs(poses: NDArray[np.float64]) -> Pairs:
    """The pairs to compare of photographs with known poses [N, 3, 4], OpenGL camera to world."""
    count = len(poses)
    if count <= FEW:
        return Pairs(list(combinations(range(count), 2)), "all pairs")
    places, ahead = poses[:, :, 3], -poses[:, :, 2]
    ranks = np.array(sorted({*range(NEIGHBOURS // 2), *(2**power for power in range(3, 7))}))
    found = _near(places, ranks, ahead)
    return Pairs(sorted(found), "near ones by pose that look the same way")


def capture_order(names: Sequence[str], exifs: Sequence[Exif]) -> list[int] | None:
    """Numbers of the photographs as taken, by EXIF's time or their names; None if neither tells."""
    times = [each.time for each in exifs if each.time is not None]
    if len(times) == len(names) and 2 * len(set(times)) > len(names):
        return sorted(range(len(names)), key=lambda number: (exifs[number].time, names[number]))
    counted = [re.findall(r"\d+", name.rsplit(".", 1)[0]) for name in names]
    if not all(counted) or len({parts[-1] for parts in counted}) * 2 <= len(names):
        return None

    def by_value(number: int) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", names[number])
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]

    return sorted(range(len(names)), key=by_value)


def _near(
    places: NDArray[np.float64], ranks: NDArray[np.int64], ahead: NDArray[np.float64] | None = None
) -> set[tuple[int, int]]:
    """Pairs of each photograph with those near to its place [N, 2 or 3], by `ranks` of distance,
    that look its way, [N, 3] if given."""
    found = set()
    for row in range(len(places)):
        distances = ((places - places[row]) ** 2).sum(axis=1)
        if ahead is not None:
            distances[ahead @ ahead[row] <= 0.0] = np.inf
        distances[row] = np.inf
        order = np.argsort(distances, kind="stable")[ranks[ranks < len(places)]]
        found |= {(min(row, o), max(row, o)) for o in order.tolist() if distances[o] < np.inf}
    return found


def _around(places: NDArray[np.float64]) -> set[tuple[int, int]]:
    """Pairs of each photograph with the nearest to its place [N, 2] in each direction."""
    found = set()
    for row in range(len(places)):
        east, north = (places - places[row]).T
        order = np.argsort(east**2 + north**2, kind="stable")
        order = order[order != row]
        turns = np.arctan2(north[order], east[order]) / (2.0 * np.pi)
        sectors = np.round(turns * SECTORS).astype(int) % SECTORS
        for sector in range(SECTORS):
            for other in order[sectors == sector][:IN_A_SECTOR].tolist():
                found.add((min(row, other), max(row, other)))
    return found


def _in_order(order: Sequence[int], steps: Iterable[int]) -> set[tuple[int, int]]:
    """Pairs of photographs that are so many steps apart in an order."""
    pairs = ((order[at], order[at + step]) for step in steps for at in range(len(order) - step))
    return {(min(pair), max(pair)) for pair in pairs}
