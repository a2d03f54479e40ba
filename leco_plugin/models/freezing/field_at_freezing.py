"""The model as it was at the moment of freezing, kept in the run's folder.

A field that goes on guided is not trained where the gate skips, and cannot say what was lost there.
The one that the gate was calibrated on can: it is what smaller gates are held to.
"""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any

import torch

from leco_plugin.models.compute.ranks import say
from leco_plugin.scenes.input_error import one_line
from leco_plugin.scenes.whole_files import write_whole

if TYPE_CHECKING:
    from leco_plugin.models.leco import LecoModel

FILE_NAME = "field_at_freezing.pt"


def leave_field(model: LecoModel, folder: Path) -> None:
    """Leaves a frozen model's state in a folder: about a third of a checkpoint, no optimizer.

    A disk that is full is said in one line; only `leco shrink` is the poorer for it.
    """
    try:
        write_whole(folder / FILE_NAME, lambda file: torch.save(model.state_dict(), file))
    except (OSError, RuntimeError) as error:  # as which torch reports a disk that is full
        say(f"{folder / FILE_NAME} could not be written ({error}); the run goes on without it")


def carry_over(resumed_from: Path, folder: Path) -> None:
    """Copies the state into the folder of a run that resumes another one, if that has left any.

    Args:
        resumed_from: a checkpoint of the other run, or its folder of checkpoints.
        folder: of the run that goes on.
    """
    checkpoints = resumed_from if resumed_from.is_dir() else resumed_from.parent
    left = checkpoints.parent / FILE_NAME
    if not left.is_file() or (folder / FILE_NAME).exists():
        return
    try:
        with left.open("rb") as source:
            write_whole(folder / FILE_NAME, lambda file: shutil.copyfileobj(source, file))
    except OSError as error:
        say(f"{left} could not be copied ({error}); the run goes on without it")


def field_at_freezing(model: LecoModel, folder: Path) -> LecoModel | None:
    """The model as it was when its gate was frozen, as another one; None where none was left.

    Args:
        model: of the run as it is now; it stays as it is.
        folder: of that run.
    Raises:
        ValueError: the file is damaged, or of another gate than the model's. One line.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    frozen = copy.deepcopy(model)
    try:
        state: dict[str, Any] = torch.load(path, map_location=model.device, weights_only=True)
        frozen.load_state_dict(state)
    except (OSError, RuntimeError, ValueError, KeyError, EOFError, UnpicklingError) as error:
        line = one_line(error, 200)
        raise ValueError(f"{path} cannot be used ({line}): move it away") from None
    gates = zip(frozen.gate.parameters(), model.gate.parameters(), strict=True)
    if not all(torch.equal(one, other) for one, other in gates):
        raise ValueError(f"{path} is of another gate than the run's last checkpoint: move it away")
    return frozen.eval()
