"""How the cost of occupancy grows with a scene: `python benchmarks/growth.py`.

Cities of 2, 4, 8 and 16 blocks a side. A gate learns until, at 1e-3 of the weight near surfaces
lost, it keeps no more than a given share of the candidates; looks are off the clock. It is given
the shortest of several schedules in which it gets there, starting with that of the next smaller
city; the seconds are those of that schedule alone. Beside it stands the occupancy grid, filled from
the same field, that loses as much and keeps the same volume. Every city's row is stored when it is
done, and a benchmark that was stopped is taken up there. `--dry-run` passes through everything in
seconds and means nothing. `python benchmarks/results_page.py` draws what is stored.
"""

from __future__ import annotations

import copy
import itertools
import json
import math
import random
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import torch
import tyro
from growth_figures import bytes_for, exponents, grid_for

from leco_plugin.evaluation.clock import Clock, warm_up
from leco_plugin.evaluation.equal_loss import LOST_SURFACE_MASS, at_equal_loss
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.evaluation.report import describe_code, describe_machine, made_by, write_json
from leco_plugin.learning.calibration import CalibrationConfig
from leco_plugin.learning.dense import dense_rendering
from leco_plugin.learning.learner import Learner
from leco_plugin.learning.run import LearningOnly
from leco_plugin.learning.schedule import RATES, ScheduleConfig
from leco_plugin.method_configs import leco_occupancy
from leco_plugin.models.gate import GateConfig
from leco_plugin.models.leco_config import FusedAdamConfig
from leco_plugin.models.sizing.sizes import sizes_for
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import City, CityConfig
from leco_plugin.scenes.city.folder import write_city
from leco_plugin.scenes.learning_data import held_out_rays

RESULTS = Path(__file__).parent / "results"


@dataclass
class Options:
    """Settings of the benchmark."""

    blocks: tuple[int, ...] = (2, 4, 8, 16)
    """Blocks a side of the cities, from small to large."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Of cities and gates."""
    schedules: tuple[int, ...] = (100, 200, 400, 800, 1600)
    """Learning steps that are tried, from few to many."""
    looks: int = 4
    """Looks at a gate in the second half of its learning steps."""
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
        seeds=(0,),
        schedules=(4, 8),
        looks=2,
        grids=(4, 8),
        rays=128,
        capture=CaptureConfig(24, 18, aerial_per_block=6.0, street_per_block=0.0),
    )


def gate_of(gate: GateConfig, blocks: int, per_doubling: int) -> GateConfig:
    """A gate that resolves the same metres: more octaves from four blocks a side on."""
    more = round(per_doubling * math.log2(max(blocks, 4) / 4))
    return replace(gate, encoding=replace(gate.encoding, octaves=gate.encoding.octaves + more))


def learn(blocks: int, seed: int, options: Options, first: int = 0) -> dict[str, Any]:
    """One city: the row of figures that is stored.

    Args:
        first: number of the schedule that is tried first.
    """
    city = CityConfig(blocks, seed)
    folder = write_city(city, options.cities / f"{blocks}-blocks-{seed}", options.capture)
    for steps in options.schedules[first:]:
        attempt = learn_gate(steps, folder, blocks, seed, options)
        if attempt.learned:
            break
        print(f"{blocks} blocks: not in {steps} steps")
    model, manager = attempt.model, attempt.manager
    mixture = model.mixture
    cells = [whole_box(mixture.occupancy()).cells(longest) for longest in options.grids]
    found = at_equal_loss(mixture, manager, cells, until_as_little=True)
    seen = City(city)
    area = float(seen.built.sum()) * city.block_size**2
    enough = grid_for(found["kept_reached_volume"], found["grids"])
    return {
        "blocks": blocks,
        "seed": seed,
        "built_blocks": int(seen.built.sum()),
        "area_square_metres": area,
        "volume_cubic_metres": round(area * seen.roof),
        "photographs": len(manager.train_dataset),
        "octaves": mixture.gate.config.encoding.octaves,
        "learned": attempt.learned,
        "schedule": steps,
        "steps": attempt.step,
        "seconds": round(attempt.seconds, 2) if attempt.learned else None,
        "psnr_held_out": round(held_out_psnr(model, manager), 2),
        "gate_bytes": bytes_of(mixture.gate),
        "field_bytes": bytes_of(mixture.field),
        "grid_bytes": bytes_for(found["kept_reached_volume"], found["grids"]),
        "grid_seconds": enough["update_seconds"] if enough is not None else None,
        "looks": attempt.looks,
        **found,
    }


@dataclass
class Attempt:
    """A gate, and what it took."""

    model: Any
    manager: Any
    learned: bool = False
    step: int = 0
    seconds: float = 0.0
    looks: list[list[float]] = field(default_factory=list)
    """Step, seconds and kept share of the candidates, of each look."""


