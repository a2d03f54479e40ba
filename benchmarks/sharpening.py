"""What sharpening brings: `python benchmarks/sharpening.py RUN=SCENE ...`.

Of runs of `leco-occupancy` that were not sharpened (`--pipeline.model.sharpening.steps 0`). Small
gates are taught with three seeds, each on other training rays. By the field at the end, at the
calibrated thresholds: candidates skipped, and what that loses on held-out pixels and on rays of
test photographs, which nothing was calibrated on. By the field at freezing, which also knows what
is skipped later: volume kept at equal loss. Grids that the same lesson teaches stand beside both,
calibrated by the same rule. Stored in `results/sharpening.json`.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import checkout  # noqa: F401
import torch
from measured_runs import main
from page_parts import machine_line, made_line, size, span, table
from torch import Tensor
from torch.nn.functional import grid_sample

from leco_plugin.capacity.evidence import Evidence, Rendered, gather
from leco_plugin.capacity.measuring import taught_grid
from leco_plugin.capacity.sources import (
    Seen,
    Source,
    draw_held_out,
    draw_test_rays,
    draw_training_rays,
    find_source,
)
from leco_plugin.chart.table import spread
from leco_plugin.cli_occupancy import occupancy_of
from leco_plugin.evaluation.equal_loss import kept_shares, mapped_box, reached_volume
from leco_plugin.evaluation.field_grids import dilate, look_up_scores
from leco_plugin.evaluation.inspection import ViewBox, in_parts
from leco_plugin.learning.calibration import Measured, calibrate, measure
from leco_plugin.learning.dense import DenseRendering, dense_rendering, in_chunks
from leco_plugin.learning.sharpening import (
    Lesson,
    Score,
    SharpeningConfig,
    guided_reference,
    lesson_from_field,
    rescore_rendering,
    sharpen,
    teach,
)
from leco_plugin.log import counted
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.mixture import Mixture
from leco_plugin.models.rendering import Intervals, Rays
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.learning_data import on_black

SEEDS = 3
GRIDS = (32, 64, 96, 128, 256)
KINDS = ("", ", dilated", ", dilated and interpolated")
"""What is made of each grid; whatever keeps least counts."""
LOST = 1e-3
"""Share of the surface mass at which volumes are compared."""
RAYS, PLACES = 8192, 1 << 17
SHOWN = ("threshold", "empty_fraction", "lost_surface_mass", "image_price_db")


def shown(measured: Measured) -> dict[str, float]:
    """Figures of a threshold, as they are stored."""
    return {name: round(float(getattr(measured, name)), 6) for name in SHOWN}


class Priced:
    """Some rays as prices are measured on them, rendered once for all that are asked."""

    def __init__(self, mixture: Mixture, seen: Seen) -> None:
        self.mixture, self.chunks = mixture, in_chunks(seen.rays, 1024)
        given = mixture, seen.rays, on_black(seen.truth), 1024
        self.rendering = dense_rendering(*given, guided_reference)

    def asked(self, score: Score) -> DenseRendering:
        """With what a gate or a grid says of candidates."""
        return rescore_rendering(self.mixture, score, self.chunks, self.rendering)


def taught_by(source: Source, mixture: Mixture) -> dict[str, Any]:
    """Small gates of three seeds by a field that was trained guided, beside what guided it and
    beside grids of the same lessons."""
    model = source.model
    assert model is not None
    occupancy = mixture.occupancy().eval()
    held_out = draw_held_out(source, occupancy, RAYS, parts=1)[0]
    tests = draw_test_rays(source, occupancy, RAYS)
    assert tests is not None
    losses, calibration = model.config.gate_loss, model.config.calibration
    on_held_out, on_tests = (Priced(mixture, seen) for seen in (held_out, tests))
    rows, grids = [], []
    for seed in range(SEEDS):
        taught = rays_that_teach(source, occupancy, seed)
        started = time.process_time()
        found = sharpen(
            mixture,
            taught,
            (held_out.rays, on_black(held_out.truth)),
            [],  # no photograph vouches: other test rays say what a new view loses
            [],
            losses,
            calibration,
            SharpeningConfig(),
        )
        assert found is not None
        seconds = time.process_time() - started
        small = partial(mixture.occupancies, gate=found.gate)
        after = measure(on_tests.asked(small), found.measured.threshold)
        rows.append(
            {"seconds": round(seconds, 1), "held_out": shown(found.measured), "test": shown(after)}
        )
        print(f"  seed {seed}: {rows[-1]}", flush=True)
        lesson = lesson_from_field(mixture, taught, losses, 1.0, 1024)
        of_seed = {}
        for name, (_, score) in grids_of(mixture, lesson).items():
            measured = calibrate(on_held_out.asked(score), calibration, spent=mixture.report)
            after = measure(on_tests.asked(score), measured.threshold)
            of_seed[name] = {"held_out": shown(measured), "test": shown(after)}
        grids.append(of_seed)
    routing = partial(mixture.occupancies, gate=mixture.gate)
    before = measure(on_tests.asked(routing), float(mixture.threshold))
    first = {"held_out": shown(found.before), "test": shown(before)}
    return {"before": first, "small": rows, "grids": grids}


def rays_that_teach(source: Source, occupancy: Occupancy, seed: int) -> Rays:
    """Training rays, others for each seed."""
    torch.manual_seed(seed)
    return draw_training_rays(source, occupancy, SharpeningConfig().rays).rays


def grids_of(mixture: Mixture, lesson: Lesson) -> dict[str, tuple[int, Score]]:
    """Grids of one lesson as `KINDS` has them, by name: bytes as bits, and the score."""
    found: dict[str, tuple[int, Score]] = {}
    box = mapped_box(mixture)
    for n in GRIDS:
        filled = taught_grid(lesson, box, n)
        wide = dilate(filled)
        made = (
            partial(look_up_scores, filled, box),
            partial(look_up_scores, wide, box),
            partial(interpolated, wide, box),
        )
        size = -(-(n**3) // 8)
        found |= {f"grid {n}^3{kind}": (size, one) for kind, one in zip(KINDS, made, strict=True)}
    return found


def interpolated(scores: Tensor, box: ViewBox, mapped: Tensor) -> Tensor:
    """Scores [nx, ny, nz] between the middles of cells: of mapped positions [N, 3], [N]."""
    places = ((mapped - box.low) / (box.high - box.low) * 2.0 - 1.0).flip(-1)[None, None, None]
    given = scores[None, None], places
    return grid_sample(*given, align_corners=False, padding_mode="border").flatten()


def at_equal_loss(source: Source, mixture: Mixture) -> tuple[list[dict[str, Any]], float]:
    """Volume that is kept where `LOST` of the surface mass is lost, on three kinds of rays; and the
    share of the weight near surfaces of test rays that photographs confirm."""
    model, config = source.model, SharpeningConfig()
    assert model is not None
    occupancy = mixture.occupancy().eval()
    losses = model.config.gate_loss
    lessons = [
        lesson_from_field(mixture, rays_that_teach(source, occupancy, seed), losses, 0.0, 1024)
        for seed in range(SEEDS)
    ]
    lesson = lessons[0]
    tests = draw_test_rays(source, occupancy, RAYS)
    assert tests is not None
    of_tests, rendered = gather(mixture, None, tests)
    right, share = confirmed(mixture, of_tests, rendered)
    evidence: dict[str, Evidence] = {
        "held_out": gather(mixture, None, draw_held_out(source, occupancy, RAYS, parts=1)[0])[0],
        "test": of_tests,
        "confirmed": right,
    }
    places = reached_volume(mixture, lesson.mapped, PLACES, seed=5)
    rivals = {
        "learned gate": (2 * occupancy.num_params, partial(mixture.occupancies, gate=mixture.gate))
    }
    for seed, heard in enumerate(lessons):
        gate = teach(config.gate, heard, config.steps, mixture.precision)
        size = 2 * sum(p.numel() for p in gate.parameters())
        rivals[f"small gate, seed {seed}"] = (size, partial(mixture.occupancies, gate=gate))
    rivals |= grids_of(mixture, lesson)
    rows = []
    for name, (size, score) in rivals.items():
        of_volume, row = in_parts(score, places), {"name": name, "bytes": size}
        for kind, rays in evidence.items():
            mapped = mixture.region.space.map(rays.positions).clamp(-1.0, 1.0)
            kept = kept_shares(rays.worth, in_parts(score, mapped), of_volume, LOST)
            row[kind] = {"volume": round(kept[0], 5), "candidates": round(kept[1], 5)}
        rows.append(row)
        print(f"  {row}", flush=True)
    return rows, share


@torch.no_grad()
def confirmed(
    mixture: Mixture, evidence: Evidence, rendered: Sequence[Rendered]
) -> tuple[Evidence, float]:
    """The same evidence, in which only rays have surfaces whose pixel is better rendered with them
    than without: before the others the field has floaters. And the share of the worth that stays.
    """
    of_rays, first = [], 0
    for one in rendered:
        last = first + int(one.before_backdrop.sum())
        rest = torch.ones_like(one.before_backdrop)
        rest[one.before_backdrop] = evidence.worth[first:last] == 0.0
        without = mixture.shade(one.rays, Intervals(*(part[rest] for part in one.intervals))).rgb
        errors = [(rgb - one.truth).square().sum(dim=-1) for rgb in (one.rgb, without)]
        of_rays.append(errors[0] < errors[1])
        first = last
    worth = evidence.worth * torch.cat(of_rays)[evidence.ray_indices]
    share = float(worth.sum()) / max(float(evidence.worth.sum()), 1e-12)
    return evidence._replace(worth=worth), share


def row_of(run: Path, data: Path) -> dict[str, Any]:
    """All figures of one run."""
    file = occupancy_of(run)
    source = find_source(file, data)
    assert isinstance(source.model, LecoModel) and source.frozen is not None
    if source.model.mixture.small is not None:
        raise SystemExit(
            f"{run} is sharpened already: train with --pipeline.model.sharpening.steps 0"
        )
    at_end = taught_by(source, source.model.mixture.eval())
    rows, share = at_equal_loss(source, source.frozen)
    return {
        "learned_params": sum(p.numel() for p in source.frozen.gate.parameters()),
        "at_end": at_end,
        "at_equal_loss": rows,
        "confirmed_share": round(share, 4),
    }


def sharpening_sections(report: dict[str, Any]) -> list[str]:
    """The stored figures as a part of `docs/results.md`."""
    scenes = report["scenes"].items()
    guided = table(
        "scene | skipped by the learned gate | by small gates | surface lost on test rays | s"
        " | by the best grid, taught alike | surface lost on test rays",
        [_guided_row(scene, found["at_end"]) for scene, found in scenes],
    )
    equal, right = (
        table(
            "scene | learned gate | small gate | best grid up to 256³, taught alike",
            [_equal_row(scene, found, kind) for scene, found in scenes],
        )
        for kind in ("test", "confirmed")
    )
    # rows that were made before shares were stored have none
    shares = [found["confirmed_share"] for _, found in scenes if "confirmed_share" in found]
    where = f"of the weight on {counted(len(shares), 'scene')}"
    confirm = f" Photographs confirm {span(shares, '.0%')} {where}." if shares else ""
    return [
        "## Sharpened occupancies\n",
        "`python benchmarks/sharpening.py RUN=SCENE ...`, of runs of `ns-train leco-occupancy "
        "--max-num-iterations 700 --pipeline.model.sharpening.steps 0`; "
        f"{machine_line(report)}. Rows {made_line(report['scenes'].values())}.\n",
        "The field at the end teaches small gates, each of three on other training rays. Shares "
        "are of candidates on held-out rays, at the calibrated thresholds; losses are of what the "
        "learned gate keeps. Seconds of one core are for teaching and calibrating. Grids of 32³ to "
        "256³ cells have the same lessons and the same rule, as they are, dilated by a cell, or "
        "interpolated between cells too; the one that skips most counts. Where 0% is skipped, the "
        "learned gate has left too little of the bound for any threshold: it stays then.\n",
        *guided,
        f"\nAt {LOST:g} of the surface lost *on test rays*, by the field at freezing: volume kept "
        "of what rays reach; candidates kept on those rays; bytes. Of the same grids the one that "
        "keeps least.\n",
        *equal,
        "\nThe same where only rays count whose photograph is better rendered with their surface "
        f"than without it. Before the others the field has floaters.{confirm}\n",
        *right,
        "",
    ]


def best_grid(found: dict[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    """Of the grids at the end of a run the one that skips most, in the median of its lessons."""
    of_seeds = found["grids"]
    return max(
        ((name, [one[name] for one in of_seeds]) for name in of_seeds[0]),
        key=lambda named: statistics.median(skipped_by(named[1])),
    )


def skipped_by(rows: list[dict[str, Any]]) -> list[float]:
    """Shares of candidates on held-out rays."""
    return [row["held_out"]["empty_fraction"] for row in rows]


def kept_by_grids(report: dict[str, Any]) -> str:
    """How many candidates the best grid keeps at the end of a run, beside small gates: for
    `docs/results.md`."""
    times = []
    for found in report["scenes"].values():
        grid, small = (
            1.0 - statistics.median(skipped_by(rows))
            for rows in (best_grid(found["at_end"])[1], found["at_end"]["small"])
        )
        times.append(grid / small)
    return (
        f"At the end of a run, by the run's own rule, the best of such grids keeps {span(times)} "
        f"times as many candidates as the small gate, on {len(times)} scenes"
    )


def _guided_row(scene: str, found: dict[str, Any]) -> list[str]:
    small = found["small"]
    name, grids = best_grid(found)
    return [
        scene,
        f"{found['before']['held_out']['empty_fraction']:.1%}",
        spread(skipped_by(small), ".1%"),
        spread([row["test"]["lost_surface_mass"] for row in small], ".1e"),
        spread([row["seconds"] for row in small], ".0f"),
        f"{spread(skipped_by(grids), '.1%')} ({name[5:]})",
        spread([row["test"]["lost_surface_mass"] for row in grids], ".1e"),
    ]


def _equal_row(scene: str, found: dict[str, Any], kind: str) -> list[str]:
    rows = {row["name"]: row for row in found["at_equal_loss"]}
    small = [row for name, row in rows.items() if name.startswith("small gate")]
    best = min(
        (row for name, row in rows.items() if name.startswith("grid")),
        key=lambda row: row[kind]["volume"],
    )
    return [
        scene,
        _kept([rows["learned gate"]], kind),
        _kept(small, kind),
        f"{_kept([best], kind)} ({best['name'][5:]})",
    ]


def _kept(rows: list[dict[str, Any]], kind: str) -> str:
    volume, candidates = (
        spread([row[kind][name] for row in rows], ".1%") for name in ("volume", "candidates")
    )
    return f"{volume}; {candidates}; {size(rows[0]['bytes'] / 1e3)}"


if __name__ == "__main__":
    main(row_of, "sharpening")
