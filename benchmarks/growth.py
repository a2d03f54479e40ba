"""How the cost of occupancy grows with a scene: `python benchmarks/growth.py`.

Cities of 2, 4, 8 and, if asked for, 16 blocks a side. A gate learns until, at 1e-3 of the weight
near surfaces lost, it keeps no more than a given share of the candidates; looks are off the clock.
Beside it stands the occupancy grid, filled from the same field, that loses as much and keeps the
same volume. Every city's row is stored when it is done, and a benchmark that was stopped is taken
up there. `--dry-run` passes through everything in seconds and means nothing.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from growth_picture import draw
from nerfstudio.engine.callbacks import TrainingCallbackAttributes

from leco_plugin.evaluation.clock import Clock, warm_up
from leco_plugin.evaluation.equal_loss import LOST_SURFACE_MASS, at_equal_loss
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.evaluation.json_file import write_json
from leco_plugin.evaluation.machine import describe_machine
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.calibration import CalibrationConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.lifecycle import Lifecycle
from leco_plugin.models.optimizers import RATES, FusedAdamConfig
from leco_plugin.models.phases import ScheduleConfig
from leco_plugin.models.sizes import sizes_for
from leco_plugin.scenes.city import City, CityConfig
from leco_plugin.scenes.city_capture import CaptureConfig
from leco_plugin.scenes.city_folder import write_city

RESULTS = Path(__file__).parent / "results"


@dataclass
class Options:
    """Settings of the benchmark."""

    blocks: tuple[int, ...] = (2, 4, 8)
    """Blocks a side of the cities; add 16 for the largest."""
    seed: int = 0
    """Of cities and gates."""
    steps_per_side: int = 100
    """Learning steps for each block a side; looks begin when they are over."""
    most: float = 4.0
    """Times those steps after which a gate is given up."""
    steps_per_look: int = 25
    """Steps between two looks."""
    kept: float = 0.35
    """Share of the candidates that a gate may keep when it counts as learned."""
    octaves_per_doubling: int = 1
    """Octaves that the gate's encoding has more when the city's side doubles."""
    grids: tuple[int, ...] = (16, 24, 32, 48, 64, 96, 128, 192, 256, 384)
    """Cells along the longest side of the grids, whose cells are nearly cubic."""
    rays: int = 4096
    """Held-out rays of a look."""
    capture: CaptureConfig = field(default_factory=lambda: CaptureConfig(street_per_block=0.0))
    """How the cities are photographed."""
    cities: Path = Path("data/growth")
    """Where the cities are, or will be."""
    out: Path = RESULTS / "growth.json"
    """Where the figures go; the picture lies beside them."""
    dry_run: bool = False
    """The smallest cities, a few steps: to see that everything passes."""


def dry(options: Options) -> Options:
    """Sizes that take seconds."""
    return replace(
        options,
        blocks=(1, 2),
        steps_per_side=4,
        most=1.5,
        steps_per_look=2,
        grids=(4, 8),
        rays=128,
        capture=CaptureConfig(24, 18, aerial_per_block=6.0, street_per_block=0.0),
    )


def slope(sizes: Sequence[float], values: Sequence[float | None]) -> float | None:
    """The exponent p of values ~ sizes^p by least squares in logarithms; None from one value."""
    pairs = [(math.log(s), math.log(v)) for s, v in zip(sizes, values) if v is not None and v > 0]
    if len({size for size, _ in pairs}) < 2:
        return None
    middle_x = sum(x for x, _ in pairs) / len(pairs)
    middle_y = sum(y for _, y in pairs) / len(pairs)
    across = sum((x - middle_x) * (y - middle_y) for x, y in pairs)
    return across / sum((x - middle_x) ** 2 for x, _ in pairs)


def bytes_for(volume: float, grids: Sequence[dict[str, Any]]) -> float | None:
    """Bytes of the grid that keeps this share of the volume, between those measured.

    Interpolated in logarithms between the largest grid that keeps more and the next. None where no
    grid keeps so little; the smallest grid's bytes where all do.
    """
    rows = sorted(grids, key=lambda row: row["bytes"])
    enough = next((i for i, row in enumerate(rows) if row["kept_reached_volume"] <= volume), None)
    if enough is None:
        return None
    if enough == 0:
        return float(rows[0]["bytes"])
    less, more = rows[enough - 1], rows[enough]
    span = math.log(less["kept_reached_volume"] / max(more["kept_reached_volume"], 1e-9))
    along = math.log(less["kept_reached_volume"] / max(volume, 1e-9)) / span if span > 0 else 1.0
    low, high = math.log(less["bytes"]), math.log(more["bytes"])
    return math.exp(low + min(1.0, max(0.0, along)) * (high - low))


def gate_of(gate: GateConfig, blocks: int, per_doubling: int) -> GateConfig:
    """A gate that resolves the same metres: more octaves from four blocks a side on."""
    more = round(per_doubling * math.log2(max(blocks, 4) / 4))
    return replace(gate, encoding=replace(gate.encoding, octaves=gate.encoding.octaves + more))


def learn(blocks: int, options: Options) -> dict[str, Any]:
    """One city: the row of figures that is stored."""
    city = CityConfig(blocks, options.seed)
    folder = write_city(city, options.cities / f"{blocks}-blocks", options.capture)
    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = folder
    model_config = config.model
    steps = max(2, options.steps_per_side * blocks)
    model_config.schedule = ScheduleConfig(freeze=False, learn_steps=steps)
    model_config.calibration = CalibrationConfig(rays=options.rays)
    sizes = sizes_for(leco_occupancy.config.machine.device_type)
    gate = gate_of(sizes.gate, blocks, options.octaves_per_doubling)
    model_config.sizes = replace(sizes, gate=gate)
    torch.manual_seed(options.seed)
    pipeline: Any = config.setup(device=leco_occupancy.config.machine.device_type)
    manager, model = pipeline.datamanager, pipeline.model
    model.train()
    warm_up(model.device)
    clock = Clock()
    clock.start()
    lifecycle = Lifecycle(model, TrainingCallbackAttributes(None, None, pipeline, None))
    clock.stop()
    groups = model.get_param_groups()
    optimizers = [FusedAdamConfig(lr=RATES[name]).setup(group) for name, group in groups.items()]
    learned, looks, step = False, [], 0
    while not learned and step < options.most * steps:
        _step(model, lifecycle, manager, optimizers, step, clock)
        step += 1
        if step >= steps and (step - steps) % options.steps_per_look == 0:
            found = at_equal_loss(model, manager)
            looks.append([step, round(clock.seconds, 2), found["kept_candidates"]])
            learned = found["kept_candidates"] <= options.kept
    cells = [whole_box(model.occupancy()).cells(longest) for longest in options.grids]
    found = at_equal_loss(model, manager, cells)
    built = City(city).built
    size = sum(value.numel() * value.element_size() for value in model.gate.state_dict().values())
    return {
        "blocks": blocks,
        "built_blocks": int(built.sum()),
        "area_square_metres": float(built.sum()) * city.block_size**2,
        "photographs": len(manager.train_dataset),
        "octaves": gate.encoding.octaves,
        "learned": learned,
        "steps": step,
        "seconds": round(clock.seconds, 2) if learned else None,
        "gate_bytes": size,
        "grid_bytes": bytes_for(found["kept_reached_volume"], found["grids"]),
        "looks": looks,
        **found,
    }


def _step(
    model: Any, lifecycle: Lifecycle, manager: Any, optimizers: list[Any], step: int, clock: Clock
) -> None:
    clock.start()
    lifecycle.before_step(step)
    bundle, batch = manager.next_train(step)
    losses = model.get_loss_dict(model(bundle), batch)
    for optimizer in optimizers:
        optimizer.zero_grad(set_to_none=True)
    torch.stack(list(losses.values())).sum().backward()
    for optimizer in optimizers:
        optimizer.step()
    clock.stop()


def exponents(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Growth of each figure with the built area."""
    areas = [row["area_square_metres"] for row in rows]
    names = ("gate_bytes", "grid_bytes", "seconds")
    return {name: slope(areas, [row[name] for row in rows]) for name in names}


