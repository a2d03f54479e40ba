"""`docs/gifts.md`: what each contender of a chart is given, read from the configs of its runs."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
from nerfacc import OccGridEstimator
from page_parts import ROOT, table
from rivals import STORED, sweep_lines

from leco_plugin.chart.contender import (
    DENSE,
    GRID,
    LEARNED,
    LONG_STEPS,
    WITHOUT_GIFTS,
    Contender,
    config_of,
    short_names,
)
from leco_plugin.chart.methods import contenders
from leco_plugin.evaluation.queries import WARM_UP
from leco_plugin.hosts.guided import GuidedModelConfig
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.models.leco_config import LecoModelConfig
from leco_plugin.models.sizing.sizes import SMALL
from leco_plugin.models.switch.field import SwitchNerfModelConfig
from leco_plugin.samplers.registry import sampler_spec
from leco_plugin.scenes.pixels.known_distances import KnownDistancePixelSamplerConfig

PAGE = ROOT / "docs" / "gifts.md"
WORDS = {"yes": "given", "-": "not"}
HOSTS = ["leco-ngp", "leco-nerfacto", "leco-switch-nerf", "leco-mega-nerf"]
HEAD = f"""# Who gets what

All rows of a chart train for the same time on the same photographs. This page says what else each
row gets. Below each table stand the gifts that only some rows get. `leco chart --samplers
learned-occupancy-without-gifts` charts a learned row without them; a stored one is that of
[Instant-NGP](results.md#what-is-gained-in-the-same-time).

- **Distances**: while an occupancy is learned, rays end at the sparse points that they lead to.
- **Bounds**: the scene's walls are found from sparse points.
- **Opaque start**: the field begins with a density that makes what is kept of a ray opaque. A grid
  keeps the whole box at first, and is opaque by itself.
- **Careful start**: skipping begins at a lower threshold, and its price is watched.
- **Warm-up**: a grid asks all of its cells at first, for at most 1/{1 / WARM_UP:.0f} of a run.
- **Rates** and **batch**: learning rates of the host, and what it shades in a step on a CPU.
- **Table**: entries of a level of the field's hash table, on a CPU.
- **Codes**: small ones begin at zero. Those of nerfstudio cost test views
  [several dB](hosts.md#appearance-codes) of a drone survey.
- **Front to back**: images leave out what lies behind opaque surfaces. *guided*: where that is
  faster.
- **Clock**: all that the process of a run does counts, drawing rays too. Data managers of
  nerfstudio that draw them in other processes draw them in the run's own.
- **Loss of colours**: `leco-occupancy` in all its rows weighs errors in hue eight times, each host
  keeps its own loss in all of its rows.
- **Across methods** only time, photographs, threads and codes are equal. Fields, losses, batches
  and bounds are each method's own; LeCO also renders in C, and has the largest table. What a gate
  gains is seen between rows of one method.

Instant-NGP and Nerfacto begin with nerfstudio's rates, the others with rates of ours. How rates
fall stands below each chart, alike for all of its rows. Sizes are what a step on a CPU can pay.
Rates and sizes of rivals were [swept](#the-rivals-swept), those of learned rows were not.

This page is generated: `python benchmarks/reference_pages.py`.
"""


def compared() -> list[Contender]:
    """The rows of charts by method, in every way that a method can be sampled."""
    rows = contenders(["leco-occupancy", "leco-occupancy-never-frozen"])
    rows += contenders(["leco-occupancy-homogeneous"])
    samplers = [LEARNED, WITHOUT_GIFTS, OWN_SAMPLER, f"{GRID}-64", DENSE, LONG_STEPS]
    return rows + contenders(HOSTS, samplers)


def page(rows: Sequence[Contender] | None = None) -> str:
    """The whole of `docs/gifts.md`, of these contenders or of all."""
    parts, groups = [HEAD], dict[str, list[Contender]]()
    for one in compared() if rows is None else rows:
        groups.setdefault(one.method, []).append(one)
    for method, group in groups.items():
        names = short_names([one.name for one in group])
        given = {name: gifts_of(one) for name, one in zip(names, group)}
        cells = [[name, *gifts.values()] for name, gifts in given.items()]
        head = " | ".join(["row", *next(iter(given.values()))])
        learned = [name for name, one in zip(names, group) if one.sampler.startswith(LEARNED)]
        parts += [f"## `{method}`\n", *table(head, cells), "", *missing(given, learned)]
    if rows is None:
        parts += ["## The rivals, swept\n", *sweep_lines(json.loads(STORED.read_text()))]
    return "\n".join(parts).rstrip() + "\n"


def missing(given: dict[str, dict[str, str]], learned: Sequence[str]) -> list[str]:
    """A line for each gift that not all rows have alike.

    Args:
        given: gifts of each row.
        learned: the rows with a learned occupancy.
    """
    lines = []
    for gift in next(iter(given.values())):
        by_cell: dict[str, list[str]] = {}
        for name, gifts in given.items():
            by_cell.setdefault(gifts[gift], []).append(name)
        if gift == "warm-up" or len(by_cell) < 2:
            continue  # a warm-up is no gift to a row without a grid
        most = max(by_cell, key=lambda cell: len(by_cell[cell]))
        parts = [
            f"{WORDS.get(cell, cell)} for {' and '.join(names)}"
            for cell, names in by_cell.items()
            if cell != most
        ]
        others = f"{WORDS.get(most, most)} for the others"
        without = [name for name in learned if given[name][gift] != given[learned[0]][gift]]
        beside = (
            "a learned row without it can be charted" if without else "all learned rows have it"
        )
        lines.append(f"- **{gift.capitalize()}**: {'; '.join([*parts, others])}; {beside}.")
    return [*(lines or ["- All rows have the same."]), ""]


def gifts_of(contender: Contender) -> dict[str, str]:
    """What a contender is given, by the config of its run; a dash is nothing."""
    config = config_of(contender, Path("scene"), Path("runs"))
    pipeline: Any = config.pipeline
    model, manager = pipeline.model, pipeline.datamanager
    guided = isinstance(model, GuidedModelConfig)
    host = model.host if guided else model
    learner = model
    if guided:
        own = model.occupancy.sampler == OWN_SAMPLER
        learns = not own and sampler_spec(model.occupancy.sampler).needs_occupancy
        learner = model.occupancy.learning if learns else None
    packed = guided and not hasattr(host, "num_proposal_samples_per_ray")
    measured = isinstance(manager.pixel_sampler, KnownDistancePixelSamplerConfig)
    rates = (f"{name} {group['optimizer'].lr:g}" for name, group in config.optimizers.items())
    gifts: dict[str, bool] = {
        "distances": learner is not None and measured and learner.termination > 0.0,
        "bounds": learner is not None or hasattr(host, "bounds"),
        "opaque start": packed and learner is not None and model.occupancy.opaque_start,
        "careful start": packed and learner is not None and learner.calibration.recheck_rays > 0,
    }
    return {name: "yes" if given else "-" for name, given in gifts.items()} | {
        "warm-up": _warm_up(model, host) if guided else "-",
        "rates": ", ".join(rates),
        "batch": _batch(pipeline),
        "table": _table(host),
        "codes": model.codes if guided else "small",
        "front to back": {True: "yes", None: "guided"}.get(getattr(model, "front_to_back", 0), "-"),
    }


def _batch(pipeline: Any) -> str:
    """Samples or rays of a training step."""
    samples, model = getattr(pipeline, "target_num_samples", None), pipeline.model
    rays = f"{pipeline.datamanager.train_num_rays_per_batch} rays"
    if isinstance(model, LecoModelConfig) and model.schedule.freeze and not model.homogeneous:
        rays += f", up to {SMALL.guided_batch:g} times as many where samples are skipped"
    return rays if samples is None else f"{samples} samples"


def _table(host: Any) -> str:
    """Entries of a level of its field's hash table."""
    if isinstance(host, LecoModelConfig):
        return f"by the scene, up to 2^{SMALL.field.encoding.log2_table}"
    entries = getattr(host, "log2_hashmap_size", None)  # none where a field has no table
    return "-" if entries is None else f"2^{entries}"


def _warm_up(model: GuidedModelConfig, host: Any) -> str:
    """Steps of a grid's warm-up in a long run."""
    sampler = model.occupancy.sampler
    if isinstance(host, SwitchNerfModelConfig):
        gridded = sampler == OWN_SAMPLER and host.sampling == "occupancy-grid"
        return f"{host.sizes.grid_warmup_steps} steps" if gridded else "-"
    gridded = sampler == GRID or (sampler == OWN_SAMPLER and hasattr(host, "grid_resolution"))
    update: Callable[..., Any] = OccGridEstimator.update_every_n_steps
    steps = inspect.signature(update).parameters["warmup_steps"].default
    return f"{steps} steps" if gridded else "-"
