"""Claims about `leco_plugin.studio.dynamic_batch`, on the host that uses it."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.data.pixel_samplers import PixelSamplerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipeline, DynamicBatchPipelineConfig
from nerfstudio.utils import writer

from leco_plugin.host_configs import leco_ngp
from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy
from leco_plugin.scenes.pixels import known_distances
from leco_plugin.space import Space, SpaceKind
from leco_plugin.studio.dynamic_batch import (
    MOST_GROWTH,
    MOST_RAYS,
    ClampedDynamicBatchPipeline,
    ClampedDynamicBatchPipelineConfig,
    clamped,
)

TARGET, MOST_PER_RAY = 2048, 32
FIRST = TARGET // MOST_PER_RAY


@pytest.fixture(autouse=True)
def _alone(without_cache: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without what other trainers have to write."""
    monkeypatch.setattr(writer, "GLOBAL_BUFFER", {})
    monkeypatch.setattr(writer, "EVENT_WRITERS", [])


def occupancy(threshold: float, kind: SpaceKind = "contraction") -> Occupancy:
    """Of a gate that has learned nothing: o(x) is about two thirds everywhere."""
    torch.manual_seed(0)
    gate = Gate(GateConfig(EncodingConfig(octaves=1), width=8, layers=1, scene_experts=2))
    return Occupancy(gate, Space(kind, (0.0, 0.0, 0.0), 1.0), threshold)


def config(scene: Path, folder: Path, threshold: float = 0.0, **bounds: int) -> Any:
    """`leco-ngp` in sizes for a test, guided by a file."""
    made: Any = copy.deepcopy(leco_ngp.config)
    file = folder / "occupancy.safetensors"
    occupancy(threshold).save(file)
    made.output_dir, made.timestamp, made.vis = folder, "run", "tensorboard"
    made.logging.local_writer.enable = False
    made.steps_per_eval_image = made.steps_per_save = 0
    made.pipeline.datamanager.data = scene
    made.pipeline.model.occupancy.path = file
    host = made.pipeline.model.host
    host.log2_hashmap_size, host.max_res, host.cone_angle = 8, 32, 1 / 8
    made.pipeline = replace(
        made.pipeline, target_num_samples=TARGET, max_num_samples_per_ray=MOST_PER_RAY, **bounds
    )
    return made


def pipeline_of(made: Any) -> ClampedDynamicBatchPipeline:
    pipeline = made.pipeline.setup(device="cpu", test_mode="val")
    assert isinstance(pipeline, ClampedDynamicBatchPipeline)
    return pipeline


@pytest.fixture(scope="module")
def pipeline(
    tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory
) -> ClampedDynamicBatchPipeline:
    made = config(tiny_scene, tmp_path_factory.mktemp("run"), fewest_rays=16, most_rays=512)
    return pipeline_of(made)


def rays_after(pipeline: ClampedDynamicBatchPipeline, rays: int, samples: int) -> int:
    """Rays of the batch that follows one of so many rays with so many samples."""
    pipeline._set_rays(rays)
    pipeline._update_dynamic_num_rays_per_batch(samples)
    assert int(pipeline.rays_per_batch) == pipeline.dynamic_num_rays_per_batch
    return pipeline.dynamic_num_rays_per_batch


