"""The two methods of this file are what their names say, before anything of them runs."""

from __future__ import annotations

from typing import Any

import pytest

from leco_plugin.method_configs import (
    STEPS,
    best_device,
    leco_occupancy,
    leco_occupancy_paper,
)
from leco_plugin.models.sizing.sizes import left_open, sizes_for
from leco_plugin.scenes.photographs import LecoPhotographs
from leco_plugin.scenes.pixels.held_out_pixels import HeldOutPixelSampler
from leco_plugin.studio.cooldown import CooldownSchedulerConfig

METHODS = {"leco-occupancy": leco_occupancy, "leco-occupancy-paper": leco_occupancy_paper}


def test_the_papers_method_has_the_papers_sizes() -> None:
    model: Any = leco_occupancy_paper.config.pipeline.model
    sizes, experts = model.sizes, model.sizes.field.experts
    assert (experts.width, experts.layers, experts.scene_experts) == (256, 7, 8)
    assert (sizes.candidates, sizes.learn_candidates, sizes.gate.scene_experts) == (257, 257, 8)
    assert sizes.field.encoding.kind == sizes.gate.encoding.kind == "frequency"
    assert experts.empty_expert == "identity" and left_open(sizes) == []


def test_the_default_leaves_sizes_open_that_follow_the_scene_and_takes_the_rest_of_the_device() -> (
    None
):
    model: Any = leco_occupancy.config.pipeline.model
    largest = sizes_for(best_device())
    assert "field.encoding.log2_table" in left_open(model.sizes)
    assert model.sizes.candidates == largest.candidates
    assert model.sizes.field.experts.layers == largest.field.experts.layers
    assert leco_occupancy.config.max_num_iterations == STEPS


@pytest.mark.parametrize("name", METHODS)
def test_a_method_reads_checked_photographs_holds_pixels_back_and_ends_when_it_is_done(
    name: str,
) -> None:
    config: Any = METHODS[name].config
    assert config.method_name == name
    data = config.pipeline.datamanager
    assert data.dataparser._target is LecoPhotographs
    assert issubclass(data.pixel_sampler._target, HeldOutPixelSampler)
    assert config.machine.device_type == best_device()
    assert config.viewer.quit_on_train_completion


@pytest.mark.parametrize("name", METHODS)
def test_rates_of_all_groups_fall_towards_the_end_however_long_a_run_is_made(name: str) -> None:
    config: Any = METHODS[name].config
    assert config.optimizers.keys() == {"gate", "field", "encoding"}
    for group in config.optimizers.values():
        assert group["scheduler"] == CooldownSchedulerConfig(max_steps=0)
