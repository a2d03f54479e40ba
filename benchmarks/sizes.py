"""Automatic sizes against a sweep: `python benchmarks/sizes.py [SCENE ...]`.

`leco-occupancy` trains for the same number of steps, on drone surveys of cities and on scenes that
are named: in the sizes that it chooses, in those of the device, with smaller and larger tables and,
where it chooses several scene experts, with half of them; on the largest city in automatic sizes
and larger ones only. Steps and not seconds: it may run beside other work. A run is stored when it
is done; a benchmark that was stopped goes on there, and a run is known by its scene, sizes and
seed, whatever code made it, which the page says. `--dry-run` passes through everything in seconds
and means nothing.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import tyro
from measured_runs import stored_rows
from sizes_figures import AUTOMATIC, bars, verdict

from leco_plugin.evaluation.clock import Budget
from leco_plugin.evaluation.report import describe_code, describe_machine, made_by
from leco_plugin.evaluation.timed_run import timed_run
from leco_plugin.method_configs import best_device, leco_occupancy
from leco_plugin.models.sizing.scene_sizes import complete
from leco_plugin.models.sizing.sizes import (
    CHOSEN,
    Sizes,
    automatic,
    size_at,
    sizes_for,
    values_of,
    with_size,
)
from leco_plugin.scenes.bounds import BoundsConfig
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import write_city
from leco_plugin.scenes.survey import CAMERAS, detail_of, points_in
from leco_plugin.scenes.whole_files import write_json

DEVICE = "the device's"
FEWEST = 40
"""Photographs of a city from the air, however small it is: from the eight of a single block, one of
them for testing, PSNR scattered by 2 dB between seeds."""
TABLE, EXPERTS = "field.encoding.log2_table", "scene_experts"


@dataclass
class Options:
    """Settings of the benchmark."""

    data: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Scenes in nerfstudio's format, say caliterra."""
    cities: tuple[int, ...] = (1, 3)
    """Blocks a side of the cities with a sweep."""
    beside_larger: tuple[int, ...] = (8,)
    """Blocks a side of cities that are trained in automatic sizes and in larger ones only."""
    sized: tuple[int, ...] = (16,)
    """Blocks a side of cities for which sizes are chosen only."""
    steps: int = 1000
    """Training steps of a run."""
    learn_steps: int = 200
    """Of them, until the gate is frozen; more where it has not settled. With 150 some gates skipped
    next to nothing, and PSNR said more of that than of sizes."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of the runs, one after the other: what is there is whole whenever this is stopped."""
    tables: tuple[int, ...] = (-2, 2)
    """Added to the binary logarithm of the table that is chosen."""
    experts: tuple[float, ...] = (0.5,)
    """Times the scene experts that are chosen."""
    folder: Path = Path("data/sizes")
    """Where the cities are, or will be."""
    out: Path = Path(__file__).parent / "results" / "sizes.json"
    """Where the figures go."""
    dry_run: bool = False
    """Tiny cities and a few steps: to see that everything passes."""


def dry(options: Options) -> Options:
    """Sizes that take seconds, in a folder and a file of their own."""
    return replace(
        options,
        cities=(1,),
        beside_larger=(2,),
        sized=(),
        steps=8,
        learn_steps=4,
        seeds=(0,),
        folder=options.folder / "dry",
        out=options.folder / "dry" / "sizes.json",
    )


def larger(chosen: Sizes, most: Sizes, options: Options) -> dict[str, Sizes]:
    """Of a sweep, the chosen sizes and those with more parameters."""
    points = sweep(chosen, most, options)
    few = values_of(chosen, images=0)
    return {
        name: sizes
        for name, sizes in points.items()
        if name == AUTOMATIC or values_of(sizes, images=0) > few
    }


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


STORED = ("steps", "psnr", "image_psnr", "ssim", "flip", "train_seconds")
"""Figures of a run that are kept."""


