"""What a path to an occupancy means, and what is said where it means none."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from ball_occupancy import ball

from leco_plugin.hosts.guided_start import load_occupancy, occupancy_file
from leco_plugin.scenes.input_error import InputError

NAME = "occupancy.safetensors"


def test_a_file_a_folder_and_the_newest_in_a_folder(tmp_path: Path) -> None:
    run = tmp_path / "scene" / "leco-occupancy" / "run"
    run.mkdir(parents=True)
    older, newer = run / NAME, tmp_path / "scene" / "later" / NAME
    newer.parent.mkdir()
    for age, file in enumerate([newer, older]):
        ball().save(file)
        os.utime(file, (1e9 - age, 1e9 - age))
    assert occupancy_file(older) == older
    assert occupancy_file(run) == older
    assert occupancy_file(tmp_path) == newer


def bad_paths(folder: Path) -> dict[str, tuple[Path, str]]:
    """Paths that a user may well give, and what is said of them."""
    whole = folder / NAME
    ball().save(whole)
    damaged = bytearray(whole.read_bytes())
    damaged[-10] ^= 1
    (folder / "damaged").write_bytes(damaged)
    (folder / "cut").write_bytes(damaged[:2000])
    (folder / "text").write_text("no occupancy")
    (folder / "empty").mkdir()
    return {
        "no file": (folder / "none", "there is no occupancy .*none: train leco-occupancy"),
        "no file in a folder": (folder / "empty", f"there is no occupancy .*empty/{NAME}"),
        "a damaged file": (folder / "damaged", "damaged is damaged: .* checksum"),
        "a file cut short": (folder / "cut", "cut is no safetensors file, or not a whole one"),
        "another file": (folder / "text", "text is no safetensors file, or not a whole one"),
    }


def test_bad_paths_are_named_in_a_line(tmp_path: Path) -> None:
    for what, (path, message) in bad_paths(tmp_path).items():
        with pytest.raises(InputError, match=message) as error:
            load_occupancy(path)
        assert "\n" not in str(error.value), what
