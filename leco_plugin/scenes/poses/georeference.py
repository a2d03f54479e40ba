"""What becomes of a reconstruction: set upright, in metres where GPS is known, and a scene on disk:
transforms.json, sparse points and COLMAP's own files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from leco_plugin.log import by_number
from leco_plugin.scenes.frames import turn_to_upright
from leco_plugin.scenes.poses.originals import Position
from leco_plugin.scenes.whole_files import write_json, write_points

Array = NDArray[np.float64]
TOLERANCE, TOLERATED = 10.0, 0.1
"""How far a position by GPS may be from its pose: metres, and share of the survey's spread."""
RECEIVER, LEAST_TOLD = 5.0, 0.3
"""How far a position of an ordinary receiver may always be: metres, and share of the spread. Of
shuffled positions one survey in fifty agrees by this, and of right ones within 25 m nearly all do,
where half do by `TOLERATED`."""
FEWEST = 4
"""Photographs with GPS for which a similarity, of seven numbers, can be doubted."""
AGREEING, ALWAYS = 0.5, 3
"""Share of positions that must agree with the poses, beside those few that always can."""
TRIALS = 1000
"""Pairs of positions by which a similarity of the plane is looked for."""
TILT, LESS_LEVEL = 0.99, 0.7
"""Cosine of the angle between the vertical by GPS and by cameras and ground, 8 degrees, beyond
which one of them is wrong; and the slope of photographs' right edges (root mean square) by the
latter, over that by GPS, below which GPS is: its altitudes drift."""
WANDERING = 0.3
"""Length of the mean of the cameras' top axes below which they do not say what is up."""


@dataclass(frozen=True)
class Placement:
    """A reconstruction in the world: world = scale * turn @ x + shift."""

    scale: float
    turn: Array
    """[3, 3], a rotation."""
    shift: Array
    """[3]."""
    residuals: Array | None = None
    """[C] metres between pose and GPS, nan where there is none; on the level where `level` is set.
    None: not by GPS."""
    reason: str = ""
    """Why GPS is not used."""
    level: bool = False
    """Whether latitudes and longitudes alone were used, and what is up is what cameras see."""

    def apply(self, points: Array) -> Array:
        """World coordinates [N, 3] of points of the reconstruction."""
        return np.asarray(self.scale * points @ self.turn.T + self.shift)


def local_places(
    pycolmap: Any, positions: Sequence[Position | None]
) -> tuple[Position | None, Array]:
    """An origin at sea level, the median of positions, and these in metres east, north and up of
    it [N, 3]; None and nan where nothing is known. A nan altitude is the median of others, or 0."""
    places = np.array([each or (np.nan,) * 3 for each in positions], dtype=float).reshape(-1, 3)
    there = np.isfinite(places[:, 0])
    if not there.any():
        return None, places
    known = places[there]
    given = known[np.isfinite(known[:, 2]), 2]
    known[~np.isfinite(known[:, 2]), 2] = np.median(given) if len(given) else 0.0
    turns = (known[:, 1] - known[0, 1] + 180.0) % 360.0 - 180.0  # -179.9 is near 179.9
    longitude = (known[0, 1] + np.median(turns) + 180.0) % 360.0 - 180.0
    origin = (float(np.median(known[:, 0])), float(longitude), 0.0)
    places[there] = pycolmap.GPSTransform().ellipsoid_to_enu(known, *origin)
    return origin, places


def upright(poses: Array, points: Array) -> Array:
    """The direction [3] that is up, by OpenGL poses [C, 3, 4] and points [P, 3]. Of surveys from
    the air ground and cameras tell it. Of others it is the mean of the photographs' top edges, or
    against the mean view where these point in all directions."""
    # a survey that lies within 20 degrees of upright is not turned: laid down, it is
    for base in (np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.eye(3)):
        turn = turn_to_upright(torch.from_numpy(base @ poses), torch.from_numpy(points @ base.T))
        if turn is not None:
            return np.asarray((turn.double().numpy() @ base)[2])
    top = poses[:, :, 1].mean(axis=0)
    up = top if np.linalg.norm(top) > WANDERING else poses[:, :, 2].mean(axis=0)
    return np.asarray(up / max(float(np.linalg.norm(up)), 1e-9))


