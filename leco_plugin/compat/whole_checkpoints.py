"""Which checkpoints of a run can be gone on with: whole files, and numbers that are finite."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import torch
from torch import nn

from leco_plugin.scenes.input_error import InputError

PREVIOUS = "previous"
"""Ending of the folder, beside that of the checkpoints, with the one before the newest."""


def previous_of(checkpoints: Path) -> Path:
    """The folder with the checkpoint before the newest of a folder of checkpoints."""
    return checkpoints.with_name(f"{checkpoints.name}.{PREVIOUS}")


def damage_of(path: Path) -> str | None:
    """What is wrong with a checkpoint, in a few words; None is nothing.

    torch reads a flipped bit without complaint, although its files carry checksums.
    """
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
    """The newest checkpoint of a folder, or the one before it, that is whole.

    Returns:
        Its path, and a line for each newer one that is damaged.
    Raises:
        InputError: there is none.
    """
    damaged: list[str] = []
    for folder in (checkpoints, previous_of(checkpoints)):
        found = [path for path in folder.glob("*.ckpt") if step_of(path) >= 0]
        for path in sorted(found, key=step_of, reverse=True):
            damage = damage_of(path)
            if damage is None:
                return path, damaged
            damaged.append(f"{path} is damaged ({damage})")
    if not damaged:
        raise InputError(f"there is no checkpoint in {checkpoints}")
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
