"""What a packed host keeps of its rays is opaque when it begins, and in every checkpoint since."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from ball_occupancy import ball_of_the_tiny_scene
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
from small_hosts import pipeline_of, small
from torch import nn

from leco_plugin.hosts import host_watch as opaque_start
from leco_plugin.hosts.guide import Guide
from leco_plugin.hosts.host_watch import begin_opaque
from leco_plugin.hosts.stand_ins import GuidedEstimator
from leco_plugin.models.switch.field import SMALL, SwitchNerfModelConfig
from leco_plugin.scenes.bounds import SceneBounds
from leco_plugin.swap import with_sampler_swapped


class Host(nn.Module):
    """A field whose density has a factor, behind a packed sampler or another."""

    def __init__(self, packed: bool, density: float = 1.0) -> None:
        super().__init__()
        self.field = nn.Module()
        self.field.average_init_density = density  # type: ignore[assignment]
        self.sampler = GuidedEstimator(Guide(), None) if packed else nn.Identity()


LENGTHS = torch.tensor([0.0, 0.05, 0.1, 0.2, 0.0])


def test_half_of_the_rays_that_keep_anything_begin_opaque() -> None:
    host, guide = Host(packed=True), Guide()
    begin_opaque(host, guide, LENGTHS)
    assert host.field.average_init_density == guide.first_density
    assert 1.0 - math.exp(-guide.first_density * 0.1) == pytest.approx(0.9)


def test_all_processes_begin_with_what_the_first_one_has_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    host, guide = Host(packed=True), Guide()
    monkeypatch.setattr(opaque_start, "from_first", lambda make, device: 0.01)
    begin_opaque(host, guide, LENGTHS)
    assert 1.0 - math.exp(-host.field.average_init_density * 0.01) == pytest.approx(0.9)


def test_a_host_that_is_opaque_already_begins_as_it_would() -> None:
    host, guide = Host(packed=True, density=30.0), Guide()
    begin_opaque(host, guide, LENGTHS)
    assert host.field.average_init_density == 30.0
    assert guide.first_density is None


def test_a_field_that_begins_denser_than_is_needed_stays_as_it_is() -> None:
    host, guide = Host(packed=True), Guide()
    host.other = Host(packed=True, density=30.0).field
    begin_opaque(host, guide, LENGTHS)
    assert 1.0 < host.field.average_init_density < 30.0 == host.other.average_init_density
    guide.first_density = 40.0  # as a checkpoint has it
    opaque_start.set_first_density(host, guide)
    assert host.field.average_init_density == host.other.average_init_density == 40.0


def test_a_host_that_draws_a_fixed_number_of_samples_is_left_alone() -> None:
    host, guide = Host(packed=False), Guide()
    begin_opaque(host, guide, LENGTHS)
    assert host.field.average_init_density == 1.0


@pytest.mark.parametrize("host", [Host(packed=True), nn.Linear(1, 1)])
def test_without_rays_or_without_a_factor_nothing_is_done(host: nn.Module) -> None:
    guide = Guide()
    begin_opaque(host, guide, torch.zeros(3) if isinstance(host, Host) else LENGTHS)
    assert guide.first_density is None


def test_switch_nerf_begins_opaque_too_whatever_its_scene_measures() -> None:
    torch.manual_seed(0)
    box = torch.tensor([-2.0] * 3 + [2.0] * 3)
    model = SwitchNerfModelConfig(sizes=SMALL).setup(
        scene_box=SceneBox(box.view(2, 3)), num_train_data=2
    )
    model.set_bounds(SceneBounds("box", torch.zeros(3), 2.0, 0.1, 4.0, box, ""), 2.0)
    positions = torch.rand(200, 3)
    before, own = model.density_fn(positions), model.average_init_density
    assert own == pytest.approx(math.log1p(math.exp(-1.0)) / 2.0)
    guide = Guide()
    begin_opaque(model, guide, LENGTHS)
    assert guide.first_density is None  # its own samples go from end to end
    model.sample_with(GuidedEstimator(guide, None))
    begin_opaque(model, guide, LENGTHS)
    assert guide.first_density is not None and guide.first_density > own
    assert model.average_init_density == pytest.approx(guide.first_density)
    torch.testing.assert_close(model.density_fn(positions), before * guide.first_density / own)


def test_a_checkpoint_brings_the_density_back(
    tiny_scene: Path, tmp_path: Path, without_cache: None
) -> None:
    ball_of_the_tiny_scene().save(tmp_path / "occupancy.safetensors")
    config = with_sampler_swapped(small("instant-ngp"), tmp_path / "occupancy.safetensors")
    begun, reader = (pipeline_of(config, tiny_scene) for _ in range(2))
    attributes = TrainingCallbackAttributes(None, None, begun, None)  # type: ignore[arg-type]
    for callback in begun.get_training_callbacks(attributes):
        callback.run_callback_at_location(0, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    model: Any = begun.model
    assert model.leco_guide.first_density == model.field.average_init_density > 1.0
    assert reader.model.field.average_init_density == 1.0
    reader.model.load_state_dict(model.state_dict())
    assert reader.model.field.average_init_density == model.field.average_init_density
