"""`leco shrink`: from the words on the command line to a smaller file."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.cli_reports import check_place
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.evaluation.machine import describe_code, describe_machine, made_by
from leco_plugin.occupancy import BACKDROP_PRICE, Occupancy
from leco_plugin.progress_bar import bar
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
from leco_plugin.shrink.checks import check_known, check_march, check_room, check_skips
from leco_plugin.shrink.evidence import Evidence, gather
from leco_plugin.shrink.references import LOST_DECISIONS, names_of, references, shares_lost
from leco_plugin.shrink.rungs import Bounds, Found, Ground, Rung
from leco_plugin.shrink.saying import line_of, line_of_original
from leco_plugin.shrink.search import search
from leco_plugin.shrink.sources import (
    Source,
    check_scene,
    find_source,
    held_out,
    of_test_photographs,
    trained_on,
)
from leco_plugin.shrink.verifying import HOLDS, is_measured, of_original, verify

RAYS = 4096
TAUGHT_RAYS = 6144
TIMED_POSITIONS, ROUNDS = 1 << 16, 15
COPIED = (
    *("step", "train_seconds", "bounds", "near", "far", "step_size", "cone_angle", "aabb"),
    *("frame", "cameras", BACKDROP_PRICE),
)
"""What a smaller occupancy's report takes over from the original's."""


def shrink(
    file: Path,
    data: Path,
    out: Path,
    bounds: Bounds,
    seed: int = 0,
    keep: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Finds the smallest gate that decides as a frozen one does, and writes it.

    Args:
        file: an occupancy, in the folder of its run if its trained model is to be the reference.
        data: the scene in nerfstudio's format.
        out: of the smaller occupancy.
        bounds: what it may declare.
        seed: of rays that were trained on.
        keep: called with what is known so far after each gate that was tried: JSON values.
    Returns:
        The frontier that was walked, and what was written: JSON values.
    Raises:
        ValueError, OSError: a file, a folder or a bound is wrong; nothing was written.
    """
    code = describe_code()
    check_place("--out", out)
    if out.exists() and out.samefile(file):
        raise ValueError(f"--out {out} is the occupancy itself; name another file")
    original = Occupancy.load(file)
    check_room(original, bounds)
    check_march(original, file)
    check_skips(original, file)
    torch.manual_seed(seed)
    source = find_source(file, data)
    check_scene(source, original, data)
    check_known(source, original, file)
    original = original.to(source.manager.device)
    ground = _ground(source, original)
    itself = of_original(ground, bounds)
    _say(line_of_original(itself, is_measured(ground)))
    known = {
        "format": 1,
        "machine": describe_machine(),
        **made_by(code),
        "from": {"params": original.num_params, "bytes": file.stat().st_size},
        "bounds": {**vars(bounds)},
        "original": itself.to_dict(),
    }
    rungs: list[dict[str, Any]] = []

    def tell(rung: Rung) -> None:
        _say(line_of(rung))
        rungs.append(rung.to_dict())
        if keep is not None:
            keep({**known, "rungs": rungs})

    found = Found(None, [])
    if itself.verdict == HOLDS:
        with bar("Teaching smaller gates") as show:
            found = search(ground, bounds, on_rung=tell, on_progress=show)
    smaller = found.occupancy
    if smaller is None:
        if is_measured(ground):
            looks = max((rung.look or 0 for rung in found.rungs), default=0)
            verify(ground, original, bounds, itself, looks + 1)
        smaller = _rounded_as_it_is(original)
    checked = check(source, original, smaller)
    untrained = held_out_sampler(source.manager) is not None
    smaller.report = report_of(ground, found, itself, untrained)
    out.parent.mkdir(parents=True, exist_ok=True)
    smaller.save(out)
    speedup, times = compare_queries(original, smaller)
    reported = {name: value for name, value in smaller.report.items() if name not in COPIED}
    return {
        **known,
        "original": itself.to_dict(),
        "to": {"params": smaller.num_params, "bytes": out.stat().st_size, **reported},
        "query_speedup": speedup,
        "query_milliseconds": times,
        "queried_positions": TIMED_POSITIONS,
        "checked": checked,
        "rungs": rungs,
    }


def check(source: Source, original: Occupancy, smaller: Occupancy) -> dict[str, Any] | None:
    """What the smaller gate loses on rays of test photographs, which decided nothing here.

    Returns:
        `rays`, the worst `lost_surface_mass` of any reference, or `lost_decisions` without a field,
        and that of each (`against`); None without such photographs, and of the original where
        nothing measures it.
    """
    seen = of_test_photographs(source, original, RAYS)
    if seen is None:
        return None
    shares = shares_lost(source, original, smaller, seen)
    if not shares:
        return None
    lost = _lost(source.model is None, max(shares.values()))
    return {"rays": len(seen.truth), **lost, "against": shares}


