"""`leco demo`: a guided run on a city, and the same model never frozen, for equal time."""

from __future__ import annotations

import copy
import datetime
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from leco_plugin.chart.contender import changed
from leco_plugin.chart.methods import SKIPPING_NOTHING
from leco_plugin.chart.picture import draw_curves, name_ends
from leco_plugin.chart.summary import Line
from leco_plugin.chart.theme import LIGHT, new_figure, save_picture, save_whole, style, themed
from leco_plugin.evaluation.clock import Budget, forget_peaks
from leco_plugin.evaluation.equal_loss import take_occupancy
from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.evaluation.occupancy_picture import draw_slice
from leco_plugin.evaluation.report import describe_code, describe_cores, describe_machine
from leco_plugin.evaluation.timed_run import TimedRun, timed_run
from leco_plugin.log import bar
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import CaptureConfig, CityTruth, write_city
from leco_plugin.scenes.whole_files import write_json
from leco_plugin.studio.host_models import true_colours

SECONDS = 130.0
"""Training time of each run: about five minutes in all on two cores."""
FULL_LEARNING = 150.0
"""Training time from which on the occupancy learns for the method's own number of steps."""
MOST_LEARNING = 0.5
"""Limit of learning, as a share of the training time, for slow machines."""
CITY, AERIAL = CityConfig(), CaptureConfig(street_per_block=0.0)
"""A drone survey: with pictures from the street, all rays would have to begin at the lens."""
QUICK_SECONDS = 15.0
QUICK = CityConfig(blocks=1), CaptureConfig(48, 36, aerial_per_block=24.0, street_per_block=0.0)
"""Shows that everything works, and nothing else."""
FEWEST_LEARN_STEPS = 10
SLICE_HEIGHT = 4.0
"""Metres over the ground of the slice that is shown: through walls, poles and crowns."""

NEVER_FROZEN = "leco-occupancy-never-frozen"


def run_demo(
    out: Path,
    seconds: float | None = None,
    quick: bool = False,
    began: float | None = None,
) -> dict[str, Any]:
    """Writes `report.json`, `chart.png`, `picture.png`, the occupancy, the city and both runs into
    the folder `out`, and returns the report. An earlier demo's city there is used again.

    Each run trains for so many seconds, by default `SECONDS`, or `QUICK_SECONDS` of a `quick` demo
    of one block. The command `began` at that `time.monotonic()`, by default now. ValueError or
    OSError if the time is no positive number or `out` cannot be used; RuntimeError if the time was
    over before the occupancy was learned.
    """
    command = "leco demo --quick" if quick else "leco demo"
    command += "" if seconds is None else f" --seconds {seconds:g}"
    seconds = (QUICK_SECONDS if quick else SECONDS) if seconds is None else seconds
    city, capture = QUICK if quick else (CITY, AERIAL)
    if not 0.0 < seconds < math.inf:
        raise ValueError(f"the training time is a positive number of seconds, not {seconds}")
    began = time.monotonic() if began is None else began
    code = describe_code()  # before anything is measured
    folder = write_city(city, out / "city", capture)

    guided = _config(folder, out, FULL_LEARNING if quick else seconds)
    budget = Budget(seconds, learn_seconds=MOST_LEARNING * seconds)
    with bar("Guided: learns, freezes, goes on") as show:
        guided_run, trainer = run_with_peaks(
            guided, budget, sampler="learned-occupancy", on_progress=show
        )
    learned: Any = trainer.pipeline.model
    left = take_occupancy(trainer, folder, out) if learned.mixture.is_frozen else None
    if left is None:
        raise RuntimeError(
            "the time was over before the occupancy was learned: give more with --seconds"
        )
    occupancy, facts, truth = left
    assert truth is not None
    _draw_picture(trainer, occupancy, truth, out / "picture.png")
    other = never_frozen(guided, learned.progress.learn_steps)
    del trainer, learned

    with bar("The same, never frozen") as show:
        other_run, trainer = run_with_peaks(
            other, Budget(seconds), sampler="dense", on_progress=show
        )
    report = {
        "format": 1,
        "machine": describe_machine(),
        "made": {"date": datetime.date.today().isoformat(), "command": command, **code},
        "scene": _scene_facts(city, capture, trainer.pipeline.datamanager),
        "occupancy": facts,
        "runs": [run.to_dict() for run in (guided_run, other_run)],
    }
    draw_chart(report, out / "chart.png")
    report["seconds_in_all"] = round(time.monotonic() - began, 1)
    write_json(out / "report.json", report)
    return report


def run_with_peaks(
    config: TrainerConfig, budget: Budget, **options: Any
) -> tuple[TimedRun, Trainer]:
    """`timed_run` with peaks of memory of its own; None where the system cannot reset them."""
    is_own = forget_peaks()
    run, trainer = timed_run(config, budget, **options)
    if not is_own:
        run.peak_process_bytes, run.peak_memory_bytes = None, run.peak_allocator_bytes
    return run, trainer


