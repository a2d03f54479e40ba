"""`ns-train` in a process that kills itself with SIGKILL at an exact moment.

Meant for the forkserver of `multiprocessing`: nerfstudio is imported once, and each run is a fork.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts import train as ns_train

from leco_plugin.learning import collapse
from leco_plugin.learning.collapse import Collapse
from leco_plugin.learning.freezing import FILE_NAME
from leco_plugin.models.leco import LecoModel
from leco_plugin.occupancy import Occupancy
from leco_plugin.samplers import estimator
from leco_plugin.scenes.whole_files import PART
from leco_plugin.studio.commands import show_one_line_in_ns_commands
from leco_plugin.studio.trainer import AtomicTrainer

FREEZES_AT = 11
"""The step at which the runs of the tests freeze their gate."""

HEALED_FREEZES_AT = 17
"""The same after `collapse_once`: the first phase is half as long again."""

MOMENTS: dict[str, tuple[type, str, Callable[..., bool]]] = {
    "while it learns": (AtomicTrainer, "train_iteration", lambda _, step: step == 8),
    "with a part of the occupancy's file": (
        type(Path()),
        "open",
        lambda path, *_: path.name.endswith(PART) and FILE_NAME in path.name,
    ),
    "with the occupancy's file written": (Occupancy, "save", lambda *_: True),
    "with the frozen checkpoint not yet in its place": (
        Trainer,
        "save_checkpoint",
        lambda _, step: step == FREEZES_AT,
    ),
    "with the frozen checkpoint written": (
        AtomicTrainer,
        "save_checkpoint",
        lambda _, step: step == FREEZES_AT,
    ),
    "while it is guided": (AtomicTrainer, "train_iteration", lambda _, step: step == 17),
    "after it has been healed": (AtomicTrainer, "train_iteration", lambda _, step: step == 14),
}
"""Owner and name of a function, and the arguments of the call that it does not survive: the process
dies when that call has returned."""


def die_after(owner: type, name: str, fatal: Callable[..., bool]) -> None:
    """Makes a function kill its process."""
    function = getattr(owner, name)

    def dies(*arguments: Any, **options: Any) -> Any:
        result = function(*arguments, **options)
        if fatal(*arguments):
            os.kill(os.getpid(), signal.SIGKILL)
        return result

    setattr(owner, name, dies)


def collapse_once() -> None:
    """Has the gate found collapsed at the end of the first phase, once."""
    found = [Collapse("the gate calls all space empty")]

    def find_collapse(kept: float, shares: torch.Tensor, at_the_end: bool) -> Collapse | None:
        return found.pop() if at_the_end and found else None

    collapse.FEWEST_STEPS = 0
    collapse.find_collapse = find_collapse


def leave_out_the_cache() -> None:
    """Has the gate asked directly: building its cell cache would take most of so short a run."""

    def refuse(*arguments: Any, **options: Any) -> None:
        raise ValueError("a test is short")

    estimator.build_cache = refuse


def show_what_was_loaded(path: Path) -> None:
    """Has a run save what it begins its first step with."""
    train = Trainer.train

    def saves_and_trains(self: Trainer) -> None:
        optimizers = {k: v.state_dict() for k, v in self.optimizers.optimizers.items()}
        torch.save({"pipeline": self.pipeline.state_dict(), "optimizers": optimizers}, path)
        train(self)

    Trainer.train = saves_and_trains


def spoil_a_batch(step: int) -> None:
    """Has one pixel of one batch be no number."""
    losses = LecoModel.get_loss_dict

    def spoiled(self: LecoModel, outputs: Any, batch: Any, *rest: Any) -> Any:
        if self.plan.step == step:
            batch["image"][3, 1] = torch.nan
        return losses(self, outputs, batch, *rest)

    LecoModel.get_loss_dict = spoiled  # type: ignore[method-assign]


def press_ctrl_c(step: int) -> None:
    """Has somebody press Ctrl-C in the middle of a step."""
    train_iteration = AtomicTrainer.train_iteration

    def interrupted(self: AtomicTrainer, now: int) -> Any:
        if now == step:
            os.kill(os.getpid(), signal.SIGINT)
        return train_iteration(self, now)

    AtomicTrainer.train_iteration = interrupted  # type: ignore[method-assign]


def run(
    arguments: list[str],
    log: Path,
    moment: str | None = None,
    loaded: Path | None = None,
    collapses: bool = False,
    spoiled: int | None = None,
    interrupted: int | None = None,
) -> None:
    """`ns-train` with these arguments; the target of a process.

    Args:
        log: file for what it prints.
        moment: of `MOMENTS`, when it dies; None is never.
        loaded: file for what it begins its first step with.
        collapses: whether the gate is found collapsed once.
        spoiled: step whose batch holds a value that is not finite.
        interrupted: step in which somebody presses Ctrl-C.
    """
    with log.open("wb") as printed:
        os.dup2(printed.fileno(), sys.stdout.fileno())
        os.dup2(printed.fileno(), sys.stderr.fileno())
    torch.set_num_threads(1)
    leave_out_the_cache()
    if moment is not None:
        die_after(*MOMENTS[moment])
    if loaded is not None:
        show_what_was_loaded(loaded)
    if collapses:
        collapse_once()
    if spoiled is not None:
        spoil_a_batch(spoiled)
    if interrupted is not None:
        press_ctrl_c(interrupted)
    sys.argv = ["ns-train", *arguments]
    show_one_line_in_ns_commands()
    try:
        ns_train.entrypoint()
    except Exception:  # noqa: BLE001  as Python itself ends, which a fork does otherwise
        sys.excepthook(*sys.exc_info())
        sys.exit(1)
