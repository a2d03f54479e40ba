"""Pass, degraded or fail: what the runs of a sampler in a case say beside those of its reference.

A sampler is held to what its own host reaches when nothing is skipped, in as many steps of as many
rays. Where that does not train, nothing is held to anything.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

from leco_plugin.log import counted

Verdict = Literal["pass", "degraded", "fail", "no reference"]
Runs = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Bars:
    """The most that a verdict may fall short, dB; and lose."""

    below_reference: float
    """Of the median seed below the reference's median seed."""
    below_median: float
    """Of any seed below the median seed."""
    detail: float
    """As `below_reference`, on the pixels that the case is about."""
    lost_mass: float
    """Share of the rays whose surface is not sampled, above the reference's. No occupancy is exact
    to a pixel at the edges of things."""


PASS, DEGRADED = Bars(0.2, 0.5, 0.5, 0.01), Bars(1.0, 1.5, 2.0, 0.05)
TRAINED_ABOVE = 1.0
"""dB over the mean colour that a reference must reach to have trained."""
GOOD_ANYWAY = 30.0
"""dB that are enough where the mean colour is nearly right already."""


@dataclass(frozen=True)
class Cell:
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
    runs: Runs, reference: Runs | None, failures: Sequence[str] = (), missing: int = 0
) -> Cell:
    """The cell of a sampler in a case, by its finished runs.

    Args:
        reference: runs of its dense reference, of which the same seeds count; None where it is one
            itself.
        failures: reasons of its runs that have ended without a result.
        missing: number of its runs that have not been made.
    """
    if failures:
        many = len(failures) + len(runs)
        ended = f"{len(failures)} of {counted(many, 'run')} ended: {failures[0]}"
        return Cell("fail", ended, many, missing)
    if not runs:
        return Cell("no reference", "not run", 0, missing)
    if reference is not None:
        reference = _of_the_same_seeds(reference, runs)
    if unmeasured := _unmeasured(runs, reference or ()):
        return Cell("fail", unmeasured, len(runs), missing)
    cell = _figures(runs, reference, missing)
    lost = 0.0
    if reference is None:
        if not _is_trained(runs):
            return replace(cell, verdict="fail", reason="does not train")
    elif _is_trained(reference):
        lost = (cell.lost_mass or 0.0) - max(_values(reference, "lost_mass"), default=0.0)
    else:
        if cell.gap is not None and cell.gap < -DEGRADED.below_reference:
            reason = f"{-cell.gap:.2f} dB below a dense run that does not train"
            return replace(cell, verdict="degraded", reason=reason)
        reason = "the reference does not train" if reference else "the reference has no result"
        return replace(cell, verdict="no reference", reason=reason)
    if reason := _broken(cell, DEGRADED, lost):
        return replace(cell, verdict="fail", reason=reason)
    if reason := _broken(cell, PASS, lost):
        return replace(cell, verdict="degraded", reason=reason)
    return cell


def _of_the_same_seeds(some: Runs, others: Runs) -> Runs:
    """Those whose seeds others have too: seeds differ by more than what is compared."""
    seeds = {run["seed"] for run in others}
    return [run for run in some if run["seed"] in seeds]


def _broken(cell: Cell, bars: Bars, lost: float) -> str:
    """The first bar that a cell is on the wrong side of, in words; `lost` is the share of surfaces
    lost beyond the reference's."""
    if cell.gap is not None and cell.gap < -bars.below_reference:
        return f"{-cell.gap:.2f} dB below dense"
    if cell.detail_gap is not None and cell.detail_gap < -bars.detail:
        return f"{-cell.detail_gap:.1f} dB below dense where it matters"
    if lost > bars.lost_mass:
        return f"{lost:.1%} of surfaces lost"
    if cell.worst is not None and cell.worst < -bars.below_median:
        return f"seed {cell.worst_seed} is {-cell.worst:.2f} dB below the median"
    return ""


def _unmeasured(runs: Runs, reference: Runs) -> str:
    """The first figure that is missing or no number, in words: what was not seen is not passed."""
    wanted = ["kept_fraction", "trivial_psnr"]
    wanted += [name for name in ("lost_mass", "detail_psnr") if _values(reference, name)]
    for run in runs:
        if run["psnr"] is None:
            return f"seed {run['seed']} renders what is no number"
        for name in wanted:
            if run["measured"].get(name) is None:
                return f"seed {run['seed']} has no {name.replace('_', ' ')}"
    return ""


def _figures(runs: Runs, reference: Runs | None, missing: int) -> Cell:
    """A pass with all figures of some runs."""
    middle, worst = _psnr(runs), min(runs, key=lambda run: float(run["psnr"]))
    gap = detail_gap = None
    if reference and math.isfinite(_psnr(reference)):
        paired = _of_the_same_seeds(runs, reference)
        gap = _psnr(paired) - _psnr(reference)
        ours, theirs = _median(paired, "detail_psnr"), _median(reference, "detail_psnr")
        if ours is not None and theirs is not None:
            detail_gap = ours - theirs
    return Cell(
        "pass",
        "",
        len(runs),
        missing,
        psnr=middle,
        gap=gap,
        worst=float(worst["psnr"]) - middle,
        worst_seed=int(worst["seed"]),
        lost_mass=max(_values(runs, "lost_mass"), default=None),
        kept_fraction=_median(runs, "kept_fraction"),
        detail_gap=detail_gap,
    )


def _is_trained(runs: Runs) -> bool:
    trivial = _median(runs, "trivial_psnr")
    return trivial is not None and _psnr(runs) > min(trivial + TRAINED_ABOVE, GOOD_ANYWAY)


def _psnr(runs: Runs) -> float:
    """Median over seeds, dB; what is no number is worse than any."""
    return statistics.median(-math.inf if r["psnr"] is None else float(r["psnr"]) for r in runs)


def _values(runs: Runs, name: str) -> list[float]:
    return [run["measured"][name] for run in runs if run["measured"].get(name) is not None]


def _median(runs: Runs, name: str) -> float | None:
    values = _values(runs, name)
    return statistics.median(values) if values else None