def _scene_facts(city: CityConfig, capture: CaptureConfig, manager: Any) -> dict[str, Any]:
    return {
        "name": "city",
        "blocks": city.blocks,
        "seed": city.seed,
        "width": capture.width,
        "height": capture.height,
        "train_images": len(manager.train_dataset),
        "test_images": len(manager.eval_dataset),
    }


def draw_chart(report: dict[str, Any], path: Path) -> Path:
    """Draws the demo's chart from its report: PSNR against seconds of training of both runs."""
    runs, blocks, machine = report["runs"], report["scene"]["blocks"], report["machine"]
    where = describe_cores(machine) if machine["device"] == "cpu" else "one GPU"
    gain = runs[0]["psnr"] - runs[1]["psnr"]
    title = f"{gain:+.1f} dB after the same time, by skipping what is empty"
    if _is_quick(report):
        title = "All works; these figures mean nothing"
    names = ("skips what it has\nlearned is empty", "the same model,\nskipping nothing")
    lines = [Line(name, "", run["sampler"], (run,)) for name, run in zip(names, runs)]
    with themed(LIGHT):
        figure = new_figure((8, 4.4), LIGHT.page)
        figure.suptitle(title, fontsize=14, fontweight="bold", x=0.01, ha="left")
        scene = f"Procedural city of {blocks} x {blocks} blocks, {where}, one seed: no verdict"
        figure.text(0.01, 0.93, scene, va="top", fontsize=11.5)
        axes = figure.add_axes((0.11, 0.14, 0.55, 0.68))
        draw_curves(axes, lines, LIGHT)
        axes.set_xlabel("seconds of training")
        axes.set_ylabel("PSNR on unseen photographs, dB", fontsize=11)
        name_ends(axes, lines, LIGHT, apart=0.16)
        if (frozen := runs[0]["freeze_seconds"]) is not None:
            colour = style(0, LIGHT)["color"]
            axes.axvline(frozen, color=colour, linestyle="--", linewidth=1.4)
            known = f" what is empty\n is known after {frozen:.0f} s"
            place = axes.get_xaxis_transform()  # at the top, for curves rise
            axes.text(frozen, 0.98, known, transform=place, va="top", color=colour, fontsize=11)
        return save_picture(figure, path, runs, dpi=120)


def never_frozen(config: TrainerConfig, learn_steps: int) -> TrainerConfig:
    """The same method with as many learning steps, never frozen: nothing is skipped."""
    config = copy.deepcopy(config)
    config.method_name = NEVER_FROZEN
    pipeline: Any = config.pipeline
    learning = {"schedule.learn_steps": learn_steps, "schedule.learn_share": 0.0}
    for path, value in {**SKIPPING_NOTHING, **learning}.items():
        pipeline.model = changed(pipeline.model, path, value)
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


@torch.no_grad()
def _draw_picture(trainer: Trainer, occupancy: Occupancy, truth: CityTruth, path: Path) -> None:
    """Draws a test photograph, its guided rendering, the depth, and a slice of the occupancy."""
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
    seen = torch.nanquantile(depth, torch.tensor([0.01, 0.99])).nan_to_num().tolist()
    # letters of this size can still be read where a page shows the picture half as wide
    figure = new_figure((11, 2.9), layout="constrained")
    axes = figure.subplots(1, 4, gridspec_kw={"width_ratios": [4, 4, 4.5, 2.6]})
    axes[0].imshow(photograph.cpu())
    axes[0].set_title("photograph\n(held out)")
    axes[1].imshow(rgb.cpu())
    axes[1].set_title(f"guided rendering\n({samples:.0f} samples a ray)")
    shown = axes[2].imshow(depth, cmap="turbo_r", vmin=seen[0], vmax=seen[1])
    axes[2].set_title("its depth\n(metres)")
    figure.colorbar(shown, ax=axes[2], shrink=0.8, pad=0.01)
    surface = truth.visible_surface("test")
    box = ViewBox(surface.amin(dim=0), surface.amax(dim=0))
    at = truth.to_metres(torch.zeros(3))
    at[2] = SLICE_HEIGHT
    height = float(truth.to_model(at)[2])
    draw_slice(axes[3], occupancy, box, 2, height, solid=truth.occupied)
    axes[3].set_title(f"occupancy {SLICE_HEIGHT:.0f} m up\n(true walls white)", fontsize=12)
    for panel in axes:
        panel.set(xticks=[], yticks=[], xlabel="", ylabel="")
    save_whole(figure, path, dpi=160, bbox_inches="tight")


def _is_quick(report: dict[str, Any]) -> bool:
    """Whether it is of the city of a quick demo, whose figures mean nothing."""
    return bool(report["scene"]["blocks"] == QUICK[0].blocks)


def summary(report: dict[str, Any]) -> list[str]:
    """The report in a few lines, for the terminal."""
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
    if _is_quick(report):
        lines.append("all works; figures of one block and so short a time mean nothing")
    lines.append(f"all of it took {report['seconds_in_all'] / 60:.1f} minutes")
    return lines
