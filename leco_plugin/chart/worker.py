"""One run of a chart in a process of its own: `python -m leco_plugin.chart.worker FOLDER`."""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from leco_plugin.chart.runner import FAILURE, JOB, PROGRESS, RESULT, die_with_parent
from leco_plugin.scenes.input_error import one_line
from leco_plugin.scenes.whole_files import write_json

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import Trainer, TrainerConfig

    from leco_plugin.chart.contender import Contender, Protocol

WORKER = (sys.executable, "-W", "ignore", "-m", "leco_plugin.chart.worker")
SMALL_GATES = {
    "MLP": "frequency-6-32-2",
    "hash grid": "hash-4-10",
    "TensoRF planes": "vm-32-4",
    "K-planes": "k-planes-32-4-1",
}
"""A gate of each kind that keeps little for its bytes in `leco capacity`: 5 to 27 kB."""
TAUGHT_GRIDS = (32, 64, 128, 256)
"""Cells along an axis of grids that are taught as small gates are."""
BYTES_A_POINT = 6
"""Its three numbers in half precision."""


def run_job(*job: Any) -> dict[str, Any]:
    """The record of `train_job`, which takes the same arguments."""
    return train_job(*job)[0]


def train_job(
    contender: Contender,
    seed: int,
    data: Path,
    protocol: Protocol,
    folder: Path,
    on_progress: Callable[[float], None] | None = None,
    *,
    adapt: Callable[[TrainerConfig], TrainerConfig] = lambda config: config,
    looked_at: bool = True,
) -> tuple[dict[str, Any], Trainer]:
    """Trains by the contender's config, which `adapt` may change, evaluates and measures.

    Args:
        folder: for the occupancy, if there is one, and for nerfstudio's own files.
        looked_at: False leaves the test images, and all figures of them, to the caller.
    Returns:
        A run of `results.json`, with its `occupancy`, as JSON values; and the trainer.
    """
    from leco_plugin.chart.contender import config_of
    from leco_plugin.evaluation.equal_loss import take_occupancy
    from leco_plugin.evaluation.timed_run import timed_run
    from leco_plugin.scenes.scene_file import file_in

    budget = protocol.budget()
    place = folder / "nerfstudio"
    config = config_of(contender, data, place, budget.learn_seconds, protocol.held_out)
    run, trainer = timed_run(
        adapt(config),
        budget,
        sampler=contender.sampler,
        seed=seed,
        curve_points=protocol.curve_points if looked_at else 0,
        images=protocol.images if looked_at else 0,
        on_progress=on_progress,
    )
    left = take_occupancy(trainer, file_in(data).parent, folder)
    facts = None if left is None else left[1]
    if facts is not None:
        facts["at_equal_loss"] = _at_freezing(trainer, contender)
        facts["learn_seconds"] = run.learn_seconds
    return {**run.to_dict(), "name": contender.name, "occupancy": facts}, trainer


def _at_freezing(trainer: Trainer, contender: Contender) -> dict[str, Any] | None:
    """What `compare_at_freezing` finds with the field of the moment of freezing; None without.
    Measured after the run, so that neither its time nor its random numbers change."""
    import torch

    from leco_plugin.learning.freezing import field_at_freezing
    from leco_plugin.models.leco import LecoModel

    model: Any = trainer.pipeline.model
    if not isinstance(model, LecoModel) or model.config.schedule.restart:
        return None
    now = model.mixture
    try:
        with torch.random.fork_rng():
            frozen = field_at_freezing(now, trainer.base_dir)
        if frozen is None:
            return None
        for number, remains in enumerate(now.field.experts.left.tolist(), 1):
            if not remains:  # which left just after
                frozen.field.experts.drop(number)
        model.mixture = frozen
        return compare_at_freezing(model, trainer.pipeline.datamanager, contender)
    except ValueError as error:  # the run itself is whole
        print(error)
        return None
    finally:
        model.mixture = now


