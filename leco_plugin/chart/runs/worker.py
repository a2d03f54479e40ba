"""One run in a process of its own: `python -m leco_plugin.chart.runs.worker FOLDER`.

The folder holds `job.json`; the run leaves `result.json` in it, or `failure.json` with its reason.
"""

from __future__ import annotations

import copy
import json
import math
import os
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from leco_plugin.scenes.input_error import one_line

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import Trainer, TrainerConfig

    from leco_plugin.chart.contenders.contender import Contender
    from leco_plugin.chart.contenders.protocol import Protocol
    from leco_plugin.models.leco import LecoModel

JOB, RESULT, FAILURE, PROGRESS = "job.json", "result.json", "failure.json", "progress"


def die_with_parent() -> None:
    """Ends this process when the one that started it is gone: its end of our input is then closed.

    A run that nobody waits for would slow the ones that are timed.
    """

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1):
            pass
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def run_job(
    contender: Contender,
    seed: int,
    data: Path,
    protocol: Protocol,
    folder: Path,
    on_progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Trains, evaluates and measures; the record as JSON values. Arguments as of `train_job`."""
    from leco_plugin.chart.contenders.configs import config_of

    budget = protocol.budget(contender.budget)
    config = config_of(contender, data, folder / "nerfstudio", budget.learn_seconds)
    return train_job(config, contender, seed, data, protocol, folder, on_progress)[0]


def train_job(
    config: TrainerConfig,
    contender: Contender,
    seed: int,
    data: Path,
    protocol: Protocol,
    folder: Path,
    on_progress: Callable[[float], None] | None = None,
    *,
    looked_at: bool = True,
) -> tuple[dict[str, Any], Trainer]:
    """Trains, evaluates and measures.

    Args:
        config: of the contender.
        contender, seed: what.
        data: the scene.
        protocol: how long, and how it is evaluated.
        folder: for the occupancy, if there is one, and for nerfstudio's own files.
        on_progress: called with the share that is done.
        looked_at: False leaves the test images, and all figures of them, to the caller.
    Returns:
        A run of `results.json`, with an `occupancy` of its own, as JSON values; and the trainer
        with its model.
    """
    from leco_plugin.evaluation.timed_run import timed_run
    from leco_plugin.models.leco import LecoModel

    budget = protocol.budget(contender.budget)
    frozen: dict[str, Any] = {}

    def when_frozen(trainer: Trainer) -> None:
        model: Any = trainer.pipeline.model
        if isinstance(model, LecoModel) and not model.config.schedule.restart:
            frozen.update(_weights_of(model))

    run, trainer = timed_run(
        config,
        budget,
        sampler=contender.sampler,
        seed=seed,
        curve_points=protocol.curve_points if looked_at else 0,
        images=protocol.images if looked_at else 0,
        on_progress=on_progress,
        on_frozen=when_frozen,
    )
    if looked_at and not math.isfinite(run.psnr):
        raise ValueError("it has diverged: the PSNR at its end is no number")
    facts = _occupancy_of(trainer, data, folder)
    if facts is not None:
        facts["at_equal_loss"] = _at_freezing(trainer, frozen, contender)
        facts["learn_seconds"] = run.learn_seconds
    return {**run.to_dict(), "name": contender.name, "occupancy": facts}, trainer


def _at_freezing(
    trainer: Trainer, frozen: dict[str, Any], contender: Contender
) -> dict[str, Any] | None:
    """What the gate, and representations made of the field, keep of the field as it was when the
    gate was frozen, if it ever was.

    After the run, so that its random numbers know nothing of it; of its memory only the weights
    that were set aside at freezing.
    """
    from leco_plugin.chart.runs.beside import compared

    if not frozen:
        return None
    model: Any = trainer.pipeline.model
    now = _weights_of(model)
    for name, weights in frozen.items():
        getattr(model, name).load_state_dict(weights)
    found: dict[str, Any] | None = None
    try:
        found = compared(model, trainer.pipeline.datamanager, contender)
    except ValueError as error:  # the run itself is whole
        print(error)
    for name, weights in now.items():
        getattr(model, name).load_state_dict(weights)
    return found


def _weights_of(model: LecoModel) -> dict[str, Any]:
    return {name: copy.deepcopy(getattr(model, name).state_dict()) for name in ("gate", "field")}


def _occupancy_of(trainer: Trainer, data: Path, folder: Path) -> dict[str, Any] | None:
    """What is known of the occupancy that a run has left, if any; its file is kept."""
    from leco_plugin.evaluation.occupancy_facts import occupancy_facts, truth_of
    from leco_plugin.learning.freezing import FILE_NAME
    from leco_plugin.occupancy import Occupancy
    from leco_plugin.scenes.photographs import folder_of

    file = trainer.base_dir / FILE_NAME
    if not file.exists():
        return None
    manager = trainer.pipeline.datamanager
    shutil.copyfile(file, folder / FILE_NAME)
    occupancy = Occupancy.load(file, trainer.pipeline.device)
    return occupancy_facts(occupancy, file, manager, truth_of(folder_of(data), manager))


def reason_of(error: BaseException) -> str:
    """An error in one line."""
    said = one_line(error)
    return said if isinstance(error, ValueError) and said else f"{type(error).__name__}: {said}"


def main(folder: Path, run: Callable[..., dict[str, Any]] = run_job) -> int:
    """Makes the run that a folder describes; 0, or 1 and a reason beside it.

    Args:
        run: makes it; arguments as of `run_job`.
    """
    from leco_plugin.chart.contenders.contender import Contender
    from leco_plugin.chart.contenders.protocol import Protocol
    from leco_plugin.evaluation.json_file import write_json
    from leco_plugin.evaluation.machine import describe_code

    die_with_parent()
    code, started = describe_code(), time.monotonic()  # as this process has loaded it
    job = json.loads((folder / JOB).read_text())
    shown = [0.0]

    def show(share: float) -> None:
        if share - shown[0] >= 0.01:
            shown[0] = share
            (folder / PROGRESS).write_text(f"{share:.3f}")

    try:
        result = run(
            Contender.from_dict(job["contender"]),
            job["seed"],
            Path(job["data"]),
            Protocol(**job["protocol"]),
            folder,
            show,
        )
        wall_seconds = round(time.monotonic() - started, 1)
        write_json(folder / RESULT, {**result, "code": code, "wall_seconds": wall_seconds})
    # whatever a method raises is a row of the table, and the others go on
    except BaseException as error:  # noqa: BLE001
        traceback.print_exc()
        write_json(folder / FAILURE, {"reason": reason_of(error)})
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
