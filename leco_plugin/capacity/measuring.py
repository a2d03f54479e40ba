"""`leco capacity`: one trained field teaches all representations, and what each keeps and loses."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from leco_plugin.capacity.choice import VOLUMES, answer, choose, draw, kilobytes
from leco_plugin.capacity.evidence import RAYS_AT_ONCE, Evidence, gather
from leco_plugin.capacity.search import Candidate, find_threshold, gates, grids
from leco_plugin.capacity.sources import Source, draw_held_out, draw_training_rays
from leco_plugin.chart.runner import SETTINGS, make_jobs, take_folder
from leco_plugin.chart.theme import DARK, LIGHT
from leco_plugin.evaluation import equal_loss
from leco_plugin.evaluation.clock import seconds_now
from leco_plugin.evaluation.field_grids import fits_memory, largest_in_cells
from leco_plugin.evaluation.inspection import ViewBox
from leco_plugin.evaluation.report import describe_code, describe_machine, made_by, read_object
from leco_plugin.learning.freezing import load_state
from leco_plugin.learning.sharpening import Lesson, lesson_from_field, teach
from leco_plugin.log import bar, put
from leco_plugin.models.gate import GateConfig, occupancy_logit
from leco_plugin.models.leco import LecoModel
from leco_plugin.models.mixture import Mixture
from leco_plugin.occupancy import Precision, gate_precision
from leco_plugin.scenes.input_error import InputError, require_folder
from leco_plugin.scenes.photographs import describe_scene
from leco_plugin.scenes.whole_files import alone_in, write_json, write_whole

FIELD = "field.pt"
RAYS, TAUGHT_RAYS = 8192, 1 << 15
VOLUME_POINTS = 1 << 17
STEPS = 3000
"""With which each gate is taught. After 300 small ones still keep two to nine times what they keep
after 1000 (docs/decisions.md)."""


class Taught(NamedTuple):
    """What every representation is taught and measured on."""

    mixture: Mixture
    lesson: Lesson
    held_out: Evidence
    """Dense candidates of pixels that nothing was trained on."""
    ground: equal_loss.Ground
    """Those candidates, and places that rays reach: elsewhere nothing is taught."""


def prepare(data: Path, folder: Path, learn_steps: int) -> Taught:
    """Learns the field, or loads the one that an earlier call left, and renders rays with it.

    Raises:
        InputError: what was left is damaged or of another scene, or the field shows nothing.
    """
    from leco_plugin.hosts.learn_first import learn_model
    from leco_plugin.method_configs import best_device, leco_occupancy

    config: Any = copy.deepcopy(leco_occupancy.config.pipeline)
    config.datamanager.data = data
    config.model.schedule = replace(config.model.schedule, learn_steps=learn_steps)
    device, stored = best_device(), folder / FIELD

    def photographs() -> Any:
        random.seed(0)  # nerfstudio caches images in an order that Python's own generator draws
        torch.manual_seed(0)
        return config.datamanager.setup(device=device, test_mode="val")

    if not stored.exists():
        pipeline = SimpleNamespace(datamanager=photographs(), device=torch.device(device))
        rays = config.datamanager.train_num_rays_per_batch
        learned = learn_model(config.model, pipeline, rays)
        write_whole(stored, lambda file: torch.save(learned.state_dict(), file))
    manager = photographs()  # a manager that has trained would give other rays
    dataset = manager.train_dataset
    model: LecoModel = config.model.setup(
        scene_box=dataset.scene_box,
        num_train_data=len(dataset),
        metadata=dataset.metadata,
        device=device,
    ).to(device)
    beside = f"name a new folder with --out, or delete {stored} and the points beside it"
    load_state(model, stored, model.device, beside)
    return _render_rays(manager, model.eval())


def _render_rays(manager: Any, model: LecoModel) -> Taught:
    torch.manual_seed(1)  # the same rays also where the field was loaded
    mixture = model.mixture
    lesson = lesson_of(manager, model)
    rays = draw_held_out(Source(manager, model), mixture.occupancy().eval(), RAYS, parts=1)[0]
    evidence, _ = gather(mixture, None, rays)
    if not bool(evidence.worth.any()):
        raise InputError(
            "the field shows nothing along held-out rays, so that no loss can be measured: let one "
            "learn longer, with a larger --learn-steps and a new folder at --out"
        )
    volume = equal_loss.reached_volume(mixture, lesson.mapped, VOLUME_POINTS, seed=5)
    mapped = mixture.region.space.map(evidence.positions).clamp(-1.0, 1.0)
    ground = equal_loss.Ground(equal_loss.mapped_box(mixture), mapped, evidence.worth, volume)
    return Taught(mixture, lesson, evidence, ground)


def lesson_of(manager: Any, model: LecoModel) -> Lesson:
    """What a model's field has to teach along rays that it was trained on, nothing skipped."""
    mixture, losses = model.mixture, model.config.gate_loss
    occupancy = mixture.occupancy().eval()
    taught = draw_training_rays(Source(manager, model), occupancy, TAUGHT_RAYS).rays
    return lesson_from_field(mixture, taught, losses, share=0.0, rays_at_once=RAYS_AT_ONCE)


