"""ns-eval, ns-render, ns-export and ns-viewer on a run whose newest checkpoint is damaged.

nerfstudio takes the file with the highest step whatever is in it: one that was cut off ends the
command in a traceback, and a flipped bit is evaluated without a word.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from leco_plugin.compat.moved_runs import checkpoints_of
from leco_plugin.compat.whole_checkpoints import newest_whole, step_of
from leco_plugin.log import say

EVAL_UTILS = "nerfstudio.utils.eval_utils"


def evaluate_whole_checkpoints() -> None:
    """Has nerfstudio, where its loading of runs is imported, load the newest checkpoint that is
    whole.

    Called by every model of this package when it is built, which is before nerfstudio loads a
    checkpoint. Calling it again changes nothing.
    """
    utils: Any = sys.modules.get(EVAL_UTILS)
    if utils is None or hasattr(utils.eval_load_checkpoint, "__wrapped__"):
        return
    utils.eval_load_checkpoint = from_whole(utils.eval_load_checkpoint)


def from_whole(load: Callable[..., tuple[Path, int]]) -> Callable[..., tuple[Path, int]]:
    """nerfstudio's `eval_load_checkpoint`, given the place of a whole file.

    A step that a config names is taken where the folder has it. Where it has not, it is the one
    that the run was itself resumed from, in another folder.

    Raises:
        InputError: by what is returned, where the run has no whole checkpoint.
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


def whole_of(checkpoints: Path) -> Path:
    """The newest whole checkpoint of a run, with a line about each newer one that is damaged.

    Raises:
        InputError: there is none.
    """
    path, damaged = newest_whole(checkpoints)
    for line in damaged:
        say(line)
    if damaged:
        say(f"{path} is loaded instead, the newest that is whole")
    return path
