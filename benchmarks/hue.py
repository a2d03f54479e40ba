"""Hue and thin lines, which PSNR hardly shows: `python benchmarks/hue.py SCENE ...`.

Trains `leco-occupancy` for equal seconds of one core each, with the weight of hue in the loss of
colours and without, and renders test photographs whole. A hue is a colour less its grey. Rows that
are stored in `results/hue.json` of the same code are not made again.
"""

from __future__ import annotations

import copy
import json
import statistics
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import checkout  # noqa: F401
import torch
import tyro
from page_parts import RESULTS, made_line, section, table
from torch import Tensor

from leco_plugin.chart.table import spread
from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.metrics import psnr
from leco_plugin.evaluation.report import (
    describe_code,
    describe_machine,
    finite_or_null,
    made_by,
    read_object,
)
from leco_plugin.models import losses
from leco_plugin.scenes.whole_files import write_json

IMAGES = 4
"""Test photographs, evenly chosen."""
WINDOW = 7
"""Side of the medians beside which a line is thin, pixels."""
CONTRAST = 0.1
"""By which a channel of a thin line differs from its median at least."""
FIGURES = ("psnr", "hue", "thin")


@dataclass
class Options:
    """Settings of the benchmark."""

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of scenes."""
    seconds: float = 120.0
    """Of each run, on one core."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """A run of each weight with each."""
    weights: tuple[float, ...] = (1.0, losses.HUE_WEIGHT)
    """Of squared errors in hue, beside those in brightness."""
    at_once: int = 1
    """Runs at a time."""
    out: Path = RESULTS / "hue.json"
    """Where the figures go."""


def hue_error(predicted: Tensor, truth: Tensor) -> float:
    """Length of the errors in hue of an image, both [H, W, 3]; pixels weigh by the length of their
    true hue. 1 for a grey image; NaN where the truth is grey."""
    hue, true_hue = (colours - colours.mean(dim=-1, keepdim=True) for colours in (predicted, truth))
    weights = true_hue.norm(dim=-1)
    return float((weights * (hue - true_hue).norm(dim=-1)).sum() / weights.square().sum())


def thin_error(predicted: Tensor, truth: Tensor) -> float:
    """Squared error of an image on thin lines, both [H, W, 3]: pixels that differ from the median
    around them. 1 where the medians stand in their place; NaN without thin lines."""
    edge = WINDOW // 2
    padded = torch.nn.functional.pad(truth.permute(2, 0, 1)[None], [edge] * 4, mode="replicate")[0]
    around = padded.unfold(1, WINDOW, 1).unfold(2, WINDOW, 1).flatten(3)
    contrast = truth - around.median(dim=-1).values.permute(1, 2, 0)
    thin = contrast.abs().amax(dim=-1) > CONTRAST
    return float((predicted - truth)[thin].square().sum() / contrast[thin].square().sum())


def figures_of(predicted: Tensor, truth: Tensor) -> dict[str, float]:
    """`FIGURES` of an image, in the place of `image_metrics`."""
    measures = (psnr, hue_error, thin_error)
    return {name: measure(predicted, truth) for name, measure in zip(FIGURES, measures)}


def train(data: Path, seconds: float, seed: int, weight: float) -> dict[str, Any]:
    """The figures of a run, means over its test photographs."""
    from leco_plugin.evaluation import timed_run as runs
    from leco_plugin.method_configs import leco_occupancy

    torch.set_num_threads(1)
    code, budget = describe_code(), Budget(seconds=seconds)
    config: Any = copy.deepcopy(leco_occupancy.config)
    config.data = config.pipeline.datamanager.data = data
    with TemporaryDirectory() as folder, patch.object(losses, "HUE_WEIGHT", weight):
        config.output_dir = Path(folder)
        run, trainer = runs.timed_run(
            config, budget, sampler="", seed=seed, curve_points=0, images=0
        )
    with patch.object(runs, "image_metrics", figures_of):
        means = runs.evaluate_images(trainer, IMAGES, Counter())
    found = finite_or_null({name: round(means[name], 4) for name in FIGURES})
    asked = {"scene": name_of(data), "seed": seed, "weight": weight, "seconds": seconds}
    return {**asked, "steps": run.steps, **found, **made_by(code)}


def name_of(data: Path) -> str:
    """What a scene is called; of `.` too."""
    return data.resolve().name


def hue_section(report: dict[str, Any]) -> list[str]:
    """The stored figures as a part of `docs/measurements.md`."""
    rows = report["runs"]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    weights = sorted({row["weight"] for row in rows})
    cells = []
    for scene, weight in product(scenes, weights):
        some = [row for row in rows if (row["scene"], row["weight"]) == (scene, weight)]
        if some:
            psnr, *errors = ([row[name] for row in some] for name in FIGURES)
            of_errors = (spread(values, ".3f", statistics.fmean) for values in errors)
            cells.append([scene, f"{weight:g}", spread(psnr, ".1f", statistics.fmean), *of_errors])
    seconds = ", ".join(f"{each:g} s" for each in sorted({row["seconds"] for row in rows}))
    note = (
        f" Runs of `leco-occupancy`, {seconds} of one core each. Means over seeds, with the least "
        f"and the most, of {IMAGES} test photographs rendered whole. A hue is a colour less its "
        "grey: a grey picture has an error of 1. Thin lines stand out from the "
        f"{WINDOW} x {WINDOW} pixels around them: the error is 1 where they are painted over. "
        f"Runs {made_line(rows)}."
    )
    command = " ".join(["python benchmarks/hue.py", *scenes])
    head = "scene | weight of hue in the loss | PSNR, dB | error in hue | error on thin lines"
    return section("Hue and thin lines", command, report, "\n".join(table(head, cells)), note)


def main(args: Sequence[str] | None = None) -> None:
    options = tyro.cli(Options, args=args)
    known = read_object(options.out, "is damaged; delete it") if options.out.exists() else {}
    code, rows = describe_code(), known.get("runs", [])
    rows = [row for row in rows if row["code"]["sources"] == code["sources"]]
    done = {(row["scene"], row["seconds"], row["seed"], row["weight"]) for row in rows}
    wanted = product(options.scenes, [options.seconds], options.seeds, options.weights)
    left = [each for each in wanted if (name_of(each[0]), *each[1:]) not in done]
    with ProcessPoolExecutor(options.at_once, get_context("spawn")) as pool:
        for row in pool.map(train, *zip(*left)) if left else ():
            rows.append(row)
            print(json.dumps(row), flush=True)
            write_json(options.out, {"format": 1, "machine": describe_machine(), "runs": rows})


if __name__ == "__main__":
    main()
