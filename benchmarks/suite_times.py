"""How long the suites took whose charts are stored, scene by scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import checkout  # noqa: F401

from leco_plugin.chart.contenders.suites import SUITES

HEAD = """### How long the suites take

Minutes of all runs of a suite on two cores, each from the start of its process to its end, two at a
time; together, runs that several suites share are counted once. Each was to take less than 45 and
all of them together 240.
"""


def minutes_section(charts: Sequence[dict[str, Any]]) -> list[str]:
    """What each suite took on each scene, and all of a scene without runs that it shares.

    Args:
        charts: their results, one for each scene and suite.
    """
    times: dict[str, dict[str, str]] = {}
    together: dict[str, float] = {}
    for results in charts:
        scene = results["scene"]["name"]
        its = times.setdefault(scene, {})
        spent = [run.get("wall_seconds") for run in results["runs"]]
        if None in spent:
            its[results["suite"]], together[scene] = "-", math.inf
            continue
        at_once = 60.0 * results["protocol"].get("at_once", 1)
        its[results["suite"]] = f"{sum(spent) / at_once:.0f}"
        own = [run["wall_seconds"] for run in results["runs"] if not run.get("reused")]
        together[scene] = together.get(scene, 0.0) + sum(own) / at_once
    lines = [
        HEAD,
        f"| scene | {' | '.join(SUITES)} | together |",
        "|---" * (len(SUITES) + 2) + "|",
    ]
    for scene, its in times.items():
        total = "-" if math.isinf(together[scene]) else f"{together[scene]:.0f}"
        cells = [its.get(suite, "-") for suite in SUITES]
        lines.append(f"| {scene} | {' | '.join(cells)} | {total} |")
    return ["\n".join(lines) + "\n"]
