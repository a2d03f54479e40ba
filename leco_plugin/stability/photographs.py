"""The scenes of the cases, photographed and written in nerfstudio's format, with the truth.

All but the far ones lie within four metres of the middle. Whatever stands in them is grey; only the
sky is blue. A host learns hue late, in some seeds hundreds of steps later than in others, and this
says nothing about where it samples.

What goes wrong touches the training pictures only: the held-out ones show what is really there.
truth/NAME.npz holds, for each held-out picture, `depth` [h, w] in metres along the rays (inf for no
surface), `detail` [h, w], the pixels in which something is seen that the case is about, and
`shown_by` [h, w], how many training pictures show the same surface.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from leco_plugin.scenes.city.cameras import Lens, look_at
from leco_plugin.scenes.city.folder import POINTS, TRANSFORMS, frame_of, transforms_of
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_json, write_points
from leco_plugin.stability.scene import (
    Array,
    Ball,
    Box,
    Fog,
    Paint,
    Pane,
    Rod,
    Seen,
    Shape,
    Stage,
    photograph,
)


def grey(lightness: float, grain: float = Paint.grain, contrast: float = Paint.contrast) -> Paint:
    """A paint without a hue."""
    return Paint((lightness, lightness, lightness), grain, contrast)


BRICK, SAND, LAWN, SLATE = grey(0.36), grey(0.86), grey(0.48), grey(0.26)
STEEL, CAR = grey(0.17, contrast=0.1), grey(0.95, grain=2.0)

FLOOR = Box((-3.6, -3.6, -0.3), (3.6, 3.6, 0.0), grey(0.59, grain=1.1))
HOUSES: tuple[Shape, ...] = (
    Box((-2.4, -2.2, 0.0), (-1.0, -0.8, 1.6), BRICK),
    Box((0.9, 0.8, 0.0), (2.2, 2.4, 1.1), SAND),
    Box((-1.9, 1.1, 0.0), (-0.9, 2.3, 0.7), SLATE),
    Ball((1.5, -1.4, 0.6), 0.6, LAWN),
)
YARD = Stage((FLOOR, *HOUSES))
"""A few things on a floor: what every method can learn."""


def _poles_and_wires() -> tuple[Shape, ...]:
    feet = [(x, y) for x in (-3.0, 0.0, 3.0) for y in (-3.0, 3.0)]
    poles = [Rod((x, y, 0.0), (x, y, 1.9), 0.04, STEEL) for x, y in feet]
    wires = [Rod((-3.0, y, z), (3.0, y, z), 0.02, STEEL) for y in (-3.0, 3.0) for z in (1.5, 1.85)]
    return (*poles, *wires)


def _irregular_floor() -> tuple[Shape, ...]:
    """Plates that leave bays and an island: no box fits the outline."""
    plates = (
        *(((-3.6, -1.0), (-0.4, 1.2)), ((-0.4, -0.2), (1.6, 3.4))),
        *(((-2.0, -3.4), (-0.9, -1.0)), ((2.3, -3.2), (3.5, -1.7))),
    )
    return tuple(Box((*low, -0.3), (*high, 0.0), FLOOR.paint) for low, high in plates)


def _hills() -> tuple[Shape, ...]:
    """A plain, and hills at several times the scene's size."""
    plain = Box((-40.0, -40.0, -0.6), (40.0, 40.0, -0.31), grey(0.41, grain=6.0))
    turns = 2.0 * np.pi * np.arange(7) / 7
    hills = [
        Ball((24.0 * float(np.cos(a)), 24.0 * float(np.sin(a)), -7.0), 11.0, plain.paint)
        for a in turns
    ]
    return (plain, *hills)


_ROOM = (
    Box((-3.5, -3.5, 0.0), (3.5, 3.5, 2.6), grey(0.77, grain=1.6)),
    Box((-1.0, -0.6, 0.0), (1.0, 0.6, 0.8), BRICK),
    Box((2.4, -3.2, 0.0), (3.3, -1.4, 2.0), SLATE),
    Ball((-2.4, 2.3, 0.5), 0.5, LAWN),
)
_AIR = Box((-3.6, -3.6, 0.0), (3.6, 3.6, 2.4), grey(0.76, grain=3.0, contrast=0.15))
_EVERYWHERE = Box((-6.0, -6.0, -2.0), (6.0, 6.0, 6.0), grey(0.51, 2.4, 0.5))
_WINDOWS = (
    Pane(Box((-0.6, -2.6, 0.0), (-0.56, -0.2, 1.8), grey(0.50, grain=2.0)), 0.35),
    Pane(Box((0.2, 0.3, 0.0), (2.6, 0.34, 1.5), grey(0.56, grain=2.0)), 0.35),
)

