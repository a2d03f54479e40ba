"""What the runs of a chart say together: one line for each contender, and who is on the front."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leco_plugin.chart.contender import shared_method, short_names

LOST_SURFACE_MASS = 1e-3
"""Of the weight near surfaces, at which `evaluation.equal_loss` compares representations."""
OURS = "learned-occupancy"
"""The sampler whose gate is the one that this package takes by default."""
CURVE_TIMES = 60
"""Common times at which the curves of several seeds are read."""


@dataclass(frozen=True)
class Cost:
    """Something that is better when it is less."""

    key: str
    """In a run, with a dot into its `occupancy`."""
    title: str
    unit: str
    scale: float = 1.0
    """From the run's unit to the one shown."""

    def of(self, run: Mapping[str, Any]) -> float | None:
        """Its value in a run, in the unit shown; None where the run has none."""
        value: Any = run
        for name in self.key.split("."):
            value = value.get(name) if isinstance(value, Mapping) else None
        return None if value is None else float(value) * self.scale


RENDERING = Cost("render_seconds_per_image", "rendering an image", "s")
MEMORY = Cost("peak_memory_bytes", "peak memory in training", "GB", 1e-9)
QUERIES = Cost("field_queries_per_ray", "field queries a ray", "")
LEARNING = Cost("learn_seconds", "learning the occupancy", "s")
BYTES = Cost("occupancy.bytes", "size of the occupancy", "kB", 1e-3)
KEPT = Cost("occupancy.at_equal_loss.kept_reached_volume", "volume kept at equal loss", "%", 100.0)
COSTS = (RENDERING, MEMORY, QUERIES)


@dataclass(frozen=True)
class Line:
    """All seeds of one contender."""

    name: str
    method: str
    sampler: str
    runs: tuple[dict[str, Any], ...]

    @property
    def learned(self) -> bool:
        """Whether it asks a learned occupancy."""
        return self.sampler.startswith("learned-occupancy")

    @property
    def psnrs(self) -> list[float]:
        """Of each seed, dB."""
        return [run["psnr"] for run in self.runs]

    @property
    def psnr(self) -> float:
        """Mean over seeds, dB."""
        return statistics.fmean(self.psnrs)

    def mean(self, key: str) -> float | None:
        """Mean over seeds of a figure of quality; None where a seed has none."""
        values = [run.get(key) for run in self.runs]
        return None if None in values else statistics.fmean(v for v in values if v is not None)

    def median(self, cost: Cost) -> float | None:
        """Median over seeds of a cost; None where a seed has none."""
        values = [cost.of(run) for run in self.runs]
        return None if None in values else statistics.median(v for v in values if v is not None)

    def curve(self) -> tuple[NDArray[np.float64], ...]:
        """Seconds [T], and mean, lowest and highest PSNR of the seeds there [T]."""
        curves = [np.array(run["curve"], dtype=float) for run in self.runs]
        begin, end = max(c[0, 0] for c in curves), min(c[-1, 0] for c in curves)
        seconds = np.linspace(begin, end, CURVE_TIMES) if end > begin else np.array([end])
        values = np.stack([np.interp(seconds, curve[:, 0], curve[:, 1]) for curve in curves])
        return seconds, values.mean(axis=0), values.min(axis=0), values.max(axis=0)

    def seconds_to(self, psnr: float) -> float | None:
        """When its mean curve first reaches a PSNR; None if it does not."""
        seconds, mean, _, _ = self.curve()
        reached = np.flatnonzero(mean >= psnr)
        return float(seconds[reached[0]]) if len(reached) else None


def lines_of(results: Mapping[str, Any]) -> list[Line]:
    """The contenders of a chart in their order, under names without what all share."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for run in results["runs"]:
        groups.setdefault(run["name"], []).append(run)
    return [
        Line(name, runs[0]["method"], runs[0]["sampler"], tuple(runs))
        for name, runs in zip(short_names(list(groups)), groups.values())
    ]


def common_psnr(lines: Sequence[Line]) -> float:
    """What every contender reaches: the lowest of their last mean PSNRs, dB."""
    return min(line.psnr for line in lines)


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which points (cost, gain) no other one beats in both: their numbers, by rising cost."""
    order = sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1]))
    found: list[int] = []
    for i in order:
        if not found or points[i][1] > points[found[-1]][1]:
            found.append(i)
    return found


