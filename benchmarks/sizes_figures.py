"""What `sizes.py` makes of its runs: automatic sizes beside a sweep, and beside larger models."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import checkout  # noqa: F401

from leco_plugin.chart.summary import Verdict, compare

MAY_LOSE, MAY_HAVE, SMALL_AGAINST_LARGE = 0.1, 1.25, 0.25
"""dB below the best of the sweep and below a larger model, parameters of the best times this, and
parameters of the smallest city against those of the largest: the bars."""
AS_GOOD = 0.05
"""dB below the highest mean of a sweep that count as none."""
AUTOMATIC = "automatic"

Run = Mapping[str, Any]


def points_of(rows: Sequence[Run], scene: str) -> dict[str, dict[int, Run]]:
    """Runs of a scene's sweep by point and seed; only points with as many seeds as any has."""
    points: dict[str, dict[int, Run]] = {}
    for row in rows:
        if row["scene"] == scene and row["point"] is not None:
            points.setdefault(row["point"], {})[row["seed"]] = row
    most = max((len(runs) for runs in points.values()), default=0)
    return {name: runs for name, runs in points.items() if len(runs) == most}


def mean_psnr(runs: Mapping[int, Run]) -> float:
    """Over seeds, dB."""
    return statistics.fmean(run["psnr"] for run in runs.values())


def against(of: Mapping[int, Run], others: Mapping[int, Run]) -> Verdict:
    """Whether runs are ahead of others in PSNR."""
    return compare(*([run["psnr"] for run in runs.values()] for runs in (of, others)))


def best_of(points: Mapping[str, dict[int, Run]]) -> str:
    """The smallest point that is as good as the highest mean."""
    highest = max(map(mean_psnr, points.values()))
    as_good = [name for name in points if mean_psnr(points[name]) >= highest - AS_GOOD]
    return min(as_good, key=lambda name: _parameters(points[name]))


def verdict(rows: Sequence[Run]) -> dict[str, dict[str, Any]]:
    """Of each scene: automatic beside the best of the sweep; only points with all their seeds.

    Args:
        rows: runs, whose `point` is None where they belong to no point of this sweep.
    """
    found = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        points = points_of(rows, scene)
        if AUTOMATIC not in points or len(points) < 2:
            continue
        ours = points[AUTOMATIC]
        best = best_of(points)
        behind = against(points[best], ours)
        parameters, its = (_parameters(points[name]) for name in (AUTOMATIC, best))
        found[scene] = {
            "psnr": mean_psnr(ours),
            "best": best,
            "best_psnr": mean_psnr(points[best]),
            "behind": behind.difference,
            "margin": behind.margin,
            "seeds": len(ours),
            "parameters": parameters,
            "best_parameters": its,
            "reached": behind.difference <= MAY_LOSE and parameters <= MAY_HAVE * its,
        }
    return found


def bars(scenes: Sequence[Mapping[str, Any]], rows: Sequence[Run]) -> list[dict[str, Any]]:
    """Parameters of the smallest city against the largest's, and what larger models are ahead by.

    Args:
        scenes: as `sizes.look` describes them; of cities also `blocks`.
        rows: runs.
    """
    trained = {row["scene"] for row in rows if row["point"] is not None}
    cities = sorted(
        (scene for scene in scenes if scene.get("blocks") and scene["scene"] in trained),
        key=lambda scene: scene["blocks"],
    )
    if len(cities) < 2:
        return []
    small, large = cities[0], cities[-1]
    share = small["parameters"] / large["parameters"]
    found = [
        {
            "name": f"parameters of {small['scene']} against {large['scene']}",
            "value": share,
            "margin": None,
            "seeds": None,
            "bar": SMALL_AGAINST_LARGE,
            "reached": share <= SMALL_AGAINST_LARGE,
        }
    ]
    for city in (small, large):
        points = points_of(rows, city["scene"])
        ours = points.pop(AUTOMATIC, {})
        larger = [p for p in points.values() if _parameters(p) > city["parameters"]]
        if not ours or not larger:
            continue
        behind = max((against(runs, ours) for runs in larger), key=lambda one: one.difference)
        found.append(
            {
                "name": f"{city['scene']}: best larger model ahead by, dB",
                "value": behind.difference,
                "margin": behind.margin,
                "seeds": len(ours),
                "bar": MAY_LOSE,
                "reached": behind.difference <= MAY_LOSE,
            }
        )
    return found


def _parameters(runs: Mapping[int, Run]) -> int:
    parameters: int = next(iter(runs.values()))["parameters"]
    return parameters
