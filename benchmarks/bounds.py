"""Bounds found from the data against near and far set by hand: `python benchmarks/bounds.py SCENE`.

`leco-occupancy` trains for the same time with automatic bounds and with each pair, set as by
somebody who knows no more: space is contracted, and nothing cuts rays but near and far. Each pair
is tried once more with the space and the planes that are found from the data. Each run is stored
when it is done; a benchmark that was stopped goes on there. `--dry-run` takes a few steps and means
nothing.
"""

from __future__ import annotations

import copy
import itertools
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import tyro
from large_scene_tables import bounds_verdict
from measured_runs import stored_rows

from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.report import describe_code, describe_machine, made_by
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.learning.collapse import GateCollapsed
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.input_error import TrainingStopped
from leco_plugin.scenes.whole_files import write_json

Pair = tuple[float, float]


@dataclass
class Options:
    """Settings of the benchmark."""

    data: tyro.conf.Positional[Path]
    """A scene in nerfstudio's format, say brighton_beach."""
    pairs: tuple[Pair, ...] = ((0.05, 1000.0), (0.05, 6.0), (0.3, 3.0), (0.5, 2.0), (0.7, 1.6))
    """Near and far set by hand, scene units: nerfstudio's own first, then closer and closer."""
    planes: tuple[bool, ...] = (False, True)
    """Whether space and planes found from the data are kept where near and far are set by hand."""
    seconds: float = 60.0
    """Training time of a run."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the runs."""
    dry_run: bool = False
    """A few steps of two pairs: to see that everything passes."""
    out: Path = Path(__file__).parent / "results" / "bounds.json"
    """Where the figures go."""


def run(options: Options, pair: Pair | None, planes: bool, seed: int) -> dict[str, Any]:
    """One training run; a pair of None is automatic."""
    config: Any = copy.deepcopy(leco_occupancy.config)
    config.pipeline.datamanager.data = options.data
    if pair is not None:
        config.pipeline.model.near, config.pipeline.model.far = pair
    if not planes:
        config.pipeline.model.bounds = BoundsConfig(space="contraction")
    budget = Budget(options.seconds, 6 if options.dry_run else None)
    facts: dict[str, Any] = {"range": pair, "planes": planes, "seed": seed}
    try:
        record, trainer = timed_run(
            config, budget, sampler="learned-occupancy", seed=seed, curve_points=2, images=1
        )
    except (GateCollapsed, TrainingStopped) as error:  # as a badly chosen range may
        if pair is None:
            raise
        return facts | {"range": list(pair), "psnr": None, "failed": str(error)}
    region = trainer.pipeline.model.mixture.region
    facts |= {"marched": [float(region.near), float(region.far)], **record.to_dict()}
    plain: dict[str, Any] = json.loads(json.dumps(facts))
    return plain


def wanted_runs(options: Options) -> list[tuple[Pair | None, bool, int]]:
    """Near and far, planes and seed of each run, seed after seed."""
    by_hand = list(itertools.product(options.pairs, options.planes))
    ways: list[tuple[Pair | None, bool]] = [(None, True), *by_hand]
    return [(pair, planes, seed) for seed in options.seeds for pair, planes in ways]


def main(options: Options) -> None:
    """Trains what is not stored yet, and stores each run; `SystemExit` where runs of other settings
    are."""
    if options.dry_run:
        options = replace(options, pairs=options.pairs[:2])
    code = describe_code()  # before anything is measured
    settings = {
        "scene": options.data.resolve().name,
        "seconds": options.seconds,
        "dry_run": options.dry_run,
    }
    rows = stored_rows(options.out, settings)
    for pair, planes, seed in wanted_runs(options):
        key = [list(pair) if pair is not None else None, planes, seed]
        if any([row["range"], row["planes"], row["seed"]] == key for row in rows):
            continue
        rows.append(run(options, pair, planes, seed) | made_by(code))
        report = {
            "format": 1,
            "machine": describe_machine(),
            "settings": settings,
            "runs": rows,
        }
        write_json(options.out, report)
        name = f"{pair or 'automatic'}, planes {'on' if planes else 'off'}, seed {seed}"
        print(f"{name}: {rows[-1]['psnr']} dB", flush=True)
    print("\n".join(bounds_verdict(rows)))


if __name__ == "__main__":
    main(tyro.cli(Options))
