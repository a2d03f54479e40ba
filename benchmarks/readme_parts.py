"""What the README shows of stored results: the demo, and ours beside its rivals on each scene."""

from __future__ import annotations

import json
from typing import Any

import checkout  # noqa: F401
from chart_sections import stored, titles
from page_parts import RESULTS, between

from leco_plugin.chart.findings.representations import Representation, representations_of
from leco_plugin.chart.findings.summary import Line, lines_of

DEMO = "<!-- demo table: generated -->", "<!-- end of the demo table -->"
RIVALS = "<!-- rivals: generated -->", "<!-- end of the rivals -->"


def readme(text: str) -> str:
    """The README with its tables renewed."""
    text = between(text, DEMO, demo_table(json.loads((RESULTS / "demo.json").read_text())))
    return between(text, RIVALS, rivals_table())


def demo_table(report: dict[str, Any]) -> str:
    """The two runs of a demo, side by side."""
    lines = [
        "| run | PSNR | SSIM | steps | samples a ray | seconds to render an image |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {run['method']} | {run['psnr']:.2f} dB | {run['ssim']:.3f} | {run['steps']} "
        f"| {run['samples_per_ray']:.1f} | {run['render_seconds_per_image']:.2f} |"
        for run in report["runs"]
    ]
    facts = report["occupancy"]
    lines += [
        "",
        f"Occupancy: {facts['bytes'] / 1000:.0f} kB, learned and frozen in "
        f"{report['runs'][0]['freeze_seconds']:.0f} of "
        f"{report['runs'][0]['train_seconds']:.0f} s; {facts['empty_fraction']:.1%} of all "
        f"candidates skipped for {facts['image_price_db']:+.3f} dB and "
        f"{facts['lost_surface_mass']:.1e} of the surface mass on held-out rays. Against the exact "
        f"city: {facts['kept_surface_recall']:.1%} of the visible surface kept, "
        f"{facts['free_space_skipped']:.1%} of free space skipped.",
    ]
    return "\n".join(lines)


def rivals_table() -> str:
    """A row for each scene of which both suites are stored: what must be sampled, and accuracy
    after equal time."""
    suites: dict[str, dict[str, Any]] = {"representations": {}, "enough-time": {}}
    for name in titles():
        results = stored(name)
        if results["suite"] in suites:
            suites[results["suite"]][results["scene"]["name"]] = results
    space, times = suites.values()
    names: list[str] = []
    rows = []
    for scene in sorted(space.keys() & times.keys()):
        runs = lines_of(times[scene])
        names = names or [line.name.split(" + ")[-1] for line in runs]
        cells = _kept(representations_of(lines_of(space[scene]))) + _reached(runs)
        rows.append(f"| {scene} | {' | '.join(cells)} |")
    if not rows:
        return "Not measured yet."
    seconds = next(iter(times.values()))["protocol"]["seconds"]
    head = [
        "scene",
        "space that must be sampled: ours",
        "best occupancy grid",
        *(
            f"Switch-NeRF after {seconds:g} s: {name}" if i == 0 else name
            for i, name in enumerate(names)
        ),
    ]
    return "\n".join([f"| {' | '.join(head)} |", f"|{'---|' * len(head)}", *rows])


def _kept(held: list[Representation]) -> list[str]:
    """The one of ours, and the grid, that keep least."""
    cells = []
    for group in (
        [one for one in held if one.ours],
        [one for one in held if one.name.startswith("grid ")],
    ):
        best = min(group, key=lambda one: one.kept)
        resolution = f" ({best.name.removeprefix('grid ')})" if not best.ours else ""
        cells.append(f"{best.kept:.1f}% in {_size(best.median('size'))}{resolution}")
    return cells


def _size(kilobytes: float) -> str:
    return f"{kilobytes / 1e3:.1f} MB" if kilobytes >= 1e3 else f"{kilobytes:.0f} kB"


def _reached(lines: list[Line]) -> list[str]:
    return [f"{line.psnr:.1f} dB" for line in lines]
