"""A .pt file is data: what could run, or claims more than it has, is refused in one line."""

from __future__ import annotations

import io
import os
import pickle
import re
import time
import zipfile
from collections import OrderedDict
from pathlib import Path, PosixPath

import numpy as np
import pytest
import torch
from mega_nerf_scene import rebuilt, saved, zipped
from scene_files import refused

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.pt_file import load, read_pt

VALUES = {
    "c2w": torch.arange(12.0).view(3, 4),
    "turned": torch.arange(12.0).view(3, 4).T,
    "mask": torch.tensor([True, False]),
    "half": torch.ones(2, dtype=torch.bfloat16),
    "H": 4000,
    "large": 1 << 70,
    "scale": 0.5,
    "flag": True,
}


def refusal(data: bytes) -> str:
    with pytest.raises(InputError) as caught:
        load(data, "poses/7.pt")
    line = str(caught.value)
    assert line.startswith("poses/7.pt ") and "\n" not in line
    return line


def test_what_torch_saves_comes_back() -> None:
    loaded = load(saved(VALUES), "file")
    assert loaded.keys() == VALUES.keys()
    for name, value in VALUES.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(loaded[name], value) and loaded[name].dtype == value.dtype
        else:
            assert loaded[name] == value


def test_views_and_shared_storages_come_back() -> None:
    whole = torch.arange(20.0)
    first, second = load(saved([whole[3:9:2], whole]), "file")
    assert torch.equal(first, whole[3:9:2]) and torch.equal(second, whole)
    assert load(saved(torch.zeros(0, 4)), "file").shape == (0, 4)
    assert load(saved(OrderedDict(H=3)), "file") == {"H": 3}


class Runs:
    """Runs a command when unpickled by a reader that trusts it."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    assert "posix.system" in refusal(saved({"H": Runs(marker)}))
    assert "torch 1.6" in refusal(pickle.dumps({"H": Runs(marker)}))
    assert "torch 1.6" in refusal(saved(Runs(marker), _use_new_zipfile_serialization=False))
    assert not marker.exists()
    pickle.loads(pickle.dumps(Runs(marker)))  # else this test would prove nothing
    assert marker.exists()


@pytest.mark.parametrize("value", [np.float64(1.0), Path("a"), np.zeros(3)])
def test_what_is_no_tensor_and_no_number_is_named(value: object) -> None:
    with torch.serialization.safe_globals([Path, PosixPath]):  # as processes have their own
        assert "only tensors and numbers are read" in refusal(saved({"x": value}))
    assert "only tensors and numbers are read" in refusal(saved({"x": value}))


@pytest.mark.filterwarnings("ignore")  # what torch thinks of making and saving them
def test_tensors_of_other_kinds_are_refused() -> None:
    for value in (
        torch.eye(3).to_sparse(),
        torch.zeros(3, dtype=torch.complex64),
        torch.quantize_per_tensor(torch.zeros(3), 0.1, 0, torch.qint8),
        torch.nn.Parameter(torch.zeros(3)),
        torch.zeros(3, device="meta"),
    ):
        for held in (value, {"x": value}):
            assert re.search("only tensors (of plain|and) numbers", refusal(saved(held)))


HUGE = b"\x8a\x06\0\0\0\0\0\x01"  # 2^40
MAPPING = b"ccollections\nOrderedDict\n"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"K\x0ctq", b"J\0\0\0\x70tq"),
        (b"K\x0ctq", b"J\xff\xff\xff\xfftq"),
        (b"K\x0ctq", b"K\x0dtq"),
        (b"FloatStorage", b"DoubleStorage"),
        (b"X\x01\0\0\x000q", b"X\x01\0\0\x007q"),
        (b"K\x00K\x0c\x85", b"K\x05K\x0c\x85"),
        (b"K\x01\x85q", b"K\x02\x85q"),
        (b"K\x0c\x85q", b"J\xff\xff\xff\xff\x85q"),
        (b"K\x0c\x85q", HUGE + b"\x85q"),
        (b"K\x0c\x85q", b"K\x0cK\x01\x86q"),
        (b"K\x0c\x85q", b"]q"),
        (b"\x89" + MAPPING, b"N" + MAPPING),
    ],
)
def test_a_tensor_is_believed_only_as_far_as_its_bytes(old: bytes, new: bytes) -> None:
    def replace(pickled: bytes) -> bytes:
        assert old in pickled
        return pickled.replace(old, new)

    assert "is damaged" in refusal(rebuilt(saved(torch.zeros(12)), replace))


SLOW_KEY = b"}(K\x01\x85q\x00" + b"h\x00h\x00\x86q\x00" * 60
"""A dictionary and pairs of pairs of pairs: a key whose hash takes 2^60 steps."""
DEEP_KEY = b"}K\x01" + b"\x85" * 400_000
"""A key in 400,000 tuples, one in the other: hashing it ends the process."""


@pytest.mark.parametrize(
    ("pickled", "reason"),
    [
        (b"\x80\x02" + SLOW_KEY + b"u.", "in a way that torch does not"),
        (b"\x80\x02" + DEEP_KEY + b"Ns.", "far too many"),
        (b"\x80\x02" + b"N" * 70_000 + b".", "far too many"),
        (b"\x80\x02]" + b"q\x00h\x00\x85" * 3_000 + b".", "in a way"),
        (b"\x80\x02r\xff\xff\xff\x7fN.", "is damaged"),
        (b"\x80\x02cos\nsystem\n.", "holds os.system, and only tensors and numbers"),
        (b"\x80\x02ctorch.jit\n_load\n.", "holds torch.jit._load"),
        (b"", "is damaged"),
        (b"\x80\x02h\x07.", "is damaged"),
        (b"\x80\x02X\xff\xff\xff\x7fa.", "is damaged"),
    ],
    ids=map(str, range(10)),
)
def test_a_strange_pickle_is_refused_at_once(pickled: bytes, reason: str) -> None:
    data = rebuilt(saved({"H": 1}), lambda _: pickled)
    began = time.thread_time()
    assert re.search(reason, refusal(data))
    assert time.thread_time() - began < 2


def test_a_compressed_archive_is_refused_before_it_is_unpacked() -> None:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02N.")
        archive.writestr("archive/data/0", bytes(50_000_000))
    assert len(file.getvalue()) < 100_000
    assert "compressed" in refusal(file.getvalue())


def test_a_zip_of_something_else_is_named() -> None:
    assert "is a zip, but not one of torch.save" in refusal(zipped(b"sun", "holiday.txt"))


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    (tmp_path / "large.pt").write_bytes(bytes(2000))
    os.mkfifo(tmp_path / "pipe.pt")  # reading it would wait for ever
    for name, reason in (
        ("large.pt", "has 2000 bytes"),
        ("none.pt", "no file"),
        ("pipe.pt", "no file"),
        (".", "no file"),
    ):
        with refused(reason):
            read_pt(tmp_path / name, 1000)
