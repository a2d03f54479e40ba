"""The rivals' rates and sizes, swept: `python benchmarks/rivals.py SCENE --out FOLDER`.

Each host as it samples itself, and with long steps, trains for the same time with other learning
rates, batches, tables, grids and samples; ours get no sweep. On a scene that no chart of hosts
shows. What is finished is kept whenever this is stopped. Stored in `results/rivals.json`; the
table is in `docs/gifts.md`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Any

import checkout  # noqa: F401
import tyro
from page_parts import RESULTS, machine_line, span, table

from leco_plugin.chart.chart import Chart
from leco_plugin.chart.command import processes
from leco_plugin.chart.contender import LONG_STEPS, Contender, Protocol
from leco_plugin.chart.methods import contenders
from leco_plugin.chart.summary import compare
from leco_plugin.hosts.guided_start import OWN_SAMPLER
from leco_plugin.log import bar, put, resumable
from leco_plugin.scenes.whole_files import write_json

STORED = RESULTS / "rivals.json"
SAMPLES, RAYS = "pipeline.target_num_samples", "pipeline.datamanager.train_num_rays_per_batch"
TABLE, GRID = "host.log2_hashmap_size", "host.grid_resolution"
PROPOSED, SHADED = "host.num_proposal_samples_per_ray", "host.num_nerf_samples_per_ray"


def _rates(rate: float, *groups: str) -> dict[str, Any]:
    """Settings of a learning rate, which falls as that of each host does."""
    return {f"optimizers.{group}.optimizer.lr": rate for group in groups}


SWEPT: tuple[tuple[str, str, tuple[tuple[str, dict[str, Any]], ...]], ...] = (
    (
        "leco-ngp",
        OWN_SAMPLER,
        (
            ("rate 0.03", _rates(0.03, "fields")),
            ("rate 0.003", _rates(0.003, "fields")),
            ("32768 samples a step", {SAMPLES: 1 << 15}),
            ("8192 samples a step", {SAMPLES: 1 << 13}),
            ("table 2^18", {TABLE: 18}),
            ("grid 32³", {GRID: 32}),
            ("grid 128³", {GRID: 128}),
        ),
    ),
    (
        "leco-ngp",
        LONG_STEPS,
        (("rate 0.03", _rates(0.03, "fields")), ("rate 0.003", _rates(0.003, "fields"))),
    ),
    (
        "leco-nerfacto",
        OWN_SAMPLER,
        (
            ("rates 0.03", _rates(0.03, "fields", "proposal_networks")),
            ("rates 0.003", _rates(0.003, "fields", "proposal_networks")),
            ("1024 rays a step", {RAYS: 1024}),
            ("256 rays a step", {RAYS: 256}),
            ("table 2^18", {TABLE: 18}),
            ("64 + 32 proposal samples", {PROPOSED: (64, 32)}),
            ("256 + 96 and 48 samples, nerfstudio's", {PROPOSED: (256, 96), SHADED: 48}),
        ),
    ),
    (
        "leco-switch-nerf",
        OWN_SAMPLER,
        (("rate 0.015", _rates(0.015, "fields")), ("rate 0.0017", _rates(0.0017, "fields"))),
    ),
)
"""Method, sampler, and what is changed: what it is called, and the settings by their paths."""


def swept() -> Iterator[tuple[Contender, list[Contender]]]:
    """Each rival as charts have it, and with one thing changed."""
    for method, sampler, variants in SWEPT:
        (given,) = contenders([method], [sampler])
        yield given, [_changed(given, name, settings) for name, settings in variants]


def _changed(given: Contender, name: str, settings: dict[str, Any]) -> Contender:
    of_model = {path: value for path, value in settings.items() if path.startswith("host.")}
    others = {path: value for path, value in settings.items() if path not in of_model}
    changes = {**given.changes, **of_model}
    return replace(given, name=f"{given.name}, {name}", changes=changes, settings=others)


@dataclass
class Options:
    """Settings of the sweep."""

    data: tyro.conf.Positional[Path]
    """A scene in nerfstudio's format."""
    out: Path
    """Folder of the runs."""
    seconds: float = 120.0
    """Of training, each run."""
    seeds: tuple[int, ...] = (0,)
    """Of each row."""


def main(options: Options) -> None:
    """Makes what is missing of the sweep, and stores it."""
    rows = [one for given, others in swept() for one in (given, *others)]
    protocol, titled = Protocol(options.seconds, images=1, at_once=2), (None, None)
    command = f"python benchmarks/rivals.py {options.data.resolve().name} --out FOLDER"
    chart = Chart(options.data, options.out, rows, options.seeds, protocol, titled, command)
    with resumable(), bar("sweep of rivals") as show:
        chart.make(processes(chart), put, show)
    write_json(STORED, chart.write())


def sweep_lines(results: dict[str, Any]) -> list[str]:
    """What is said of the stored sweep, its table, which runs failed, and what made it. Rows
    without a result are left out of the table."""
    psnrs: dict[str, list[float]] = {}
    for run in results["runs"]:
        psnrs.setdefault(run["name"], []).append(run["psnr"])
    rows = []
    for given, others in swept():
        base = psnrs.get(given.name)
        if base is None:
            continue
        rows.append([f"**{given.name}**", f"{fmean(base):.1f} dB", "as in all charts"])
        for one in others:
            if found := psnrs.get(one.name):
                name = one.name.removeprefix(f"{given.name}, ")
                rows.append([name, f"{fmean(found):.1f} dB", compare(found, base).said()])
    made, steps = results["made"], span((run["steps"] for run in results["runs"]), ",d")
    said = (
        f"On {results['scene']['name']}, {results['protocol']['seconds']:g} s a run, which are "
        f"{steps} steps on this core. With more steps another rate may be the best."
    )
    about = f"`{made['command']}`, {made['date']}, leco_plugin {made['version']}; "
    head = "row | mean PSNR | beside the row of charts"
    failed = [f"{one['name']}, seed {one['seed']}" for one in results["failures"]]
    failures = [f"Failed: {'; '.join(failed)}.", ""] if failed else []
    return [said, "", *table(head, rows), "", *failures, f"{about}{machine_line(results)}."]


if __name__ == "__main__":
    main(tyro.cli(Options))
