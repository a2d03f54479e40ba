"""What `docs/results.md` shows of stored charts: pictures, tables, the paper's figures beside."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import checkout  # noqa: F401
from page_parts import RESULTS, machine_line, picture

from leco_plugin.chart.representations import COSTS, fronts_of, representations_of, verdict
from leco_plugin.chart.suites import SUITES
from leco_plugin.chart.summary import lines_of
from leco_plugin.chart.table import table

CHARTS = RESULTS / "charts"

ENOUGH_TIME = """The paper's three columns, on its own scenes and by its own protocol (500k
steps; the rebuttal's table of enough training time, 41.5 and 43.4 h). Figures of the two protocols
cannot be compared; who is ahead can.

| paper | Switch-NeRF | + occupancy grid | + learned occupancy |
|---|---|---|---|
| Rubble: PSNR, SSIM, LPIPS | 24.31, 0.562, 0.496 | 23.94, 0.538, 0.526 | 24.52, 0.581, 0.477 |
| Residence: PSNR, SSIM, LPIPS | 22.57, 0.654, 0.457 | 22.48, 0.645, 0.474 | 22.88, 0.658, 0.454 |
| speed-up of guided training | | | 2.5 x |
"""
GRID_RESOLUTION = """The paper's rows, Switch-NeRF guided for 500k steps by its own protocol; who
is ahead can be compared, figures cannot.

| paper | PSNR, SSIM, LPIPS | time, h | memory, GB |
|---|---|---|---|
| grid 128³ | 25.48, 0.760, 0.413 | 14.1 | 5.8 |
| grid 256³ | 25.86, 0.764, 0.409 | 46.0 | 12.5 |
| learned | 26.04, 0.772, 0.398 | 14.1 | 2.7 |
"""
EMPTY_EXPERT = """The paper's rows: the gate learned with the imbalance loss alone for 40k steps,
then Switch-NeRF guided by it. Rows of ours that are named after that loss learn with it too, for
some hundred steps; where their gate was never frozen nothing was guided by it, and no row of ours
is the counterpart.

| paper | PSNR | SSIM | LPIPS |
|---|---|---|---|
| as large as a scene expert (7 layers) | 20.23 | 0.631 | 0.506 |
| 4 layers | 23.62 | 0.701 | 0.463 |
| identity | 26.30 | 0.781 | 0.383 |
"""
PAPER_ROWS = {
    "enough-time": ENOUGH_TIME,
    "city-4-switch": ENOUGH_TIME,
    "grid-resolution": GRID_RESOLUTION,
    "empty-expert": EMPTY_EXPERT,
}
"""What the paper says beside the first chart of ours with such a suite, or such a name."""


def titles() -> dict[str, str]:
    """The title of each stored chart by the name of its file: those of `charts.json` in its order,
    then every other file, suite by suite."""
    found: dict[str, str] = json.loads((RESULTS / "charts.json").read_text())
    others = {path.stem: stored(path.stem) for path in CHARTS.glob("*.json")}
    order = list(SUITES)
    for name in sorted(
        others.keys() - found.keys(),
        key=lambda name: (_place(others[name], order), name),
    ):
        scene, suite = others[name]["scene"]["name"], others[name]["suite"]
        found[name] = f"Suite `{suite}` on {scene}" if suite else scene
    return found


def _place(results: dict[str, Any], order: list[str]) -> int:
    return order.index(results["suite"]) if results["suite"] in order else len(order)


def stored(name: str) -> dict[str, Any]:
    """The results of a stored chart."""
    found: dict[str, Any] = json.loads((CHARTS / f"{name}.json").read_text())
    return found


def chart_sections() -> list[str]:
    """All stored charts, each with its picture, its tables, its command and its machine; and with
    what `notes.json` says of those that were made by code which has been mended since."""
    parts: list[str] = []
    said: set[str] = set()
    file = RESULTS / "notes.json"
    notes: dict[str, str] = json.loads(file.read_text()) if file.exists() else {}
    for name, title in titles().items():
        results = stored(name)
        _, body = table(results).split("\n", 1)
        note = [f"\n**{notes[name]}**"] if name in notes else []
        parts += [f"## {title}\n", picture(name), *note, body, f"{machine_line(results)}.\n"]
        paper = PAPER_ROWS.get(results["suite"] or name)
        if paper is not None and paper not in said:
            said.add(paper)
            parts.append(paper)
    return parts + fronts_section(stored(name) for name in titles())


def fronts_section(charts: Iterable[dict[str, Any]]) -> list[str]:
    """On which fronts our gate is, scene by scene, where representations were compared."""
    rows = []
    counts = dict.fromkeys(COSTS, 0)
    for results in charts:
        held = representations_of(lines_of(results))
        ours = next((one for one in held if one.ours), None)
        if ours is None or results["suite"] != "representations":
            continue
        found = fronts_of(ours, held)
        for name in found:
            counts[name] += 1
        marks = " | ".join("yes" if name in found else "**no**" for name in COSTS)
        rows.append(f"| {results['scene']['name']} | {ours.kept:.1f} | {marks} | {verdict(held)} |")
    if not rows:
        return []
    listed = " and ".join(f"of {name} on {count}" for name, count in counts.items())
    scenes = f"{len(rows)} scene{'s' if len(rows) > 1 else ''}"
    return [
        "## Whether our gate is on the front, scene by scene\n",
        "Volume kept of what rays reach where each representation loses 0.1% of the surface mass, "
        f"against its size and against the time to learn it: of {scenes}, ours is on the front "
        f"{listed}. Grids are made from the field that taught our gate: their time is that of the "
        "field and of filling them, so that they differ from ours in size.\n",
        f"| scene | volume kept by ours, % | {' | '.join(COSTS)} | |",
        f"|---|---|{'---|' * len(COSTS)}---|",
        *rows,
        "",
    ]