@dataclass(frozen=True)
class Representation:
    """One way to hold an occupancy, over all seeds: medians."""

    name: str
    size: float
    """kB of its file, or of a grid's bits."""
    learn_seconds: float
    """Until it is there; for a grid, of the field it was made from, and its own updates."""
    kept: float
    """Percent of the volume that rays reach which it keeps when all lose equally much."""
    ours: bool = False
    """Whether it is the gate that this package takes by default."""

    def beats(self, other: Representation, cost: Callable[[Representation], float]) -> bool:
        """Whether it keeps no more at no more cost, and is better in one of the two."""
        mine, theirs = (cost(self), self.kept), (cost(other), other.kept)
        return mine != theirs and all(a <= b for a, b in zip(mine, theirs))


FRONTS: dict[str, Callable[[Representation], float]] = {
    "size": lambda one: one.size,
    "learning time": lambda one: one.learn_seconds,
}
"""The costs on whose fronts representations are."""


def representations_of(lines: Sequence[Line]) -> list[Representation]:
    """Learned occupancies, and grids made from the same field, where they were measured.

    None where all are gates of one kind: then something else is compared.
    """
    found: list[Representation] = []
    kinds: set[str] = set()
    for line in lines:
        size, seconds, kept = (line.median(cost) for cost in (BYTES, LEARNING, KEPT))
        if size is None or seconds is None or kept is None:
            continue
        found.append(Representation(line.name, size, seconds, kept, line.sampler == OURS))
        kinds.add(line.sampler)
        of_runs = [
            {str(grid["resolution"]): grid for grid in run["occupancy"]["at_equal_loss"]["grids"]}
            for run in line.runs
        ]
        for resolution in of_runs[0]:
            grids = [grids[resolution] for grids in of_runs if resolution in grids]
            kinds.add("grid")
            updates = statistics.median(grid["update_seconds"] for grid in grids)
            found.append(
                Representation(
                    f"grid {resolution}³",
                    grids[0]["bytes"] / 1e3,
                    seconds + updates,
                    100.0 * statistics.median(grid["kept_reached_volume"] for grid in grids),
                )
            )
    return found if len(kinds) > 1 else []


def fronts_of(one: Representation, all_of_them: Sequence[Representation]) -> list[str]:
    """The names of the `FRONTS` on which a representation is."""
    return [
        name
        for name, cost in FRONTS.items()
        if not any(other.beats(one, cost) for other in all_of_them)
    ]


def headline(results: Mapping[str, Any]) -> str:
    """What the chart shows, in one sentence."""
    lines = lines_of(results)
    ranked = sorted(lines, key=lambda line: -line.psnr)
    if len(ranked) < 2:
        return f"{ranked[0].name}: {ranked[0].psnr:.1f} dB"
    best, second = ranked[:2]
    lead = best.psnr - second.psnr
    apart = len(best.runs) == 1 or min(best.psnrs) > max(second.psnrs)
    if lead < 0.05 or not apart:
        return f"{best.name} and {second.name} are level at {best.psnr:.1f} dB"
    return f"{best.name} is ahead: {best.psnr:.1f} dB, {lead:.1f} more than {second.name}"


def circumstances(results: Mapping[str, Any]) -> str:
    """Method, scene, machine, budget and seeds, in one line."""
    machine, protocol = results["machine"], results["protocol"]
    where = (
        f"{machine['cores']} CPU cores" if machine["device"] == "cpu" else str(machine["device"])
    )
    parts = []
    if protocol["seconds"] is not None:
        parts.append(f"{protocol['seconds']:g} s")
    if protocol["steps"] is not None:
        parts.append(f"{protocol['steps']} steps")
    if (at_once := protocol.get("at_once", 1)) > 1:
        where += f", {at_once} runs at a time"
    seeds = len({run["seed"] for run in results["runs"]})
    many = "one seed" if seeds == 1 else f"mean of {seeds} seeds (bands: least to most)"
    method = shared_method(list(dict.fromkeys(run["name"] for run in results["runs"])))
    what = f"{method} on {results['scene']['name']}" if method else results["scene"]["name"]
    return f"{what}, {' or '.join(parts)} of training on {where}, {many}"


def verdict(representations: Sequence[Representation]) -> str:
    """On which fronts ours is, and what beats it where it is not."""
    ours = next((one for one in representations if one.ours), None)
    if ours is None:
        return "our own gate has no figures here"
    held, beaten = fronts_of(ours, representations), []
    for name, cost in FRONTS.items():
        better = [one for one in representations if one.beats(ours, cost)]
        if better:
            beaten.append(f"in {name} by {min(better, key=lambda one: one.kept).name}")
    if not beaten:
        return (
            f"{ours.name} is on both fronts: what keeps less space is larger and takes longer to "
            "learn"
        )
    where = f"is on the front of {held[0]} only" if held else "is on neither front"
    return f"{ours.name} {where}: it is beaten {' and '.join(beaten)}"


def sentence(text: str) -> str:
    """The text as it begins a line."""
    return text[:1].upper() + text[1:]
