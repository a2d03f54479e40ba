"""Runs that nobody made, for tables that nobody measured."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from leco_plugin.chart.contender import Job
from leco_plugin.chart.runner import RUNS, RunFailed, Runner
from leco_plugin.stability.cases import cases_named
from leco_plugin.stability.plan import QUICK, samplers_named
from leco_plugin.stability.suite import Suite

TINY = replace(QUICK, picture=0.25, views=0.1)
MEASURED = {
    "lost_mass": 0.001,
    "kept_fraction": 0.25,
    "detail_psnr": None,
    "trivial_psnr": 12.0,
}


def suite(out: Path, cases: tuple[str, ...], samplers: tuple[str, ...], seeds: Any = (0,)) -> Suite:
    return Suite(out, cases_named(cases), samplers_named(samplers), seeds, TINY)


class Runs:
    """Makes runs at once, and remembers them.

    Args:
        psnrs: by name of the sampler, None for no number; 25 dB for others.
        broken: name of a sampler whose runs end without a result.
        stops_at: number of the run at which somebody presses Ctrl-C.
    """

    def __init__(
        self,
        psnrs: dict[str, float | None] | None = None,
        broken: str | None = None,
        stops_at: int | None = None,
        pictures: Path | None = None,
    ) -> None:
        self.made: list[tuple[str, str, int]] = []
        self.psnrs, self.broken, self.stops_at = psnrs or {}, broken, stops_at
        self.pictures = pictures
        self._counting = threading.Lock()

    def __call__(self, scene: str) -> Runner:
        def make(job: Job, show: Callable[[float], None]) -> dict[str, Any]:
            name = job.contender.sampler
            with self._counting:
                if len(self.made) == self.stops_at:
                    raise KeyboardInterrupt
                self.made.append((scene, name, job.seed))
            if name == self.broken:
                raise RunFailed(f"{name} is broken")
            if self.pictures is not None:
                place = self.pictures / "runs" / scene / RUNS / f"{job.name}.png"
                Image.fromarray(np.full((12, 16, 3), 90, np.uint8)).save(place)
            return {
                "sampler": name,
                "seed": job.seed,
                "psnr": self.psnrs.get(name, 25.0),
                "processor_seconds": 10.0,
                "measured": MEASURED,
            }

        return make


def make(made: Suite, runs: Runs) -> dict[str, Any]:
    made.runner = runs  # type: ignore[method-assign]
    made.make(lambda line: None, lambda share: None)
    return made.results()
