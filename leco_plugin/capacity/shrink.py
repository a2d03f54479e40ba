"""`leco shrink`: from an occupancy to a smaller one that decides alike, with an honest report."""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from leco_plugin.capacity import references, sources
from leco_plugin.capacity.choice import line_of, line_of_lowered, losses_in_words
from leco_plugin.capacity.evidence import gather
from leco_plugin.capacity.references import HOLDS, LOST_DECISIONS, Bounds, Ground, Rung
from leco_plugin.capacity.search import Found, kept_of_box, lower_threshold, search
from leco_plugin.capacity.sources import Seen, Source
from leco_plugin.evaluation.clock import Clock
from leco_plugin.evaluation.inspection import whole_box
from leco_plugin.evaluation.report import describe_code, describe_machine, made_by
from leco_plugin.learning.freezing import HARDLY_ANYTHING
from leco_plugin.learning.sharpening import round_weights
from leco_plugin.log import bar, put
from leco_plugin.occupancy import BACKDROP_PRICE, Occupancy
from leco_plugin.scenes.pixels.held_out_pixels import held_out_sampler
from leco_plugin.scenes.whole_files import check_apart, check_place

RAYS = 4096
TAUGHT_RAYS = 6144
TIMED_POSITIONS, TIMED_ROUNDS = 1 << 16, 15
COPIED = (
    *("step", "train_seconds", "bounds", "near", "far", "step_size", "cone_angle", "aabb"),
    *("frame", "data_frame", "cameras", BACKDROP_PRICE),
)
"""What a smaller occupancy's report takes over from the original's."""


def shrink(
    file: Path,
    data: Path,
    out: Path,
    bounds: Bounds,
    keep: Callable[[dict[str, Any]], None],
) -> dict[str, Any]:
    """Finds the smallest gate that decides as a frozen one does, and writes it, by the options of
    `leco shrink`; returns the gates that were tried, and what was written: JSON values.

    After each gate `keep` gets the results so far. For a wrong file, folder or bound ValueError or
    OSError, before anything is written.
    """
    code = describe_code()
    check_place("--out", out)
    check_apart({"--out": out}, file)
    original = Occupancy.load(file)
    _check_original(original, file, bounds)
    random.seed(0)  # nerfstudio caches images in an order of its own
    torch.manual_seed(0)
    source = sources.find_source(file, data)
    sources.check_scene(source, original, data)
    check_losses(source, original, file, bounds)
    original = original.to(source.manager.device)
    ground, itself, lowered = _meet_bounds(source, original, file, bounds)
    results: dict[str, Any] = {
        "format": 1,
        "machine": describe_machine(),
        **made_by(code),
        "from": {"params": ground.original.num_params, "bytes": file.stat().st_size},
        "bounds": asdict(bounds),
        "lowered": lowered,
        "original": asdict(itself),
        "rungs": [],
    }

    def tell(rung: Rung) -> None:
        put(line_of(rung))
        results["rungs"].append(asdict(rung))
        keep(results)

    smaller, rung = _find_smaller(ground, bounds, itself, tell)
    checked = _check_on_test_photographs(source, ground.original, smaller)
    is_untrained = held_out_sampler(source.manager) is not None
    smaller.report = _report_of(ground, smaller, rung, is_untrained, lowered, checked)
    out.parent.mkdir(parents=True, exist_ok=True)
    smaller.save(out)
    speedup, times = compare_queries(ground.original, smaller)
    reported = {name: value for name, value in smaller.report.items() if name not in COPIED}
    return results | {
        "original": asdict(itself),  # with what is declared of it
        "to": {"params": smaller.num_params, "bytes": out.stat().st_size, **reported},
        "query_speedup": speedup,
        "query_milliseconds": times,
        "queried_positions": TIMED_POSITIONS,
        "checked": checked,
    }