def _ground(source: Source, original: Occupancy) -> Ground:
    """Rays to teach by, to search on, and to verify on, with what they are worth."""
    searched, verified = held_out(source, original, RAYS)
    found = references(source, original, searched, verified)
    parts = [part.evidence for one in found for part in (one.search, one.verify)]
    if not all(bool(part.kept.any()) for part in parts[:2]):
        raise ValueError(
            "the occupancy keeps nothing on the rays of these photographs: they are of another "
            "scene, or it has been moved since"
        )
    if not all(bool(part.worth.any()) for part in parts):
        raise ValueError(
            "the run's field renders nothing where the occupancy keeps something, so that no loss "
            "can be measured: it is of another run, or was hardly trained"
        )
    return Ground(original, _taught(source, original), found)


def _taught(source: Source, original: Occupancy) -> Evidence:
    """Rays to teach by; a candidate weighs what it weighs in any of the fields."""
    seen = trained_on(source, original, TAUGHT_RAYS)
    taught, _ = gather(source, original, seen)
    if source.frozen is None:
        return taught
    before, _ = gather(source._replace(model=source.frozen), None, seen)
    return taught._replace(weights=taught.weights.maximum(before.weights))


def _rounded_as_it_is(original: Occupancy) -> Occupancy:
    """The original itself, its products' weights in bfloat16 where they are asked in it anyway.

    Not a decision changes: autocast rounds them so whenever the gate is asked.
    """
    if original.precision == "bfloat16":
        for layer in original.gate.hidden:
            for parameter in layer.parameters():
                parameter.copy_(parameter.bfloat16().float())
    return original


def report_of(ground: Ground, found: Found, itself: Rung, untrained: bool) -> dict[str, Any]:
    """What the smaller occupancy declares: the original's loss and, on top, its own.

    Args:
        itself: the original, which is stored again where nothing smaller holds.
        untrained: whether nothing was trained on the pixels of the ground's rays.
    """
    original = ground.original
    report = {name: original.report[name] for name in COPIED if name in original.report}
    if "cameras" in report:
        report["cameras"] = [[round(float(x), 4) for x in row] for row in report["cameras"]]
    if found.occupancy is None:
        report = {**original.report, **report}
        return report | (_measured(ground, itself, untrained) if is_measured(ground) else {})
    rung = found.rungs[-1]
    return (
        report
        | _measured(ground, rung, untrained)
        | {
            "params": rung.params,
            "threshold": found.occupancy.threshold,
            "kept_candidates_dropped": rung.verified["kept_candidates_dropped"],
            "shrunk_from_params": original.num_params,
            "kept_volume_of_the_original": rung.kept_volume,
        }
    )


def _measured(ground: Ground, rung: Rung, untrained: bool) -> dict[str, Any]:
    """Of a report, what was measured on rays that the search did not see."""
    measured, first = rung.verified, ground.references[0]
    alone = first.model is None
    return {
        **_lost(alone, measured["lost_surface_mass_bound"]),
        "lost_mass": None if alone else measured["lost_mass"],
        "image_price_db": measured["image_price_db"],
        "empty_fraction": measured["empty_fraction"],
        "calibration_rays": first.verify.evidence.rays,
        "held_out": untrained and bool(ground.original.report.get("held_out", False)),
        "loss_measured_against": names_of(ground.references),
    }


def _lost(alone: bool, share: float | None) -> dict[str, float | None]:
    """A loss by its name: without a field it is one of decisions, and that of surfaces unknown."""
    if alone:
        return {"lost_surface_mass": None, LOST_DECISIONS: share}
    return {"lost_surface_mass": share}


def compare_queries(original: Occupancy, smaller: Occupancy) -> tuple[float, list[float]]:
    """How many times faster the smaller gate answers: median of interleaved pairs.

    Returns:
        the median of the pairs' ratios, and the median milliseconds of each.
    """
    box = whole_box(original)
    unit = torch.rand(TIMED_POSITIONS, 3, generator=torch.Generator().manual_seed(0))
    device = original.threshold_value.device
    positions = torch.lerp(box.low, box.high, unit).to(device)
    pairs = [
        tuple(_seconds(occupancy, positions) for occupancy in (original, smaller))
        for _ in range(ROUNDS)
    ][2:]
    ratio = statistics.median(before / after for before, after in pairs)
    return round(ratio, 2), [round(1e3 * statistics.median(times), 3) for times in zip(*pairs)]


def _seconds(occupancy: Occupancy, positions: torch.Tensor) -> float:
    from leco_plugin.evaluation.clock import synchronize

    synchronize()
    started = time.perf_counter()
    occupancy.occupied(positions)
    synchronize()
    return time.perf_counter() - started


def _say(line: str) -> None:
    CONSOLE.print(line, markup=False, highlight=False)
