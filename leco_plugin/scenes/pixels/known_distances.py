"""Batches in which some pixels have a known distance: those in which a sparse point is seen."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from torch import Tensor

from leco_plugin.on_cpu import on_cpu
from leco_plugin.scenes.bounds import FEWEST_POINTS
from leco_plugin.scenes.input_error import InputError, require
from leco_plugin.scenes.lenses import bend
from leco_plugin.scenes.pixels.held_out_pixels import HeldOutPixelSampler, Lattice, look_up
from leco_plugin.scenes.pixels.stored_pictures import picture_sizes

NEARER = 0.9
"""A point hides its neighbours in the image that are farther than it by more than this factor."""
POINTS_PER_CELL = 2.0
"""Points that share a cell of the coarse depth map, on average."""
MOST_POINTS = 50_000
"""Of a larger cloud so many points are drawn: 5 ms for each image."""
MOST_PIXELS = 4_000_000
"""Of all images together: about 110 MB."""


class SparsePixels(NamedTuple):
    """Pixels with known distances, sorted by image."""

    indices: Tensor
    """[K, 3] int64: image, row, column."""
    distances: Tensor
    """[K] float32 along the unit ray, scene units."""


def sparse_pixels(cameras: Cameras, points: Tensor, lattice: Lattice) -> SparsePixels:
    """Where perspective cameras see sparse points [P, 3], but for pixels that are held out."""
    cameras = cameras.to("cpu")
    points = _at_most(MOST_POINTS, points.detach().float().cpu())
    for_each_image = MOST_PIXELS // max(len(cameras), 1)
    indices, distances = [torch.zeros(0, 3, dtype=torch.long)], [torch.zeros(0)]
    for number in range(len(cameras) if len(points) >= FEWEST_POINTS else 0):
        if int(cameras.camera_type[number]) != CameraType.PERSPECTIVE.value:
            continue
        pixels, lengths = project(cameras, number, points)
        height, width = int(cameras.height[number]), int(cameras.width[number])
        inside = (pixels >= 0).all(dim=-1) & (lengths > 0)
        inside &= (pixels[:, 0] < height) & (pixels[:, 1] < width)
        pixels, lengths = pixels[inside].long(), lengths[inside]
        seen = ~hidden(pixels, lengths, height, width)
        found = torch.cat([torch.full((len(pixels), 1), number), pixels], dim=-1)
        seen &= ~lattice.holds_out(found)
        chosen = _at_most(for_each_image, seen.nonzero()[:, 0])
        indices.append(found[chosen])
        distances.append(lengths[chosen])
    return SparsePixels(torch.cat(indices), torch.cat(distances))


def _at_most(most: int, rows: Tensor) -> Tensor:
    """The rows, or so many of them, drawn evenly and always the same."""
    if len(rows) <= most:
        return rows
    return rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:most]]


def project(cameras: Cameras, number: int, points: Tensor) -> tuple[Tensor, Tensor]:
    """Image places of points [P, 2] (row, column; whole numbers are upper left corners of pixels),
    and distances [P], scene units, negative where the camera does not see them: behind it, or where
    the formula of its lens folds them back into the image."""
    pose = cameras.camera_to_worlds[number]
    local = (points - pose[:, 3]) @ pose[:, :3]
    ahead = -local[:, 2]
    slopes = local[:, :2] / ahead.clamp(min=1e-9)[:, None] * torch.tensor([1.0, -1.0])
    seen = ahead > 0
    if cameras.distortion_params is not None:
        slopes, sharp = bend(slopes, cameras.distortion_params[number].tolist())
        seen = seen & sharp
    rows = cameras.cy[number] + cameras.fy[number] * slopes[:, 1]
    columns = cameras.cx[number] + cameras.fx[number] * slopes[:, 0]
    lengths = local.norm(dim=-1)
    return torch.stack([rows, columns], dim=-1), torch.where(seen, lengths, -lengths)


def hidden(pixels: Tensor, lengths: Tensor, height: int, width: int) -> Tensor:
    """Which of pixels [P, 2] (row, column) at distances [P] lie behind a neighbour: bool [P]."""
    cell = max(1, round(math.sqrt(POINTS_PER_CELL * height * width / max(len(pixels), 1))))
    rows, columns = -(-height // cell), -(-width // cell)
    places = pixels[:, 0] // cell * columns + pixels[:, 1] // cell
    nearest = torch.full((rows * columns,), torch.inf)
    nearest.scatter_reduce_(0, places, lengths, "amin")
    around = -torch.nn.functional.max_pool2d(-nearest.view(1, 1, rows, columns), 3, 1, 1)
    return around.flatten()[places] < NEARER * lengths


DISTANCE = "known_distance"
"""Key of a batch: [N] float32 along the unit ray, scene units, 0 where it is not known."""


@dataclass
class KnownDistancePixelSamplerConfig(PixelSamplerConfig):
    """Samples pixels uniformly, except for a lattice that calibration keeps to itself, and a share
    of them where sparse points are seen."""

    _target: type = field(default_factory=lambda: KnownDistancePixelSampler)
    """target class to instantiate"""
    known_share: float = 0.25
    """Share of a batch with known distances, as long as the model asks for them."""

    def __post_init__(self) -> None:
        share = self.known_share
        require(0.0 <= share <= 1.0, "pixel-sampler.known-share", share, "from 0 to 1")


def sampler_here(datamanager: Any) -> Any:
    """The sampler that training batches are drawn with, if in this process: nerfstudio's parallel
    data manager draws in others, which hold copies of it."""
    if hasattr(datamanager, "data_procs"):
        return None
    return getattr(datamanager, "train_pixel_sampler", None)


def _draws_even_numbers(sampler: Any, dataset: Any) -> bool:
    """Whether a sampler draws even numbers of rays alone: nerfstudio's own, from photographs of
    several sizes."""
    if sampler is None or isinstance(sampler, HeldOutPixelSampler):
        return False
    return len(picture_sizes(dataset).unique(dim=0)) > 1


def drawable(rays: int, manager: Any) -> int:
    """So many rays, or one more where the sampler of training batches draws even numbers alone."""
    sampler = getattr(manager, "train_pixel_sampler", None)
    is_odd = rays % 2 == 1 and _draws_even_numbers(sampler, manager.train_dataset)
    return rays + 1 if is_odd else rays


def refuse_odd_batches(manager: Any) -> None:
    """InputError for batches that nerfstudio's own samplers could not draw."""
    for which in ("train", "eval"):
        sampler = getattr(manager, f"{which}_pixel_sampler", None)
        rays = getattr(sampler, "num_rays_per_batch", 0)
        if rays % 2 == 1 and _draws_even_numbers(sampler, getattr(manager, f"{which}_dataset")):
            raise InputError(
                f"--pipeline.datamanager.{which}-num-rays-per-batch is {rays}, and nerfstudio draws"
                f" even numbers alone from photographs of several sizes: give {rays + 1}"
            )


