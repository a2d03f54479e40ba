"""Photographs decoded once, one by one, into files of bare bytes, of which single pixels are read.

A batch asks for a few thousand pixels of thousands of photographs. Here that takes the memory of
the batch; the files may lie in the system's cache, which gives way to whatever needs memory.
"""

from __future__ import annotations

import hashlib
import os
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from leco_plugin.log import for_each
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_whole, writing_into
from leco_plugin.studio.host_models import outputs_of


class StoredPictures:
    """Pictures of height and width [P, 2] int64, each a file of bytes [H, W, channels]."""

    def __init__(self, files: list[Path], sizes: Tensor, channels: int) -> None:
        self.files, self.sizes, self.channels = files, sizes, channels
        self._pixels_until = sizes.prod(dim=-1).cumsum(0)

    def __len__(self) -> int:
        return len(self.files)

    def draw(self, count: int, by_solid_angle: bool = False) -> Tensor:
        """Random pixels [count, 3] (picture, row, column), all alike or by their solid angle."""
        total = int(self._pixels_until[-1])
        drawn = torch.randint(total, (count,))
        which = torch.searchsorted(self._pixels_until, drawn, right=True)
        within = drawn - (self._pixels_until[which] - self.sizes[which].prod(dim=-1))
        width = self.sizes[which, 1]
        rows, columns = within // width, within % width
        if by_solid_angle:
            heights = self.sizes[which, 0]
            polar = torch.acos(1.0 - 2.0 * torch.rand(count)) / torch.pi
            rows = (polar * heights).long().minimum(heights - 1)
        return torch.stack([which, rows, columns], dim=-1)

    def read(self, places: Tensor) -> Tensor:
        """Values [K, C] float32 in [0, 1] of pixels [K, 3] int64 (picture, row, column). InputError
        if a file is shorter than its picture."""
        which, rows, columns = places.unbind(dim=-1)
        offsets = (rows * self.sizes[which, 1] + columns) * self.channels
        found = np.empty((len(which), self.channels), dtype=np.uint8)
        order = which.argsort(stable=True).tolist()
        numbers, at = which.tolist(), offsets.tolist()
        for number, of_file in groupby(order, numbers.__getitem__):
            with self.files[number].open("rb", buffering=0) as file:
                for row in of_file:
                    file.seek(at[row])
                    if file.readinto(found[row]) != self.channels:
                        raise InputError(f"{self.files[number]} is cut off: delete it and go on")
        return torch.from_numpy(found).float() / 255.0


def store_pictures(dataset: Any, folder: Path, what: str = "photographs") -> dict[str, Any]:
    """Decodes what a dataset (nerfstudio's `InputDataset`) has not yet decoded into `folder`.
    Returns a batch as of its loader: `image` and, if there are masks, `mask`, both
    `StoredPictures`, and `image_idx` [P]. InputError if nothing can be written there, or the
    pictures have no common form."""
    sizes = picture_sizes(dataset)
    masked = outputs_of(dataset).mask_filenames is not None
    names = [_name(dataset, number) for number in range(len(dataset))]
    files = {"image": [folder / f"{name}.pixels" for name in names]}
    if masked:
        files["mask"] = [folder / f"{name}.mask" for name in names]

    def store(number: int) -> None:
        if not all(made[number].is_file() for made in files.values()):
            _decode(dataset, number, sizes[number].tolist(), files)

    for_each(f"Decoding the {what}", range(len(dataset)), store)
    pixels = sizes.prod(dim=-1).tolist()
    stored: dict[str, Any] = {
        kind: StoredPictures(made, sizes, _channels(made, pixels)) for kind, made in files.items()
    }
    return stored | {"image_idx": torch.arange(len(dataset))}


def picture_sizes(dataset: Any) -> Tensor:
    """Height and width of all photographs of a dataset: [P, 2] int64."""
    cameras = dataset.cameras
    return torch.stack([cameras.height.flatten(), cameras.width.flatten()], dim=-1).long()


def _name(dataset: Any, number: int) -> str:
    """Another picture, or the same one read otherwise, has another name."""
    outputs = outputs_of(dataset)
    paths = [outputs.image_filenames[number]]
    if outputs.mask_filenames is not None:
        paths.append(outputs.mask_filenames[number])
    of_files = [(str(path), os.stat(path).st_mtime_ns, os.stat(path).st_size) for path in paths]
    alpha = None if outputs.alpha_color is None else torch.as_tensor(outputs.alpha_color).tolist()
    text = repr((of_files, dataset.scale_factor, alpha))
    return hashlib.blake2b(text.encode(), digest_size=12).hexdigest()


def _decode(dataset: Any, number: int, size: list[int], files: dict[str, list[Path]]) -> None:
    source = dataset.image_filenames[number]
    data = dataset.get_data(number, image_type="uint8")
    height, width = data["image"].shape[:2]
    if [height, width] != size:
        raise InputError(
            f"{source} has {width} x {height} pixels, its camera {size[1]} x {size[0]}"
        )
    for kind, made in files.items():
        values = data[kind].numpy()
        values = (values > 0).astype(np.uint8) * 255 if kind == "mask" else values
        with writing_into(made[number].parent, "--pipeline.datamanager.pixels"):
            write_whole(made[number], values.tobytes())


def _channels(files: list[Path], pixels: list[int]) -> int:
    """Bytes of a pixel, the same in all files."""
    sizes = {path.stat().st_size / count for path, count in zip(files, pixels)}
    if len(sizes) != 1 or (channels := sizes.pop()) not in (1, 3, 4):
        raise InputError(
            "some photographs have transparency and some have not, or decoded ones are damaged: "
            f"make them alike, or remove {files[0].parent} to decode them again"
        )
    return int(channels)
