"""`leco shrink`: from the words on the command line to a smaller file."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from leco_plugin.cli_reports import check_place
from leco_plugin.evaluation.report import describe_code, describe_machine, made_by
from leco_plugin.log import bar
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
from leco_plugin.shrink.checks import (
    check_bounds,
    check_known,
    check_march,
    check_room,
    check_skips,
    check_still_skips,
)
from leco_plugin.shrink.evidence import Evidence, gather
from leco_plugin.shrink.lowering import facts_of, lowered
from leco_plugin.shrink.references import Side, references, shares_lost, sides_of
from leco_plugin.shrink.report import (
    COPIED,
    lost_by_name,
    report_of,
    with_test_photographs,
)
from leco_plugin.shrink.rungs import Bounds, Found, Ground, Rung
from leco_plugin.shrink.saying import line_of, line_of_lowered, line_of_original
from leco_plugin.shrink.search import search
from leco_plugin.shrink.sources import (
    Seen,
    Source,
    check_scene,
    find_source,
    held_out,
    of_test_photographs,
    trained_on,
)
from leco_plugin.shrink.timing import TIMED_POSITIONS, compare_queries
from leco_plugin.shrink.verifying import HOLDS, is_measured, of_original, verify

RAYS = 4096
TAUGHT_RAYS = 6144


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
    check_bounds(bounds)
    check_march(original, file)
    check_skips(original, file)
    random.seed(seed)  # nerfstudio caches images in an order of its own
    torch.manual_seed(seed)
    source = find_source(file, data)
    check_scene(source, original, data)
    check_known(source, original, file)
    if source.frozen is None:  # with it the threshold can be lowered
        check_room(original, bounds)
    original = original.to(source.manager.device)
    drawn = _draw(source, original)
    ground = _ground(source, original, drawn)
    itself = of_original(ground, bounds)
    _say(line_of_original(itself, is_measured(ground)))
    facts = None
    if (lower := lowered(ground, bounds)) is not None:
        facts, original = facts_of(original, lower), lower
        ground = _ground(source, original, drawn)
        itself = of_original(ground, bounds)
        _say(line_of_lowered(itself, facts))
        check_still_skips(ground, file)
    elif itself.verdict != HOLDS:
        _say("no threshold is within them, and no smaller gate is looked for")
    known = {
        "format": 1,
        "machine": describe_machine(),
        **made_by(code),
        "from": {"params": original.num_params, "bytes": file.stat().st_size},
        "bounds": {**vars(bounds)},
        "lowered": facts,
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
    kept_more = 1.0 if facts is None else facts["kept_volume"]
    smaller.report = with_test_photographs(
        report_of(ground, found, itself, untrained, kept_more), checked
    )
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
    lost = lost_by_name(source.model is None, max(shares.values()))
    return {"rays": len(seen.truth), **lost, "against": shares}


class Drawn(NamedTuple):
    """Rays of a search."""

    sides: list[Side]
    taught: Seen


def _draw(source: Source, original: Occupancy) -> Drawn:
    sides = sides_of(source, original, held_out(source, original, RAYS))
    return Drawn(sides, trained_on(source, original, TAUGHT_RAYS))


def _ground(source: Source, original: Occupancy, drawn: Drawn) -> Ground:
    """Rays to teach by, to search on, and to verify on, with what they are worth."""
    found = references(source, original, drawn.sides)
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
    return Ground(original, _taught(source, original, drawn.taught), found)


def _taught(source: Source, original: Occupancy, seen: Seen) -> Evidence:
    """Rays to teach by; a candidate weighs what it weighs in any of the fields."""
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


def _say(line: str) -> None:
    CONSOLE.print(line, markup=False, highlight=False)
