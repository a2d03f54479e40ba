"""Bounds found from the data against near and far set by hand: `python benchmarks/bounds.py SCENE`.

`leco-occupancy` trains for the same time with automatic bounds and with each pair; the planes that
cut rays stay those of the data. Each run is stored when it is done; a benchmark that was stopped
goes on there.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_machine
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.method_configs import leco_occupancy

Pair = tuple[float, float]
MAY_LOSE = 0.1
"""dB by which automatic bounds may be below the best pair."""


@dataclass
class Options:
    """Settings of the benchmark."""

    data: tyro.conf.Positional[Path]
    """A scene in nerfstudio's format, say brighton_beach."""
    pairs: tuple[Pair, ...] = ((0.05, 1000.0), (0.05, 6.0), (0.3, 3.0), (0.5, 2.0), (0.7, 1.6))
    """Near and far set by hand, scene units: nerfstudio's own first, then closer and closer."""
    seconds: float = 120.0
    """Training time of a run."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the runs."""
    out: Path = Path(__file__).parent / "results" / "bounds.json"
    """Where the figures go."""


def verdict(rows: Sequence[dict[str, Any]]) -> dict[str, float | bool]:
    """Mean PSNR with automatic bounds, of the best pair, and whether the one is near the other."""
    by_range: dict[str, list[float]] = {}
    for row in rows:
        by_range.setdefault(json.dumps(row["range"]), []).append(row["psnr"])
    means = {name: sum(values) / len(values) for name, values in by_range.items()}
    automatic = means.pop("null")
    best = max(means.values())
    return {"automatic": automatic, "best_by_hand": best, "reached": automatic >= best - MAY_LOSE}


def run(options: Options, pair: Pair | None, seed: int) -> dict[str, Any]:
    """One training run; None is automatic."""
    config: Any = copy.deepcopy(leco_occupancy.config)
    config.pipeline.datamanager.data = options.data
    if pair is not None:
        config.pipeline.model.near, config.pipeline.model.far = pair
    record, trainer = timed_run(
        config, Budget(options.seconds), sampler="learned-occupancy", seed=seed
    )
    march_range = trainer.pipeline.model.march_range.tolist()[:2]
    facts = {"range": pair, "marched": march_range, **record.to_dict()}
    plain: dict[str, Any] = json.loads(json.dumps(facts))
    return plain


def main(options: Options) -> None:
    settings = {"scene": options.data.name, "seconds": options.seconds}
    rows: list[dict[str, Any]] = []
    if options.out.is_file():
        stored = json.loads(options.out.read_text())
        rows = stored["runs"] if stored["settings"] == settings else []
    wanted = [(pair, seed) for seed in options.seeds for pair in (None, *options.pairs)]
    for pair, seed in wanted:
        key = [list(pair) if pair is not None else None, seed]
        if any([row["range"], row["seed"]] == key for row in rows):
            continue
        rows.append(run(options, pair, seed))
        complete = len({json.dumps(row["range"]) for row in rows}) > 1
        report = {
            "format": 1,
            "machine": describe_machine(),
            "settings": settings,
            "verdict": verdict(rows) if complete else None,
            "runs": rows,
        }
        write_json(options.out, report)
        print(f"{pair or 'automatic'}, seed {seed}: {rows[-1]['psnr']:.2f} dB")
    print(verdict(rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
