"""Records what `leco-occupancy` does, and holds later code to it.

    leco city --out city
    python benchmarks/record.py --data city caliterra --out record.json
    python benchmarks/record.py --data city caliterra --against record.json

Each run learns for 200 steps and goes on guided for 200. Only nerfstudio's trainer and
`Occupancy` are used, so that the script outlives any change inside the package.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import json
import random
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import numpy as np
import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer

from leco_plugin.chart.contender import changed
from leco_plugin.chart.methods import SEVERAL_EXPERTS
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.occupancy import Occupancy

STEPS, EVERY = 400, 10
CLOSE = {"steps": 30, "relative": 2e-3}
"""Until so many steps, losses agree to so much: later, rounding has grown into other runs."""
BOUNDS = {"psnr": 0.25, "kept": 0.03, "threshold": 0.35}
"""At the end: dB, share of candidates, and natural logarithm."""


def run(data: Path, seed: int, folder: Path) -> dict[str, Any]:
    """Losses every tenth step and the figures at the end of one run."""
    for sow in (random.seed, np.random.seed, torch.manual_seed):
        sow(seed)
    config = copy.deepcopy(leco_occupancy.config)
    config.pipeline.datamanager.data = config.data = data
    config.output_dir = folder
    config.max_num_iterations, config.vis, config.steps_per_save = STEPS, "tensorboard", 0
    config.machine.seed = seed
    config.steps_per_eval_image = config.steps_per_eval_batch = 0
    config.logging.local_writer.enable = False
    model: Any = config.pipeline.model
    model.schedule = replace(model.schedule, learn_steps=STEPS // 2, earliest=1.0)
    for path, value in SEVERAL_EXPERTS.items():  # as when the record was made
        model = changed(model, path, value)
    config.pipeline.model = model
    config.set_timestamp()
    writer.EVENT_WRITERS.clear()
    writer.GLOBAL_BUFFER.clear()
    trainer: Trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    losses: dict[str, dict[str, float]] = {}
    iterate = trainer.train_iteration

    def watched(step: int) -> Any:
        found = iterate(step)
        if step % EVERY == 0:
            named = {name: float(value) for name, value in found[1].items()}
            losses[str(step)] = named | {"kept_fraction": float(found[2]["kept_fraction"])}
        return found

    trainer.train_iteration = watched
    trainer.train()
    occupancy = Occupancy.load(Path(trainer.base_dir) / "occupancy.safetensors")
    trainer.pipeline.eval()
    image = trainer.pipeline.get_average_eval_image_metrics(STEPS)
    return {
        "losses": losses,
        "psnr": float(image["psnr"]),
        "threshold": occupancy.threshold,
        "kept": 1.0 - float(occupancy.report["empty_fraction"]),
    }


def differences(now: dict[str, Any], then: dict[str, Any]) -> list[str]:
    """What a run does otherwise than the recorded one, in words."""
    found = []
    for step, losses in then["losses"].items():
        for name, value in losses.items() if int(step) <= CLOSE["steps"] else ():
            other = now["losses"][step].get(name, float("nan"))
            if not abs(other - value) <= CLOSE["relative"] * max(abs(value), 1e-4):
                found.append(f"step {step}: {name} is {other:.6g}, was {value:.6g}")
    apart = {name: abs(now[name] - then[name]) for name in ("psnr", "kept")}
    apart["threshold"] = abs(float(np.log(now["threshold"] / then["threshold"])))
    found += [
        f"{name} is {now[name]:.4g}, was {then[name]:.4g}"
        for name, distance in apart.items()
        if not distance <= BOUNDS[name]
    ]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--against", type=Path)
    given = parser.parse_args()
    then = json.loads(given.against.read_text()) if given.against else {}
    now: dict[str, Any] = {}
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for data, seed in itertools.product(given.data, given.seeds):
            name = f"{data.name} {seed}"
            now[name] = run(data, seed, Path(folder))
            shown = {key: round(now[name][key], 4) for key in ("psnr", "threshold", "kept")}
            print(name, shown, flush=True)
            if given.out:
                given.out.write_text(json.dumps(now, indent=1) + "\n")
            for line in differences(now[name], then[name]) if then else ():
                print("  differs:", line, flush=True)
                wrong += 1
    if then:
        print(f"{wrong} differences from {given.against}")
    raise SystemExit(wrong > 0)


if __name__ == "__main__":
    main()
