"""What `docs/results.md` shows of stored charts: pictures, tables, the paper's figures beside."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import checkout  # noqa: F401
from page_parts import RESULTS, machine_line, picture
from paper_rows import PAPER_ROWS

from leco_plugin.chart.contenders.suites import SUITES
from leco_plugin.chart.drawing.table import table
from leco_plugin.chart.findings.representations import COSTS, fronts_of, representations_of, verdict
from leco_plugin.chart.findings.summary import lines_of

CHARTS = RESULTS / "charts"


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
