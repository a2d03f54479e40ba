"""ns-eval, ns-render, ns-export and ns-viewer on a run that was moved after it was trained.

A run's config names its data and its checkpoints by the paths of its training. What is no longer
there is looked for around the config that the command was given.
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

from leco_plugin.compat.whole_checkpoints import previous_of
from leco_plugin.models.compute.ranks import say
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

    Args:
        config: a `TrainerConfig`, just read from its file.
    Raises:
        InputError: they are nowhere around the file.
    """
    path = config_in_use()
    manager: Any = getattr(config.pipeline, "datamanager", None)
    parser = getattr(manager, "dataparser", None)
    named = getattr(manager, "data", None) or getattr(parser, "data", None)
    if path is None or named is None or Path(named).exists():
        return
    found = found_around(Path(named), path.parent)
    if found is None:
        raise InputError(
            f"{named}, with the data of this run, is not there: put it, or a link with the name "
            f"{Path(named).name}, beside {path}"
        )
    say(f"{named} is not there; the data are read from {found}")
    config.data = manager.data = found
    if parser is not None:
        parser.data = found


def found_around(named: Path, folder: Path) -> Path | None:
    """What a path has become that was moved together with a folder, or put into it; None if lost.

    As much of the path as possible is found again, in the folder or one that holds it.
    """
    folder = folder.resolve()
    around = [place for place in (folder, *folder.parents) if place != place.parent]
    parts = named.parts[1:] if named.is_absolute() else named.parts
    for first in range(len(parts)):
        for place in around:
            found = place.joinpath(*parts[first:])
            if found.exists() and found.resolve() not in around:  # a run may have its data's name
                return found
    return None


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
