"""Training pixels that are never trained on: what the threshold of the gate is calibrated with.

A thin lattice of pixels of the training images is left out of every batch. It needs no memory, and
is the same on every process and after every resume.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.data.pixel_samplers import PixelSampler, PixelSamplerConfig
from torch import Tensor

from leco_plugin.scenes.input_error import InputError

PERIOD = 11
"""Of 121 pixels one is held out."""
_OFFSET = 5


def is_held_out(indices: Tensor) -> Tensor:
    """Whether pixels (image, row, column) [N, 3] are held out: bool [N]."""
    return ((indices[:, 1] % PERIOD == _OFFSET) & (indices[:, 2] % PERIOD == _OFFSET)).bool()


def look_up(source: Any, which: Tensor, places: Tensor) -> Tensor:
    """Values of pixels: [K, ...].

    Args:
        source: images [P, H, W, ...], or a list of one or more [H, W, ...].
        which: [K] int64, number of the image in `source`.
        places: [K, 2] int64, row and column.
    """
    rows, columns = places.unbind(dim=-1)
    if isinstance(source, Tensor):
        return source[which.to(source.device), rows.to(source.device), columns.to(source.device)]
    values = [source[i][r, c] for i, r, c in zip(which, rows, columns)]
    return torch.stack(values) if values else source[0].new_zeros(0, *source[0].shape[2:])


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
        indices = sample(self, batch_size, num_images, image_height, image_width, mask, device)
        return self._step_aside(indices, image_width, mask)

    return sample_others


@dataclass
class HeldOutPixelSamplerConfig(PixelSamplerConfig):
    """Samples pixels uniformly, except for a lattice that calibration keeps to itself."""

    _target: type = field(default_factory=lambda: HeldOutPixelSampler)
    """target class to instantiate"""


class HeldOutPixelSampler(PixelSampler):
    """nerfstudio's sampler with a lattice of pixels left out of training."""

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

        Raises:
            InputError: the mask leaves no pixel.
        """
        seen = mask.reshape(num_images, image_height, image_width).bool()
        sizes = torch.tensor([num_images, image_height, image_width], device=device)
        indices = (torch.rand((num_samples, 3), device=device) * sizes).long()
        image, row, column = indices.to(seen.device).unbind(dim=-1)
        hidden = ~seen[image, row, column].to(device)
        if bool(hidden.any()):
            others = seen.nonzero().to(device)
            if len(others) == 0:
                raise InputError("the masks leave no pixel of the training images")
            indices[hidden] = others[torch.randint(len(others), (int(hidden.sum()),))]
        return indices

    def _step_aside(self, indices: Tensor, image_width: int, mask: Tensor | None) -> Tensor:
        """Moves held-out pixels [N, 3] to their neighbours, or to others where those are masked."""
        held_out, columns = is_held_out(indices), indices[:, 2]
        aside = torch.where(columns + 1 < image_width, columns + 1, columns - 1)
        indices[:, 2] = torch.where(held_out, aside, columns)
        if isinstance(mask, Tensor) and not self.config.ignore_mask:
            image, row, column = indices.to(mask.device).unbind(dim=-1)
            seen = mask[image, row, column].bool().flatten().to(indices.device)
            others = seen.nonzero()[:, 0]
            if len(others) > 0:
                drawn = torch.randint(len(others), (len(indices),), device=indices.device)
                indices = torch.where(seen[:, None], indices, indices[others[drawn]])
        return indices

    def sample_held_out(self, images: dict[str, Any], count: int, seed: int) -> dict[str, Tensor]:
        """A batch of held-out pixels, as `sample` returns it for training; the same for a seed.

        Args:
            images: a batch of the image data loader: `image` [K, H, W, C] (or a list of [H, W, C]),
                `image_idx` [K], and `mask` where there are masks.
            count: pixels wanted; fewer come back where masks leave fewer.
        Returns:
            `image` [N, C] and `indices` [N, 3] int64 (image, row, column).
        """
        generator = torch.Generator().manual_seed(seed)
        pictures = images["image"]
        which = torch.randint(len(pictures), (count,), generator=generator)
        sizes = torch.tensor([picture.shape[:2] for picture in pictures])[which]
        cells = ((sizes - _OFFSET - 1) // PERIOD + 1).clamp(min=1)
        places = (torch.rand(count, 2, generator=generator) * cells).long() * PERIOD + _OFFSET
        places = torch.minimum(places, sizes - 1)
        if "mask" in images:
            seen = look_up(images["mask"], which, places).flatten(1).all(dim=1).cpu()
            which, places = which[seen], places[seen]
        colors = look_up(pictures, which, places)
        numbers = torch.as_tensor(images["image_idx"]).cpu()[which]
        return {"image": colors, "indices": torch.cat([numbers[:, None], places], dim=-1)}
