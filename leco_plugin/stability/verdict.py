"""Pass, degraded or fail: what the runs of a sampler in a case say beside those of its reference.

A sampler is held to what its own host reaches when nothing is skipped, with as many steps of as
many rays; where that does not train, nobody can be held to anything.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

Verdict = Literal["pass", "degraded", "fail", "no reference"]


@dataclass(frozen=True)
class Bars:
    """Largest shortfalls, dB."""

    below_reference: float
    """Of the median seed below the reference's median seed."""
    below_median: float
    """Of any seed below the median seed."""
    detail: float
    """As `below_reference`, on the pixels that the case is about."""


PASS, DEGRADED = Bars(0.2, 0.5, 0.5), Bars(1.0, 1.5, 2.0)
LOST_MASS = 0.01, 0.05
"""Share of the rays whose surface is not sampled, above the reference's: up to the first is a pass,
up to the second degraded. No occupancy is exact to a pixel at the edges of things."""
TRAINED_ABOVE = 1.0
"""dB over the mean colour that a reference must reach to have trained."""
GOOD_ANYWAY = 30.0
"""dB that are enough where the mean colour is nearly right already."""


@dataclass(frozen=True)
class Cell:
    """One cell of the table."""

    verdict: Verdict
    reason: str
    """In a few words; empty for a pass."""
    seeds: int
    missing: int = 0
    """Seeds that were asked for and not run yet."""
    psnr: float | None = None
    """Median over seeds, dB."""
    gap: float | None = None
    """Median PSNR less the reference's over the seeds that both have, dB; None for a reference."""
    worst: float | None = None
    """Worst seed less the median one, dB."""
    worst_seed: int | None = None
    lost_mass: float | None = None
    """Worst over seeds."""
    kept_fraction: float | None = None
    """Median over seeds."""
    detail_gap: float | None = None
    """As `gap`, on the pixels that the case is about."""

    def to_dict(self) -> dict[str, Any]:
        """JSON values, rounded to what they mean."""
        return {
            name: round(value, 5) if isinstance(value, float) else value
            for name, value in asdict(self).items()
        }


def judge(
    runs: Sequence[Mapping[str, Any]],
    reference: Sequence[Mapping[str, Any]] | None,
    failures: Sequence[str] = (),
    missing: int = 0,
) -> Cell:
    """The cell of a sampler in a case.

    Args:
        runs: its finished runs.
        reference: those of its dense reference, of which the same seeds count; None where it is
            one itself.
        failures: reasons of its runs that have ended without a result.
        missing: its runs that have not been made.
    """
    if failures:
        many = len(failures) + len(runs)
        return Cell("fail", f"{len(failures)} of {many} runs ended: {failures[0]}", many, missing)
    if not runs:
        return Cell("no reference", "not run", 0, missing)
    reference = _of_the_same_seeds(reference, runs)
    blind = _unmeasured(runs, reference or ())
    if blind:
        return Cell("fail", blind, len(runs), missing)
    cell = _figures(runs, reference, missing)
    held_to = runs if reference is None else reference
    if not _trained(held_to):
        reason = "the reference does not train" if held_to else "the reference has no result"
        verdict: Verdict = "no reference"
        if reference is None:
            reason, verdict = "does not train", "fail"
        elif cell.gap is not None and cell.gap < -DEGRADED.below_reference:
            reason, verdict = (
                f"{-cell.gap:.2f} dB below a dense run that does not train",
                "degraded",
            )
        return Cell(**{**asdict(cell), "verdict": verdict, "reason": reason})
    lost = None
    if reference is not None and cell.lost_mass is not None:
        lost = cell.lost_mass - (_worst(reference, "lost_mass") or 0.0)
    for verdict, bars, most_lost in (("fail", DEGRADED, 1), ("degraded", PASS, 0)):
        reason = _broken(cell, bars, lost, LOST_MASS[most_lost])
        if reason:
            return Cell(**{**asdict(cell), "verdict": verdict, "reason": reason})
    return cell


def _of_the_same_seeds(
    some: Sequence[Mapping[str, Any]] | None, others: Sequence[Mapping[str, Any]]
) -> list[Mapping[str, Any]] | None:
    """Those of some runs whose seeds others have too: medians of different seeds would differ by
    more than what is compared."""
    if some is None:
        return None
    seeds = {run["seed"] for run in others}
    return [run for run in some if run["seed"] in seeds]


def _broken(cell: Cell, bars: Bars, lost: float | None, most_lost: float) -> str:
    """The first bar that a cell is on the wrong side of, in words."""
    if cell.gap is not None and cell.gap < -bars.below_reference:
        return f"{-cell.gap:.2f} dB below dense"
    if cell.detail_gap is not None and cell.detail_gap < -bars.detail:
        return f"{-cell.detail_gap:.1f} dB below dense where it matters"
    if lost is not None and lost > most_lost:
        return f"{lost:.1%} of surfaces lost"
    if cell.worst is not None and cell.worst < -bars.below_median:
        return f"seed {cell.worst_seed} is {-cell.worst:.2f} dB below the median"
    return ""


def _unmeasured(runs: Sequence[Mapping[str, Any]], reference: Sequence[Mapping[str, Any]]) -> str:
    """The first figure that is no number although there should be one, in words: what nobody has
    seen is not passed."""
    wanted = ["kept_fraction", "trivial_psnr"]
    wanted += [name for name in ("lost_mass", "detail_psnr") if _values(reference, name)]
    for run in runs:
        if run["psnr"] is None:
            return f"seed {run['seed']} renders what is no number"
        for name in wanted:
            if run["measured"].get(name) is None:
                return f"seed {run['seed']} has no {name.replace('_', ' ')}"
    return ""


def _figures(
    runs: Sequence[Mapping[str, Any]],
    reference: Sequence[Mapping[str, Any]] | None,
    missing: int,
) -> Cell:
    psnrs = [float(run["psnr"]) for run in runs]
    middle = statistics.median(psnrs)
    at = min(range(len(runs)), key=psnrs.__getitem__)
    gap = detail_gap = None
    paired = _of_the_same_seeds(runs, reference or ())
    if reference and paired and math.isfinite(_psnr(reference)):
        gap = _psnr(paired) - _psnr(reference)
        ours, theirs = _median(paired, "detail_psnr"), _median(reference, "detail_psnr")
        if ours is not None and theirs is not None:
            detail_gap = ours - theirs
    return Cell(
        "pass",
        "",
        len(runs),
        missing,
        middle,
        gap,
        psnrs[at] - middle,
        int(runs[at]["seed"]),
        _worst(runs, "lost_mass"),
        _median(runs, "kept_fraction"),
        detail_gap,
    )


def _trained(runs: Sequence[Mapping[str, Any]]) -> bool:
    if not runs:
        return False
    trivial = _median(runs, "trivial_psnr")
    return trivial is not None and _psnr(runs) > min(trivial + TRAINED_ABOVE, GOOD_ANYWAY)


def _psnr(runs: Sequence[Mapping[str, Any]]) -> float:
    """Median over seeds, dB; what is no number is worse than any."""
    return statistics.median(-math.inf if r["psnr"] is None else float(r["psnr"]) for r in runs)


def _values(runs: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    return [run["measured"][name] for run in runs if run["measured"].get(name) is not None]


def _median(runs: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = _values(runs, name)
    return statistics.median(values) if values else None


def _worst(runs: Sequence[Mapping[str, Any]], name: str) -> float | None:
    """The largest: of what had better be small."""
    return max(_values(runs, name), default=None)