def place(
    pycolmap: Any,
    centres: Array,
    gps: Array,
    up: Array,
    top: Array | None = None,
    rights: Array | None = None,
    altitudes: bool = True,
) -> Placement:
    """The similarity that takes a reconstruction to metres, or a rotation that sets it upright.
    Centres [C, 3] have positions by GPS [C, 3] in metres, or nan. A flight along one line also
    needs what is `up` [3]. The mean `top` [3] of the photographs' top edges counts where GPS would
    turn it upside down, right edges `rights` [C, 3] where altitudes would tilt it. Where altitudes
    are not known, or contradict the poses, `up` takes their place."""
    placed = _place_in_space(pycolmap, centres, gps, up, top)
    tilts = placed.residuals is not None and _is_tilted(placed.turn, up, rights)
    if altitudes and placed.residuals is not None and not tilts:
        return placed
    return _place_on_the_level(centres, gps, up) or placed


def _is_tilted(turn: Array, up: Array, rights: Array | None) -> bool:
    """Whether a turn [3, 3] tilts what is up [3], and photographs, by their right edges [C, 3], are
    held clearly less level so: on a slope that looked flat they are held more level."""
    if rights is None or (turn @ up)[2] > TILT or (turn @ up)[2] < 0.0:
        return False
    by_gps, by_up = (float(np.sqrt((part**2).mean())) for part in (rights @ turn[2], rights @ up))
    return by_up < LESS_LEVEL * by_gps


def _place_on_the_level(centres: Array, gps: Array, up: Array) -> Placement | None:
    """A placement by latitudes and longitudes alone, with `up` upright: the similarity of the plane
    with which most positions agree. None where too few do."""
    there = np.isfinite(gps).all(axis=1)
    if there.sum() < FEWEST:
        return None
    upright_turn = _by_direction(up, "").turn
    seen = centres[there] @ upright_turn.T
    source, target = seen[:, 0] + 1j * seen[:, 1], gps[there, 0] + 1j * gps[there, 1]
    width = tolerance(_spread(gps[there, :2]))
    rng, best = np.random.default_rng(0), np.zeros(len(source), dtype=bool)
    for one, other in rng.integers(0, len(source), size=(TRIALS, 2)):
        if width > 0.0 and source[one] != source[other]:
            factor = (target[one] - target[other]) / (source[one] - source[other])
            off = np.abs(factor * (source - source[one]) + target[one] - target)
            best = max(best, off <= width, key=np.sum)
    best = _apart(gps[there, :2], best, width)
    if best.sum() - ALWAYS < AGREEING * (len(source) - ALWAYS):
        return None
    from_middle, to_middle = source[best] - source[best].mean(), target[best] - target[best].mean()
    factor = np.vdot(from_middle, to_middle) / np.vdot(from_middle, from_middle)
    scale = float(np.abs(factor))
    turn = Rotation.from_euler("z", np.angle(factor)).as_matrix() @ upright_turn
    offsets = gps[there] - scale * centres[there] @ turn.T
    shift = np.array([*offsets[best, :2].mean(axis=0), np.median(offsets[:, 2])])
    placed = Placement(scale, turn, shift, level=True)
    return replace(placed, residuals=np.linalg.norm((placed.apply(centres) - gps)[:, :2], axis=1))


def _place_in_space(
    pycolmap: Any, centres: Array, gps: Array, up: Array, top: Array | None
) -> Placement:
    """A placement by positions with altitudes; by `up`, with the reason, if these contradict."""
    there = np.isfinite(gps).all(axis=1)
    known, count = gps[there], int(there.sum())
    if count < FEWEST:
        have = by_number(count, "photograph has", "photographs have")
        few = f"{count or 'no'} placed {have} a GPS position"
        return _by_direction(up, f"{few}, and {FEWEST} are needed")
    spread = _spread(known)
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = tolerance(spread), 0
    found: Any = None
    if options.max_error > 0.0:  # else all positions are the same
        found = pycolmap.estimate_sim3d_robust(centres[there], known, options)
    inlier = np.zeros(count, dtype=bool) if found is None else np.asarray(found["inlier_mask"])
    inlier = _apart(known, inlier, options.max_error)
    if inlier.sum() - ALWAYS < AGREEING * (count - ALWAYS):
        within = f"{inlier.sum()} of {count} positions agree within {options.max_error:.1f} m"
        reason = f"GPS contradicts the poses: {within}; mend EXIF, or"
        if spread < TOLERANCE:
            near = f"the positions by GPS lie {spread:.1f} m apart"
            reason = f"{near}, too near for what GPS is off by;"
        return _by_direction(up, f"{reason} set metres_per_unit in transforms.json")
    matrix = found["tgt_from_src"].matrix()
    scale, places = float(np.linalg.det(matrix[:, :3])) ** (1.0 / 3.0), known[inlier]
    turn = roll_upright(matrix[:, :3] / scale, places, up, options.max_error)
    if _is_mirrored(turn, places, up, top, options.max_error):
        mend = "mend the references to north or south, east or west in EXIF, where they are wrong"
        return _by_direction(up, f"GPS fits the poses only upside down: {mend}")
    shift = places.mean(axis=0) - scale * turn @ centres[there][inlier].mean(axis=0)
    placed = Placement(scale, turn, shift)
    return replace(placed, residuals=np.linalg.norm(placed.apply(centres) - gps, axis=1))


