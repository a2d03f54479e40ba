"""Training pixels that are never trained on: what the threshold of the gate is calibrated with.

A thin lattice of pixels of the training images is left out of every batch. It needs no memory, and
is the same on every process and after every resume.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig
from torch import Tensor

from leco_plugin.on_cpu import on_cpu
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.pixels.stored_pictures import StoredPictures
from leco_plugin.scenes.survey import chosen_cameras

PERIODS = (11, 9, 7, 5)
"""Pixels between two that are held out, in both directions: 1 in 121 where pictures have enough, 1
in 25 at most."""
WANTED = 12_000
"""Held-out pixels of all pictures together: some more than calibrating and checking ask for."""
Share = Literal["calibration", "recheck", "all"]
"""Which held-out pixels: those that the threshold is calibrated with, those that it is checked with
later, a quarter of all, or either."""


@dataclass(frozen=True)
class Lattice:
    """One pixel of `period` x `period`."""

    period: int = PERIODS[0]

    def __post_init__(self) -> None:
        if self.period < 2:
            raise InputError(
                f"of {self.period} pixels in both directions none is left to train on; "
                "held-out-period is 2 or more"
            )

    @property
    def offset(self) -> int:
        """Row and column of a picture's first held-out pixel."""
        return self.period // 2

    def holds_out(self, pixels: Tensor) -> Tensor:
        """Whether pixels (image, row, column) [N, 3] are held out: bool [N]."""
        return (pixels[:, 1:] % self.period == self.offset).all(dim=-1)

    def is_of(self, pixels: Tensor, share: Share) -> Tensor:
        """Whether held-out pixels (image, row, column) [N, 3] belong to a share: bool [N]."""
        if share == "all":
            return torch.ones(len(pixels), dtype=torch.bool)
        checks = (pixels[:, 1:] // self.period).sum(dim=-1) % 4 == 3
        return checks if share == "recheck" else ~checks

    def counts(self, sizes: Tensor) -> Tensor:
        """Rows and columns [P, 2] of held-out pixels, one at least, of sizes [P, 2]."""
        return ((sizes - self.offset - 1) // self.period + 1).clamp(min=1)

    def draw(self, sizes: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Held-out pixels [N, 3] int64 (image, row, column) in random order, each once: up to so
        many of pictures of sizes [P, 2] (height, width)."""
        counts = self.counts(sizes)
        ends = counts.prod(dim=-1).cumsum(dim=0)
        total = int(ends[-1])
        if total <= count:
            numbers = torch.randperm(total, generator=generator)
        else:
            numbers = torch.randint(total, (count,), generator=generator).unique()
            numbers = numbers[torch.randperm(len(numbers), generator=generator)]
        which = torch.searchsorted(ends, numbers, right=True)
        numbers = numbers - (ends - counts.prod(dim=-1))[which]
        columns = counts[which, 1]
        places = torch.stack([numbers // columns, numbers % columns], dim=-1)
        places = torch.minimum(places * self.period + self.offset, sizes[which] - 1)
        return torch.cat([which[:, None], places], dim=-1)


def lattice_for(sizes: Sequence[Sequence[int]] | Tensor) -> Lattice:
    """The thinnest lattice with `WANTED` pixels of sizes [P, 2] (height, width), or the densest."""
    sizes = torch.as_tensor(sizes)
    for period in PERIODS:
        if int(Lattice(period).counts(sizes).prod(dim=-1).sum()) >= WANTED:
            return Lattice(period)
    return Lattice(PERIODS[-1])


DRAWN = 8
"""Times as many pixels as are wanted are drawn, before some are left out."""
SOME = 16
"""Images that are read where a data manager has none loaded."""
TRIES = 100
"""Draws of a pixel that no mask hides: one in three fails where 1% of the pixels are seen."""


def look_up(source: Any, places: Tensor) -> Tensor:
    """Values [K, ...] of pixels [K, 3] int64 (picture, row, column) of images [P, H, W, ...], of a
    list of one or more [H, W, ...], or of stored ones."""
    if isinstance(source, StoredPictures):
        return source.read(places)
    which, rows, columns = places.unbind(dim=-1)
    if isinstance(source, Tensor):
        return source[which.to(source.device), rows.to(source.device), columns.to(source.device)]
    values, order = source[0].new_zeros(len(which), *source[0].shape[2:]), which.argsort()
    numbers, counts = which[order].unique_consecutive(return_counts=True)
    for number, own in zip(numbers.tolist(), order.split(counts.tolist())):
        values[own] = source[number][rows[own], columns[own]]
    return values


def sizes_of(pictures: Any) -> Tensor:
    """Height and width [P, 2] of pictures, as `look_up` takes them."""
    if isinstance(pictures, StoredPictures):
        return pictures.sizes
    return torch.tensor([picture.shape[:2] for picture in pictures])


def some_images(dataset: Any) -> dict[str, Any]:
    """A batch of up to `SOME` images of nerfstudio's `InputDataset`, spread evenly."""
    chosen = chosen_cameras(len(dataset), SOME)
    read = [dataset.get_data(number) for number in chosen.tolist()]
    images = {key: [data[key] for data in read] for key in ("image", "mask") if key in read[0]}
    return images | {"image_idx": chosen}


def _stepping_aside(sample: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """One of nerfstudio's ways to draw pixels, with held-out pixels giving way to others."""

    @functools.wraps(sample)
    def sample_others(
        self: HeldOutPixelSampler,
        batch_size: int,
        num_images: int,
        image_height: int,
        image_width: int,
        mask: Tensor | None = None,
        device: torch.device | str = "cpu",
    ) -> Tensor:
        def drawn(count: int) -> Tensor:
            return sample(self, count, num_images, image_height, image_width, mask, device)

        # nerfstudio draws of all pictures at once, or of one after the other
        numbers, self.numbers = self.numbers[:num_images], self.numbers[num_images:]
        sizes = torch.tensor([image_height, image_width], device=device)
        return self._step_aside(
            self._through_the_lens(drawn, batch_size, sizes, numbers), sizes, mask
        )

    return sample_others


class HeldOutPixelSampler(PixelSampler):
    """nerfstudio's sampler with a lattice of pixels left out of training."""

    lattice = Lattice()
    """The held-out pixels; whoever knows all pictures chooses it by them."""
    radii: Tensor | None = None
    """[P] in place of the one `fisheye_crop_radius`, by the dataset's number of a picture; infinite
    where its camera is no fisheye."""
    set_aside: Tensor | None = None
    """[P] bool, by the dataset's number of a picture: those of which nothing is drawn for now."""
    numbers = torch.zeros(0, dtype=torch.int64)
    """Numbers in the dataset of the batch's pictures that are still to be drawn of."""

    sample_method = _stepping_aside(PixelSampler.sample_method)
    sample_method_equirectangular = _stepping_aside(PixelSampler.sample_method_equirectangular)
    sample_method_fisheye = _stepping_aside(PixelSampler.sample_method_fisheye)

    def rejection_sample_mask(
        self,
        mask: Tensor,
        num_samples: int,
        num_images: int,
        image_height: int,
        image_width: int,
        device: torch.device | str,
    ) -> Tensor:
        """Pixels [N, 3] int64 of a mask [P, H, W, 1]; nerfstudio's own cannot sample one image.
        InputError if the mask leaves none."""
        seen = mask.reshape(num_images, image_height, image_width)
        sizes = torch.tensor([num_images, image_height, image_width], device=device)
        indices = torch.zeros(num_samples, 3, dtype=torch.long, device=device)
        hidden = torch.arange(num_samples, device=device)
        for _ in range(TRIES):
            drawn = (torch.rand(len(hidden), 3, device=device) * sizes).long()
            indices[hidden] = drawn
            image, row, column = drawn.to(seen.device).unbind(dim=-1)
            hidden = hidden[~seen[image, row, column].bool().to(device)]
            if len(hidden) == 0:
                return indices
        # of masks that leave next to nothing; to list the pixels of all images takes seconds
        others = seen.nonzero().to(device)
        if len(others) == 0:
            raise InputError("the masks leave no pixel of the training images")
        indices[hidden] = others[torch.randint(len(others), (len(hidden),))]
        return indices

    def sample(self, image_batch: dict[str, Any]) -> dict[str, Any]:
        """A batch as nerfstudio makes it, also of stored pictures."""
        pictures = image_batch["image"]
        if isinstance(pictures, StoredPictures):
            return self._sample_stored(image_batch)
        self.numbers = on_cpu(torch.as_tensor(image_batch["image_idx"]))
        return dict(super().sample(image_batch))

    def collate_image_dataset_batch_list(
        self, batch: dict[str, Any], num_rays_per_batch: int, keep_full_image: bool = False
    ) -> dict[str, Any]:
        """A batch of pictures of several sizes, lists of [H, W, C]: equal shares of those drawn.

        nerfstudio's own wants an even number of rays, never draws of some of many pictures, and
        sorts its rays by pictures.
        """
        pictures, masks, numbers = batch["image"], batch.get("mask"), self.numbers
        on_sphere = self.config.is_equirectangular and masks is None
        draw = self.sample_method_equirectangular if on_sphere else self.sample_method
        drawn = torch.arange(len(pictures))
        if self.set_aside is not None:
            drawn = drawn[~self.set_aside[numbers]]
        share, rest = divmod(num_rays_per_batch, len(drawn))
        counts = torch.zeros_like(numbers).index_fill_(0, drawn, share)
        counts[drawn[torch.randperm(len(drawn))[:rest]]] += 1
        chosen = counts.nonzero()[:, 0]
        self.numbers, found = numbers[chosen], []
        for number in chosen.tolist():
            picture, mask = pictures[number], None if masks is None else masks[number][None]
            found.append(draw(int(counts[number]), 1, *picture.shape[:2], mask, picture.device))
            found[-1][:, 0] = number
        places = torch.cat(found)[torch.randperm(num_rays_per_batch)].cpu()
        return _pixels_at(batch, places) | ({"full_image": pictures} if keep_full_image else {})

    def shown(self, pixels: Tensor, sizes: Tensor, numbers: Tensor | None = None) -> Tensor:
        """Whether a fisheye shows pixels (image, row, column) [N, 3]: bool [N]. Sizes (height,
        width) are [2] or [N, 2]; `numbers` [P] are the dataset's, if images are places in a
        batch."""
        radius: Any = self.config.fisheye_crop_radius
        if self.radii is not None:
            images = pixels[:, 0].cpu()
            images = images if numbers is None else numbers[images]
            radius = self.radii[images].to(pixels.device)
        if radius is None:
            return torch.ones(len(pixels), dtype=torch.bool, device=pixels.device)
        # the middle that nerfstudio draws around
        corners = pixels[:, 1:] - torch.div(sizes, 2, rounding_mode="floor")
        return corners.abs().maximum((corners + 1).abs()).square().sum(dim=-1) <= radius**2

    def _may_be_drawn(self, pixels: Tensor, sizes: Tensor, numbers: Tensor | None) -> Tensor:
        """Whether pixels are shown, and not set aside unless all are; arguments as `shown`."""
        shown = self.shown(pixels, sizes, numbers)
        if self.set_aside is None:
            return shown
        aside = self.set_aside if numbers is None else self.set_aside[numbers]
        if bool(aside.all()):
            return shown
        return shown & ~aside[pixels[:, 0].cpu()].to(shown.device)

    def _through_the_lens(
        self,
        draw: Callable[[int], Tensor],
        count: int,
        sizes: Tensor,
        numbers: Tensor | None = None,
    ) -> Tensor:
        """Drawn pixels [count, 3]; others in place of those that may not be drawn. `sizes` as of
        `shown`, or [P, 2] of all pictures. InputError if none of those drawn is shown."""
        pixels = draw(count)
        for _ in range(TRIES):
            each = sizes if sizes.dim() == 1 else sizes[pixels[:, 0]]
            hidden = ~self._may_be_drawn(pixels, each, numbers)
            if not bool(hidden.any()):
                return pixels
            pixels[hidden] = draw(int(hidden.sum()))
        others = pixels[~hidden]
        if len(others):  # of a small circle a few are left over by chance: take some that it shows
            pixels[hidden] = others[torch.randint(len(others), (int(hidden.sum()),))]
            return pixels
        radius = self.config.fisheye_crop_radius if self.radii is None else float(self.radii.min())
        raise InputError(
            f"a fisheye_crop_radius of {radius} pixels shows next to "
            "nothing of the training images: it is in pixels of the images as they are read"
        )

    def _sample_stored(self, batch: dict[str, Any]) -> dict[str, Any]:
        """A batch of pixels that are neither held out nor, as far as there are others, masked."""
        pictures, masks = batch["image"], batch.get("mask")
        indices = self._drawn_aside(pictures, self.num_rays_per_batch)
        for _ in range(TRIES if masks is not None and not self.config.ignore_mask else 0):
            seen = look_up(masks, indices)[:, 0] > 0
            if bool(seen.all()):
                break
            indices[~seen] = self._drawn_aside(pictures, int((~seen).sum()))
        return _pixels_at(batch, indices)

    def _drawn_aside(self, pictures: StoredPictures, count: int) -> Tensor:
        """Pixels [count, 3] of stored pictures, none of them held out."""
        draw = partial(pictures.draw, by_solid_angle=bool(self.config.is_equirectangular))
        indices = self._through_the_lens(draw, count, pictures.sizes)
        return self._aside(indices, pictures.sizes[indices[:, 0]])

    def _aside(self, indices: Tensor, sizes: Tensor) -> Tensor:
        """Pixels [N, 3] of sizes [2] or [N, 2], held-out ones moved by one towards the middle."""
        columns = indices[:, 2]
        aside = torch.where(columns < sizes[..., 1] // 2, columns + 1, columns - 1)
        indices[:, 2] = torch.where(self.lattice.holds_out(indices), aside, columns)
        return indices

    def _step_aside(self, indices: Tensor, sizes: Tensor, mask: Tensor | None) -> Tensor:
        """Moves held-out pixels [N, 3] to their neighbours, or to others where those are masked."""
        indices = self._aside(indices, sizes)
        if isinstance(mask, Tensor) and not self.config.ignore_mask:
            image, row, column = indices.to(mask.device).unbind(dim=-1)
            seen = mask[image, row, column].bool().flatten().to(indices.device)
            others = seen.nonzero()[:, 0]
            if len(others) > 0:
                drawn = torch.randint(len(others), (len(indices),), device=indices.device)
                indices = torch.where(seen[:, None], indices, indices[others[drawn]])
        return indices

    def sample_held_out(
        self, images: dict[str, Any], count: int, seed: int, share: Share = "all"
    ) -> dict[str, Tensor]:
        """Up to `count` held-out pixels, each once, the same for a seed: `image` [N, C] and
        `indices` [N, 3] int64 (image, row, column). `images` is a batch of the image loader:
        `image` [K, H, W, C] or a list of [H, W, C], `image_idx` [K], and `mask` if any. Where none
        of the share is left, as of tiny images, of all shares."""
        return _pixels_at(images, self._held_out(images, count, seed, share))

    def sample_pictures(
        self, images: dict[str, Any], chosen: Tensor, count: int, seed: int
    ) -> dict[str, Tensor]:
        """Up to `count` random pixels of each of the chosen pictures [K], numbers in the dataset
        that the batch has, in their order; as of `sample_held_out`."""
        numbers, sizes = torch.as_tensor(images["image_idx"]).cpu(), sizes_of(images["image"])
        generator = torch.Generator().manual_seed(seed)
        found = []
        for picture in (numbers[None] == chosen[:, None]).int().argmax(dim=1).tolist():
            drawn = torch.rand(DRAWN * count, 2, generator=generator) * sizes[picture]
            places = torch.nn.functional.pad(drawn.long(), (1, 0), value=picture)
            found.append(places[self.visible(images, places)][:count])
        return _pixels_at(images, torch.cat(found))

    def visible(self, images: dict[str, Any], places: Tensor) -> Tensor:
        """Which pixels [N, 3] (place in the batch, row, column) no lens or mask hides: bool [N]."""
        numbers, sizes = torch.as_tensor(images["image_idx"]).cpu(), sizes_of(images["image"])
        seen = self.shown(places, sizes[places[:, 0]], numbers)
        if "mask" in images:
            masks = look_up(images["mask"], places)
            seen &= masks.flatten(1).all(dim=1).cpu()
        return seen

    def count_held_out(self, images: dict[str, Any], most: int, share: Share) -> int:
        """How many pixels of a share there are, up to `most`; arguments as of `sample_held_out`."""
        return len(self._held_out(images, most, 0, share))

    def _held_out(self, images: dict[str, Any], count: int, seed: int, share: Share) -> Tensor:
        """Pixels [N, 3] (place in the batch, row, column); arguments as of `sample_held_out`."""
        sizes = sizes_of(images["image"])
        places = self.lattice.draw(sizes, DRAWN * count, torch.Generator().manual_seed(seed))
        places = places[self.visible(images, places)]
        of_share = self.lattice.is_of(places, share)
        return (places[of_share] if bool(of_share.any()) else places)[:count]


def _pixels_at(images: dict[str, Any], places: Tensor) -> dict[str, Tensor]:
    """Pixels [N, 3] (place in the batch, row, column) as `PixelSampler.sample` returns them."""
    numbers = torch.as_tensor(images["image_idx"]).cpu()
    values = {
        key: look_up(source, places)
        for key, source in images.items()
        if key not in ("image_idx", "mask") and source is not None
    }
    return values | {"indices": torch.cat([numbers[places[:, :1]], places[:, 1:]], dim=-1)}


def visible_in_test(manager: Any, number: int, data: dict[str, Any], pixels: Tensor) -> Tensor:
    """`HeldOutPixelSampler.visible` of pixels [N, 2] of a test photograph, by a dataset's data."""
    sampler = getattr(manager, "eval_pixel_sampler", None)
    if not isinstance(sampler, HeldOutPixelSampler):
        sampler = HeldOutPixelSampler(getattr(sampler, "config", PixelSamplerConfig()))
    images = {key: [value] for key, value in {**data, "image_idx": number}.items()}
    return sampler.visible(images, torch.nn.functional.pad(pixels, (1, 0)))


def held_out_sampler(datamanager: Any) -> HeldOutPixelSampler | None:
    """The data manager's pixel sampler, if it keeps pixels back for calibration."""
    sampler = getattr(datamanager, "train_pixel_sampler", None)
    return sampler if isinstance(sampler, HeldOutPixelSampler) else None
