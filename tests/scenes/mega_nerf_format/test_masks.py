"""A mask is a zip that holds a .pt of its own name, of the picture's size."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from mega_nerf_scene import pack, write_mask

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.mega_nerf_format.outputs import read_mask

KEEP = np.random.default_rng(0).random((6, 9)) < 0.5


def test_a_mask_comes_back_as_it_was_written(tmp_path: Path) -> None:
    write_mask(tmp_path, "a", KEEP)
    np.testing.assert_array_equal(read_mask(tmp_path / "a.pt", 9, 6), KEEP)


def test_a_mask_of_another_size_is_named(tmp_path: Path) -> None:
    write_mask(tmp_path, "a", KEEP)
    with pytest.raises(InputError, match=r"a\.pt is a mask of 9 x 6 pixels, its picture has 6 x 9"):
        read_mask(tmp_path / "a.pt", 6, 9)


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        (torch.ones(6, 9), "a tensor of float32, 6 x 9"),
        (torch.ones(6, 9, 1, dtype=torch.bool), "a tensor of bool, 6 x 9 x 1"),
        ({"mask": torch.ones(6, 9, dtype=torch.bool)}, "a value of type dict"),
    ],
)
def test_what_is_no_mask_is_named(value: object, reason: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=reason):
        read_mask(pack(tmp_path / "a.pt", value), 9, 6)


def test_a_zip_without_the_mask_and_a_bare_pt_are_named(tmp_path: Path) -> None:
    pack(tmp_path / "a.pt", torch.from_numpy(KEEP), "b.pt")
    torch.save(torch.from_numpy(KEEP), tmp_path / "c.pt")
    for name in "ac":
        with pytest.raises(InputError, match=f"is a zip without {name}.pt"):
            read_mask(tmp_path / f"{name}.pt", 9, 6)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.pt", bytes(60_000_000))
    assert (tmp_path / "a.pt").stat().st_size < 100_000
    with pytest.raises(InputError, match=r"a\.pt unpacks to more than"):
        read_mask(tmp_path / "a.pt", 300, 200)


def test_other_compressions_and_large_files_are_refused(tmp_path: Path) -> None:
    pack(tmp_path / "a.pt", torch.from_numpy(KEEP), compression=zipfile.ZIP_BZIP2)
    with pytest.raises(InputError, match="does not use"):
        read_mask(tmp_path / "a.pt", 9, 6)
    (tmp_path / "a.pt").write_bytes(bytes(1 << 20))
    with pytest.raises(InputError, match="needs no more than"):
        read_mask(tmp_path / "a.pt", 9, 6)


def test_no_mask_and_a_damaged_one_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no file"):
        read_mask(tmp_path / "a.pt", 9, 6)
    (tmp_path / "a.pt").write_bytes(b"PK\x03\x04")
    with pytest.raises(InputError, match="is not a zip with a mask"):
        read_mask(tmp_path / "a.pt", 9, 6)