def _meet_bounds(
    source: Source, original: Occupancy, file: Path, bounds: Bounds
) -> tuple[Ground, Rung, dict[str, float] | None]:
    """What smaller gates are taught and measured on, what the original itself loses there, and how
    far its threshold was lowered to lose less."""
    drawn = draw_rays(source, original)
    ground = prepare(source, original, *drawn)
    itself = references.measure_original(ground, bounds)
    if ground.measures_original:
        put(f"the original {losses_in_words(itself)}")
    else:
        put("nothing here measures what the original itself loses")
    lower = lower_threshold(ground, bounds)
    if lower is None:
        if itself.verdict != HOLDS:
            put("no threshold is within them, and no smaller gate is looked for")
        return ground, itself, None
    more = round(kept_of_box(lower) / max(kept_of_box(original), 1e-12), 4)
    lowered = {"from": original.threshold, "to": lower.threshold, "kept_volume": more}
    ground = prepare(source, lower, *drawn)
    itself = references.measure_original(ground, bounds)
    put(line_of_lowered(itself, lowered))
    skipped = 1.0 - float(ground.references[0].search.evidence.kept.double().mean())
    if skipped < HARDLY_ANYTHING:
        raise ValueError(
            f"{file} is within these bounds only where it skips {skipped:.1%} of all "
            "candidates, next to nothing: raise --lost-surface-mass, or learn it for more steps"
        )
    return ground, itself, lowered


def _find_smaller(
    ground: Ground, bounds: Bounds, itself: Rung, tell: Callable[[Rung], None]
) -> tuple[Occupancy, Rung]:
    """What is stored, and its rung: the original again where no smaller gate holds.

    Its weights are rounded where autocast rounds them anyway: not a decision changes. Where a
    reference measures it, `itself` gets what is to be declared.
    """
    found, original = Found(None, []), ground.original
    if itself.verdict == HOLDS:
        with bar("Teaching smaller gates") as show:
            found = search(ground, bounds, on_rung=tell, on_progress=show)
    if found.occupancy is not None:
        return found.occupancy, found.rungs[-1]
    if ground.measures_original:
        looks = max((rung.look or 0 for rung in found.rungs), default=0)
        references.verify(ground, original, bounds, itself, looks + 1)
    if original.precision == "bfloat16":
        round_weights(original.gate.hidden)
    return original, itself


def draw_rays(source: Source, original: Occupancy) -> tuple[Sequence[tuple[Seen, Seen]], Seen]:
    """Rays to search on and to verify on, of held-out pixels and others; and rays to teach by."""
    sides = references.pair_sides(source, original, sources.draw_held_out(source, original, RAYS))
    return sides, sources.draw_training_rays(source, original, TAUGHT_RAYS)


def prepare(
    source: Source, original: Occupancy, sides: Sequence[tuple[Seen, Seen]], taught_on: Seen
) -> Ground:
    """What gates are taught and measured on; `ValueError` where nothing there is worth anything."""
    found = references.find_references(source, original, sides)
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
    taught, _ = gather(source.mixture, original, taught_on)
    if source.frozen is not None:  # a candidate weighs what it weighs in any of the fields
        before, _ = gather(source.frozen, None, taught_on)
        taught = taught._replace(weights=taught.weights.maximum(before.weights))
    return Ground(original, taught, found)


def _check_original(original: Occupancy, file: Path, bounds: Bounds) -> None:
    """Raises `ValueError` for what can be refused before the photographs are read."""
    if not 0.0 <= bounds.lost_surface_mass < 1.0 or not math.isfinite(bounds.image_price_db):
        raise ValueError(
            f"--lost-surface-mass is from 0 to 1 and --image-price a number of dB, not "
            f"{bounds.lost_surface_mass} and {bounds.image_price_db}"
        )
    marched = {"cone_angle": 0.0, **original.report}
    for name in ("near", "far", "step_size", "cone_angle"):
        value = marched.get(name)
        known = isinstance(value, int | float) and 0.0 <= value < math.inf
        if not known or (name == "step_size" and value == 0.0):
            raise ValueError(
                f"{file} does not say how its rays are marched: its {name} is {value}; give the "
                "file that a run has left"
            )
    skipped = original.report.get("empty_fraction")
    if original.threshold == 0.0:
        said = "skips nothing, for its threshold is 0"
    elif isinstance(skipped, int | float) and skipped < HARDLY_ANYTHING:
        said = f"skips {skipped:.1%} of all candidates, next to nothing"
    else:
        return
    raise ValueError(f"{file} {said}: there is nothing to shrink; learn it for more steps")