def train(data: Path, sizes: Sizes, seed: int, options: Options) -> dict[str, Any]:
    """One training run."""
    config: Any = copy.deepcopy(leco_occupancy.config)
    config.pipeline.datamanager.data = data
    config.output_dir = options.folder / "sweep"
    model = config.pipeline.model
    schedule = replace(model.schedule, learn_steps=options.learn_steps, learn_share=0.0)
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
        "empty_fraction": trainer.pipeline.model.mixture.report.get("empty_fraction"),
        **{key: record.to_dict()[key] for key in STORED},
    }
    plain: dict[str, Any] = json.loads(json.dumps(facts))
    return plain


def described(data: Path, blocks: int | None) -> dict[str, Any]:
    """`look`, and of a city how many blocks it has a side."""
    return look(data) | ({} if blocks is None else {"blocks": blocks})


def cities_of(options: Options) -> dict[int, Path]:
    """The folder of each city by its blocks a side, written where it is missing."""
    blocks = dict.fromkeys([*options.cities, *options.beside_larger, *options.sized])
    return {
        n: write_city(CityConfig(n), options.folder / f"city-{n}", capture_of(n, options.dry_run))
        for n in blocks
    }


def capture_of(blocks: int, dry_run: bool) -> CaptureConfig:
    """How a city of so many blocks a side is surveyed."""
    capture = CaptureConfig(street_per_block=0.0)
    if dry_run:
        return replace(capture, width=24, height=18, aerial_per_block=6.0)
    fewest = FEWEST / blocks**2
    return replace(capture, aerial_per_block=max(capture.aerial_per_block, fewest))


def wanted_runs(
    scenes: Mapping[Path, dict[str, Any]], cities: Mapping[int, Path], options: Options
) -> list[tuple[Path, str, Sizes, int]]:
    """Scene, point, sizes and seed of each run, seed after seed.

    Args:
        scenes: as `look` describes them.
        cities: by their blocks a side.
    """
    ways = {data: sweep for data in (*(cities[n] for n in options.cities), *options.data)}
    for n in options.beside_larger:
        ways.setdefault(cities[n], larger)
    most = sizes_for(best_device())
    return [
        (data, name, sizes, seed)
        for seed in options.seeds
        for data, way in ways.items()
        for name, sizes in way(sizes_of(scenes[data]), most, options).items()
    ]


def main(options: Options) -> None:
    """Trains what is not stored yet, and stores each run.

    Raises:
        SystemExit: the file holds runs of other settings.
    """
    options = dry(options) if options.dry_run else options
    settings = {"steps": options.steps, "learn_steps": options.learn_steps}
    code = describe_code()
    rows = stored_rows(options.out, settings)
    cities = cities_of(options)
    blocks = {folder: n for n, folder in cities.items()}
    scenes = {
        data: described(data, blocks.get(data))
        for data in dict.fromkeys([*options.data, *cities.values()])
    }
    wanted = wanted_runs(scenes, cities, options)
    left = sum(find(rows, data.name, sizes, seed) is None for data, _, sizes, seed in wanted)
    print(f"{left} of {len(wanted)} runs to do", flush=True)

    def store() -> dict[str, Any]:
        done = named(rows, wanted)
        others = ({**row, "point": None} for row in rows if not _among(row, done))
        report = {
            "format": 1,
            "machine": describe_machine(),
            "settings": settings,
            "scenes": list(scenes.values()),
            "verdict": verdict(done),
            "bars": bars(list(scenes.values()), done),
            "runs": [*done, *others],
        }
        write_json(options.out, report)
        return report

    report = store()
    for data, name, sizes, seed in wanted:
        if find(rows, data.name, sizes, seed) is None:
            rows.append({**train(data, sizes, seed, options), **made_by(code)})
            print(f"{data.name}, {name}, seed {seed}: {rows[-1]['psnr']:.2f} dB", flush=True)
            report = store()
    print(json.dumps([report["verdict"], report["bars"]], indent=1))


def named(
    rows: Sequence[dict[str, Any]], wanted: Sequence[tuple[Path, str, Sizes, int]]
) -> list[dict[str, Any]]:
    """Those of the wanted runs that are there, with the names of their points."""
    found = ((find(rows, data.name, sizes, seed), name) for data, name, sizes, seed in wanted)
    return [{**row, "point": name} for row, name in found if row is not None]


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


if __name__ == "__main__":
    main(tyro.cli(Options))