def compare_at_freezing(model: Any, datamanager: Any, contender: Contender) -> dict[str, Any]:
    """What the gate keeps at equal loss, beside grids and small gates made from the same field.

    Returns:
        As `at_equal_loss`. For a contender with small gates, `taught` holds for each of
        `SMALL_GATES` its `name`, `bytes`, `seconds` of teaching and what it keeps; `others` the
        same of grids that had the same lesson, and of the scene's sparse points, where what lies
        near one is kept. `learned_first` says whether the field is needed.
    Raises:
        ValueError: held-out rays see no surface.
    """
    from leco_plugin.evaluation.equal_loss import at_equal_loss, mapped_box, near_points

    if not contender.taught:
        return at_equal_loss(model.mixture, datamanager, contender.grids)
    from leco_plugin.capacity.measuring import lesson_of, taught_grid, taught_score
    from leco_plugin.capacity.search import gates
    from leco_plugin.chart.representations import SPARSE
    from leco_plugin.evaluation.clock import Clock
    from leco_plugin.learning.dense import evaluating
    from leco_plugin.scenes.survey import sparse_points

    known = {gate.key: gate for gate in gates()}
    clock = Clock()
    clock.start()
    with evaluating(model):
        lesson = lesson_of(datamanager, model)
    of_lesson = clock.stop()
    scores: dict[str, Any] = {}
    rows: dict[str, list[dict[str, Any]]] = {"taught": [], "others": []}

    def add(kind: str, name: str, make: Callable[[], Any], before: float, **facts: Any) -> None:
        clock.start()
        scores[name] = make()
        rows[kind].append({"name": name, "seconds": round(before + clock.stop(), 2), **facts})

    for name, key in SMALL_GATES.items():
        config = known[key].gate
        assert config is not None
        teach = partial(taught_score, config, lesson, model.mixture.precision)
        add("taught", name, teach, of_lesson, bytes=known[key].bytes)
    box = mapped_box(model.mixture)
    for cells in TAUGHT_GRIDS:
        fill = partial(taught_grid, lesson, box, cells)
        add("others", f"taught grid {cells}³", fill, of_lesson, learned_first=True)
    points = sparse_points(datamanager.train_dataset)
    if points is not None:
        near = partial(near_points, model.mixture.region.space.map(points.to(model.device)))
        facts = {"bytes": BYTES_A_POINT * len(points), "learned_first": False}
        add("others", SPARSE, near, 0.0, **facts)
    found = at_equal_loss(model.mixture, datamanager, contender.grids, others=scores)
    kept = found.pop("others")
    for row in (row for some in rows.values() for row in some):
        row |= kept[row["name"]]
        row["bytes"] = row.pop("octree_bytes", row.get("bytes"))
    return found | rows


def main(folder: Path, run: Callable[..., dict[str, Any]] = run_job) -> int:
    """Makes the run that a folder describes, by a function as `run_job`: the other side of
    `ProcessRunner`. Its record is left in the folder, or the reason why there is none; returns 0,
    or 1 on failure."""
    from leco_plugin.chart.contender import Contender, Protocol
    from leco_plugin.evaluation.clock import seconds_now
    from leco_plugin.evaluation.report import describe_code

    die_with_parent()
    code, started = describe_code(), seconds_now()  # as this process has loaded it
    shown = 0.0

    def show(share: float) -> None:
        nonlocal shown
        if share - shown >= 0.01:
            shown = share
            (folder / PROGRESS).write_text(f"{share:.3f}")

    try:
        job = json.loads((folder / JOB).read_text())
        contender, protocol = Contender.from_dict(job["contender"]), Protocol(**job["protocol"])
        found = run(contender, job["seed"], Path(job["data"]), protocol, folder, show)
        # the name that stored charts have; in one thread on a CPU they are the processor's
        seconds = round(seconds_now() - started, 1)
        write_json(folder / RESULT, {**found, "code": code, "wall_seconds": seconds})
    # whatever a method raises is a row of the table, and the others go on
    except BaseException as error:  # noqa: BLE001
        traceback.print_exc()
        said = one_line(error)
        reason = said if isinstance(error, ValueError) and said else None
        write_json(folder / FAILURE, {"reason": reason or f"{type(error).__name__}: {said}"})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