STAGES: dict[str, Stage] = {
    "yard": YARD,
    "poles-and-wires": Stage(YARD.shapes, details=_poles_and_wires()),
    "glass": Stage(YARD.shapes, panes=_WINDOWS),
    "fog": Stage(YARD.shapes, fog=Fog(_AIR, 0.25)),
    "all-empty": Stage(sky=True),
    "all-full": Stage(fog=Fog(_EVERYWHERE, 0.9)),
    "far-terrain": Stage((*YARD.shapes, *_hills()), sky=True),
    "outline": Stage((*_irregular_floor(), Box((-2.6, -0.6, 0.0), (-1.4, 0.6, 1.2), BRICK))),
    "indoors": Stage(_ROOM),
}


RADIUS = 5.0
"""Of the circle that cameras stand on, metres."""
STRAY_RADIUS = 9.0
"""Of a camera that stands far off, metres."""
DESCRIPTION, TRUTH = "stability.json", "truth"
POINTS_PER_VIEW = 60


@dataclass(frozen=True)
class Capture:
    """How a scene is photographed: two captures that are equal give the same pictures."""

    views: int = 48
    """Training pictures: so many, so wide and from so far that three of them show nearly all that
    the held-out ones show. From 40 narrow ones nearer by, a wall was placed by chance."""
    test_views: int = 16
    width: int = 64
    height: int = 48
    """Of a picture, pixels."""
    field_of_view: float = 60.0
    """Horizontal opening angle, degrees."""
    stand: str = "around"
    """`around` the scene and above it, `low` around it with the horizon in view, or `inside`."""
    stray: int = 0
    """Training pictures that are taken from far outside."""
    exposure: float = 0.0
    """Standard deviation of the exposure, stops."""
    shift: float = 0.0
    """Standard deviation of each coordinate that is written of a camera's position, metres."""
    turn: float = 0.0
    """Standard deviation of each angle that is written of its attitude, degrees."""
    moving: bool = False
    """Whether a car drives through every third picture."""
    sizes: tuple[float, ...] = (1.0,)
    """Multiples of width and height that pictures take in turn."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the scene's middle lies in the coordinates that are written, metres."""
    seed: int = 0
    """Another seed, other places to stand."""

    def lens(self, times: float = 1.0) -> Lens:
        """The camera of pictures of a multiple of the size."""
        width, height = round(times * self.width), round(times * self.height)
        return Lens(width, height, width / 2 / float(np.tan(np.deg2rad(self.field_of_view) / 2)))


@dataclass(frozen=True)
class Shot:
    name: str
    pose: Array
    """[3, 4] where the camera really is, metres, OpenGL axes."""
    written: Array
    """[3, 4] where the scene's description says it is."""
    held_out: bool
    size: float = 1.0
    """Multiple of width and height."""
    gain: float = 1.0
    """Multiple of the light."""
    moving: bool = False
    """Whether the car is there."""

    @property
    def file(self) -> str:
        """The picture, in the folder of the scene."""
        return f"images/{self.name}.png"


def shots_of(capture: Capture) -> list[Shot]:
    """All pictures of a capture, always the same."""
    random = np.random.default_rng([capture.seed, 21])
    poses = [_pose(capture, random, number) for number in range(capture.views + capture.test_views)]
    places = (np.arange(capture.test_views) + 0.5) * len(poses) / capture.test_views
    held_out = set(places.astype(int).tolist())
    noise = np.random.default_rng([capture.seed, 22])
    shots: list[Shot] = []
    for number, pose in enumerate(poses):
        name = f"view_{number:03d}"
        if number in held_out:
            shots.append(Shot(name, pose, _shift(pose, capture.origin), True))
            continue
        trained = number - sum(other < number for other in held_out)
        if trained < capture.stray:
            pose = np.column_stack([pose[:, :3], pose[:, 3] * (STRAY_RADIUS / RADIUS)])
        turn = Rotation.from_rotvec(np.deg2rad(capture.turn) * noise.standard_normal(3))
        turned = turn.as_matrix() @ pose[:, :3]
        misjudged = np.column_stack([turned, pose[:, 3]])
        misjudged = _shift(misjudged, capture.shift * noise.standard_normal(3))
        written = _shift(misjudged, capture.origin)
        size = capture.sizes[trained % len(capture.sizes)]
        gain = float(2.0 ** (capture.exposure * noise.standard_normal()))
        moving = capture.moving and trained % 3 == 0
        shots.append(Shot(name, pose, written, False, size, gain, moving))
    return shots


