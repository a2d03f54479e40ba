"""One run of a case on real hosts; and what a sampler keeps and loses of a known scene."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.model_components.ray_samplers import UniformSampler
from torch import Tensor

from leco_plugin.chart import worker
from leco_plugin.chart.contender import Contender, Job, Protocol
from leco_plugin.chart.runner import JOB, PROGRESS, RESULT
from leco_plugin.hosts.proposal import DenseSampler
from leco_plugin.samplers import registry
from leco_plugin.samplers.base import DenseEstimator, Estimator
from leco_plugin.samplers.boxes import nested_boxes
from leco_plugin.samplers.registry import SamplerSpec
from leco_plugin.scenes.whole_files import write_json
from leco_plugin.stability.cases import CASES
from leco_plugin.stability.photographs import TRUTH, YARD, Capture, write_scene
from leco_plugin.stability.plan import DENSE_LEVELS, SAMPLERS, Sizes, contender_of
from leco_plugin.stability.verdict import judge
from leco_plugin.stability.worker import (
    FEWEST_VIEWS,
    NEAR,
    RASTER,
    count_lost,
    find_samples,
    measure,
    raster,
    run_cell,
)

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
    write_json(folder / JOB, asdict(Job(contender, 0)) | shared)
    assert worker.main(folder, run_cell) == 0
    record: dict[str, Any] = json.loads((folder / RESULT).read_text())
    assert (folder / PROGRESS).read_text() == "1.000"
    assert (folder / "view.png").exists()
    assert record["steps"] == MICRO.steps and 0.0 < record["psnr"] < 60.0
    assert record["curve"] == [] and record["ssim"] is None  # nobody else has looked
    assert all(math.isfinite(value) for value in record["measured"].values() if value is not None)
    return record


def on_small_host(sampler: str) -> Contender:
    base = contender_of(SAMPLERS["dense"], MICRO, CASES["yard"])
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
    contender = contender_of(SAMPLERS["dense-proposal"], MICRO, CASES["yard"])
    record = run(contender, scene, tmp_path / "run")
    assert record["measured"]["kept_fraction"] == 1.0
    assert record["train_queries"]["proposal"] == 0


RADIUS = 0.5
"""Of the ball around the origin that the rays meet."""
FAR = 2.0
"""From the origin to where the rays begin."""
AABB = torch.tensor([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])


def bundle(count: int = 64) -> tuple[RayBundle, Tensor]:
    """Rays towards the origin, and how far they go to the ball."""
    generator = torch.Generator().manual_seed(0)
    outward = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    ends = torch.zeros(count, 1), torch.full((count, 1), 2 * FAR)
    rays = RayBundle(FAR * outward, -outward, torch.ones(count, 1), None, *ends)
    return rays, torch.full((count,), FAR - RADIUS)


class Shell(Estimator):
    """Keeps what is as far from the origin as the ball is wide, give or take."""

    def __init__(self, radius: float, width: float) -> None:
        super().__init__()
        self.radius, self.width = radius, width

    def questions(self) -> Any:
        return lambda x: (x.norm(dim=-1) - self.radius).abs() < self.width, None

    def bounds(self) -> None:
        return None


def packed(estimator: Estimator) -> Any:
    config = SimpleNamespace(near_plane=0.05, far_plane=20.0, render_step_size=0.02, cone_angle=0.0)
    return SimpleNamespace(
        config=config, occupancy_grid=estimator, scene_aabb=AABB, device=torch.device("cpu")
    )


def lost(model: Any) -> tuple[float, float]:
    """Share of the rays whose surface is lost, and of the candidates that are kept."""
    rays, depth = bundle()
    nearest, count, most = find_samples(model, rays, depth, 64)
    return float((nearest > NEAR * depth).float().mean()), count / most


def test_who_keeps_the_surface_loses_nothing_however_much_else_is_skipped() -> None:
    share, kept = lost(packed(Shell(RADIUS, 0.03)))
    assert share == 0.0 and 0.0 < kept < 0.1


def test_who_keeps_another_place_loses_every_surface() -> None:
    share, kept = lost(packed(Shell(0.9, 0.1)))
    assert share == 1.0 and kept > 0.0


def test_a_ray_without_samples_is_lost() -> None:
    rays, depth = bundle()
    nearest, count, _ = find_samples(packed(Shell(50.0, 0.1)), rays, depth, 64)
    assert nearest.isinf().all() and count == 0


def test_a_ray_that_meets_nothing_is_not_asked_about() -> None:
    rays, _ = bundle(4)
    nowhere = torch.full((4,), math.inf)
    nearest, _, _ = find_samples(packed(Shell(RADIUS, 0.1)), rays, nowhere, 64)
    assert not (nearest <= 1e9).any()


@pytest.mark.parametrize(("samples", "share"), [(256, 0.0), (3, 1.0)])
def test_a_proposal_host_loses_what_its_samples_are_far_from(samples: int, share: float) -> None:
    sampler = DenseSampler(samples=samples, initial_sampler=UniformSampler())
    model = SimpleNamespace(proposal_sampler=sampler.eval(), density_fns=[], collider=None)
    assert lost(model) == (share, pytest.approx(samples / 64))


def test_only_surfaces_that_enough_training_pictures_show_can_be_lost() -> None:
    depth = torch.tensor([2.0, 2.0, 2.0, 2.0, math.inf])
    nearest = torch.tensor([0.01, 0.5, math.inf, 0.5, math.inf])
    shown_by = torch.tensor([9, 9, FEWEST_VIEWS, FEWEST_VIEWS - 1, 0])
    assert count_lost(nearest, depth, shown_by) == (2, 3)


def test_a_raster_takes_its_share_of_every_row_and_every_column() -> None:
    taken = raster(9, 12).view(9, 12).float()
    for share in (taken.mean(dim=0), taken.mean(dim=1)):
        torch.testing.assert_close(share, torch.full_like(share, 1 / RASTER))


HEIGHT, WIDTH = 9, 12
DETAIL = 4
"""Columns of a picture, at its left, that show what a case is about."""


class Painter:
    """A host whose pictures are wrong by a known amount: by 0.1 everywhere, by 0.3 in the columns
    of the detail."""

    def __init__(self) -> None:
        vars(self).update(vars(packed(Shell(RADIUS, 0.1))))

    def __call__(self, rays: RayBundle) -> dict[str, Tensor]:
        assert rays.metadata is not None
        column = rays.metadata["column"]
        return {"rgb": (0.5 + torch.where(column < DETAIL, 0.3, 0.1)).expand(-1, 3)}


class Pictures:
    """Grey held-out pictures from the origin, whose rays know their column."""

    def __init__(self, folder: Path, many: int, metres: float = math.inf) -> None:
        (folder / TRUTH).mkdir()
        self.image_filenames = [folder / "images" / f"{n}.png" for n in range(many)]
        facts = {
            "depth": np.full((HEIGHT, WIDTH), metres, np.float32),
            "detail": np.arange(WIDTH)[None].repeat(HEIGHT, 0) < DETAIL,
            "shown_by": np.full((HEIGHT, WIDTH), FEWEST_VIEWS * math.isfinite(metres)),
        }
        for file in self.image_filenames:
            np.savez(folder / TRUTH / f"{file.stem}.npz", **facts)
        poses = torch.eye(4)[None, :3].repeat(many, 1, 1)
        self.lens = Cameras(poses, 12.0, 12.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)

    @property
    def cameras(self) -> Pictures:
        return self

    def to(self, device: str) -> Pictures:
        return self

    def generate_rays(self, camera_indices: int) -> RayBundle:
        rays: RayBundle = self.lens.generate_rays(camera_indices=camera_indices)
        columns = torch.arange(WIDTH).expand(HEIGHT, WIDTH)[..., None]
        rays.metadata = {"column": columns}
        return rays

    def get_data(self, number: int) -> dict[str, Tensor]:
        return {"image": torch.full((HEIGHT, WIDTH, 3), 0.5)}


def pipeline_of(pictures: Pictures, scale: float) -> Any:
    """Of a host that keeps a shell around the origin; `scale` is scene units a metre."""
    outputs = SimpleNamespace(dataparser_scale=scale)
    manager = SimpleNamespace(eval_dataset=pictures, train_dataparser_outputs=outputs)
    return SimpleNamespace(
        datamanager=manager, model=Painter(), device="cpu", eval=lambda: None, train=lambda: None
    )


@pytest.mark.parametrize(("metres", "lost"), [(4.0 * RADIUS, 0.0), (RADIUS, 1.0)])
def test_surfaces_are_looked_for_in_scene_units(metres: float, lost: float, tmp_path: Path) -> None:
    pipeline = pipeline_of(Pictures(tmp_path, 1, metres), scale=0.25)
    assert measure(pipeline, tmp_path, 64)[0].lost_mass == lost


def test_errors_of_pictures_are_those_of_the_pixels_that_are_looked_at(tmp_path: Path) -> None:
    found, shown = measure(pipeline_of(Pictures(tmp_path, 2), scale=1.0), tmp_path, 64)
    third = DETAIL / WIDTH
    assert found.psnr == pytest.approx(-10 * math.log10(third * 0.09 + (1 - third) * 0.01))
    assert found.detail_psnr == pytest.approx(-10 * math.log10(0.09))
    assert found.lost_mass is None and found.trivial_psnr == pytest.approx(120.0)
    assert shown.shape == (HEIGHT, WIDTH, 3) and set(shown[0, :, 0]) == {204, 153}


def test_who_saw_nothing_paints_the_mean_colour_of_all_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, colours = Pictures(tmp_path, 2), ((0.2, 0.5, 0.8), (0.6, 0.5, 0.4))
    images = [torch.tensor(colour).expand(HEIGHT, WIDTH, 3) for colour in colours]
    monkeypatch.setattr(pictures, "get_data", lambda number: {"image": images[number]})
    found, _ = measure(pipeline_of(pictures, scale=1.0), tmp_path, 64)
    squared = (0.2**2 + 0.0 + 0.2**2) / 3  # (0.4, 0.5, 0.6) is the mean
    assert found.trivial_psnr == pytest.approx(-10 * math.log10(squared))
