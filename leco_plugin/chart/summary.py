"""What the runs of a chart say together: lines, verdicts on pairs of them, and fronts."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from operator import eq
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from leco_plugin.chart.contender import LEARNED, Protocol, shared_method, short_names
from leco_plugin.evaluation.report import describe_cores
from leco_plugin.log import counted

CONFIDENCE = 0.95
"""Of the interval around a difference of means; of each comparison alone, however many are made."""
CLOSE, CLOSE_SHARE = 0.5, 0.25
"""The widest margin with which two are level: dB, or of other figures a share of their means. With
a wider one the seeds do not decide."""


@dataclass(frozen=True)
class Verdict:
    """A difference of means, and what its interval over seeds says."""

    word: Literal["ahead", "level", "undecided", "behind"] | None
    """Ahead is more. None where a side has one seed, or a figure is no number."""
    difference: float
    margin: float | None
    """Half the interval's width; None where there is none."""
    seeds: tuple[int, int]

    @property
    def is_open(self) -> bool:
        """Whether the interval holds zero."""
        return self.word in ("level", "undecided")

    @property
    def by(self) -> str:
        """The number of seeds, or why there is no verdict."""
        if self.margin is None:
            return "one seed: no verdict" if min(self.seeds) < 2 else "not a number: no verdict"
        ours, theirs = self.seeds
        return f"{ours} seeds" if ours == theirs else f"{ours} and {theirs} seeds"

    def said(self) -> str:
        """The whole verdict, such as "ahead: +1.50 ± 0.42 dB, 3 seeds"."""
        word = f"{self.word}: " if self.word else ""
        margin = "" if self.margin is None else f" ± {self.margin:.2f}"
        return f"{word}{self.difference:+.2f}{margin} dB, {self.by}"


def compare(ours: Sequence[float], theirs: Sequence[float], close: float | None = CLOSE) -> Verdict:
    """Compares a figure of each run of two contenders by the 95% interval of Welch's t around the
    difference of their means. Where that holds zero the two are level, or, if its half is wider
    than `close`, undecided. Swap the two for a cost. `ValueError` where one has no run.

    Runs with the same seed share nothing but its number, so that they are no pairs, and two
    contenders need not scatter alike.

    Args:
        close: in the figure's unit, PSNR by default; of None `CLOSE_SHARE` of the mean of all.
    """
    if not ours or not theirs:
        raise ValueError(f"{len(ours)} runs cannot be compared with {len(theirs)}")
    counts = len(ours), len(theirs)
    difference = statistics.fmean(ours) - statistics.fmean(theirs)
    if min(counts) < 2 or not math.isfinite(difference):
        return Verdict(None, difference, None, counts)
    errors = [statistics.variance(values) / len(values) for values in (ours, theirs)]
    squared = sum(errors)
    margin = 0.0
    if squared > 0.0:
        freedom = squared**2 / sum(e**2 / (n - 1) for e, n in zip(errors, counts))
        margin = float(stdtrit(freedom, 0.5 + CONFIDENCE / 2)) * math.sqrt(squared)
    word: Any = "ahead" if difference > 0.0 else "behind"
    if abs(difference) <= margin:
        if close is None:
            close = CLOSE_SHARE * abs(statistics.fmean([*ours, *theirs]))
        word = "level" if margin <= close else "undecided"
    return Verdict(word, difference, margin, counts)


LOST_SURFACE_MASS = 1e-3
"""Loss at which `evaluation.equal_loss` compares occupancies."""
CURVE_POINTS = 60
"""Points at which the curves of several seeds are averaged."""


@dataclass(frozen=True)
class Cost:
    """Something that is better when it is less."""

    key: str
    """In a run, with dots into the mappings in it."""
    title: str
    unit: str
    scale: float = 1.0
    """From the run's unit to the one shown."""

    def of(self, run: Mapping[str, Any]) -> float | None:
        """Its value in a run, in the unit shown; None where the run has none."""
        value = figure_in(run, self.key)
        return None if value is None else value * self.scale

    @property
    def titled(self) -> str:
        return f"{self.title}, {self.unit}" if self.unit else self.title


def figure_in(values: Any, key: str) -> float | None:
    """A number by its key, with a dot into each mapping below; None where there is none."""
    for name in key.split("."):
        values = values.get(name) if isinstance(values, Mapping) else None
    return None if values is None else float(values)


def middle_of(
    values: Sequence[float | None], middle: Callable[[Sequence[float]], float] = statistics.median
) -> float | None:
    """Median, or another middle, of values of several seeds; None where a seed has none."""
    known = [value for value in values if value is not None]
    return middle(known) if len(known) == len(values) else None


def at_equal_loss(lines: Sequence[Line]) -> list[Mapping[str, Any]]:
    """What was measured at equal loss, of each run that has it."""
    held = [run.get("occupancy") or {} for line in lines for run in line.runs]
    return [found for one in held if (found := one.get("at_equal_loss"))]


