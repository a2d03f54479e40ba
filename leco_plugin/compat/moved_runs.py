"""ns-eval, ns-render, ns-export and ns-viewer on a run that was moved after it was trained.

A run's config names its data and its checkpoints by the paths of its training. What is no longer
there is looked for around the config that the command was given.
"""

from __future__ import annotations

import inspect
import os
from pathlib import Path
from typing import Any

from leco_plugin.compat.whole_checkpoints import previous_of
from leco_plugin.log import say
from leco_plugin.scenes.input_error import InputError


def config_in_use() -> Path | None:
    """The config.yml that nerfstudio's `eval_setup` is loading; None outside of it.

    `eval_setup` hands this path to nobody, so that it is read where it is called.
    """
    frame = inspect.currentframe()
    while frame is not None:
        path = frame.f_locals.get("config_path") if frame.f_code.co_name == "eval_setup" else None
        if isinstance(path, Path):
            return path.absolute()
        frame = frame.f_back
    return None


def follow_data(config: Any) -> None:
    """Has a config that is being loaded for evaluation name its data where they are now.

    A config whose data are nowhere stays as it is: nerfstudio may be about to name others.

    Args:
        config: a `TrainerConfig`, just read from its file.
    """
    path = config_in_use()
    manager: Any = getattr(getattr(config, "pipeline", None), "datamanager", None)
    parser = getattr(manager, "dataparser", None)
    named = getattr(manager, "data", None) or getattr(parser, "data", None)
    if path is None or named is None or os.path.exists(named):
        return
    found = found_around(Path(named), path.parent)
    if found is None:
        return
    say(f"{named} is not there; the data are read from {found}")
    config.data = manager.data = found
    if parser is not None:
        parser.data = found


def require_data(named: Path) -> None:
    """Called where data are read.

    Raises:
        InputError: a run is being loaded for evaluation, and its data are not there.
    """
    path = config_in_use()
    if path is not None and not os.path.exists(named):
        raise InputError(
            f"{named}, with the data of this run, is not there: put it, or a link with the name "
            f"{named.name}, beside {path}"
        )


def found_around(named: Path, folder: Path) -> Path | None:
    """What a path has become that was moved together with a folder, or put into it; None if lost.

    As much of the path as possible is found again, in the folder or one that holds it. Scenes'
    files share one name: one that is not in the folder has to be in a folder of its old name too.
    """
    folder = folder.resolve()
    around = [place for place in (folder, *folder.parents) if place != place.parent]
    parts = named.parts[1:] if named.is_absolute() else named.parts
    for first in range(len(parts)):
        for place in around:
            found = place.joinpath(*parts[first:])
            if not os.path.exists(found) or found.resolve() in around:
                continue
            elsewhere = found.is_file() and parts[first:] == parts[-1:] and place != folder
            if not elsewhere and not holds_runs(found):
                return found
    return None


def holds_runs(folder: Path) -> bool:
    """Whether this is nerfstudio's folder of the runs on some data, which has the data's name."""
    return any(folder.glob("*/*/config.yml"))


def checkpoints_of(config: Any) -> Path:
    """The folder of a run's checkpoints: that beside the config in use, or the one it names.

    Raises:
        InputError: neither holds a checkpoint.
    """
    named, path = Path(config.load_dir), config_in_use()
    if path is None:
        return named
    beside = path.parent / named.name
    for folder in (beside, named):
        if any(list(each.glob("*.ckpt")) for each in (folder, previous_of(folder))):
            return folder
    raise InputError(
        f"there is no checkpoint in {named}, nor in {beside}: put the folder {named.name} of this "
        f"run beside {path}"
    )
