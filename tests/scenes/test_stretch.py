"""A stretch of cameras that is held out is a line or an arc, and its neighbours teach nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_scene as tiny
from scene_files import change, described, refused

from leco_plugin.scenes.photographs import (
    BESIDE,
    LEAST,
    MOST,
    LecoPhotographsDataParserConfig,
    describe_held_out,
    find_stretch,
    stretch_of,
)

Array = np.ndarray


def lines(count: int = 8, each: int = 10, along: float = 1.0, across: float = 2.0) -> Array:
    """A survey of parallel lines [count * each, 3], flown to and fro at one height."""
    places = [
        (line * across, (step if line % 2 == 0 else each - 1 - step) * along, 5.0)
        for line in range(count)
        for step in range(each)
    ]
    return np.array(places) + np.random.default_rng(0).normal(0.0, 0.03, (count * each, 3))


def circle(count: int = 40) -> Array:
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles), np.ones(count)], axis=1)


def apart(positions: Array, held_out: list[int], others: Any) -> float:
    """The least distance between a camera that is held out and one of the others."""
    between = positions[held_out][:, None] - positions[list(others)][None]
    return float(np.linalg.norm(between, axis=-1).min())


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_of_parallel_lines_one_is_held_out_whole_whatever_the_order(turn: float) -> None:
    rotation = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    positions = 1e3 * lines() @ rotation.T + 5e5
    held_out, beside = find_stretch(positions)
    (line,) = {number // 10 for number in held_out}
    assert len(held_out) == 10 and beside == [] and 0 < line < 7
    order = np.random.default_rng(1).permutation(len(positions))
    again, _ = find_stretch(positions[order])
    assert sorted(order[again].tolist()) == held_out


def test_short_lines_are_held_out_whole_several_together() -> None:
    held_out, beside = find_stretch(lines(count=30, each=4))
    numbers = {number // 4 for number in held_out}
    assert len(held_out) == 4 * len(numbers) and len(numbers) > 1 and beside == []


def test_of_a_circle_an_arc_is_held_out_and_the_cameras_at_its_ends_are_left_out() -> None:
    positions = circle()
    held_out, beside = find_stretch(positions)
    assert LEAST * 40 <= len(held_out) <= MOST * 40
    gaps = np.diff([*held_out, held_out[0] + 40])
    assert sorted(gaps.tolist())[-2:] == [1, 41 - len(held_out)]  # one arc
    assert len(beside) == 2
    trained = set(range(40)) - {*held_out, *beside}
    spacing = apart(positions, [0], [1])
    assert apart(positions, held_out, trained) > BESIDE * spacing


def test_what_is_beside_is_measured_by_the_usual_distance_not_by_a_few_wide_gaps() -> None:
    """A line whose gap ends the stretch: the wide steps at its ends do not make it all beside."""
    along = np.concatenate([[0.0, 40.0], 60.0 + np.arange(-15, 15), [130.0, 170.0]])
    positions = np.stack([along, 0.0 * along, 0.0 * along], axis=1)
    held_out, beside = find_stretch(positions)
    assert len(beside) == 2 and apart(positions, beside, held_out) == 1.0


def test_of_a_cloud_what_is_held_out_hangs_together_and_has_no_neighbour_in_training() -> None:
    positions = np.random.default_rng(0).normal(size=(200, 3))
    held_out, beside = find_stretch(positions)
    trained = set(range(200)) - {*held_out, *beside}
    assert LEAST * 200 <= len(held_out) <= MOST * 200 and len(trained) >= 100
    reached = {held_out[0]}
    for _ in held_out:
        reached |= {one for one in held_out if apart(positions, [one], reached) < 1.0}
    assert reached == set(held_out)
    nearest = [apart(positions, [one], trained) for one in held_out]
    usual = np.median([apart(positions, [one], set(range(200)) - {one}) for one in range(200)])
    assert min(nearest) > usual


@pytest.mark.parametrize(
    ("positions", "said"),
    [
        (circle(11), "11 cameras, and a stretch is held out of 12"),
        (np.zeros((40, 3)), "too many to leave them out"),
    ],
)
def test_too_few_cameras_or_a_single_place_is_said_in_a_line(positions: Array, said: str) -> None:
    frames = [{"file_path": "a", "transform_matrix": np.eye(4)} for _ in positions]
    for frame, position in zip(frames, positions):
        frame["transform_matrix"][:3, 3] = position
    with refused(f"^scene: .*{said}.*the spread instead$"):
        stretch_of({"frames": frames}, "scene")


def test_the_reader_tests_on_the_stretch_and_trains_on_what_is_not_beside_it(
    tmp_path: Path,
) -> None:
    scene = tiny.write(tmp_path / "ball", train=18, test=2, size=8)
    change(scene, lambda meta: meta["frames"].reverse())
    spread = {
        part: _names(LecoPhotographsDataParserConfig(data=scene), part)
        for part in ("train", "test")
    }
    assert spread == {part: set(described(scene)[f"{part}_filenames"]) for part in spread}
    config = LecoPhotographsDataParserConfig(data=scene, held_out="stretch")
    found = {part: _names(config, part) for part in ("train", "val", "test")}
    said = describe_held_out(scene, "stretch")
    assert found["test"] == found["val"] == set(said["test"]) != spread["test"]
    every = {frame["file_path"] for frame in described(scene)["frames"]}
    assert said["beside"] and found["train"] == every - {*said["test"], *said["beside"]}
    assert describe_held_out(scene, "spread") == {"kind": "spread"}


def _names(config: LecoPhotographsDataParserConfig, part: str) -> set[str]:
    images = config.setup().get_dataparser_outputs(part).image_filenames
    return {str(image.relative_to(config.data)) for image in images}
