"""What the pages show of stored charts: pictures, tables, the paper's figures beside."""

from __future__ import annotations

import json
from typing import Any

import checkout  # noqa: F401
from page_parts import RESULTS, machine_line, noted, picture
from paper_rows import PAPER_ROWS

from leco_plugin.chart.methods import SUITES
from leco_plugin.chart.table import table

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
        seconds = others[name]["protocol"]["seconds"]
        time = f", {seconds:g} s" if _is_longer(others[name]) else ""
        found[name] = f"Suite `{suite}` on {scene}{time}" if suite else scene
    return found


def by_scene(suite: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """Name and results of the stored charts of a suite, by scene."""
    charts = [(name, stored(name)) for name in titles()]
    return {
        results["scene"]["name"]: (name, results)
        for name, results in charts
        if results["suite"] == suite and not _is_longer(results)
    }


def longer(suite: str) -> list[tuple[str, dict[str, Any]]]:
    """Title and results of the stored charts whose runs had more time than their suite gives."""
    charts = [(title, stored(name)) for name, title in titles().items()]
    return [each for each in charts if each[1]["suite"] == suite and _is_longer(each[1])]


def _is_longer(results: dict[str, Any]) -> bool:
    given = SUITES[results["suite"]].seconds if results["suite"] in SUITES else None
    return given is not None and (results["protocol"]["seconds"] or 0.0) > given


def _place(results: dict[str, Any], order: list[str]) -> int:
    return order.index(results["suite"]) if results["suite"] in order else len(order)


def stored(name: str) -> dict[str, Any]:
    """The results of a stored chart."""
    found: dict[str, Any] = json.loads((CHARTS / f"{name}.json").read_text())
    return found


def notes() -> dict[str, str]:
    """What is said of charts that were made by code which has been mended since."""
    return noted(RESULTS)


def star(*names: str) -> str:
    """The mark behind what is said of stored results if there is a note on any of them."""
    return " (*)" if notes().keys() & set(names) else ""


def chart_sections() -> list[str]:
    """Charts of `docs/measurements.md`: those that belong to no suite."""
    return _sections(of_suites=False)


def suite_sections() -> list[str]:
    """Charts of `docs/suites.md`."""
    return _sections(of_suites=True)


def _sections(of_suites: bool) -> list[str]:
    """Each chart with its picture, its tables, its command, its machine and its note."""
    parts: list[str] = []
    said: set[str] = set()
    noted = notes()
    for name, title in titles().items():
        results = stored(name)
        if (results["suite"] is not None) != of_suites:
            continue
        _, body = table(results).split("\n", 1)
        note = [f"\n**{noted[name]}**"] if name in noted else []
        parts += [f"## {title}\n", picture(name), *note, body, f"{machine_line(results)}.\n"]
        paper = PAPER_ROWS.get(results["suite"] or name)
        if paper is not None and paper not in said:
            said.add(paper)
            parts.append(paper)
    return parts
