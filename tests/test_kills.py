"""Claims about benchmarks/kills.py: it sees what a kill has cost."""

from __future__ import annotations

import multiprocessing
import random
import time
from pathlib import Path
from typing import Any

import kills
from stability_page import has_lost


class StandIn:
    """Runs that only sleep, and the steps of their newest checkpoints, look by look."""

    def __init__(self, folder: Path, *newest: tuple[int, int]) -> None:
        self.folder, self.looks = folder, iter(newest)
        self.started: list[int] = []

    def newest(self, name: str) -> tuple[int, int]:
        return next(self.looks)

    def start(self, name: str, seed: int, done: int) -> Any:
        self.started.append(done)
        seconds = 60 if len(self.started) == 1 else 0
        process = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(seconds,))
        process.start()
        return process

    def end(self, name: str) -> dict[str, Any]:
        return {"step": 59, "psnr": 13.0, "frozen": True}


def made(runs: StandIn) -> Any:
    return kills.train_with_kills(runs, 0, 1, 0.0, 0.0, random.Random(0))


def test_what_a_process_destroys_of_its_own_is_lost(tmp_path: Path) -> None:
    run = made(StandIn(tmp_path, (40, 0), (-1, 0), (-1, 0)))
    assert run["step"] == -1 and "psnr" not in run
    (kill,) = run["kills"]
    assert (kill["first"], kill["before"], kill["after"]) == (40, -1, -1)
    assert has_lost(kill)


def test_a_run_that_loses_nothing_goes_on_from_where_it_was(tmp_path: Path) -> None:
    runs = StandIn(tmp_path, (7, 0), (11, 0), (11, 0), (11, 0), (59, 0))
    run = made(runs)
    assert runs.started == [8, 12] and run["psnr"] == 13.0
    assert not has_lost(run["kills"][0])


def test_a_damaged_checkpoint_is_a_loss(tmp_path: Path) -> None:
    run = made(StandIn(tmp_path, (7, 0), (7, 0), (7, 1)))
    assert has_lost(run["kills"][0]) and "psnr" not in run