@contextmanager
def batches_of(rays: int, manager: Any) -> Iterator[None]:
    """A data manager's batches have so many rays meanwhile, where it has them drawn here."""
    sampler = sampler_here(manager)
    if sampler is None:
        yield
        return
    before = sampler.num_rays_per_batch
    sampler.set_num_rays_per_batch(drawable(rays, manager))
    try:
        yield
    finally:
        sampler.set_num_rays_per_batch(before)


class KnownDistancePixelSampler(HeldOutPixelSampler):
    """The sampler of held-out pixels, which can be told of sparse points."""

    config: KnownDistancePixelSamplerConfig
    sparse: SparsePixels | None = None

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """A batch as nerfstudio makes it; with `DISTANCE` while sparse points are known."""
        batch: dict[str, Any] = super().sample(image_batch)
        if self.sparse is not None and len(self.sparse.distances) > 0:
            self._put_known(batch, image_batch, self.sparse)
        return batch

    def _put_known(
        self, batch: dict[str, Any], images: dict[str, Any], sparse: SparsePixels
    ) -> None:
        """Puts pixels with known distances in place of the batch's first ones."""
        numbers = on_cpu(torch.as_tensor(images["image_idx"]))
        drawn = torch.randint(
            len(sparse.distances), (round(self.config.known_share * len(batch["indices"])),)
        )
        pixels = sparse.indices[drawn]
        # a batch may be of some of the images only, and too small for its share
        place_of = torch.full((int(torch.cat([numbers, pixels[:, 0]]).max()) + 1,), -1)
        place_of[numbers] = torch.arange(len(numbers))
        loaded = place_of[pixels[:, 0]] >= 0
        if self.set_aside is not None:
            loaded &= ~self.set_aside[pixels[:, 0]]
        drawn, pixels = drawn[loaded], pixels[loaded]
        places = torch.cat([place_of[pixels[:, :1]], pixels[:, 1:]], dim=-1)
        seen = self.visible(images, places)
        drawn, pixels, places = drawn[seen], pixels[seen], places[seen]
        known = batch["image"].new_zeros(len(batch["indices"]), dtype=torch.float32)
        known[: len(drawn)] = sparse.distances[drawn].to(known.device)
        for key, source in images.items():
            if key in batch and key not in ("image_idx", "indices"):
                values = look_up(source, places)
                batch[key][: len(drawn)] = values.to(batch[key].device)
        batch["indices"][: len(drawn)] = pixels.to(batch["indices"].device)
        batch[DISTANCE] = known
