"""Checkpoints of nerfstudio: read without unsafe loading, whole, and of runs that were moved."""

from __future__ import annotations

import functools
import inspect
import os
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from leco_plugin.log import say
from leco_plugin.scenes.input_error import ANOTHER_VERSION, InputError

# The function that pickle calls to build a numpy scalar; it has no public name.
_numpy_scalar = np.float64(0).__reduce__()[0]

# What one float64 scalar pickles to: that function, a dtype, and the dtype's own class. numpy 2
# gave the function another address; a file may come from either.
_FLOAT64_SCALAR: list[Any] = [
    (_numpy_scalar, "numpy.core.multiarray.scalar"),
    (_numpy_scalar, "numpy._core.multiarray.scalar"),
    np.dtype,
    type(np.dtype(np.float64)),
]


def allow_checkpoint_globals() -> None:
    """Allows `torch.load` to read float64 numpy scalars, and nothing else, in this process."""
    torch.serialization.add_safe_globals(_FLOAT64_SCALAR)


def refuse_earlier(state_dict: dict[str, Any], prefix: str, name: str) -> None:
    """InputError for the state of a module of before, or of another: one that has anything, but not
    a name of today."""
    names = [key for key in state_dict if key.startswith(prefix)]
    if names and f"{prefix}{name}" not in names:
        version = ANOTHER_VERSION.removeprefix("is ")
        raise InputError(f"the checkpoint is of another method, or {version}")


def previous_of(checkpoints: Path) -> Path:
    """The folder, beside that of the checkpoints, with the one before the newest."""
    return checkpoints.with_name(f"{checkpoints.name}.previous")


def damage_of(path: Path) -> str | None:
    """What is wrong with a checkpoint, in a few words; None is nothing. torch reads a flipped bit
    without complaint, although its files carry checksums."""
    try:
        with zipfile.ZipFile(path) as archive:
            part = archive.testzip()
    except (OSError, zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError) as error:
        return str(error) or type(error).__name__
    return f"the checksum of its part {part} is wrong" if part is not None else None


def step_of(path: Path) -> int:
    """The step in a checkpoint's name, as nerfstudio reads it; -1 is that of any other file."""
    number = path.stem.removeprefix("step-")
    return int(number) if path.suffix == ".ckpt" and number.isdecimal() else -1


def newest_whole(checkpoints: Path) -> tuple[Path, list[str]]:
    """The newest checkpoint of a folder, or the one before it, that is whole, and a line for each
    newer one that is damaged. InputError if there is none."""
    damaged: list[str] = []
    for folder in (checkpoints, previous_of(checkpoints)):
        found = [path for path in folder.glob("*.ckpt") if step_of(path) >= 0]
        for path in sorted(found, key=step_of, reverse=True):
            damage = damage_of(path)
            if damage is None:
                return path, damaged
            damaged.append(f"{path} is damaged ({damage})")
    if not damaged:
        inside = sorted({path.parent for path in checkpoints.glob("*/step-*.ckpt")})
        remedy = f"give {inside[0]}" if inside else "give a run's folder of checkpoints"
        raise InputError(f"there is no checkpoint in {checkpoints}: {remedy}")
    raise InputError(
        f"no checkpoint can be gone on with: {'; '.join(damaged)}; put a copy of one of them back, "
        "or train again"
    )


def first_not_finite(module: nn.Module) -> str | None:
    """Name of the first parameter of a module that holds NaN or infinity; None is none."""
    for name, value in module.named_parameters():
        if value.numel() and not bool(torch.isfinite(value).all()):
            return name
    return None


def config_in_use() -> Path | None:
    """The config.yml that nerfstudio's `eval_setup` is loading; None outside of it. It hands this
    path to nobody, so that it is read where it is called."""
    frame = inspect.currentframe()
    while frame is not None:
        path = frame.f_locals.get("config_path") if frame.f_code.co_name == "eval_setup" else None
        if isinstance(path, Path):
            return path.absolute()
        frame = frame.f_back
    return None


def follow_data(config: Any) -> None:
    """Has a `TrainerConfig` that is being loaded for evaluation name its data where they are now;
    one whose data are nowhere stays as it is: nerfstudio may be about to name others."""
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
    """InputError where a run is being loaded for evaluation, and its data are not there."""
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
            of_runs = any(found.glob("*/*/config.yml"))  # nerfstudio names it as the data
            if not elsewhere and not of_runs:
                return found
    return None


def checkpoints_of(config: Any) -> Path:
    """The folder of a run's checkpoints: that beside the config in use, or the one it names.
    InputError if neither holds a checkpoint."""
    named, path = Path(config.load_dir), config_in_use()
    if path is None:
        return named
    relative = getattr(config, "relative_model_dir", named.name)
    beside = path.parent / relative
    for folder in (beside, named):
        if any(list(each.glob("*.ckpt")) for each in (folder, previous_of(folder))):
            return folder
    raise InputError(
        f"there is no checkpoint in {named}, nor in {beside}: put the folder {relative} of this "
        f"run beside {path}"
    )


def prepare_checkpoints() -> None:
    """Has checkpoints of this process read safely, and nerfstudio, where its loading of runs is
    imported, load the newest whole one. Every model of this package calls it when it is built,
    which is before nerfstudio loads one."""
    allow_checkpoint_globals()
    utils: Any = sys.modules.get("nerfstudio.utils.eval_utils")
    if utils is not None and not hasattr(utils.eval_load_checkpoint, "__wrapped__"):
        utils.eval_load_checkpoint = from_whole(utils.eval_load_checkpoint)


def from_whole(load: Callable[..., tuple[Path, int]]) -> Callable[..., tuple[Path, int]]:
    """nerfstudio's `eval_load_checkpoint`, given the place of a whole file; what is returned raises
    InputError where the run has none.

    A step that a config names is taken where the folder has it. Where it has not, it is the one
    that the run was itself resumed from, in another folder.
    """

    @functools.wraps(load)
    def loading(config: Any, pipeline: Any) -> tuple[Path, int]:
        folder = config.load_dir = checkpoints_of(config)
        step = config.load_step
        if step is None or not (folder / f"step-{step:09d}.ckpt").exists():
            path = whole_of(folder)
            config.load_dir, config.load_step = path.parent, step_of(path)
        return load(config, pipeline)

    return loading


def whole_of(checkpoints: Path, then: str = "{} is loaded instead") -> Path:
    """The newest whole checkpoint of a run, with a line about each newer one that is damaged, and
    what becomes of it `then`. InputError if there is none."""
    path, damaged = newest_whole(checkpoints)
    for line in damaged:
        say(line)
    if damaged:
        say(f"{then.format(path)}, the newest that is whole")
    return path
