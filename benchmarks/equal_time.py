"""The same scene, the same seconds: guided, never frozen, and the dense homogeneous mixture.

    python benchmarks/equal_time.py --data SCENE --seconds 100 --seeds 0 1 2 --out results.json

Methods take turns within a seed, so that a machine whose speed drifts treats them alike. Each run
is stored when it ends, and a run that is stored is not made again.
"""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import tyro
from nerfstudio.engine.trainer import TrainerConfig

from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_machine
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.method_configs import leco_occupancy


def guided(config: TrainerConfig) -> None:
    """The method as it is."""


def never_frozen(config: TrainerConfig) -> None:
    """The same HMoE, gate trained to the end, nothing skipped."""
    model: Any = config.pipeline.model
    model.schedule = replace(model.schedule, freeze=False)


def homogeneous(config: TrainerConfig) -> None:
    """The same scene experts without an empty-space expert: every candidate through an expert."""
    never_frozen(config)
    model: Any = config.pipeline.model
    model.homogeneous = True


METHODS = {
    "leco-occupancy": (guided, "learned-occupancy"),
    "leco-occupancy-never-frozen": (never_frozen, "dense"),
    "leco-occupancy-homogeneous": (homogeneous, "dense"),
}


def main(data: Path, out: Path, seconds: float = 100.0, seeds: tuple[int, ...] = (0, 1, 2)) -> None:
    """Run whatever is missing.

    Args:
        data: A scene in nerfstudio's format.
        out: JSON file of the results; existing runs in it are kept.
        seconds: Training time of each run.
        seeds: Seeds.
    """
    name = data.resolve().name
    report: dict[str, Any] = {
        "format": 1,
        "machine": describe_machine(),
        "scene": {"name": name},
        "seconds": seconds,
        "runs": [],
    }
    if out.exists():
        report = json.loads(out.read_text())
    done = {(run["method"], run["seed"]) for run in report["runs"]}
    for seed in seeds:
        for method, (change, sampler) in METHODS.items():
            if (method, seed) in done:
                continue
            config = copy.deepcopy(leco_occupancy.config)
            config.output_dir, config.method_name = Path("runs/equal-time"), method
            config.pipeline.datamanager.data = data
            change(config)
            run, trainer = timed_run(config, seconds, sampler=sampler, seed=seed, images=1)
            del trainer
            report["runs"].append(run.to_dict())
            write_json(out, report)
            print(f"{name} seed {seed} {method}: {run.psnr:.2f} dB after {run.steps} steps")


if __name__ == "__main__":
    tyro.cli(main)