RENDERING = Cost("render_seconds_per_image", "rendering an image", "s")
MEMORY = Cost("peak_memory_bytes", "peak memory", "GB", 1e-9)
QUERIES = Cost("field_queries_per_ray", "field queries a ray", "")
LEARNING = Cost("learn_seconds", "learning the occupancy", "s")
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
        """Whether it uses a learned occupancy."""
        return self.sampler.startswith(LEARNED)

    @property
    def psnrs(self) -> list[float]:
        """PSNR of each seed, dB."""
        return [run["psnr"] for run in self.runs]

    @property
    def psnr(self) -> float:
        """Mean over seeds, dB."""
        return statistics.fmean(self.psnrs)

    @property
    def warming_up(self) -> bool:
        """Whether its occupancy grid is still in its warm-up at the end, with some seed."""
        return any(run.get("warming_up") for run in self.runs)

    @property
    def kept_up(self) -> float:
        """Median share of the training time spent on updates of a grid; 0 without one."""
        seconds = None if self.learned else self.median(LEARNING)
        if seconds is None:
            return 0.0
        return seconds / statistics.median(run["train_seconds"] for run in self.runs)

    def mean(self, key: str) -> float | None:
        """Mean over seeds of a figure of quality; None where a seed has none."""
        return middle_of([run.get(key) for run in self.runs], statistics.fmean)

    def median(self, cost: Cost) -> float | None:
        """Median over seeds of a cost; None where a seed has none."""
        return middle_of([cost.of(run) for run in self.runs])

    def curve(self) -> tuple[NDArray[np.float64], ...]:
        """Mean seconds [T], and mean, lowest and highest PSNR [T] over seeds, dB, at equal shares
        of their training, the end included."""
        curves = [np.array(run["curve"], dtype=float) for run in self.runs]
        ends = np.array([curve[-1, 0] for curve in curves])
        begin = max(curve[0, 0] / end for curve, end in zip(curves, ends))
        shares = np.linspace(begin, 1.0, CURVE_POINTS) if begin < 1.0 else np.ones(1)
        values = np.stack([np.interp(shares * end, *curve.T) for curve, end in zip(curves, ends)])
        seconds = shares * ends.mean()
        return seconds, values.mean(axis=0), values.min(axis=0), values.max(axis=0)

    @property
    def first_evaluations(self) -> tuple[float, ...]:
        """Seconds of the first point of each curve."""
        return tuple(float(run["curve"][0][0]) for run in self.runs)

    def seconds_to_each(self, psnr: float) -> tuple[float | None, ...]:
        """When each of its runs reaches a PSNR to stay, as `seconds_to_pass`."""
        return tuple(seconds_to_pass(run["curve"], psnr) for run in self.runs)

    def seconds_to(self, psnr: float) -> float | None:
        """When its runs reach a PSNR to stay, median over seeds; None if one of them does not."""
        return middle_of(self.seconds_to_each(psnr))


def seconds_to_pass(curve: Sequence[Sequence[float]], psnr: float) -> float | None:
    """When a curve [[seconds, PSNR], ...] reaches a PSNR and stays above it, interpolated. None for
    never; the first point's seconds, at most, where no point is below."""
    below = [i for i, (_, value) in enumerate(curve) if value < psnr]
    if not below:
        return float(curve[0][0])
    if below[-1] == len(curve) - 1:
        return None
    (before, low), (after, high) = curve[below[-1]], curve[below[-1] + 1]
    return float(before + (psnr - low) / (high - low) * (after - before))


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
    """What every run reaches: the lowest of their last PSNRs, dB."""
    return min(run["curve"][-1][1] for line in lines for run in line.runs)


def front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Which points (cost, gain) no other one beats in both: their numbers, by rising cost."""
    found: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: (points[i][0], -points[i][1])):
        if not found or points[i][1] > points[found[-1]][1]:
            found.append(i)
    return found


def best_so_far(lines: Sequence[Line]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The front of accuracy against training time: seconds [T], and the highest mean PSNR [T], dB,
    that any contender has reached by then."""
    curves = [line.curve()[:2] for line in lines]
    times = np.unique(np.concatenate([seconds for seconds, _ in curves]))
    reached = [np.interp(times, seconds, psnr, left=-np.inf) for seconds, psnr in curves]
    return times, np.maximum.accumulate(np.max(reached, axis=0))


