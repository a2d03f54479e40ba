"""Automatic sizes against a sweep: `python benchmarks/sizes.py [SCENE ...]`.

`leco-occupancy` trains for the same number of steps, on drone surveys of cities of 1 and 3 blocks a
side and on scenes that are named: in the sizes that it chooses, in those of the device, and with
smaller and larger tables and fewer and more experts than chosen. Steps and not seconds: it may run
beside other work. Each run is stored when it is done; a benchmark that was stopped goes on there.
"""

from __future__ import annotations

import copy
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import tyro

from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_code, describe_machine
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.method_configs import best_device, leco_occupancy
from leco_plugin.models.scene_sizes import complete
from leco_plugin.models.size_limits import values_of
from leco_plugin.models.sizes import CHOSEN, Sizes, automatic, size_at, sizes_for, with_size
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.city import CityConfig
from leco_plugin.scenes.city_capture import CaptureConfig
from leco_plugin.scenes.city_folder import write_city
from leco_plugin.scenes.detail import CAMERAS, detail_of
from leco_plugin.scenes.survey import points_in

MAY_LOSE, MAY_HAVE, SMALL_AGAINST_LARGE = 0.1, 1.25, 0.25
"""dB below the best of the sweep, its parameters times this, and parameters of the smallest city
against those of the largest: the bars."""
AUTOMATIC, DEVICE = "automatic", "the device's"
TABLE, EXPERTS = "field.encoding.log2_table", "scene_experts"


@dataclass
class Options:
    """Settings of the benchmark."""

    data: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Scenes in nerfstudio's format, say caliterra."""
    cities: tuple[int, ...] = (1, 3)
    """Blocks a side of the cities that are trained on."""
    sized: tuple[int, ...] = (8,)
    """Blocks a side of cities for which sizes are chosen only."""
    steps: int = 300
    """Training steps of a run."""
    learn_steps: int = 150
    """Of them, until the gate is frozen."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the runs."""
    tables: tuple[int, ...] = (-2, 2)
    """Added to the binary logarithm of the table that is chosen."""
    experts: tuple[float, ...] = (0.5, 2.0)
    """Times the scene experts that are chosen."""
    folder: Path = Path("data/sizes")
    """Where the cities are, or will be."""
    out: Path = Path(__file__).parent / "results" / "sizes.json"
    """Where the figures go."""
    dry_run: bool = False
    """A tiny city and a few steps: to see that everything passes."""


def dry(options: Options) -> Options:
    """Sizes that take seconds."""
    return replace(options, cities=(1,), sized=(2,), steps=8, learn_steps=4, seeds=(0,))


def sweep(chosen: Sizes, most: Sizes, options: Options) -> dict[str, Sizes]:
    """What is trained, by name; sizes that come twice only once."""
    points = {AUTOMATIC: chosen, DEVICE: most}
    for more in options.tables:
        wanted = max(4, size_at(chosen, TABLE) + more)
        points[f"table x {2.0**more:g}"] = with_size(chosen, TABLE, wanted)
    for factor in options.experts:
        number = max(1, round(factor * chosen.field.experts.scene_experts))
        changed = with_size(chosen, f"field.experts.{EXPERTS}", number)
        points[f"experts x {factor:g}"] = with_size(changed, f"gate.{EXPERTS}", number)
    kept: dict[str, Sizes] = {}
    for name, sizes in points.items():
        if sizes not in kept.values():
            kept[name] = sizes
    return kept


def look(data: Path) -> dict[str, Any]:
    """A scene's detail, the sizes chosen for it and their parameters; nothing is trained."""
    parser: Any = copy.deepcopy(leco_occupancy.config.pipeline.datamanager.dataparser)
    parser.data = data
    outputs = parser.setup().get_dataparser_outputs("train")
    images, device = len(outputs.image_filenames), best_device()
    metadata = {**outputs.metadata, CAMERAS: outputs.cameras}
    chosen = complete(automatic(sizes_for(device)), BoundsConfig(), metadata, images, device)
    found = detail_of(outputs.cameras, points_in(outputs.metadata))
    return {
        "scene": data.name,
        "images": images,
        "pixels": found.pixels,
        "texels": round(found.texels),
        "across": round(found.across),
        "sizes": {path: size_at(chosen, path) for path in CHOSEN},
        "parameters": values_of(chosen, images),
        "device_parameters": values_of(sizes_for(device), images),
    }


def sizes_of(facts: dict[str, Any]) -> Sizes:
    """The complete sizes of a row of `look`."""
    sizes = sizes_for(best_device())
    for path, value in facts["sizes"].items():
        sizes = with_size(sizes, path, value)
    return sizes