def measure(evidence: Evidence, scores: Tensor, of_volume: Tensor, lost: float) -> dict[str, Any]:
    """What a representation keeps when it loses a given share, and loses at given kept volumes.

    Args:
        scores: [M] of dense candidates.
        of_volume: [P] of places spread evenly over what rays reach of the scene's box.
        lost: share of the weight near surfaces.
    """
    volume, candidates = equal_loss.kept_shares(evidence.worth, scores, of_volume, lost)
    losses = [lost_where(evidence.worth, scores, of_volume, share) for share in VOLUMES]
    return {"kept_volume": volume, "kept_candidates": candidates, "lost_at_volumes": losses}


def lost_where(worth: Tensor, scores: Tensor, of_volume: Tensor, share: float) -> float:
    """Share of the worth [M] of candidates that is lost where just so much of the volume is kept.

    Many cells of a grid may have the score of the threshold. A part of them is kept, drawn by lot:
    all of them would be more than is asked for.
    """
    threshold = find_threshold(of_volume, share)
    above, at = (
        float(part.double().mean()) for part in (of_volume > threshold, of_volume == threshold)
    )
    drawn = min(max((share - above) / at, 0.0), 1.0)
    lost = worth.double() @ ((scores < threshold).double() + (1.0 - drawn) * (scores == threshold))
    return float(lost / worth.double().sum())


def measure_candidate(taught: Taught, candidate: Candidate, lost: float) -> dict[str, Any]:
    """Teaches a gate or a grid and measures it, as it would be stored and asked."""
    started, ground = seconds_now(), taught.ground
    score: Callable[[Tensor], Tensor] | Tensor
    if candidate.gate is None:
        score = taught_grid(taught.lesson, ground.box, int(candidate.size))
    else:
        score = taught_score(candidate.gate, taught.lesson, taught.mixture.precision)
    rows = [
        measure(taught.held_out, of_rays, of_volume, lost) | facts
        for of_rays, of_volume, facts in ground.scores_of(score, lost)
    ]
    found = min(rows, key=lambda one: one["kept_volume"])  # a grid may keep less dilated
    seconds = round(seconds_now() - started, 2)
    named = {"family": candidate.family, "size": candidate.size, "bytes": candidate.bytes}
    return {**named, "seconds": seconds, **found}


def taught_score(
    config: GateConfig, lesson: Lesson, precision: Precision
) -> Callable[[Tensor], Tensor]:
    """The logit [N] of a gate that is taught now, as it would be stored and asked: of mapped
    positions [N, 3]."""
    gate = teach(config, lesson, STEPS, precision)

    @torch.no_grad()
    def score(mapped: Tensor) -> Tensor:
        with gate_precision(mapped.device.type, precision):
            return occupancy_logit(gate(mapped))

    return score


