"""The results of a table as JSON values, `stability.json`, and the runs that are in them."""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from leco_plugin.occupancy import CALIBRATED_AT
from leco_plugin.stability.plan import Entry
from leco_plugin.stability.verdict import judge

if TYPE_CHECKING:
    from leco_plugin.stability.suite import Suite

Runs = Mapping[tuple[str, str], dict[str, Any]]
"""Records of finished runs by scene and name."""

OF_OCCUPANCY = (
    "threshold",
    "lost_surface_mass",
    "image_price_db",
    "empty_fraction",
    "recoveries",
    CALIBRATED_AT,
)
"""What is kept of a learned occupancy."""


def results_of(suite: Suite) -> dict[str, Any]:
    """Every cell with its verdict, its figures, and those of each of its runs."""
    stored, failures = suite.stored(), suite.failures()
    rows = []
    for case in suite.cases:
        cells = {
            entry.sampler.name: _cell(suite, entry, stored, failures)
            for entry in suite.entries
            if entry.case is case
        }
        facts = {"name": case.name, "title": case.title, "why": case.why}
        scene = {"name": case.scene, "digest": suite.digests[case.scene]}
        rows.append({**facts, "must_fail": case.must_fail, "scene": scene, "cells": cells})
    return {
        "format": 1,
        "machine": suite.machine,
        "sizes": asdict(suite.sizes),
        "made": {
            "date": datetime.date.today().isoformat(),
            "command": suite.command,
            **suite.made,
        },
        "samplers": [
            {"name": one.name, "title": one.title, "reference": one.reference}
            for one in suite.samplers
        ],
        "cases": rows,
    }


def _cell(
    suite: Suite, entry: Entry, stored: Runs, failures: Mapping[tuple[str, str], str]
) -> dict[str, Any]:
    runs = [stored[run.key] for run in entry.runs if run.key in stored]
    failed = [failures[run.key] for run in entry.runs if run.key in failures.keys() - stored.keys()]
    reference = None
    if entry.sampler.reference is not None:
        others = suite.reference_of(entry).runs
        reference = [stored[run.key] for run in others if run.key in stored]
    cell = judge(runs, reference, failed, len(entry.runs) - len(runs) - len(failed))
    names = {run.job.seed: run.job.name for run in entry.runs}
    return {**cell.to_dict(), "runs": [_figures(run, names[run["seed"]]) for run in runs]}


def _figures(run: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Of a run, what a verdict needs, and what says where it comes from."""
    kept = {key: run[key] for key in ("seed", "psnr", "processor_seconds", "measured", "made")}
    facts = run.get("occupancy")
    if facts:
        kept["occupancy"] = {key: facts.get(key) for key in OF_OCCUPANCY}
    return {"name": name, "sampler": run["sampler"], **kept}


def runs_in(results: Mapping[str, Any], suite: Suite) -> dict[tuple[str, str], dict[str, Any]]:
    """Runs of a table, made elsewhere or earlier, that a suite would make just so: in its sizes, of
    its scenes, with its version.

    Args:
        results: as of `results_of`.
    """
    if results["sizes"] != asdict(suite.sizes):
        return {}
    found = {}
    for row in results["cases"]:
        name = row["scene"]["name"]
        if suite.digests.get(name) != row["scene"]["digest"]:
            continue
        for cell in row["cells"].values():
            for run in cell["runs"]:
                if run["made"]["version"] == suite.made["version"]:
                    found[name, run["name"]] = run
    return found