@pytest.mark.parametrize(
    ("rays", "samples", "then"),
    [
        pytest.param(100, TARGET, 100, id="as many samples as wanted"),
        pytest.param(100, 4 * TARGET, 25, id="too many"),
        pytest.param(100, round(TARGET / 1.5), 150, id="too few"),
        pytest.param(100, 2, 200, id="at most doubled"),
        pytest.param(100, TARGET // 3, 200, id="at most doubled, of more"),
        pytest.param(400, 2, 512, id="not above the upper bound"),
        pytest.param(100, 100 * TARGET, 16, id="not below the lower bound"),
        pytest.param(100, 0, 100, id="no samples say nothing"),
        pytest.param(100, 1, 100, id="nor does the one of an empty batch"),
    ],
)
def test_the_batch_follows_the_samples_that_rays_have_within_bounds(
    pipeline: ClampedDynamicBatchPipeline, rays: int, samples: int, then: int
) -> None:
    assert rays_after(pipeline, rays, samples) == then


def test_of_pictures_of_many_sizes_a_sampler_of_nerfstudio_is_asked_for_even_numbers(
    pipeline: ClampedDynamicBatchPipeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes, samples = torch.tensor([[3, 4], [4, 3]]), 4 * TARGET
    monkeypatch.setattr(known_distances, "picture_sizes", lambda dataset: sizes)
    assert rays_after(pipeline, 100, samples) == 25
    plain = PixelSamplerConfig().setup()
    monkeypatch.setattr(pipeline.datamanager, "train_pixel_sampler", plain)
    assert rays_after(pipeline, 100, samples) == 26
    sizes[1] = sizes[0]
    assert rays_after(pipeline, 100, samples) == 25


def test_the_first_batch_keeps_to_the_bounds(tiny_scene: Path, tmp_path: Path) -> None:
    pipeline = pipeline_of(config(tiny_scene, tmp_path, fewest_rays=2 * FIRST))
    assert pipeline.dynamic_num_rays_per_batch == 2 * FIRST
    assert len(pipeline.datamanager.next_train(0)[0]) == 2 * FIRST


def test_the_fake_sample_of_an_empty_batch_is_ignored(tiny_scene: Path, tmp_path: Path) -> None:
    made = config(tiny_scene, tmp_path)
    occupancy(1.0, "box").save(made.pipeline.model.occupancy.path)
    pipeline = pipeline_of(made)
    _, _, metrics = pipeline.get_train_loss_dict(0)
    assert int(metrics["num_samples_per_batch"]) == 1  # VolumetricSampler invents it
    assert metrics["num_rays_per_batch"] == FIRST
    assert len(pipeline.datamanager.next_train(1)[0]) == FIRST
    DynamicBatchPipeline._update_dynamic_num_rays_per_batch(pipeline, 1)
    assert pipeline.dynamic_num_rays_per_batch == FIRST * TARGET


def test_a_batch_of_backdrops_grows_no_faster(tiny_scene: Path, tmp_path: Path) -> None:
    pipeline = pipeline_of(config(tiny_scene, tmp_path, threshold=1.0))
    _, _, metrics = pipeline.get_train_loss_dict(0)
    assert int(metrics["num_samples_per_batch"]) == FIRST  # one a ray
    assert pipeline.dynamic_num_rays_per_batch <= MOST_GROWTH * FIRST


def test_a_resumed_run_goes_on_with_its_batch(tiny_scene: Path, tmp_path: Path) -> None:
    made = config(tiny_scene, tmp_path, fewest_rays=8)
    made.max_num_iterations = 4
    trainer = made.setup()
    trainer.setup()
    trainer.train()
    rays = trainer.pipeline.dynamic_num_rays_per_batch
    assert rays != FIRST

    resumed = replace(made, load_dir=made.get_checkpoint_dir(), timestamp="resumed").setup()
    resumed.setup()
    assert resumed.pipeline.dynamic_num_rays_per_batch == rays
    assert len(resumed.pipeline.datamanager.next_train(4)[0]) == rays

    (checkpoint,) = made.get_checkpoint_dir().iterdir()
    state = torch.load(checkpoint)["pipeline"]
    narrow = pipeline_of(replace(made, pipeline=replace(made.pipeline, most_rays=rays - 1)))
    narrow.load_pipeline(state, 3)
    assert narrow.dynamic_num_rays_per_batch == rays - 1
    evaluated = made.pipeline.setup(device="cpu", test_mode="inference")
    evaluated.load_pipeline(state, 3)  # there is no sampler to tell
    assert int(evaluated.rays_per_batch) == rays
    del state["rays_per_batch"]  # as of nerfstudio's own pipeline
    narrow.load_pipeline(state, 3)
    assert narrow.dynamic_num_rays_per_batch == rays - 1


class TheirPipeline(DynamicBatchPipeline):
    """Of another package."""

    def __init__(self, config: Any, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.theirs = config.theirs


@dataclass
class TheirPipelineConfig(DynamicBatchPipelineConfig):
    """Dynamic batches of another package"""

    _target: type = field(default_factory=lambda: TheirPipeline)
    theirs: int = 7


def test_a_pipeline_of_another_package_is_clamped_too(tiny_scene: Path, tmp_path: Path) -> None:
    made = config(tiny_scene, tmp_path).pipeline
    theirs = clamped(
        TheirPipelineConfig(
            datamanager=made.datamanager,
            model=made.model,
            target_num_samples=TARGET,
            max_num_samples_per_ray=MOST_PER_RAY,
        )
    )
    again = yaml.load(yaml.dump(theirs), Loader=yaml.Loader)
    assert again == theirs == clamped(again)
    pipeline = again.setup(device="cpu", test_mode="val")
    assert isinstance(pipeline, TheirPipeline) and pipeline.theirs == 7
    assert rays_after(pipeline, 100, 1) == 100
    assert rays_after(pipeline, MOST_RAYS, 2) == MOST_RAYS
    assert "rays_per_batch" in pipeline.state_dict()


def test_only_dynamic_batches_are_clamped() -> None:
    plain, ours = VanillaPipelineConfig(), ClampedDynamicBatchPipelineConfig(fewest_rays=3)
    assert clamped(plain) is plain and clamped(ours) is ours
    stock = clamped(DynamicBatchPipelineConfig(target_num_samples=5))
    assert type(stock) is ClampedDynamicBatchPipelineConfig and stock.target_num_samples == 5