def _pose(capture: Capture, random: Generator, number: int) -> Array:
    if capture.stand == "inside":
        turn, up = random.uniform(0, 2 * np.pi), random.uniform(-0.35, 0.05)
        x, y = random.uniform((-1.0, -2.9), (1.0, -0.9))
        position = np.array([x, y, random.uniform(1.2, 1.8)])
        return look_at(position, position + np.array([np.cos(turn), np.sin(turn), up]))
    turn = 2 * np.pi * (0.618034 * number + random.uniform(-0.05, 0.05))
    low, high = (1.0, 2.0) if capture.stand == "low" else (2.2, 4.0)
    place = RADIUS * np.array([np.cos(turn), np.sin(turn)])
    position = np.array([*place, random.uniform(low, high)])
    target_height = random.uniform(0.6, 1.6) if capture.stand == "low" else random.uniform(0, 0.6)
    return look_at(position, np.array([*random.uniform(-1.2, 1.2, 2), target_height]))


def _shift(pose: Array, by: Sequence[float] | Array) -> Array:
    return np.column_stack([pose[:, :3], pose[:, 3] + np.array(by)])


def count_views(seen: Seen, others: Sequence[Seen]) -> NDArray[np.int32]:
    """[h, w] how many of the other pictures show what a picture shows; 0 where it shows nothing.

    A surface in one picture alone has no depth that could be learned: whether it is kept is chance.
    """
    counts = np.zeros(seen.depth.shape, dtype=np.int32)
    there = np.isfinite(seen.depth)
    points = seen.lens.points(seen.pose, seen.depth)[there]
    for other in others:
        counts[there] += other.shows(points)
    return counts


def write_scene(stage: Stage, capture: Capture, folder: Path) -> Path:
    """Writes the scene to `folder`, unless it holds just this one; returns the folder.

    The scene appears only when it is complete; one process at a time may write it. A folder with
    something else is an `InputError`.
    """
    description = folder / DESCRIPTION
    described = {"digest": digest_of(stage, capture), "capture": asdict(capture)}
    text = json.dumps(described, indent=1) + "\n"
    if folder.exists():
        if not description.is_file():
            raise InputError(f"{folder} holds something else; delete it, or name a new --out")
        if description.read_bytes() == text.encode():
            return folder
        shutil.rmtree(folder)
    unfinished = folder.with_name(f".{folder.name}")  # that of a killed run is removed
    shutil.rmtree(unfinished, ignore_errors=True)
    for name in ("images", TRUTH):
        (unfinished / name).mkdir(parents=True)
    _take_pictures(stage, capture, unfinished)
    (unfinished / DESCRIPTION).write_text(text)
    unfinished.replace(folder)
    return folder


def digest_of(stage: Stage, capture: Capture) -> str:
    return hashlib.sha256(repr((stage, capture)).encode()).hexdigest()[:16]


def _take_pictures(stage: Stage, capture: Capture, folder: Path) -> None:
    """Writes pictures, truth, sparse points and transforms."""
    taken: list[tuple[Shot, Seen]] = []
    for number, shot in enumerate(shots_of(capture)):
        there = stage
        if shot.moving:  # a car, never twice in the same place
            x = -3.0 + (1.7 * number) % 6.0
            car = Box((x - 0.5, -0.35, 0.0), (x + 0.5, 0.25, 0.55), CAR)
            there = replace(stage, shapes=(*stage.shapes, car))
        taken.append((shot, photograph(there, shot.pose, capture.lens(shot.size))))
    trained = [seen for shot, seen in taken if not shot.held_out]
    clouds, frames = [], []
    for number, (shot, seen) in enumerate(taken):
        light = seen.image[..., :3].astype(float) * shot.gain
        image = np.dstack([np.rint(light.clip(0, 255)).astype(np.uint8), seen.image[..., 3]])
        Image.fromarray(image).save(folder / shot.file)
        if shot.held_out:
            shown = count_views(seen, trained)
            truth = {"depth": seen.depth, "detail": seen.detail, "shown_by": shown}
            np.savez(folder / TRUTH / f"{shot.name}.npz", **truth)
        random = np.random.default_rng([capture.seed, 23, number])
        clouds.append(
            seen.lens.some_points(shot.written, seen.depth, seen.image, POINTS_PER_VIEW, random)
        )
        frames.append(frame_of(shot.written, file_path=shot.file, **seen.lens.intrinsics))
    facts = {"orientation_override": "none"}
    places, colours = map(np.concatenate, zip(*clouds))
    if len(places):
        write_points(folder / POINTS, places, colours)
        facts["ply_file_path"] = POINTS
    held_out = [shot.file for shot, _ in taken if shot.held_out]
    write_json(folder / TRANSFORMS, transforms_of(facts, frames, held_out), indent=1)