def headline(results: Mapping[str, Any], short: bool = False) -> str:
    """What the chart shows of accuracy, in one sentence, or only who is ahead and by how much."""
    ranked = sorted(lines_of(results), key=lambda line: -line.psnr)
    if len(ranked) < 2:
        return f"{ranked[0].name}: {ranked[0].psnr:.1f} dB"
    best, second = ranked[:2]
    found = compare(best.psnrs, second.psnrs)
    both_figures = f"{best.psnr:.1f} dB for {best.name}, {second.psnr:.1f} next"
    if found.margin is None and short:
        return f"no verdict: {both_figures}"
    if found.margin is None:
        return f"{best.name} {best.psnr:.1f} dB, {second.name} {second.psnr:.1f} dB ({found.by})"
    apart = f"{found.difference:.2f} ± {found.margin:.2f}"
    if not found.is_open and short:
        return f"{best.name} is ahead by {apart} dB"
    if not found.is_open:
        more = f"{apart} more than {second.name} ({found.by})"
        cold = ", whose grid is still in its warm-up" if second.warming_up else ""
        return f"{best.name} is ahead: {best.psnr:.1f} dB, {more}{cold}"
    figures = f"{best.psnr:.1f} and {second.psnr:.1f} dB, {apart} apart ({found.by})"
    said = f"{best.name} and {second.name} are {found.word}: {figures}"
    others = [line for line in ranked if not line.learned]
    if others:
        leads = ((line, compare(line.psnrs, others[0].psnrs)) for line in ranked if line.learned)
        leaders = [*takewhile(lambda pair: pair[1].word == "ahead", leads)]
        if len(leaders) > 1:  # and each has a margin
            last, lead = leaders[-1]
            least = f"{lead.difference:.2f} ± {lead.margin:.2f}"
            if short:
                number = {2: "two", 3: "three"}.get(len(leaders), str(len(leaders)))
                return f"{number} methods with learned occupancy lead by {least} dB"
            name = f"{others[0].name}, the best of the others"
            return f"{said}; {name}, is {least} behind {last.name}"
    if short and found.word == "level":
        return f"{best.name} is level with the next best"
    return f"undecided: {both_figures}" if short else said


def circumstances(results: Mapping[str, Any]) -> str:
    """Method, scene, machine, budget and seeds, in one line."""
    machine, protocol = results["machine"], results["protocol"]
    where, at_once = str(machine["device"]), protocol.get("at_once", 1)
    if where == "cpu":
        where = describe_cores(machine) + (" a run" if at_once > 1 else "")
    elif at_once > 1:
        where += f", {at_once} runs at a time"
    length = Protocol(protocol["seconds"], protocol["steps"]).describe()
    many = describe_seeds(results)
    if any(len(line.runs) > 1 for line in lines_of(results)):
        many += ": means of PSNR, medians of costs"
    method = shared_method(list(dict.fromkeys(run["name"] for run in results["runs"])))
    what = f"{method} on {results['scene']['name']}" if method else results["scene"]["name"]
    said = f"{what}, {length} of training on {where}, {many}"
    tested = results.get("held_out", {}).get("test")
    return said if tested is None else f"{said}, tested on a whole stretch of {len(tested)} cameras"


def describe_seeds(results: Mapping[str, Any]) -> str:
    """The least and the most seeds of a contender, and how many runs failed, such as "2 to 5 seeds;
    3 runs failed"."""
    counts = [len(line.runs) for line in lines_of(results)]
    least, most = min(counts), max(counts)
    said = "one seed" if most == 1 else f"{most} seeds" if least == most else ""
    said = said or f"{least} to {most} seeds"
    failed = len(results.get("failures", ()))
    return f"{said}; {counted(failed, 'run')} failed" if failed else said


@dataclass(frozen=True)
class Versus:
    """What one contender gains over another. Tuples are of its own runs, one for each seed."""

    ours: str
    theirs: str
    psnr: Verdict
    passed: tuple[float | None, ...]
    """Seconds of training, learning included, after which it passes the other's mean last PSNR."""
    sooner: tuple[float | None, ...]
    """The other's median training time as a multiple of those seconds."""
    faster: tuple[float, ...]
    """The other's median time to render an image as a multiple of its own."""
    at_first: tuple[bool, ...]
    """Whether each run passed by its first evaluation, and perhaps before."""


def versus(ours: Line, theirs: Line, seconds: float | None) -> Versus:
    """Compares two contenders; a last step beyond `seconds` of each does not count."""
    most = seconds or math.inf
    curves = [run["curve"] for run in theirs.runs]
    last = statistics.fmean(curve[-1][1] for curve in curves)
    ended = statistics.median(min(curve[-1][0], most) for curve in curves)
    rendered = statistics.median(run[RENDERING.key] for run in theirs.runs)
    passed = ours.seconds_to_each(last)
    sooner = tuple(None if after is None else ended / after for after in passed)
    faster = tuple(rendered / run[RENDERING.key] for run in ours.runs)
    psnr = compare(ours.psnrs, theirs.psnrs)
    at_first = tuple(map(eq, passed, ours.first_evaluations))
    return Versus(ours.name, theirs.name, psnr, passed, sooner, faster, at_first)


def rivals(lines: Sequence[Line], seconds: float | None = None) -> list[Versus]:
    """Each learned occupancy against the other samplers of its method; `seconds` as of `versus`."""
    return [
        versus(ours, theirs, seconds)
        for ours in lines
        for theirs in lines
        if ours.learned and not theirs.learned and ours.method == theirs.method
    ]


def sentence(text: str) -> str:
    """The text with a capital letter."""
    return text[:1].upper() + text[1:]
