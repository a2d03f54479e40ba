"""Claims about benchmarks/kills.py: it sees what a kill has cost."""

from __future__ import annotations

import multiprocessing
import random
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


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


@pytest.fixture
def kills(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import kills

    yield kills


def made(kills: Any, runs: StandIn) -> Any:
    return kills.killed(runs, 0, 1, 0.0, 0.0, random.Random(0))


def test_what_a_process_destroys_of_its_own_is_lost(kills: Any, tmp_path: Path) -> None:
    import stability_page

    run = made(kills, StandIn(tmp_path, (40, 0), (-1, 0), (-1, 0)))
    assert run["step"] == -1 and "psnr" not in run
    (kill,) = run["kills"]
    assert (kill["first"], kill["before"], kill["after"]) == (40, -1, -1)
    assert stability_page.has_lost(kill)


def test_a_run_that_loses_nothing_goes_on_from_where_it_was(kills: Any, tmp_path: Path) -> None:
    import stability_page

    runs = StandIn(tmp_path, (7, 0), (11, 0), (11, 0), (11, 0), (59, 0))
    run = made(kills, runs)
    assert runs.started == [8, 12] and run["psnr"] == 13.0
    assert not stability_page.has_lost(run["kills"][0])


def test_a_damaged_checkpoint_is_a_loss(kills: Any, tmp_path: Path) -> None:
    import stability_page

    run = made(kills, StandIn(tmp_path, (7, 0), (7, 0), (7, 1)))
    assert stability_page.has_lost(run["kills"][0]) and "psnr" not in run
