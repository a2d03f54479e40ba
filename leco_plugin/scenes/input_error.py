"""What ends a command in one line and without a traceback."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """Something given to a command is wrong; the message names the cause and the remedy. It ends
    `leco` with this one line and status 2, `ns-*` commands with status 1."""


class TrainingStopped(RuntimeError):
    """A run cannot go on; the message says at which step, why, and what is left of it. A training
    loop can catch it; `ns-*` commands end with its one line and status 1 (`studio.commands`)."""


ANOTHER_VERSION = (
    "is of another version of leco_plugin: train again, or install the version that made it"
)
"""After what is a run's file."""


@contextmanager
def state_of_this_version() -> Iterator[None]:
    """While the state of a checkpoint is read: InputError for one that lacks or has other keys."""
    try:
        yield
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"the checkpoint {ANOTHER_VERSION}") from error


def require_keys(values: Mapping[str, object], wanted: Iterable[str]) -> None:
    """KeyError unless a state has these keys and no others."""
    if different := values.keys() ^ set(wanted):
        raise KeyError(*sorted(different))


def require(holds: bool, option: str, value: object, wanted: str) -> None:
    """InputError unless the value of an option (named without dashes) is as `wanted`."""
    if not holds:
        raise InputError(f"{option} is {value}; it must be {wanted}")


def require_folder(path: Path, remedy: str) -> None:
    """InputError, with the remedy, if there is no such folder, or it is a file."""
    if path.exists() and not path.is_dir():
        raise InputError(f"{path} is a file, not a folder: {remedy}")
    if not path.exists():
        raise InputError(f"there is no folder {path}: {remedy}")


def one_line(error: BaseException, most: int | None = None) -> str:
    """What an error says, in one line of at most so many characters; empty if it says nothing."""
    said = str(error)
    if isinstance(error, OSError) and error.filename and error.strerror:
        said = f"{error.strerror}: {error.filename}"
    return " ".join(said.split())[:most]


def first_line(error: BaseException) -> str:
    """The first line of an error's message, or the name of its type where that says nothing."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__