def check_losses(source: Source, original: Occupancy, file: Path, bounds: Bounds) -> None:
    """Raises `ValueError` for an original whose own losses are unknown, or leave nothing of the
    bounds. With the field at freezing the threshold can be lowered, so that any loss will do."""
    if source.model is not None and LOST_DECISIONS in original.report:
        raise ValueError(
            f"{file} was shrunk without its run, so that nobody knows what it has lost of the "
            "surface mass: shrink its original"
        )
    if source.frozen is not None:
        return
    most = bounds.lost_surface_mass
    for name, said, limit, remedy in (
        (LOST_DECISIONS, "has lost {:.2e} of the decisions", most, ", or shrink its original"),
        ("lost_surface_mass", "declares a lost surface mass of {:.2e}", most, ""),
        ("image_price_db", "declares an image price of {:.3f} dB", bounds.image_price_db, ""),
    ):
        lost = references.declared(original, name)
        if not lost < limit:  # nor is NaN
            option = "--image-price" if name == "image_price_db" else "--lost-surface-mass"
            raise ValueError(
                f"the occupancy itself {said.format(lost)}, which leaves nothing of {limit:g}: "
                f"raise {option}{remedy}"
            )


def _check_on_test_photographs(
    source: Source, original: Occupancy, smaller: Occupancy
) -> dict[str, Any] | None:
    """What the smaller gate loses on rays of test photographs, which decided nothing here: worst of
    all references, and by each. None without such photographs, or where nothing measures it."""
    seen = sources.draw_test_rays(source, original, RAYS)
    shares = {} if seen is None else references.measure_shares_lost(source, original, smaller, seen)
    if seen is None or not shares:
        return None
    lost = _named_loss(source.model is None, max(shares.values()))
    return {"rays": len(seen.truth), **lost, "against": shares}


def _report_of(
    ground: Ground,
    smaller: Occupancy,
    rung: Rung,
    is_untrained: bool,
    lowered: Mapping[str, float] | None,
    checked: Mapping[str, Any] | None,
) -> dict[str, Any]:
    """What the stored occupancy declares: the original's loss and, on top, its own.

    It declares no less than rays of test photographs have lost (`checked`). They chose nothing, and
    what holds without them stays beside it.

    Args:
        is_untrained: whether nothing was trained on the pixels of the ground's rays.
        lowered: how far the original's threshold was lowered.
    """
    original = ground.original
    report = {name: original.report[name] for name in COPIED if name in original.report}
    if "cameras" in report:
        report["cameras"] = [[round(float(x), 4) for x in row] for row in report["cameras"]]
    if smaller is original:
        report = {**original.report, **report, "threshold": original.threshold}
    else:
        more = 1.0 if lowered is None else lowered["kept_volume"]
        report |= {
            "params": rung.params,
            "threshold": smaller.threshold,
            "kept_candidates_dropped": rung.verified["kept_candidates_dropped"],
            "shrunk_from_params": original.num_params,
            "kept_volume_of_the_original": round(more * rung.kept_volume, 4),
        }
    if rung.verified:
        measured, first = rung.verified, ground.references[0]
        alone = first.mixture is None
        report |= {
            **_named_loss(alone, measured["lost_surface_mass_bound"]),
            "lost_mass": None if alone else measured["lost_mass"],
            "image_price_db": measured["image_price_db"],
            "empty_fraction": measured["empty_fraction"],
            "calibration_rays": first.verify.evidence.rays,
            "held_out": is_untrained and bool(original.report.get("held_out", False)),
            "loss_measured_against": "; ".join(one.name for one in ground.references),
        }
    lost = None if checked is None else checked["lost_surface_mass"]
    verified = report.get("lost_surface_mass")
    if lost is not None and verified is not None:
        report |= {
            "lost_surface_mass": max(verified, lost),
            "verified_lost_surface_mass": verified,
            "lost_on_test_photographs": lost,
        }
    return report


def _named_loss(alone: bool, share: float | None) -> dict[str, float | None]:
    """A loss by its name: without a field it is one of decisions, and that of surfaces unknown."""
    if alone:
        return {"lost_surface_mass": None, LOST_DECISIONS: share}
    return {"lost_surface_mass": share}


def compare_queries(original: Occupancy, smaller: Occupancy) -> tuple[float, list[float]]:
    """How many times faster the smaller gate answers, in the median of interleaved pairs, and the
    median milliseconds of each."""
    positions = whole_box(original).draw(TIMED_POSITIONS).to(original.threshold_value.device)

    def seconds(occupancy: Occupancy) -> float:
        clock = Clock()
        with clock.running():
            occupancy.occupied(positions)
        return clock.seconds

    pairs = [(seconds(original), seconds(smaller)) for _ in range(TIMED_ROUNDS)][2:]
    ratio = statistics.median(before / after for before, after in pairs)
    return round(ratio, 2), [round(1e3 * statistics.median(times), 3) for times in zip(*pairs)]
