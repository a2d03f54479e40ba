"""Batches in which some pixels have a known distance: those in which a sparse point is seen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch

from leco_plugin.scenes.pixels.held_out_pixels import (
    HeldOutPixelSampler,
    HeldOutPixelSamplerConfig,
    look_up,
    sizes_of,
)
from leco_plugin.scenes.pixels.sparse_pixels import SparsePixels

DISTANCE = "known_distance"
"""Key of a batch: [N] float32 along the unit ray, scene units, 0 where it is not known."""


@dataclass
class KnownDistancePixelSamplerConfig(HeldOutPixelSamplerConfig):
    """Samples pixels uniformly, and a share of them where sparse points are seen."""

    _target: type = field(default_factory=lambda: KnownDistancePixelSampler)
    """target class to instantiate"""
    known_share: float = 0.25
    """Share of a batch with known distances, as long as the model asks for them."""


def sampler_here(datamanager: Any) -> Any:
    """The sampler that training batches are drawn with, if that happens in this process.

    nerfstudio's parallel data manager draws in others, which hold copies of it.
    """
    if hasattr(datamanager, "data_procs"):
        return None
    return getattr(datamanager, "train_pixel_sampler", None)


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
        numbers = torch.as_tensor(images["image_idx"]).cpu()
        drawn = torch.randint(
            len(sparse.distances), (round(self.config.known_share * len(batch["indices"])),)
        )
        pixels = sparse.indices[drawn]
        # a batch may be of some of the images only
        place_of = torch.full((int(max(numbers.max(), pixels[:, 0].max())) + 1,), -1)
        place_of[numbers] = torch.arange(len(numbers))
        places = place_of[pixels[:, 0]]
        loaded = places >= 0
        drawn, pixels, places = drawn[loaded], pixels[loaded], places[loaded]
        inside = self.shown(pixels, sizes_of(images["image"])[places])
        drawn, pixels, places = drawn[inside], pixels[inside], places[inside]
        if "mask" in images:
            seen = look_up(images["mask"], places, pixels[:, 1:]).flatten(1).all(dim=1).cpu()
            drawn, pixels, places = drawn[seen], pixels[seen], places[seen]
        known = batch["image"].new_zeros(len(batch["indices"]), dtype=torch.float32)
        known[: len(drawn)] = sparse.distances[drawn].to(known.device)
        for key, source in images.items():
            if key in batch and key not in ("image_idx", "indices"):
                batch[key][: len(drawn)] = look_up(source, places, pixels[:, 1:]).to(
                    batch[key].device
                )
        batch["indices"][: len(drawn)] = pixels.to(batch["indices"].device)
        batch[DISTANCE] = known
