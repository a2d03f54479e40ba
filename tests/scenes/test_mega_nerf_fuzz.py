"""Damaged and hostile files of a Mega-NeRF scene: one line or the file's contents, nothing else.

More than 2,000 files, always the same ones. Whatever is in them, no code runs, nothing takes long,
no memory is taken that was only claimed, and the interpreter survives, or this test would not end.
"""

from __future__ import annotations

import io
import os
import pickle
import resource
import struct
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mega_nerf_scene
import numpy as np
import pytest
import torch
from damaged_bytes import cut, flip, splice
from mega_nerf_scene import rebuilt, saved, zipped
from PIL import Image

from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.mega_nerf_files import read_coordinates, read_frame
from leco_plugin.scenes.mega_nerf_outputs import picture_of, read_mask
from leco_plugin.scenes.photograph_files import DerivedImages

SECONDS = 2.0
MEGABYTES = 400.0


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mega_nerf_scene.write(tmp_path_factory.mktemp("scenes") / "scene", masks=True)


def sound_files(scene: Path) -> dict[str, bytes]:
    """One file of each kind."""
    return {
        "coordinates": (scene / "coordinates.pt").read_bytes(),
        "metadata": (scene / "train/metadata/000003.pt").read_bytes(),
        "mask": (scene / "masks/000003.pt").read_bytes(),
        "picture": (scene / "train/rgbs/000003.png").read_bytes(),
    }


class Reader:
    """Reads files of each kind, and counts what becomes of them."""

    def __init__(self, scene: Path, folder: Path) -> None:
        self.scene, self.folder, self.refused, self.read = scene, folder, 0, 0
        self.image = scene / "train/rgbs/000003.png"
        self.frame = read_frame(scene / "train/metadata/000003.pt", self.image)

    def __call__(self, kind: str, data: bytes) -> None:
        path = self.folder / ("file.png" if kind == "picture" else "000003.pt")
        path.write_bytes(data)
        began = time.thread_time()
        try:
            self._read(kind, path)
            self.read += 1
        except InputError as error:
            line = str(error)
            assert str(path) in line and "\n" not in line and len(line) < 600, line
            self.refused += 1
        assert time.thread_time() - began < SECONDS, (kind, data[:2000])

    def _read(self, kind: str, path: Path) -> None:
        if kind == "coordinates":
            assert read_coordinates(path).metres > 0
        elif kind == "metadata":
            assert np.isfinite(read_frame(path, self.image).pose).all()
        elif kind == "mask":
            assert read_mask(path, 24, 16).shape == (16, 24)
        else:
            read_frame(self.scene / "train/metadata/000003.pt", path)
            derived = DerivedImages(self.folder / "cache")
            frame = self.frame.__class__(**{**vars(self.frame), "image": path})
            picture_of(frame, 2, True, derived).unlink()


@pytest.fixture
def reader(scene: Path, tmp_path: Path) -> Iterator[Reader]:
    before = peak_megabytes()
    yield Reader(scene, tmp_path)
    assert peak_megabytes() - before < MEGABYTES


def peak_megabytes() -> float:
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


@pytest.mark.parametrize("kind", ["coordinates", "metadata", "mask", "picture"])
def test_flipped_cut_and_spliced_files(kind: str, scene: Path, reader: Reader) -> None:
    random = np.random.default_rng(len(kind))
    data = sound_files(scene)[kind]
    for number in range(300):
        reader(kind, (flip, cut, splice)[number % 3](data, random))
    assert reader.refused > 200


def packed(data: bytes) -> bytes:
    """A .pt in a mask's zip."""
    return zipped(data, "000003.pt", zipfile.ZIP_DEFLATED)


def test_archives_that_are_whole_with_pickles_that_are_not(scene: Path, reader: Reader) -> None:
    random = np.random.default_rng(1)
    files = sound_files(scene)
    mask = saved(torch.from_numpy(mega_nerf_scene.mask(3)))
    numbers = [struct.pack("<i", n) for n in (-1, 1 << 20, 2**31 - 1, -(2**31))]

    def spoil(pickled: bytes) -> bytes:
        way = (flip, flip, cut, splice)[random.integers(4)]
        if random.random() < 0.4:  # a number of one byte becomes a large one of four
            places = [i for i in range(len(pickled) - 1) if pickled[i : i + 1] == b"K"]
            place = places[random.integers(len(places))]
            large = b"J" + numbers[random.integers(len(numbers))]
            return pickled[:place] + large + pickled[place + 2 :]
        return way(pickled, random)

    for number in range(450):
        kind = ("coordinates", "metadata", "mask")[number % 3]
        data = rebuilt(mask if kind == "mask" else files[kind], spoil)
        reader(kind, packed(data) if kind == "mask" else data)
    assert reader.refused > 400


def strange_values() -> list[object]:
    """Of types and sizes that do not belong into the format."""
    return [
        None,
        "north",
        b"bytes",
        [1.0],
        {"a": 1},
        {1, 2},
        1j,
        float("nan"),
        float("inf"),
        -1,
        1 << 2000,
        np.float64(1),
        np.zeros((3, 4)),
        Path("a"),
        torch.float32,
        torch.device("cpu"),
        torch.Size([3, 4]),
        torch.zeros(0),
        torch.zeros(3, 4, dtype=torch.complex64),
        torch.full((3, 4), float("nan")),
        torch.zeros(1).expand(3, 4),
        torch.zeros(1).expand(1 << 20, 1 << 10),
        torch.eye(4).to_sparse(),
        torch.quantize_per_tensor(torch.zeros(3, 4), 0.1, 0, torch.qint8),
        torch.nn.Parameter(torch.zeros(3, 4)),
        torch.zeros(3, 4, requires_grad=True),
        torch.zeros(3, 4, dtype=torch.bfloat16),
        torch.ones(16, 24, dtype=torch.uint8),
        torch.ones(1, dtype=torch.bool).expand(16, 24),
        torch.nn.Linear(2, 2),
    ]


