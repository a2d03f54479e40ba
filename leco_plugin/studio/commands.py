"""How nerfstudio's commands end: in one line where the user can act on what happened.

nerfstudio lets exceptions through to Python, which prints a traceback. The methods that it imports
when a command starts therefore set `sys.excepthook`, in processes of its commands alone.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
import sys
import warnings
from itertools import pairwise
from pathlib import Path
from traceback import walk_tb
from types import FrameType, TracebackType
from typing import Any

from leco_plugin.scenes.input_error import ANOTHER_VERSION, InputError, TrainingStopped

PACKAGE = "leco_plugin"


def is_ns_command(program: str | Path) -> bool:
    """Whether a program, `sys.argv[0]`, is nerfstudio's: `ns-train` and the like, or, with `python
    -m`, a file of `nerfstudio/scripts`."""
    path = Path(program)
    folders = path.parts[:-1]
    return path.name.startswith("ns-") or ("nerfstudio", "scripts") in pairwise(folders)


def show_one_line_in_ns_commands() -> None:
    """In a process of such a command, uncaught errors that a user can act on are one line."""
    otherwise = sys.excepthook
    if hasattr(otherwise, "of_leco_plugin") or not is_ns_command(Path(*sys.argv[:1])):
        return

    def show(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        line = line_of(error)
        if line is None:
            otherwise(kind, error, trace)
        else:
            print(line, file=sys.stderr)

    show.of_leco_plugin = True  # type: ignore[attr-defined]
    sys.excepthook = show


def render_images_without_ffmpeg() -> None:
    """In `ns-render`, only a film needs ffmpeg, and an InputError says so where it is missing;
    nerfstudio asks for it before images, too."""
    program = Path(*sys.argv[:1])
    if not is_ns_command(program) or program.stem not in ("ns-render", "render"):
        return
    from nerfstudio.utils import install_checks

    def check() -> None:
        if re.search(r"--output[-_]format[ =]images\b", " ".join(sys.argv)):
            return
        if shutil.which("ffmpeg") is None:
            raise InputError(
                "ns-render makes a film by ffmpeg, which is not installed: add "
                "--output-format images, or install ffmpeg"
            )

    install_checks.check_ffmpeg_installed = check


NO_USE: tuple[tuple[str, type[Warning], str], ...] = (
    # torch has renamed what nerfstudio's activations are decorated with
    (r"`torch\.cuda\.amp\.custom_(fwd|bwd)", FutureWarning, r"nerfstudio"),
    # nerfstudio's trainer makes its scaler by the old name
    (r"`torch\.cuda\.amp\.GradScaler", FutureWarning, r"nerfstudio"),
    # nerfstudio indexes cameras with lists of tensors; torch still reads them as tuples
    (r"Using a non-tuple sequence for multidimensional indexing", UserWarning, r"nerfstudio"),
    # nerfstudio logs losses without detaching them
    (r"Converting a tensor with requires_grad=True", UserWarning, r"nerfstudio"),
    # nerfstudio asks for four workers to cache images, however few cores there are
    (r"This DataLoader will create 4 worker processes", UserWarning, r"torch"),
    # nerfstudio's ns-eval asks how the figures of a single test photograph scatter
    (r"std_mean\(\): degrees of freedom is <= 0", UserWarning, r"nerfstudio"),
    # torchmetrics warns of an import that nerfstudio's models cause in it
    (r"Importing `spectral_angle_mapper`", FutureWarning, r""),
    # viser 0.2.7, which nerfstudio pins, uses addresses that websockets has renamed
    (r"websockets\.(legacy is|connection was)", DeprecationWarning, r""),
)
"""Message, kind and module of warnings that a user can do nothing about."""


def quiet_imports_of_our_methods() -> None:
    """Hides warnings that a user can do nothing about, in every command of nerfstudio but
    `ns-train` of a method that is not ours.

    Called by the first module of this package that nerfstudio imports, its readers. What it warns
    of earlier cannot be kept from the screen.
    """
    program = Path(*sys.argv[:1])
    trains = program.name.startswith(("ns-train", "train"))
    ours = "".join(sys.argv[1:2]).startswith(("leco-", "switch-nerf"))
    if is_ns_command(program) and (not trains or ours):
        hide_warnings_of_no_use()


def hide_warnings_of_no_use() -> None:
    """Adds a filter for each of `NO_USE`."""
    for message, kind, module in NO_USE:
        warnings.filterwarnings("ignore", message, kind, module)


def line_of(error: BaseException) -> str | None:
    """What a command says of an error; None where only a traceback explains it."""
    if isinstance(error, InputError | TrainingStopped):
        return str(error)
    frames = [frame for frame, _ in walk_tb(error.__traceback__)]
    if (views := _too_few_views(frames)) is not None:
        return (
            "ns-render interpolate flies from one photograph to the next, and there are "
            f"{views} to test with: add --pose-source train"
        )
    if not (_names_what_is_gone(error, frames) or _lacks_a_field(error)):
        return None
    named = next(filter(None, map(_config_read_in, frames)), None)
    return f"the run {named} {ANOTHER_VERSION}" if named else None


def _too_few_views(frames: list[FrameType]) -> int | None:
    """How many views nerfstudio failed to make a path of, if it did for want of a second one."""
    for frame in frames:
        if (
            frame.f_code.co_name == "get_interpolated_poses_many"
            and len(frame.f_locals["poses"]) < 2
        ):
            return len(frame.f_locals["poses"])
    return None


def _config_read_in(frame: FrameType) -> Path | None:
    """The config.yml that a function of nerfstudio reads: of `eval_setup`, or of `ns-train`."""
    path = frame.f_locals.get("config_path")
    path = path or getattr(frame.f_locals.get("config"), "load_config", None)
    is_theirs = str(frame.f_globals.get("__file__", "")).endswith(("eval_utils.py", "train.py"))
    return path if is_theirs and isinstance(path, Path) else None


def _names_what_is_gone(error: BaseException, frames: list[FrameType]) -> bool:
    """Whether yaml failed to make something of this package, but for a library that is missing."""
    of_yaml = [frame for frame in frames if frame.f_globals.get("__name__") == "yaml.constructor"]
    made = [frame.f_locals.get("suffix", frame.f_locals.get("name")) for frame in of_yaml]
    innermost = next((name for name in reversed(made) if isinstance(name, str)), "")
    missing = str(error).partition("No module named ")[2]
    library = bool(missing) and not missing.startswith(f"'{PACKAGE}")
    return f"{innermost}.".startswith(f"{PACKAGE}.") and not library


def _lacks_a_field(error: BaseException) -> bool:
    """Whether a config of this package was read that has not all of today's fields."""
    held: Any = getattr(error, "obj", None)
    if not (isinstance(error, AttributeError) and dataclasses.is_dataclass(held)):
        return False
    ours = f"{type(held).__module__}.".startswith(f"{PACKAGE}.")
    return ours and error.name in {field.name for field in dataclasses.fields(held)}
