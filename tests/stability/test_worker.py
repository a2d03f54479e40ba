"""One run of a case on real hosts, and who skips a surface in it."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.chart import worker
from leco_plugin.chart.contender import Contender, Job, Protocol
from leco_plugin.chart.runner import JOB, PROGRESS, RESULT
from leco_plugin.samplers import registry
from leco_plugin.samplers.base import DenseEstimator
from leco_plugin.samplers.boxes import nested_boxes
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.scenes.whole_files import write_json
from leco_plugin.stability.photographs import YARD, Capture, write_scene
from leco_plugin.stability.plan import DENSE_LEVELS, SAMPLERS, Sizes, contender_of
from leco_plugin.stability.verdict import judge
from leco_plugin.stability.worker import run_cell

# where a host samples does not depend on what its field has learned
MICRO = Sizes(steps=3, rays=64, learn_rays=64, learn_steps=20, dense_samples=24, table=8)
# steps short enough that no surface lies between two middles and near neither
SMALL = {
    **MICRO.host(in_nerfacto=False),
    "host.cone_angle": 1 / 20,
    "host.max_res": 32,
    "host.far_plane": 8.0,
}


class SkipsHalf(DenseEstimator):
    """Keeps every candidate on one side of the scene, and none on the other."""

    def questions(self) -> Any:
        return lambda positions: positions[:, 0] > 0.0, None


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    capture = Capture(views=6, test_views=2, width=16, height=12)
    return write_scene(YARD, capture, tmp_path_factory.mktemp("stability") / "yard")


@pytest.fixture(autouse=True)
def nothing_reads_the_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "die_with_parent", lambda: None)


def run(contender: Contender, scene: Path, folder: Path) -> dict[str, Any]:
    folder.mkdir()
    shared = {"data": str(scene), "protocol": asdict(Protocol(steps=MICRO.steps))}
    write_json(folder / JOB, Job(contender, 0).values | shared)
    assert worker.main(folder, run_cell) == 0
    record: dict[str, Any] = json.loads((folder / RESULT).read_text())
    assert (folder / PROGRESS).read_text() == "1.000"
    assert (folder / "view.png").exists()
    assert record["steps"] == MICRO.steps and 0.0 < record["psnr"] < 60.0
    assert record["curve"] == [] and record["ssim"] is None  # nobody else has looked
    assert all(math.isfinite(value) for value in record["measured"].values() if value is not None)
    return record


def on_small_host(sampler: str) -> Contender:
    base = contender_of(SAMPLERS["dense"], MICRO, {}, {})
    return replace(base, sampler=sampler, changes={**base.changes, **SMALL, **sampled_by(sampler)})


def sampled_by(sampler: str) -> dict[str, Any]:
    return {"occupancy.sampler": sampler, "occupancy.options": {"levels": DENSE_LEVELS}}


def test_the_dense_reference_of_a_packed_host_loses_no_surface(scene: Path, tmp_path: Path) -> None:
    measured = run(on_small_host("dense"), scene, tmp_path / "run")["measured"]
    assert measured["kept_fraction"] == 1.0
    assert measured["lost_mass"] < 0.01


def test_a_packed_host_that_skips_half_of_the_scene_loses_its_surfaces(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = SamplerSpec(
        "half", lambda aabb, occupancy=None, levels=1: SkipsHalf(nested_boxes(aabb, levels)[-1])
    )
    monkeypatch.setitem(registry.OURS, "skips-half", spec)
    measured = run(on_small_host("skips-half"), scene, tmp_path / "run")["measured"]
    assert 0.1 < measured["kept_fraction"] < 0.9
    assert measured["lost_mass"] > 0.2
    # found out even where its pictures are as good as the reference's
    blind = {"psnr": 25.0, "seed": 0, "measured": {**measured, "trivial_psnr": 12.0}}
    dense = {**blind, "measured": {**blind["measured"], "lost_mass": 0.0, "detail_psnr": None}}
    assert judge([dense], [dense]).verdict == "pass"
    assert judge([blind], [dense]).verdict == "fail"


def test_a_dense_proposal_host_samples_everywhere(scene: Path, tmp_path: Path) -> None:
    contender = contender_of(SAMPLERS["dense-proposal"], MICRO, {}, {})
    record = run(contender, scene, tmp_path / "run")
    assert record["measured"]["kept_fraction"] == 1.0
    assert record["train_queries"]["proposal"] == 0
