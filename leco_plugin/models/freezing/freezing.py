"""The moment of freezing: calibrate on held-out rays, fix the threshold; and the file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from leco_plugin.models.compute import ranks
from leco_plugin.models.compute.ranks import from_first, say
from leco_plugin.models.freezing.calibration import Measured, backdrop_price, calibrate
from leco_plugin.models.freezing.held_out_rendering import (
    calibration_rays,
    dense_rendering,
    evaluating,
)
from leco_plugin.occupancy import BACKDROP_PRICE, Occupancy
from leco_plugin.scenes.frames import data_frame_of, frame_of
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
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
    step: int,
    learn_seconds: float,
) -> Measured:
    """Calibrates the gate and freezes it.

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
    model.forget_estimator()  # one that somebody asked for before has the threshold of before
    say(
        f"occupancy learned in {learn_seconds:.0f} s: threshold {measured.threshold:.4f} "
        f"skips {measured.empty_fraction:.1%} of all candidates for {measured.image_price_db:+.3f} "
        f"dB and {measured.lost_surface_mass:.2e} of the surface mass "
        f"({measured.lost_mass:.2e} of all)"
    )
    learned_for = step + 1 - model.progress.since
    advice = advice_on(measured, learned_for, model.progress.recoveries)
    if advice is not None:
        say(advice)
    return measured


def advice_on(measured: Measured, steps: int, recoveries: int) -> str | None:
    """What to do about an occupancy that skips next to nothing; None for one that skips.

    Args:
        steps: that it was learned for, from its beginning or its last recovery.
        recoveries: how often its gate was healed.
    """
    if measured.threshold == 0.0:
        said = "no threshold keeps the price within its bounds, so nothing is skipped;"
    elif measured.empty_fraction >= HARDLY_ANYTHING:
        return None
    elif recoveries:
        said = "hardly anything is skipped;"
    else:
        said = "hardly anything is skipped, which is right for a scene full of fog; else"
    if recoveries:
        often = "once" if recoveries == 1 else f"{recoveries} times"
        said += f" its gate collapsed {often} before;"
    return (
        f"{said} it learned for {steps} steps, and more usually help: schedule.learn-steps, at "
        "--pipeline.model of leco-occupancy, in a run of twice as many, and at "
        "--pipeline.model.occupancy.learning of guided methods"
    )


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
        **measured._asdict(),
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
        "data_frame": data_frame_of(datamanager),
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