def learn_gate(steps: int, folder: Path, blocks: int, seed: int, options: Options) -> Attempt:
    """A gate that learns by a schedule of so many steps, until it keeps little enough."""
    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = folder
    config.model.schedule = ScheduleConfig(freeze=False, learn_steps=steps)
    config.model.calibration = CalibrationConfig(rays=options.rays)
    device = leco_occupancy.config.machine.device_type
    sizes = sizes_for(device)
    gate = gate_of(sizes.gate, blocks, options.octaves_per_doubling)
    config.model.sizes = replace(sizes, gate=gate)
    random.seed(seed)  # nerfstudio caches images in an order of its own
    torch.manual_seed(seed)
    pipeline: Any = config.setup(device=device)
    attempt = Attempt(pipeline.model, pipeline.datamanager)
    attempt.model.train()
    warm_up(attempt.model.device)
    clock = Clock()
    clock.start()
    groups = attempt.model.get_param_groups()
    optimizers = [FusedAdamConfig(lr=RATES[name]).setup(group) for name, group in groups.items()]
    learner = attempt.model.learner(attempt.manager, LearningOnly(optimizers))
    learner.begin()
    clock.stop()
    looks = look_steps(steps, options.looks)
    while not attempt.learned and attempt.step < steps:
        _step(attempt.model, learner, attempt.step, clock)
        attempt.step, attempt.seconds = attempt.step + 1, clock.seconds
        if attempt.step in looks:
            kept = at_equal_loss(attempt.model.mixture, attempt.manager)["kept_candidates"]
            attempt.looks.append([attempt.step, round(clock.seconds, 2), kept])
            attempt.learned = kept <= options.kept
    return attempt


def look_steps(steps: int, looks: int) -> set[int]:
    """After which steps a gate is looked at: evenly in the second half, the last at the end."""
    return {steps - number * (steps // 2) // looks for number in range(looks)}


@torch.no_grad()
def held_out_psnr(model: Any, manager: Any) -> float:
    """Of held-out training pixels, rendered without skipping: what the field is worth by then."""
    model.eval()
    config, mixture = model.config.calibration, model.mixture
    rays, truth = held_out_rays(mixture, manager, config.rays)
    rendering = dense_rendering(mixture, rays, truth, config.rays_at_once)
    squares = [
        (reference.rgb - truth).square()
        for reference, truth in zip(rendering.references, rendering.truths)
    ]
    model.train()
    return -10.0 * math.log10(float(torch.cat(squares).mean()))


def bytes_of(module: torch.nn.Module) -> int:
    """Of all that a checkpoint would hold of it."""
    return sum(value.numel() * value.element_size() for value in module.state_dict().values())


def _step(model: Any, learner: Learner, step: int, clock: Clock) -> None:
    clock.start()
    model.plan = learner.before_step(step)
    bundle, batch = learner.data.manager.next_train(step)
    losses = model.get_loss_dict(model(bundle), batch)
    for optimizer in learner.run.optimizers():
        optimizer.zero_grad(set_to_none=True)
    torch.stack(list(losses.values())).sum().backward()
    for optimizer in learner.run.optimizers():
        optimizer.step()
    clock.stop()


def first_schedule(rows: Sequence[dict[str, Any]], blocks: int, seed: int, options: Options) -> int:
    """Number of the schedule by which the next smaller city has learned, or was given up."""
    smaller = [row for row in rows if row["blocks"] < blocks and row["seed"] == seed]
    return options.schedules.index(smaller[-1]["schedule"]) if smaller else 0


def settings_of(options: Options) -> dict[str, Any]:
    """What a stored row depends on besides its number of blocks, the sizes of gate and field among
    them, as JSON values."""
    left_out = ("blocks", "seeds", "out", "cities")
    values = {name: value for name, value in vars(options).items() if name not in left_out}
    values["capture"] = vars(options.capture)
    values["sizes"] = asdict(sizes_for(leco_occupancy.config.machine.device_type))
    settings: dict[str, Any] = json.loads(json.dumps(values))
    return settings


def stored_rows(out: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that an earlier run of the same settings has left.

    Raises:
        SystemExit: they are of other settings, or of a field of other sizes.
    """
    if not out.is_file():
        return []
    stored = json.loads(out.read_text())
    if stored["settings"] != settings:
        raise SystemExit(f"{out} holds rows of other settings or sizes; name another --out")
    rows: list[dict[str, Any]] = stored["rows"]
    return rows


def main(options: Options) -> None:
    options = dry(options) if options.dry_run else options
    settings, code = settings_of(options), describe_code()
    rows = stored_rows(options.out, settings)
    for seed, blocks in itertools.product(options.seeds, options.blocks):
        if any((row["blocks"], row["seed"]) == (blocks, seed) for row in rows):
            print(f"{blocks} blocks, seed {seed}: stored already")
            continue
        row = learn(blocks, seed, options, first_schedule(rows, blocks, seed, options))
        row |= made_by(code)
        rows = sorted([*rows, row], key=lambda row: (row["blocks"], row["seed"]))
        report = {
            "format": 1,
            "machine": describe_machine(),
            "lost_surface_mass": LOST_SURFACE_MASS,
            "settings": settings,
            "exponents_with_area": exponents(rows, "area_square_metres"),
            "exponents_with_volume": exponents(rows, "volume_cubic_metres"),
            "rows": rows,
        }
        write_json(options.out, report)
        print(f"{blocks} blocks, seed {seed}: {report['exponents_with_area']}")


if __name__ == "__main__":
    main(tyro.cli(Options))