def _spread(places: Array) -> float:
    """Distance [m] of places [N, 2 or 3] from their middle, root mean square."""
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _apart(places: Array, agreeing: NDArray[np.bool_], width: float) -> NDArray[np.bool_]:
    """Which of places [N, 2 or 3] agree with the poses within `width` metres; none where they all
    lie at one place, as of a receiver that repeats its last: those fit any poses of no size."""
    return agreeing & bool(agreeing.any() and _spread(places[agreeing]) > width)


def _is_mirrored(turn: Array, places: Array, up: Array, top: Array | None, width: float) -> bool:
    """Whether a turn [3, 3] to places [N, 3] in a plane, `width` metres off, puts what is up [3]
    down. Other places, on a line or solid, say nothing of it. A mean `top` [3] of photographs that
    then points up says no: those cameras look up."""
    away = places - places.mean(axis=0)
    spread = np.linalg.svd(away, compute_uv=False) / np.sqrt(len(places))
    lies_in_a_plane = spread[1] > width > spread[2]
    looks_up = top is not None and np.linalg.norm(top) > WANDERING and (turn @ top)[2] > 0.0
    return bool(lies_in_a_plane and (turn @ up)[2] < -0.5 and not looks_up)


def tolerance(spread: float) -> float:
    """How far a position may be from its pose, metres, of positions with that spread in metres."""
    return min(TOLERANCE, max(TOLERATED * spread, min(RECEIVER, LEAST_TOLD * spread)))


def roll_upright(turn: Array, places: Array, up: Array, width: float) -> Array:
    """A rotation [3, 3], rolled about the line of flight so that `up` goes up: places [N, 3] on a
    line say nothing of that roll. It stays for places wider than `width` metres across."""
    _, lengths, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    if lengths[1] / np.sqrt(len(places)) > width:
        return turn
    line = axes[0]
    wanted, is_up = (each - (each @ line) * line for each in (np.array([0, 0, 1.0]), turn @ up))
    if min(np.linalg.norm(wanted), np.linalg.norm(is_up)) < WANDERING:
        return turn
    angle = np.arctan2(line @ np.cross(is_up, wanted), is_up @ wanted)
    return Rotation.from_rotvec(angle * line).as_matrix() @ turn


def _by_direction(up: Array, reason: str) -> Placement:
    """Upright, in the reconstruction's own units."""
    axis = np.cross(up, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), up[2])
    axis = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-9 else np.eye(3)[0]
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    return Placement(1.0, turn, np.zeros(3), reason=reason)


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


def transforms_of(model: Any, placement: Placement, origin: Position | None) -> dict[str, Any]:
    """A transforms.json of a placed model, with its origin's place if coordinates are metres."""
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


def write_scene(scene: Path, model: Any, meta: dict[str, Any]) -> None:
    """Writes points, COLMAP's model and, last of all, transforms.json."""
    folder = scene / MODEL
    folder.mkdir(parents=True, exist_ok=True)
    model.write(folder)
    write_sparse_points(scene / POINTS, *points_of(model))
    write_json(scene / "transforms.json", meta, indent=1)


def write_sparse_points(path: Path, places: Array, colours: NDArray[np.uint8]) -> None:
    """Writes sparse points [P, 3] with their colours [P, 3] as a PLY file."""
    large = np.abs(places).max(initial=0.0) > LARGE
    write_points(path, places.astype(np.float64 if large else np.float32), colours)