def taught_grid(lesson: Lesson, box: ViewBox, cells: int) -> Tensor:
    """Scores [n, n, n] of a grid that the lesson of the gates teaches: a cell has the largest
    target in it."""
    scores = torch.zeros((cells,) * 3, device=lesson.mapped.device)
    return largest_in_cells(scores, box, lesson.mapped, 1.0 - lesson.skip)


POINTS = "points"
DAMAGED = "is damaged; delete it, or name a new folder with --out"


def capacity(
    data: Path, out: Path, resolutions: Sequence[int], lost_surface_mass: float, learn_steps: int
) -> dict[str, Any]:
    """Teaches and measures what is missing in a folder, and draws all of it, by the options of
    `leco capacity`; returns the results, as in `results.json`. What is finished stays there
    whenever this is stopped. For a wrong folder or size ValueError or OSError, before anything is
    started."""
    if not 0.0 < lost_surface_mass < 0.5:
        raise InputError(f"--lost-surface-mass is {lost_surface_mass}, not between 0 and 0.5")
    if learn_steps < 1:
        raise InputError(f"--learn-steps is {learn_steps}; a field is learned in one or more")
    if any(n < 2 for n in resolutions):
        fewest = min(resolutions)
        raise InputError(f"--grids has {fewest}; a grid has 2 cells or more along an axis")
    require_folder(data, "give that of the scene with --data")
    scene, machine, code = describe_scene(data), describe_machine(), describe_code()
    settings = {
        "lost_surface_mass": lost_surface_mass,
        "learn_steps": learn_steps,
        "teach_steps": STEPS,
        "grids": "by the lesson of the gates",
    }
    words = {"scene": f"points of another scene than {data}"}
    holds = "points with another"
    take_folder(out / SETTINGS, {"scene": scene, **settings}, holds, DAMAGED, words)
    too_large = [n for n in sorted(set(resolutions)) if not fits_memory(n**3)]
    for n in too_large:
        put(f"a grid of {n}^3 cells does not fit the free memory; it is left out")
    candidates = [*gates(), *grids(set(resolutions) - set(too_large))]
    with alone_in(out, "points"):  # two processes would teach by two fields
        taught = prepare(data, out, learn_steps)
        rows = _measure_missing(out, taught, candidates, lost_surface_mass, code)
        results = {
            "format": 1,
            "machine": machine,
            "scene": {**scene, "train_images": taught.mixture.num_images},
            **settings,
            "rays": taught.held_out.rays,
            "representations": rows,
            "chosen": dict(choose(rows)),
            "verdict": answer(rows)[1],
        }
        write_json(out / "results.json", results)
        draw(results, out / "capacity.png", LIGHT)
        draw(results, out / "capacity-dark.png", DARK)
        return results


def _measure_missing(
    out: Path,
    taught: Taught,
    candidates: Sequence[Candidate],
    lost_surface_mass: float,
    code: dict[str, Any],
) -> list[dict[str, Any]]:
    rows: dict[str, dict[str, Any]] = {}
    files = {one.key: out / POINTS / f"{one.key}.json" for one in candidates}
    for one in candidates:
        if (file := files[one.key]).exists():
            rows[one.key] = read_object(file, DAMAGED)
            if rows[one.key].get("bytes") != one.bytes:
                refused = f"{file} is no measured representation"
                raise InputError(f"{refused}; delete it to measure it again")
    todo = [one for one in candidates if one.key not in rows]

    def measure_one(candidate: Candidate, show: Callable[[float], None]) -> str:
        row = measure_candidate(taught, candidate, lost_surface_mass) | made_by(code)
        rows[candidate.key] = row
        write_json(files[candidate.key], row)
        return line_of(row)

    with bar("Teaching representations") as show:
        make_jobs(todo, measure_one, put, show, done=len(rows))
    return [rows[one.key] for one in candidates]


def line_of(row: dict[str, Any]) -> str:
    return (
        f"{row['family']:<10} {row['size']:<10} {kilobytes(row):>10}  keeps "
        f"{row['kept_volume']:>6.2%} of the volume"
    )
