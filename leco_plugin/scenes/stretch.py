"""A stretch of cameras to hold out: a flight line, or an arc, by poses alone.

A photograph between two that are trained on shows what they show. A whole line of them is new.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from leco_plugin.scenes.input_error import InputError

Array = NDArray[np.float64]

LEAST, WANTED, MOST = 1 / 12, 1 / 8, 1 / 4
"""Shares of all cameras that a stretch may have, and the one that it has where nothing decides."""
CLEAR = 0.8
"""Share of the widest gap behind a stretch from which on another gap is as clear an end."""
BESIDE = 1.5
"""A camera stands beside a stretch up to so many times the usual distance between neighbours."""
FEWEST = 12
"""Cameras of which a stretch can be held out."""
TRAINED = 0.5
"""Least share of the cameras that is still trained on."""


class Stretch(NamedTuple):
    """Which cameras are held out, and which are neither tested nor trained on."""

    held_out: list[int]
    beside: list[int]


def find_stretch(positions: Array) -> Stretch:
    """The stretch of cameras near the middle that ends with the widest gap.

    It grows from the camera next to the middle, by the nearest camera each time, and so follows a
    line or an arc whose cameras are nearer to each other than to those of the next line.

    Args:
        positions: [C, 3], in any units.
    Returns:
        Numbers of cameras, in their order.
    Raises:
        ValueError: there are too few cameras, or they stand too close together.
    """
    count = len(positions)
    if count < FEWEST:
        raise ValueError(
            f"there are {count} cameras, and a stretch is held out of {FEWEST} or more"
        )
    order, gaps = _grow(positions)
    low, high = max(2, round(LEAST * count)), round(MOST * count)
    behind = gaps[low - 1 : high]  # behind a stretch of `low` cameras, and so on
    sizes = np.flatnonzero(behind >= CLEAR * behind.max()) + low
    size = int(sizes[np.abs(sizes - WANTED * count).argmin()])
    held_out, rest = order[:size], order[size:]
    away = np.full(len(rest), np.inf)
    for number in held_out:
        away = np.minimum(away, np.linalg.norm(positions[rest] - positions[number], axis=1))
    apart = gaps[gaps > 1e-6 * gaps.max()]
    beside = rest[away <= BESIDE * np.median(apart)] if len(apart) else rest
    if count - size - len(beside) < TRAINED * count:
        raise ValueError(
            f"beside a stretch of {size} of {count} cameras there are {len(beside)} others, too "
            "many to leave them out of training"
        )
    return Stretch(sorted(held_out.tolist()), sorted(beside.tolist()))


def _grow(positions: Array) -> tuple[NDArray[np.int64], Array]:
    """All cameras [C], each the nearest to those before it, and how far it is from them [C - 1]."""
    left = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    order, gaps = [int(left.argmin())], []
    away = np.full(len(positions), np.inf)
    for _ in range(len(positions) - 1):
        away = np.minimum(away, np.linalg.norm(positions - positions[order[-1]], axis=1))
        away[order] = np.inf
        order.append(int(away.argmin()))
        gaps.append(float(away[order[-1]]))
    return np.array(order), np.array(gaps)


def stretch_of(meta: dict[str, Any], scene: str) -> dict[str, list[str]]:
    """Names of the photographs of a transforms.json, by what they are for.

    Args:
        meta: what the file says.
        scene: named in the error.
    Returns:
        `train`, `test`, and `beside`: left out, as they stand next to the tested ones.
    Raises:
        InputError: no stretch can be held out of it.
    """
    poses = np.array([frame["transform_matrix"] for frame in meta["frames"]], dtype=float)
    try:
        found = find_stretch(poses[:, :3, 3])
    except ValueError as error:
        raise InputError(f"{scene}: {error}; hold out photographs of the spread instead") from None
    names: dict[str, list[str]] = {"train": [], "test": [], "beside": []}
    for number, frame in enumerate(meta["frames"]):
        kind = "test" if number in found.held_out else "beside"
        kind = kind if number in found.held_out + found.beside else "train"
        names[kind].append(str(frame["file_path"]))
    return names
