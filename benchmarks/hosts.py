"""Hosts at equal time: guided by learned occupancy, and as they are.

    python benchmarks/hosts.py --data SCENE --seconds 60 --seeds 0 1 2 --out results.json

The guided run learns its occupancy first, on the clock. Methods take turns within a seed, so that a
machine whose speed drifts treats them alike. Each run is stored when it ends, and a run that is
stored is not made again.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import tyro
from nerfstudio.engine.trainer import TrainerConfig

from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_machine
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.host_configs import leco_nerfacto, leco_ngp, leco_switch_nerf
from leco_plugin.models.guided_start import OWN_SAMPLER

GUIDED = "learned-occupancy"
METHODS: dict[str, tuple[TrainerConfig, str, str]] = {
    "leco-ngp": (leco_ngp.config, GUIDED, GUIDED),
    "instant-ngp": (leco_ngp.config, OWN_SAMPLER, "occupancy-grid"),
    "leco-nerfacto": (leco_nerfacto.config, GUIDED, GUIDED),
    "nerfacto": (leco_nerfacto.config, OWN_SAMPLER, "proposal-networks"),
    "leco-switch-nerf": (leco_switch_nerf.config, GUIDED, GUIDED),
    "switch-nerf": (leco_switch_nerf.config, OWN_SAMPLER, "coarse-fine"),
    "switch-nerf-grid": (leco_switch_nerf.config, OWN_SAMPLER, "occupancy-grid"),
}


def main(
    data: Path,
    out: Path,
    seconds: float = 60.0,
    learn_seconds: float | None = None,
    seeds: tuple[int, ...] = (0, 1, 2),
    methods: tuple[str, ...] = tuple(METHODS),
) -> None:
    """Run whatever is missing.

    Args:
        data: A scene in nerfstudio's format.
        out: JSON file of the results; existing runs in it are kept.
        seconds: Training time of each run.
        learn_seconds: Of which the guided ones learn their occupancy for about this long; None is
            as many steps as leco-occupancy.
        seeds: Seeds.
        methods: Which of them.
    """
    report: dict[str, Any] = {
        "format": 1,
        "machine": describe_machine(),
        "scene": {"name": data.resolve().name},
        "seconds": seconds,
        "learn_seconds": learn_seconds,
        "runs": [],
    }
    if out.exists():
        report = json.loads(out.read_text())
    done = {(run["method"], run["seed"]) for run in report["runs"]}
    for seed in seeds:
        for method in methods:
            if (method, seed) in done:
                continue
            base, sampler, called = METHODS[method]
            config = copy.deepcopy(base)
            config.output_dir, config.method_name = Path("runs/hosts"), method
            config.pipeline.datamanager.data = data
            model: Any = config.pipeline.model
            model.occupancy.sampler, model.occupancy.seconds = sampler, learn_seconds
            if method == "switch-nerf-grid":
                model.host.sampling = "occupancy-grid"
            run, trainer = timed_run(config, seconds, sampler=called, seed=seed, images=1)
            guide = getattr(trainer.pipeline.model, "guide", None)
            if guide is not None:
                run.freeze_seconds = guide.the_occupancy().report["train_seconds"]
            del trainer
            report["runs"].append(run.to_dict())
            write_json(out, report)
            print(
                f"{report['scene']['name']} seed {seed} {method}: {run.psnr:.2f} dB, "
                f"{run.steps} steps, {run.render_seconds_per_image:.1f} s an image",
                flush=True,
            )


if __name__ == "__main__":
    tyro.cli(main)