def settings_of(options: Options) -> dict[str, Any]:
    """What a stored row depends on, besides its number of blocks, as JSON values."""
    left_out = ("blocks", "out", "cities")
    values = {name: value for name, value in vars(options).items() if name not in left_out}
    values["capture"] = vars(options.capture)
    settings: dict[str, Any] = json.loads(json.dumps(values))
    return settings


def stored_rows(out: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that an earlier run of the same settings has left."""
    if not out.is_file():
        return []
    stored = json.loads(out.read_text())
    rows: list[dict[str, Any]] = stored["rows"] if stored["settings"] == settings else []
    return rows


def main(options: Options) -> None:
    options = dry(options) if options.dry_run else options
    settings = settings_of(options)
    rows = stored_rows(options.out, settings)
    for blocks in options.blocks:
        if any(row["blocks"] == blocks for row in rows):
            print(f"{blocks} blocks: stored already")
            continue
        rows = sorted([*rows, learn(blocks, options)], key=lambda row: row["blocks"])
        report = {
            "format": 1,
            "machine": describe_machine(),
            "lost_surface_mass": LOST_SURFACE_MASS,
            "settings": settings,
            "exponents_with_area": exponents(rows),
            "rows": rows,
        }
        write_json(options.out, report)
        draw(options.out.with_suffix(".png"), report)
        print(f"{blocks} blocks: {exponents(rows)}")


if __name__ == "__main__":
    main(tyro.cli(Options))
