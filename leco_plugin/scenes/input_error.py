"""The error for what a user can mend: one line on the terminal, and no traceback."""

from __future__ import annotations

import sys
from pathlib import Path
from types import TracebackType


class InputError(ValueError):
    """Something given to a command is wrong; the message names the cause and the remedy.

    It ends `leco` with this one line and status 2, and `ns-*` commands with it and status 1.
    """


def show_one_line_in_ns_commands() -> None:
    """In a process that is an `ns-*` command, an uncaught `InputError` prints its line alone.

    nerfstudio lets exceptions through to Python, which would print a traceback.
    """
    if not any(Path(program).name.startswith("ns-") for program in sys.argv[:1]):
        return
    otherwise = sys.excepthook

    def show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if isinstance(error, InputError):
            print(error, file=sys.stderr)
        else:
            otherwise(kind, error, trace)

    sys.excepthook = show


show_one_line_in_ns_commands()


def require(holds: bool, option: str, value: object, wanted: str) -> None:
    """InputError if the value of an option will not do.

    Args:
        holds: whether it will.
        option: as it is given, without the dashes before it.
        wanted: the values that will do, as `at least 1`.
    """
    if not holds:
        raise InputError(f"{option} is {value}; it must be {wanted}")


def require_folder(option: str, path: Path) -> None:
    """InputError if a path is no folder. The option is as it is given, with its dashes."""
    if not path.is_dir():
        instead = ", but a file" if path.exists() else ""
        raise InputError(f"{option} {path}: there is no such folder{instead}")


def one_line(error: BaseException, most: int | None = None) -> str:
    """What an error says, in one line of at most so many characters; empty if it says nothing."""
    return " ".join(str(error).split())[:most]
