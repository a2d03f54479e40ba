"""What nerfstudio's main of July 2025 means otherwise than its last release, asked here alone.

Both call themselves 1.1.5, so that a version tells nothing: what is installed is looked at.
"""

from __future__ import annotations

import functools
import inspect
import re
from typing import Any

from nerfstudio.engine.trainer import Trainer

COUNTED_FROM_ZERO = re.compile(
    r"max_num_iterations\s*-\s*self\._start_step"
    r"|range\(\s*self\._start_step\s*,\s*self\.config\.max_num_iterations\s*\)"
)
"""In the source of `Trainer.train` where a resumed run ends after `max_num_iterations` in all."""


@functools.cache
def counts_from_zero() -> bool:
    """Whether `--max-num-iterations` of a resumed run counts the steps before it too."""
    try:
        return COUNTED_FROM_ZERO.search(inspect.getsource(Trainer.train)) is not None
    except (OSError, TypeError):  # installed without its source: then as released
        return False


def end_of(trainer: Any) -> int:
    """Steps of a run when it ends, those before it was resumed included."""
    asked = int(trainer.config.max_num_iterations)
    return asked if counts_from_zero() else int(trainer._start_step) + asked


def iterations_until(end: int, done: int) -> int:
    """The `--max-num-iterations` with which a run goes on after `done` steps and ends at `end`."""
    return end if counts_from_zero() else end - done


def keeps_all_images(config: Any, photographs: int) -> bool:
    """Whether a data manager loads all training photographs at once.

    Args:
        config: of the data manager; the release says so by -1, and main by infinity.
        photographs: how many there are.
    """
    some = config.train_num_images_to_sample_from
    return bool(some == -1 or some >= photographs)
