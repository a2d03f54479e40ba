"""`leco demo`: a city learned, frozen and gone on with, and the same never frozen; equal time."""

from __future__ import annotations

import copy
import datetime
import math
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from torch import Tensor

from leco_plugin.chart.drawing.theme import LIGHT, Theme
from leco_plugin.evaluation.charts import psnr_against_seconds
from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine
from leco_plugin.evaluation.occupancy_facts import occupancy_facts, truth_of
from leco_plugin.evaluation.occupancy_picture import draw_slice
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.log import bar
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, write_city
from leco_plugin.scenes.city.truth import CityTruth
from leco_plugin.studio.host_models import true_colours

SECONDS = 130.0
"""Training time of each of the two runs; all of it then takes about six minutes on two cores."""
FULL_LEARNING = 150.0
"""Training time from which the occupancy is learned in the method's own number of steps."""
MOST_LEARNING = 0.5
"""Share of the training time that learning may take; a slow machine learns for fewer steps."""
AERIAL = CaptureConfig(street_per_block=0.0)
"""A drone survey: pictures from the street, too, would let all rays begin at the lens."""
FEWEST_LEARN_STEPS = 10
SLICE_HEIGHT = 4.0
"""Metres over the ground at which the occupancy is shown: through walls, poles and crowns."""

GUIDED, NEVER_FROZEN = "leco-occupancy", "leco-occupancy-never-frozen"


def run_demo(
    out: Path,
    seconds: float = SECONDS,
    city: CityConfig | None = None,
    capture: CaptureConfig | None = None,
    began: float | None = None,
) -> dict[str, Any]:
    """Writes `report.json`, `chart.png`, `picture.png`, the occupancy, the city and both runs.

    Args:
        out: folder; an earlier demo's city in it is used again, its results are replaced.
        seconds: training time of each run.
        city: 3 x 3 blocks by default.
        capture: how it is photographed.
        began: `time.monotonic()` when the command began; by default now.
    Returns:
        The report (DESIGN, section 8).
    Raises:
        ValueError, OSError: the time is no positive number, or `out` cannot be used.
        RuntimeError: the time was over before the occupancy was learned.
    """
    if not 0.0 < seconds < math.inf:
        raise ValueError(f"the training time is a positive number of seconds, not {seconds}")
    began = time.monotonic() if began is None else began
    code = describe_code()  # before anything is measured
    city, capture = city or CityConfig(), capture or AERIAL
    folder = write_city(city, out / "city", capture)

    guided = _config(folder, out, seconds)
    budget = Budget(seconds, learn_seconds=MOST_LEARNING * seconds)
    with bar("Guided: learns, freezes, goes on") as show:
        guided_run, trainer = timed_run(
            guided, budget, sampler="learned-occupancy", on_progress=show
        )
    occupancy, facts, truth = _frozen_occupancy(trainer, folder, out)
    _draw_picture(trainer, occupancy, truth, out / "picture.png")
    learned: Any = trainer.pipeline.model
    other = never_frozen(guided, learned.progress.learn_steps)
    del trainer, learned

    with bar("The same, never frozen") as show:
        other_run, trainer = timed_run(other, Budget(seconds), sampler="dense", on_progress=show)
    manager: Any = trainer.pipeline.datamanager
    report = {
        "format": 1,
        "machine": describe_machine(),
        "made": {"date": datetime.date.today().isoformat(), "command": "leco demo", **code},
        "scene": {
            "name": "city",
            "blocks": city.blocks,
            "seed": city.seed,
            "width": capture.width,
            "height": capture.height,
            "train_images": len(manager.train_dataset),
            "test_images": len(manager.eval_dataset),
        },
        "occupancy": facts,
        "runs": [run.to_dict() for run in (guided_run, other_run)],
    }
    draw_chart(report, out / "chart.png")
    report["seconds_in_all"] = round(time.monotonic() - began, 1)
    write_json(out / "report.json", report)
    return report


def draw_chart(report: dict[str, Any], path: Path, theme: Theme = LIGHT) -> Path:
    """The demo's chart from its stored report."""
    blocks, cores = report["scene"]["blocks"], report["machine"]["cores"]
    where = f"{cores} CPU cores" if report["machine"]["device"] == "cpu" else "one GPU"
    scene = f"Procedural city of {blocks} x {blocks} blocks, {where}, one seed"
    guided, dense = (run["psnr"] for run in report["runs"])
    title = f"{guided - dense:+.1f} dB after the same time, by skipping what is empty"
    labels = ["skips what it has learned is empty", "the same model, skipping nothing"]
    return psnr_against_seconds(report["runs"], path, title, scene, labels, theme)


def never_frozen(config: TrainerConfig, learn_steps: int) -> TrainerConfig:
    """The same method, of as many learning steps, its gate trained to the end, nothing skipped."""
    config = copy.deepcopy(config)
    config.method_name = NEVER_FROZEN
    model: Any = config.pipeline.model
    model.schedule = replace(model.schedule, freeze=False, learn_steps=learn_steps)
    model.front_to_back = True  # as guided images are rendered by themselves
    return config


def _config(folder: Path, out: Path, seconds: float) -> TrainerConfig:
    """`leco-occupancy` on this city; in less time than usual it learns for fewer steps."""
    config = copy.deepcopy(leco_occupancy.config)
    config.output_dir = out / "runs"
    config.experiment_name = "city"
    config.data = folder
    pipeline: Any = config.pipeline
    pipeline.datamanager.data = folder
    schedule = pipeline.model.schedule
    share = min(1.0, seconds / FULL_LEARNING)
    steps = max(FEWEST_LEARN_STEPS, round(share * schedule.learn_steps))
    pipeline.model.schedule = replace(schedule, learn_steps=steps)
    return config


