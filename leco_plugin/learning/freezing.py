"""Freezing: advice on what the gate saves, and the files that a run writes then.

A guided field is not trained where the gate skips, so it cannot show what was lost there. The field
that the gate was calibrated on can. It is saved, and smaller gates are measured against it.
"""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from pickle import UnpicklingError

import torch
from torch import nn

from leco_plugin.learning.calibration import Measured
from leco_plugin.learning.run import folder_of
from leco_plugin.log import note, say
from leco_plugin.models.mixture import Mixture
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.whole_files import write_whole

FILE_NAME = "occupancy.safetensors"
FIELD_FILE = "field_at_freezing.pt"
HARDLY_ANYTHING = 0.05
"""Share of all candidates below which a run that skips no more is given advice, and a gate in the
paper's form is taught otherwise."""


def advice_on(measured: Measured, steps: int, recoveries: int) -> str | None:
    """What to do about an occupancy that skips next to nothing after so many steps from its
    beginning or its last recovery; None for one that skips."""
    if measured.threshold == 0.0:
        said = "no threshold keeps the price within its bounds, so nothing is skipped;"
    elif measured.empty_fraction >= HARDLY_ANYTHING:
        return None
    elif recoveries:
        said = "hardly anything is skipped;"
    else:
        said = "hardly anything is skipped, which is right for a scene full of fog; else"
    if recoveries:
        often = "once" if recoveries == 1 else f"{recoveries} times"
        said += f" its gate collapsed {often} before;"
    return (
        f"{said} it learned for {steps} steps, and more usually help: schedule.learn-steps, at "
        "--pipeline.model of leco-occupancy, in a run of twice as many, and at "
        "--pipeline.model.occupancy.learning of guided methods"
    )


def leave_file(occupancy: Occupancy, folder: Path | None) -> None:
    """Leaves an occupancy as `occupancy.safetensors` in the folder of a run, if it has one; made
    where it is missing.

    A disk that is full is said in one line: the checkpoint holds the gate too.
    """
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        occupancy.save(folder / FILE_NAME)
    except OSError as error:
        say(f"{folder / FILE_NAME} could not be written ({error}); a resumed run writes it anew")
        return
    note(f"wrote {folder / FILE_NAME}")


def withdraw_file(folder: Path | None) -> None:
    """Removes the file of a gate that learns again from its folder, if it has one, so that nobody
    is guided by it."""
    if folder is None:
        return
    file = folder / FILE_NAME
    try:
        file.unlink(missing_ok=True)
    except OSError as error:
        say(f"{file} could not be withdrawn ({error}); its gate is of no use")


def leave_field(mixture: Mixture, folder: Path | None) -> None:
    """Leaves a frozen mixture's state in its folder, if it has one: about a third of a checkpoint,
    no optimizer.

    A disk that is full is said in one line; only `leco shrink` is the poorer for it.
    """
    if folder is None:
        return
    try:
        write_whole(folder / FIELD_FILE, lambda file: torch.save(mixture.state_dict(), file))
    except OSError as error:
        say(f"{folder / FIELD_FILE} could not be written ({error}); the run goes on without it")


def carry_over(resumed_from: Path, folder: Path) -> None:
    """Copies the state into the folder of a run that resumes another one, given by a checkpoint or
    its folder of checkpoints, if that has left any."""
    left = folder_of(resumed_from) / FIELD_FILE
    if not left.is_file() or (folder / FIELD_FILE).exists():
        return
    try:
        with left.open("rb") as source:
            write_whole(folder / FIELD_FILE, lambda file: shutil.copyfileobj(source, file))
    except OSError as error:
        say(f"{left} could not be copied ({error}); the run goes on without it")


def field_at_freezing(mixture: Mixture, folder: Path) -> Mixture | None:
    """The mixture of a run as it was when its gate was frozen, as another one; None where none was
    left in the run's folder. ValueError, in one line, if the file is damaged, or of another gate
    than the mixture's."""
    path = folder / FIELD_FILE
    if not path.is_file():
        return None
    frozen = copy.deepcopy(mixture)
    load_state(frozen, path, mixture.device, "move it away")
    if not frozen.gate.decides_as(mixture.gate):
        raise ValueError(f"{path} is of another gate than the run's last checkpoint: move it away")
    return frozen.eval()


def load_state(module: nn.Module, file: Path, device: torch.device, remedy: str) -> None:
    """Gives a module the state in a file. InputError, in one line with the remedy, if the file is
    damaged or its state that of another module."""
    try:
        module.load_state_dict(torch.load(file, map_location=device, weights_only=True))
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, UnpicklingError) as error:
        raise InputError(f"{file} cannot be used ({one_line(error, 200)}): {remedy}") from None