@pytest.mark.filterwarnings("ignore")  # what torch thinks of saving them
def test_values_of_other_types(reader: Reader) -> None:
    good = {
        "coordinates": {"origin_drb": torch.zeros(3), "pose_scale_factor": 2.0},
        "metadata": {
            "H": 16,
            "W": 24,
            "c2w": torch.eye(3, 4),
            "intrinsics": torch.ones(4),
            "distortion": torch.zeros(4),
        },
    }
    for value in strange_values():
        for kind, values in good.items():
            reader(kind, saved(value))
            for name in values:
                reader(kind, saved(values | {name: value}))
        reader("mask", packed(saved(value)))
        reader("mask", saved(value))
    assert reader.refused > 200


class Gadget:
    """Calls a function when a trusting reader unpickles it."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def gadgets(marker: Path) -> list[Gadget]:
    import importlib
    import runpy
    import subprocess

    touch, code = f"touch {marker}", f"open({str(marker)!r}, 'w').close()"
    script = marker.with_name("script.py")
    script.write_text(code)
    nested = saved(Gadget(os.system, touch))
    return [
        Gadget(os.system, touch),
        Gadget(os.mkdir, str(marker)),
        Gadget(eval, code),
        Gadget(exec, code),
        Gadget(open, str(marker), "w"),
        Gadget(Path.touch, marker),
        Gadget(subprocess.call, ["touch", str(marker)]),
        Gadget(runpy.run_path, str(script)),
        Gadget(importlib.import_module, "antigravity"),
        Gadget(getattr(torch.storage, "_load_from_bytes"), nested),  # noqa: B009
        Gadget(torch.load, io.BytesIO(nested)),
        Gadget(map, os.system, [touch]),
    ]


def wrapped(gadget: Gadget) -> Iterator[tuple[str, bytes]]:
    """A gadget in each place of each kind of file."""
    for protocol in (2, 4):
        bare = pickle.dumps({"H": gadget}, protocol=protocol)
        for value in ({"H": gadget}, {"c2w": torch.eye(3, 4), "H": [gadget]}, gadget):
            data = saved(value, pickle_protocol=protocol)
            yield from (("coordinates", data), ("metadata", data))
            yield from (("mask", packed(data)), ("mask", data))
        whole = saved({"H": 1})
        yield "metadata", bare
        yield "metadata", rebuilt(whole, lambda _, bare=bare: bare)
        yield "metadata", rebuilt(whole, lambda old, bare=bare: old[:-1] + bare)
        yield "metadata", rebuilt(whole, lambda _, bare=bare: bare, "version")
        yield "mask", packed(bare)
    yield "metadata", saved({"H": gadget}, _use_new_zipfile_serialization=False)


@pytest.mark.filterwarnings("ignore")  # what torch thinks of saving them
def test_nothing_that_a_file_brings_is_run(reader: Reader, tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    runs, files = 0, 0
    for gadget in gadgets(marker):
        for kind, data in wrapped(gadget):
            reader(kind, data)
            files += 1
        assert not marker.exists(), gadget.call
        function, arguments = gadget.call
        if function in (os.system, eval, exec, open):  # it would, if it were trusted
            function(*arguments)
            assert marker.exists()
            marker.unlink()
            runs += 1
    by_hand = f"(S'touch {marker}'\nios\nsystem\n.", f"cos\nsystem\n(S'touch {marker}'\ntR."
    for text in by_hand:
        reader("metadata", rebuilt(saved({"H": 1}), lambda _, text=text: text.encode()))
    assert not marker.exists()
    assert runs == 4 and files > 300
    assert reader.read == 0


def test_bombs_and_vast_claims(scene: Path, reader: Reader) -> None:
    for way, size in ((zipfile.ZIP_DEFLATED, 80), (zipfile.ZIP_BZIP2, 2), (zipfile.ZIP_LZMA, 2)):
        reader("mask", zipped(bytes(size << 20), "000003.pt", way))
        for name in ("archive/data.pkl", "archive/data/0"):
            bomb = zipped(bytes(size << 20), name, way)
            reader("metadata", bomb)
            reader("mask", packed(bomb))
    many = io.BytesIO()
    with zipfile.ZipFile(many, "w") as archive:
        for number in range(5000):
            archive.writestr(f"archive/data/{number}", b"")
    reader("metadata", many.getvalue())
    for data in (many.getvalue(), saved(torch.ones(16, 24, dtype=torch.bool))):
        reader("mask", packed(packed(data)))
    picture = sound_files(scene)["picture"]
    for side in (0, 1 << 14, 1 << 16, (1 << 31) - 1):
        reader("picture", picture[:16] + struct.pack(">II", side, side) + picture[24:])
    postscript = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 16\n%%EndComments\n"
    reader("picture", postscript + b"(marker) (w) file\n%%EOF\n")
    assert reader.read == 0
    # sizes in the directory of an archive; some are right, or do not matter
    data = sound_files(scene)["mask"]
    directory = data.rindex(b"PK\x01\x02")
    for size in (0, 1, 1 << 16, (1 << 32) - 2):
        for place in (20, 24, 42):
            start = directory + place
            reader("mask", data[:start] + struct.pack("<I", size) + data[start + 4 :])


def test_a_picture_of_another_kind_is_refused(reader: Reader) -> None:
    for form in ("TIFF", "BMP", "GIF", "PPM"):
        file = io.BytesIO()
        Image.new("RGB", (24, 16)).save(file, format=form)
        reader("picture", file.getvalue())
    assert reader.refused == 4