def _frozen_occupancy(
    trainer: Trainer, folder: Path, out: Path
) -> tuple[Occupancy, dict[str, Any], CityTruth]:
    """The occupancy that the run left, what is known and measured of it, and the exact city."""
    model: Any = trainer.pipeline.model
    written = trainer.base_dir / FILE_NAME
    if not bool(model.frozen) or not written.exists():
        raise RuntimeError(
            "the time was over before the occupancy was learned: give more with --seconds"
        )
    kept_file = out / FILE_NAME
    shutil.copyfile(written, kept_file)
    occupancy = Occupancy.load(kept_file, model.device)
    manager = trainer.pipeline.datamanager
    truth = truth_of(folder, manager)
    assert truth is not None
    return occupancy, occupancy_facts(occupancy, kept_file, manager, truth), truth


@torch.no_grad()
def _draw_picture(trainer: Trainer, occupancy: Occupancy, truth: CityTruth, path: Path) -> None:
    """A test image as it is photographed and as the guided model renders it, and the occupancy."""
    pipeline: Any = trainer.pipeline
    model = pipeline.model
    dataset = pipeline.datamanager.eval_dataset
    # at 45 degrees one sees roofs, walls and ground
    number = int((dataset.cameras.camera_to_worlds[:, 2, 2] - 0.7).abs().argmin())
    pipeline.eval()
    outputs = model.get_outputs_for_camera(dataset.cameras[number : number + 1].to(model.device))
    pipeline.train()
    rgb = outputs["rgb"].clamp(0.0, 1.0)
    photograph = true_colours(model, dataset.get_data(number)["image"].to(rgb.device))
    met = outputs["accumulation"][..., 0] > 0.5
    depth = (outputs["depth"][..., 0] / truth.scale).where(met, torch.nan).cpu()
    samples = float(outputs["samples_per_ray"].mean())
    draw_panels(photograph.cpu(), rgb.cpu(), samples, depth, occupancy, truth, path)


def draw_panels(
    photograph: Tensor,
    rgb: Tensor,
    samples: float,
    depth: Tensor,
    occupancy: Occupancy,
    truth: CityTruth,
    path: Path,
) -> None:
    """Photograph, guided rendering, its depth, and a slice of the occupancy with the true walls.

    Args:
        photograph, rgb: [H, W, 3] in [0, 1].
        samples: a ray, mean over the image.
        depth: [H, W] in metres, NaN where nothing is met.
        occupancy, truth: in the same coordinates.
        path: of the picture.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    seen = torch.nanquantile(depth, torch.tensor([0.01, 0.99])).nan_to_num().tolist()
    # letters of this size can still be read where a page shows the picture half as wide
    figure = Figure(figsize=(11, 2.9), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4, gridspec_kw={"width_ratios": [4, 4, 4.5, 2.6]})
    axes[0].imshow(photograph)
    axes[0].set_title("photograph\n(held out)")
    axes[1].imshow(rgb)
    axes[1].set_title(f"guided rendering\n({samples:.0f} samples a ray)")
    shown = axes[2].imshow(depth, cmap="turbo_r", vmin=seen[0], vmax=seen[1])
    axes[2].set_title("its depth\n(metres)")
    figure.colorbar(shown, ax=axes[2], shrink=0.8, pad=0.01)
    _draw_city_slice(axes[3], occupancy, truth)
    for panel in axes:
        panel.set(xticks=[], yticks=[], xlabel="", ylabel="")
    figure.savefig(path, dpi=160, bbox_inches="tight")


def _draw_city_slice(axes: Any, occupancy: Occupancy, truth: CityTruth) -> None:
    surface = truth.visible_surface("test")
    low, high = surface.amin(dim=0), surface.amax(dim=0)
    ground = truth.to_metres(torch.zeros(3))
    ground[2] = SLICE_HEIGHT
    height = float(truth.to_model(ground)[2])
    draw_slice(axes, occupancy, ViewBox(low, high), 2, height, solid=truth.occupied)
    axes.set_title(f"occupancy {SLICE_HEIGHT:.0f} m up\n(true walls white)", fontsize=12)


def summary(report: dict[str, Any]) -> list[str]:
    """The report in a few lines, for the terminal; of an earlier release it lacks its last one."""
    facts = report["occupancy"]
    guided, other = report["runs"]
    recall = facts["kept_surface_recall"]
    lines = [
        f"occupancy: {facts['params']} parameters, {facts['bytes'] / 1000:.0f} kB, "
        f"learned and frozen in {guided['freeze_seconds']:.0f} s",
        f"  skips {facts['empty_fraction']:.1%} of all candidates for "
        f"{facts['image_price_db']:+.3f} dB"
        + (f", keeps {recall:.2%} of the true surface" if recall is not None else ""),
    ]
    lines += [
        f"{run['method']}: {run['psnr']:.2f} dB after {run['train_seconds']:.0f} s, "
        f"{run['render_seconds_per_image']:.2f} s an image"
        for run in (guided, other)
    ]
    if (seconds := report.get("seconds_in_all")) is not None:
        lines.append(f"all of it took {seconds / 60:.1f} minutes")
    return lines
