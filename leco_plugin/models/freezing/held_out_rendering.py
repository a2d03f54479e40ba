"""Held-out rays with all their candidates rendered: what each price of skipping is measured on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor, nn

from leco_plugin.models.freezing.calibration import Reference, reference_of
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler, some_images
from leco_plugin.scenes.pixels.lattice import Share

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel


def held_out_bundle(
    datamanager: Any, count: int, seed: int = 0, share: Share = "calibration"
) -> tuple[RayBundle, Tensor]:
    """Rays of training pixels that are never trained on, and their true colours [R, 3 or 4].

    A data manager without held-out pixels gives ordinary training rays; the report says so.

    Args:
        count: rays wanted; fewer come back where there are fewer.
        seed: of the draw.
        share: of the held-out pixels.
    """
    sampler = held_out_sampler(datamanager)
    if sampler is None:
        bundle, batch = datamanager.next_train(0)
        return bundle[:count], batch["image"][:count]
    batch = sampler.sample_held_out(images_of(datamanager), count, seed, share)
    pixels = batch["indices"]
    bundle = datamanager.train_dataset.cameras.to("cpu").generate_rays(
        camera_indices=pixels[:, :1], coords=pixels[:, 1:].float() + 0.5
    )
    return bundle, batch["image"]


def calibration_rays(
    model: LecoModel,
    datamanager: Any,
    count: int | None = None,
    seed: int = 0,
    share: Share = "calibration",
) -> tuple[Rays, Tensor]:
    """Held-out rays, cut to the model's bounds, and their true colours [R, 3 or 4].

    They are of training images, whose appearance is known: an exposure that the mean of all does
    not show would stand in every error, and hide what skipping adds to it.

    Args:
        count: None is what a calibration takes.
        seed, share: see `held_out_bundle`.
    """
    count = count or model.config.calibration.rays
    bundle, truth = held_out_bundle(datamanager, count, seed, share)
    rays = model.rays_of(bundle.to(model.device), with_images=True)
    return rays, truth.to(model.device).float()


class DenseRendering(NamedTuple):
    """What `calibration.measure` and its kin take: see there."""

    references: list[Reference]
    truths: list[Tensor]
    render_kept: Callable[[int, Tensor], Tensor]


def images_of(datamanager: Any) -> dict[str, Any]:
    """Images to take held-out pixels from: those that are loaded, or some where none are here."""
    loader = getattr(datamanager, "iter_train_image_dataloader", None)
    if loader is None:
        return some_images(datamanager.train_dataset)
    loaded: dict[str, Any] = next(loader)
    return loaded


@contextmanager
def evaluating(model: nn.Module) -> Iterator[None]:
    """A model in evaluation mode for a while; then in the mode that it was in."""
    was_training = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was_training)


@torch.no_grad()
def dense_rendering(model: LecoModel, rays: Rays, truth: Tensor) -> DenseRendering:
    """All candidates of given rays rendered, in chunks, in the model's present mode."""
    config = model.config.calibration
    chunks = [
        Rays._make(None if part is None else part[i : i + config.rays_at_once] for part in rays)
        for i in range(0, len(truth), config.rays_at_once)
    ]
    references = [dense_reference(model, chunk) for chunk in chunks]

    def render_kept(number: int, mask: Tensor) -> Tensor:
        kept = Intervals(*(part[mask] for part in references[number].intervals))
        return model.shade(chunks[number], kept).rgb

    truths = list(model.renderer_rgb.blend_background(truth).split(config.rays_at_once))
    return DenseRendering(references, truths, render_kept)


def dense_reference(model: LecoModel, rays: Rays) -> Reference:
    """All candidates of some rays rendered, as the reference that skipping is measured against."""
    intervals = model.intervals_of(rays, guided=False, learning=False)
    shaded = model.shade(rays, intervals)
    return reference_of(shaded, intervals, rays)
