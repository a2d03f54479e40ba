"""The moment of freezing: calibrate on held-out rays, fix the threshold, write the file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from leco_plugin.models.compute import ranks
from leco_plugin.models.compute.ranks import from_first, say
from leco_plugin.models.freezing.calibration import (
    Measured,
    Reference,
    backdrop_price,
    calibrate,
    reference_of,
)
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.occupancy import BACKDROP_PRICE, Occupancy
from leco_plugin.scenes.frames import frame_of
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler, some_images
from leco_plugin.scenes.pixels.lattice import Share
from leco_plugin.scenes.survey import Survey

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel

FILE_NAME = "occupancy.safetensors"
HARDLY_ANYTHING = 0.05
"""Share of all candidates below which a run that skips no more is given advice, and a gate in the
paper's form is taught otherwise."""


@torch.no_grad()
def freeze(
    model: LecoModel,
    datamanager: Any,
    survey: Survey,
    folder: Path | None,
    step: int,
    learn_seconds: float,
) -> Measured:
    """Calibrates the gate, freezes it, and leaves `occupancy.safetensors` in the run's folder.

    In every process of a data-parallel run the gate is that of the first one, and so is its price.
    """
    ranks.share(model.gate.state_dict().values())
    measured, report = from_first(
        lambda: _priced(model, datamanager, survey, step, learn_seconds), model.device
    )
    model.threshold.fill_(measured.threshold)
    model.frozen.fill_(True)
    model.gate.requires_grad_(False)
    model.report = report
    say(
        f"occupancy learned in {learn_seconds:.0f} s: threshold {measured.threshold:.4f} "
        f"skips {measured.empty_fraction:.1%} of all candidates for {measured.image_price_db:+.3f} "
        f"dB and {measured.lost_surface_mass:.2e} of the surface mass "
        f"({measured.lost_mass:.2e} of all)"
    )
    advice = advice_on(measured)
    if advice is not None:
        say(advice)
    if folder is not None:
        write_occupancy(model, folder)
    return measured


def advice_on(measured: Measured) -> str | None:
    """What to do about an occupancy that skips next to nothing; None for one that skips."""
    longer = (
        "more learning steps usually help: schedule.learn-steps, at --pipeline.model of "
        "leco-occupancy and at --pipeline.model.occupancy.learning of guided methods"
    )
    if measured.threshold == 0.0:
        return f"no threshold keeps the price within its bounds, so nothing is skipped; {longer}"
    if measured.empty_fraction < HARDLY_ANYTHING:
        return f"hardly anything is skipped, which is right for a scene full of fog; else {longer}"
    return None


def _priced(
    model: LecoModel, datamanager: Any, survey: Survey, step: int, learn_seconds: float
) -> tuple[Measured, dict[str, Any]]:
    """The threshold with what it costs, and the report that the occupancy carries."""
    rays, truth = calibration_rays(model, datamanager)
    with evaluating(model):
        rendering = dense_rendering(model, rays, truth)
        measured = calibrate(*rendering, model.config.calibration)
        of_backdrop = backdrop_price(*rendering)
    return measured, {
        "step": step,
        "train_seconds": round(learn_seconds, 2),
        "params": sum(p.numel() for p in model.gate.parameters()),
        "threshold": measured.threshold,
        "lost_surface_mass": measured.lost_surface_mass,
        "lost_mass": measured.lost_mass,
        "image_price_db": measured.image_price_db,
        "empty_fraction": measured.empty_fraction,
        "surface_error": measured.surface_error,
        "price_error_db": measured.price_error_db,
        BACKDROP_PRICE: round(of_backdrop, 4),
        "calibration_rays": len(truth),
        "recoveries": model.progress.recoveries,
        "held_out": held_out_sampler(datamanager) is not None,
        "bounds": survey.bounds.reason,
        "near": float(model.march_range[0]),
        "far": float(model.march_range[1]),
        "step_size": float(model.march_range[2]),
        "cone_angle": float(model.march_range[4]),
        "aabb": model.aabb.tolist(),
        "cameras": survey.positions.tolist(),
        "frame": frame_of(datamanager),
    }


def write_occupancy(model: LecoModel, folder: Path) -> None:
    """Leaves the frozen gate as `occupancy.safetensors` in a folder."""
    leave_file(model.occupancy(), folder)


def leave_file(occupancy: Occupancy, folder: Path) -> None:
    """Leaves an occupancy as `occupancy.safetensors` in a folder, made where it is missing.

    A disk that is full is said in one line: the checkpoint holds the gate too.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupancy.save(folder / FILE_NAME)
    except OSError as error:
        say(f"{folder / FILE_NAME} could not be written ({error}); a resumed run writes it anew")
        return
    say(f"wrote {folder / FILE_NAME}")


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

    Args:
        count: None is what a calibration takes.
        seed, share: see `held_out_bundle`.
    """
    count = count or model.config.calibration.rays
    bundle, truth = held_out_bundle(datamanager, count, seed, share)
    return model.rays_of(bundle.to(model.device)), truth.to(model.device).float()


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
def evaluating(model: LecoModel) -> Iterator[None]:
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
