"""nerfstudio's viewer reads a model before its first step; what is trained must be the same."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer_elements import ViewerElement
from tiny_run import tiny_trainer

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig

GATE = GateConfig(encoding=EncodingConfig(octaves=2), layers=1, width=8)

READ: dict[str, Callable[[Pipeline], Any]] = {
    "viewer": lambda pipeline: parse_object(pipeline, ViewerElement, "Custom Elements"),
    "estimator": lambda pipeline: pipeline.model.mixture.estimator(),
    "occupancy": lambda pipeline: pipeline.model.mixture.occupancy(),
}
"""Who reads the model before it is trained; the first as `nerfstudio.viewer.viewer.Viewer` does."""


def trained(scene: Path, outputs: Path, read: Callable[[Pipeline], Any]) -> dict[str, torch.Tensor]:
    """The weights after a few steps of a run whose model was read before them."""
    random.seed(0)
    torch.manual_seed(0)
    trainer = tiny_trainer(scene, outputs, GATE, candidates=32)
    read(trainer.pipeline)
    torch.manual_seed(1)
    for step in range(3):
        trainer.pipeline.train()
        trainer.train_iteration(step)
    return {name: weights.detach() for name, weights in trainer.pipeline.model.named_parameters()}


@pytest.mark.parametrize("reader", READ)
def test_a_model_that_is_read_is_trained_as_one_that_is_not(
    tiny_scene: Path, tmp_path: Path, reader: str
) -> None:
    alone = trained(tiny_scene, tmp_path / "alone", lambda pipeline: None)
    read = trained(tiny_scene, tmp_path / "read", READ[reader])
    assert {name for name in alone if not torch.equal(alone[name], read[name])} == set()
