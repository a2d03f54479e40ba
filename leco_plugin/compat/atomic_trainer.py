"""nerfstudio's trainer, with checkpoints that are whole or absent whenever it is killed."""

from __future__ import annotations

import os
import shutil

from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.decorators import check_main_thread


class AtomicTrainer(Trainer):
    """Set as `_target` of a `TrainerConfig`.

    nerfstudio writes a checkpoint in place, and resuming takes the file with the highest step: one
    that was cut off half-way ends every attempt to go on, even with a whole one beside it.
    """

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Writes the checkpoint of `step` beside the folder of checkpoints, then moves it in.

        Beside, because nerfstudio reads a step out of every file name in that folder.
        """
        checkpoints = self.checkpoint_dir
        beside = checkpoints.with_name(f"{checkpoints.name}.unfinished")
        self.checkpoint_dir = beside
        try:
            super().save_checkpoint(step)
        finally:
            self.checkpoint_dir = checkpoints
        unfinished = beside / f"step-{step:09d}.ckpt"
        with unfinished.open("rb") as file:
            os.fsync(file.fileno())
        checkpoints.mkdir(parents=True, exist_ok=True)
        finished = unfinished.replace(checkpoints / unfinished.name)
        shutil.rmtree(beside)  # with whatever a killed process has left there
        if self.config.save_only_latest_checkpoint:
            for older in checkpoints.glob("*.ckpt"):
                if older != finished:
                    older.unlink()
