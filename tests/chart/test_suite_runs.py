"""Every contender of every suite can be trained: sizes that a scene chooses are known only then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.chart.contenders.contender import Contender
from leco_plugin.chart.contenders.protocol import Protocol
from leco_plugin.chart.contenders.suites import SUITES
from leco_plugin.chart.runs.worker import run_job
from leco_plugin.evaluation import timed_run

pytestmark = [  # nerfstudio leaves an image open
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

SMALL: dict[str, Any] = {
    "sizes.learn_candidates": 8,
    "sizes.candidates": 16,
    "calibration.rays": 64,
    "schedule.learn_steps": 3,
}
CONTENDERS = {one.alone().key: one for found in SUITES.values() for one in found.contenders}
BY_DEFAULT = {one.alone().key for one in SUITES["losses"].contenders}
"""The others take a minute of one core, and run only when long tests are asked for."""


def smaller(one: Contender) -> Contender:
    """The same comparison in sizes that train in a moment, the scene's own choices kept."""
    small = SMALL
    if one.method != "leco-occupancy":
        small = {f"occupancy.learning.{path}": value for path, value in SMALL.items()}
    changes = {**small, **one.changes}
    if "host.sizes.grid_resolution" in changes:
        changes["host.sizes.grid_resolution"] = 8
    return replace(one, changes=changes, grids=(8,) if one.grids else ())


@pytest.mark.parametrize(
    "one",
    [
        pytest.param(one, id=one.name, marks=() if key in BY_DEFAULT else pytest.mark.long)
        for key, one in CONTENDERS.items()
    ],
)
def test_every_contender_of_every_suite_can_be_trained(
    one: Contender, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timed_run, "CURVE_RAYS", 64)
    monkeypatch.setattr("leco_plugin.evaluation.equal_loss.TAUGHT_RAYS", 256)
    monkeypatch.setattr("leco_plugin.evaluation.equal_loss.VOLUME_POINTS", 4096)
    short = Protocol(steps=6, images=1, curve_points=1)
    run = run_job(smaller(one), 0, tiny_scene, short, tmp_path)
    assert run["steps"] == 6 and run["psnr"] > 0.0
    assert (run["occupancy"] is not None) == one.sampler.startswith("learned-occupancy")
