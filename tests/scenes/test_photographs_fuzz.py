"""Damaged descriptions and points of a scene: one line or what they hold, nothing else."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damaged_bytes import cut, flip, splice
from scene_files import read_ply

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.photographs import read_scene

SECONDS = 2.0


def read(path: Path, data: bytes, reader: Callable[[Path], Any]) -> bool:
    """Whether a file of these bytes is read; else it is refused in one line that names it."""
    path.write_bytes(data)
    began = time.thread_time()
    try:
        reader(path)
        accepted = True
    except InputError as error:
        line = str(error)
        assert str(path.parent) in line
        assert "\n" not in line and len(line) < 600, line
        accepted = False
    assert time.thread_time() - began < SECONDS, data[:2000]
    return accepted


def test_flipped_cut_and_spliced_descriptions(scene: Path) -> None:
    path, random = scene / "transforms.json", np.random.default_rng(1)
    data = path.read_bytes()
    taken = sum(
        read(path, (flip, cut, splice)[number % 3](data, random), read_scene)
        for number in range(450)
    )
    assert taken < 150


STRANGE: list[Any] = [None, True, -1, 0, 1e400, 10**400, "", "a\nb", "\0", [], {}, [[]], [1, "a"]]


def test_values_of_other_types_anywhere_in_a_description(scene: Path) -> None:
    path = scene / "transforms.json"
    good = json.loads(path.read_text())
    for value in STRANGE:
        for name in good:
            read(path, json.dumps(good | {name: value}).encode(), read_scene)
        for name in ("file_path", "transform_matrix", "mask_path", "w", "fl_x"):
            frames = [good["frames"][0] | {name: value}, *good["frames"][1:]]
            left = {key: part for key, part in good.items() if key != name}
            read(path, json.dumps(left | {"frames": frames}).encode(), read_scene)
        read(path, json.dumps(value).encode(), read_scene)
    assert not read(path, b"[" * 100_000, read_scene)


def ply(binary: bool) -> bytes:
    """Forty points with colours."""
    form = "binary_little_endian" if binary else "ascii"
    rows = "".join(f"property float {axis}\n" for axis in "xyz")
    rows += "".join(f"property uchar {colour}\n" for colour in ("red", "green", "blue"))
    head = f"ply\nformat {form} 1.0\nelement vertex 40\n{rows}end_header\n".encode()
    if binary:
        return head + b"".join(struct.pack("<fffBBB", n, -n, 0.5, n, n, n) for n in range(40))
    return head + b"".join(f"{n} {-n} 0.5 {n} {n} {n}\n".encode() for n in range(40))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numbers too large for single precision
@pytest.mark.parametrize("binary", [False, True])
def test_flipped_cut_and_spliced_points(binary: bool, tmp_path: Path) -> None:
    path, random, data = tmp_path / "points.ply", np.random.default_rng(2), ply(binary)
    path.write_bytes(data)
    assert len(read_ply(path)) == 40

    def finite(path: Path) -> None:
        assert bool(read_ply(path).isfinite().all())

    for number in range(300):
        read(path, (flip, cut, splice)[number % 3](data, random), finite)
    for count in (b"0", b"41", b"4000000000", b"-1", b"1e9", b"99999999999999999999"):
        read(path, data.replace(b"vertex 40", b"vertex " + count), finite)


def test_points_that_name_a_texture_open_nothing_else(tmp_path: Path) -> None:
    data = ply(True).replace(b"element", b"comment TextureFile ../secret.png\nelement", 1)
    (tmp_path / "points.ply").write_bytes(data)
    assert len(read_ply(tmp_path / "points.ply")) == 40
