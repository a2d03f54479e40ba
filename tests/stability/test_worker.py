"""The suite on a real host: it trains, it is measured, and who skips a surface is found out."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch

from leco_plugin.chart.contender import Contender
from leco_plugin.chart.protocol import Protocol
from leco_plugin.samplers import registry
from leco_plugin.samplers.grid import DenseEstimator, nested_boxes
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.stability.capture import Capture
from leco_plugin.stability.contenders import DENSE_LEVELS, SAMPLERS, contender_of
from leco_plugin.stability.scene_folder import write_scene
from leco_plugin.stability.sizes import Sizes
from leco_plugin.stability.stages import YARD
from leco_plugin.stability.verdict import judge
from leco_plugin.stability.worker import run_cell

# nerfstudio leaves the images open whose size it has read
pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]

MICRO = Sizes(steps=60, rays=128, learn_rays=64, learn_steps=20, dense_samples=24, table=11)
SMALL = {**MICRO.ngp, "host.cone_angle": 1 / 12, "host.max_res": 64, "host.far_plane": 8.0}


class SkipsHalf(DenseEstimator):
    """Keeps every candidate on one side of the scene, and none on the other."""

    def questions(self) -> Any:
        return lambda positions: positions[:, 0] > 0.0, None


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    capture = Capture(views=12, test_views=2, width=16, height=12)
    return write_scene(YARD, capture, tmp_path_factory.mktemp("stability") / "yard")


def run(contender: Contender, scene: Path, folder: Path) -> dict[str, Any]:
    folder.mkdir()
    protocol = Protocol(steps=MICRO.steps, images=1, curve_points=1)
    record = run_cell(contender, 0, scene, protocol, folder)
    assert (folder / "view.png").exists()
    assert all(math.isfinite(value) for value in record["measured"].values() if value is not None)
    return record


def on_small_host(sampler: str, options: dict[str, int]) -> Contender:
    changes = {**SMALL, "occupancy.sampler": sampler, "occupancy.options": options}
    settings = {"pipeline.datamanager.train_num_rays_per_batch": MICRO.rays}
    return Contender(sampler, "leco-ngp", sampler, changes, settings=settings)


@pytest.mark.slow
def test_who_skips_a_surface_is_found_out(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = SamplerSpec("half", lambda aabb, occupancy=None, levels=1: SkipsHalf(box(aabb, levels)))
    monkeypatch.setitem(registry.OURS, "skips-half", spec)
    dense = run(on_small_host("dense", {"levels": DENSE_LEVELS}), scene, tmp_path / "dense")
    blind = run(on_small_host("skips-half", {"levels": DENSE_LEVELS}), scene, tmp_path / "blind")
    assert judge([dense], None).verdict == "pass"
    assert dense["measured"]["kept_fraction"] == 1.0
    # steps of a twelfth of the distance leave some surfaces between two middles
    assert blind["measured"]["lost_mass"] > dense["measured"]["lost_mass"] + 0.15
    assert judge([blind], [dense]).verdict == "fail"
    assert judge([dense], [dense]).verdict == "pass"
    assert blind["steps"] == dense["steps"] == MICRO.steps


def box(aabb: torch.Tensor, levels: int) -> torch.Tensor:
    return nested_boxes(aabb, levels)[-1]


def test_the_dense_reference_of_a_proposal_host_trains(scene: Path, tmp_path: Path) -> None:
    contender = contender_of(SAMPLERS["dense-proposal"], MICRO, {}, {})
    record = run(contender, scene, tmp_path / "run")
    assert record["measured"]["kept_fraction"] == 1.0
    assert record["steps"] == MICRO.steps and record["train_queries"]["proposal"] == 0