def train(data: Path, sizes: Sizes, seed: int, options: Options) -> dict[str, Any]:
    """One training run."""
    config: Any = copy.deepcopy(leco_occupancy.config)
    config.pipeline.datamanager.data = data
    model = config.pipeline.model
    schedule = replace(model.schedule, learn_steps=options.learn_steps)
    config.pipeline.model = replace(model, sizes=sizes, schedule=schedule)
    record, trainer = timed_run(
        config,
        Budget(steps=options.steps),
        sampler="learned-occupancy",
        seed=seed,
        curve_points=1,
        images=1,
    )
    images = trainer.pipeline.model.num_train_data
    facts = {
        "scene": data.name,
        "point": None,
        "seed": seed,
        "sizes": {path: size_at(sizes, path) for path in CHOSEN},
        "parameters": values_of(sizes, images),
        "empty_fraction": trainer.pipeline.model.report.get("empty_fraction"),
        **{key: record.to_dict()[key] for key in ("steps", "psnr", "ssim", "train_seconds")},
    }
    plain: dict[str, Any] = json.loads(json.dumps(facts))
    return plain


def verdict(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Of each scene: automatic beside the best of the sweep; only points with all their seeds.

    Args:
        rows: runs, whose `point` is None where they belong to no point of this sweep.
    """
    found = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        points: dict[str, list[dict[str, Any]]] = {}
        for row in rows:
            if row["scene"] == scene and row["point"] is not None:
                points.setdefault(row["point"], []).append(row)
        most = max(len(runs) for runs in points.values())
        means = {
            name: statistics.fmean(run["psnr"] for run in runs)
            for name, runs in points.items()
            if len(runs) == most
        }
        if AUTOMATIC not in means:
            continue
        best = max(means, key=lambda name: means[name])
        ours, its = (points[name][0]["parameters"] for name in (AUTOMATIC, best))
        psnrs = [run["psnr"] for run in points[AUTOMATIC]]
        found[scene] = {
            "psnr": means[AUTOMATIC],
            "spread": max(psnrs) - min(psnrs),
            "best": best,
            "best_psnr": means[best],
            "parameters": ours,
            "best_parameters": its,
            "reached": means[AUTOMATIC] >= means[best] - MAY_LOSE and ours <= MAY_HAVE * its,
        }
    return found


def main(options: Options) -> None:
    options = dry(options) if options.dry_run else options
    capture = CaptureConfig(street_per_block=0.0)
    if options.dry_run:
        capture = replace(capture, width=24, height=18, aerial_per_block=6.0)
    folders = {
        blocks: write_city(
            CityConfig(blocks), options.folder / f"city-{blocks}", capture, layout="nerfstudio"
        )
        for blocks in dict.fromkeys([*options.cities, *options.sized])
    }
    trained = [*(folders[blocks] for blocks in options.cities), *options.data]
    scenes = [look(data) for data in dict.fromkeys([*trained, *folders.values()])]
    settings = {"steps": options.steps, "learn_steps": options.learn_steps}
    rows = stored_rows(options.out, settings)
    most = sizes_for(best_device())
    wanted = [
        (data, name, sizes, seed)
        for seed in options.seeds
        for data, facts in zip(trained, scenes)
        for name, sizes in sweep(sizes_of(facts), most, options).items()
    ]
    done: list[dict[str, Any]] = []
    for data, name, sizes, seed in wanted:
        row = find(rows, data.name, sizes, seed)
        if row is None:
            row = train(data, sizes, seed, options)
            rows.append(row)
            print(f"{data.name}, {name}, seed {seed}: {row['psnr']:.2f} dB", flush=True)
        done.append({**row, "point": name})
        report = {
            "format": 1,
            "machine": describe_machine(),
            "code": describe_code(),
            "settings": settings,
            "scenes": scenes,
            "verdict": verdict(done),
            "runs": [*done, *({**row, "point": None} for row in rows if not _among(row, done))],
        }
        write_json(options.out, report)
    print(json.dumps(verdict(done), indent=1))


def find(
    rows: Sequence[dict[str, Any]], scene: str, sizes: Sizes, seed: int
) -> dict[str, Any] | None:
    """The stored run of these sizes, whatever they were called."""
    chosen = {path: size_at(sizes, path) for path in CHOSEN}
    key = [scene, seed, chosen]
    return next((row for row in rows if [row["scene"], row["seed"], row["sizes"]] == key), None)


def _among(row: dict[str, Any], rows: Sequence[dict[str, Any]]) -> bool:
    names = ("scene", "seed", "sizes")
    return any(all(row[name] == other[name] for name in names) for other in rows)


def stored_rows(out: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that an earlier run of the same settings has left."""
    if not out.is_file():
        return []
    stored = json.loads(out.read_text())
    rows: list[dict[str, Any]] = stored["runs"] if stored["settings"] == settings else []
    return rows


if __name__ == "__main__":
    main(tyro.cli(Options))
