"""The folder of a run: who has it, and the sizes that every command finds in it."""

from __future__ import annotations

import atexit
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from leco_plugin.models.compute.ranks import is_first
from leco_plugin.models.sizing.sizes import sizes_in, sizes_to_resume
from leco_plugin.scenes.input_error import InputError
from leco_plugin.scenes.whole_files import write_whole
from leco_plugin.studio.checkpoints import allow_checkpoint_globals, newest_whole, step_of

try:
    import fcntl as _fcntl

    fcntl: Any = _fcntl
except ImportError:  # Windows has no such locks: there only checkpoints are looked for
    fcntl = None

LOCK = ".running"
"""File that a run holds locked; the system lets go of it however the run ends, and one that ends by
itself takes it away where there are such locks."""

_held: dict[Path, int] = {}
"""Descriptors of this process's locks, by folder."""


def claim(folder: Path, checkpoints: Path, load_from: Path | None) -> str | None:
    """Takes a folder for the run of this process until it ends; returns why it cannot be had.

    Args:
        folder: of the run; made where it is missing.
        checkpoints: where the run saves.
        load_from: folder or file that the run resumes from; None is a new run.
    """
    place = folder.resolve()
    if place not in _held:
        folder.mkdir(parents=True, exist_ok=True)
        held = lock(folder)
        if held is None:
            return f"another run is going on in {folder}"
        if not _held:
            atexit.register(_release_all, os.getpid())
        _held[place] = held
    theirs = [path for path in checkpoints.glob("*.ckpt") if step_of(path) >= 0]
    source = None if load_from is None else load_from.resolve()
    if theirs and (source is None or checkpoints.resolve() not in (source, source.parent)):
        release(folder)
        return f"{folder} holds an earlier run, with which this one does not go on"
    return None


def release(folder: Path) -> None:
    """Lets go of a folder before the process ends."""
    held = _held.pop(folder.resolve(), None)
    if held is not None:
        _unlock(folder, held)


def _release_all(process: int) -> None:
    """When a process ends; one that was forked from it has nothing to let go of."""
    if os.getpid() == process:
        for folder in list(_held):
            release(folder)


@contextmanager
def alone_in(folder: Path, work: str) -> Iterator[None]:
    """Keeps a folder from every other process that would make the same runs in it.

    Args:
        folder: made where it is missing.
        work: what is made there, for the message.
    Raises:
        InputError: another process is at work there, or it is no folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{folder} is no folder; name another one with --out") from None
    held = lock(folder)
    if held is None:
        raise InputError(
            f"another process makes the {work} in {folder}; wait for it, or name another folder "
            "with --out"
        )
    try:
        yield
    finally:
        _unlock(folder, held)


def lock(folder: Path, tries: int = 5) -> int | None:
    """An open file in a folder that is locked until it is closed, which the system does for a
    process that ends; None where another process has locked it."""
    held = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR, 0o644)
    if fcntl is None:
        return held
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(held)
        return None
    except OSError:
        return held  # a file system without locks
    if tries > 1 and not _lies_in(folder, held):  # taken away by who held it, or never the same
        os.close(held)
        return lock(folder, tries - 1)
    return held


def _lies_in(folder: Path, held: int) -> bool:
    """Whether the folder's lock is still this open file."""
    try:
        return os.path.samestat(os.stat(folder / LOCK), os.fstat(held))
    except FileNotFoundError:
        return False


def _unlock(folder: Path, held: int) -> None:
    """Takes the lock away while it is held, so that nobody else's is taken away."""
    with suppress(OSError):
        if fcntl is not None and _lies_in(folder, held):
            (folder / LOCK).unlink()
    os.close(held)


CONFIG = "config.yml"


def checkpoint_of(config: Any) -> Path | None:
    """The checkpoint that training goes on from: of a folder, the newest that is whole.

    Raises:
        InputError: the folder holds none.
    """
    if config.load_dir is None:
        path: Path | None = config.load_checkpoint
        return path
    if config.load_step is not None:
        return Path(config.load_dir) / f"step-{config.load_step:09d}.ckpt"
    return newest_whole(config.load_dir)[0]


def with_sizes_of(config: Any, checkpoint: Path | None) -> Any:
    """A trainer's config with the sizes of the run that is gone on with.

    Args:
        checkpoint: that training goes on from; None, or one that is not there, changes nothing.
    Raises:
        InputError: a size has been set by hand, and the run has another one.
    """
    from leco_plugin.models.leco_config import LecoModelConfig

    model = config.pipeline.model
    if checkpoint is None or not isinstance(model, LecoModelConfig) or not checkpoint.exists():
        return config
    allow_checkpoint_globals()
    stored = sizes_in(checkpoint)
    if stored is None:
        return config
    return _with_model(config, replace(model, sizes=sizes_to_resume(model.sizes, stored)))


def keep_sizes(config: Any, model: Any, asked: Any) -> Any:
    """A trainer's config with the sizes that its model has, also in the run's `config.yml`.

    Args:
        asked: the model's config as the command gave it, which is what is stored so far.
    """
    if not _has_mixture(model) or asked.sizes == model.config.sizes:
        return config
    config = _with_model(config, model.config)
    path = config.get_base_dir() / CONFIG
    if is_first() and path.exists():  # what is not to be stored has none
        text = yaml.dump(config)
        write_whole(path, lambda file: file.write(text.encode("utf8")))
    return config


def check_photographs(pipeline: Any) -> None:
    """Whether a run that is gone on with still has the photographs that it was begun with.

    Raises:
        InputError: there are more or fewer; their codes would go to others.
    """
    model: Any = getattr(pipeline, "model", None)
    if not _has_mixture(model):
        return
    now = len(pipeline.datamanager.train_dataset)
    if model.num_train_data != now:
        raise InputError(
            f"the run was begun with {model.num_train_data} training photographs, and the scene "
            f"has {now}: put the same ones there, or begin a new run"
        )


def _has_mixture(model: Any) -> bool:
    """Whether a model is `leco-occupancy`'s, whose sizes may be chosen from the scene."""
    from leco_plugin.models.mixture import Mixture

    return isinstance(getattr(model, "mixture", None), Mixture)


def _with_model(config: Any, model: Any) -> Any:
    return replace(config, pipeline=replace(config.pipeline, model=model))
