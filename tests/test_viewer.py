"""nerfstudio's viewer reads a model before its first step; what is trained must be the same. In a
browser it shows the controls of an occupancy."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from browser import needs_chromium, open_page
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
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


@needs_chromium
@pytest.mark.slow
def test_a_browser_opens_on_a_training_view_and_shows_the_controls(
    tiny_scene: Path, tmp_path: Path
) -> None:
    trainer = tiny_trainer(tiny_scene, tmp_path, GATE, candidates=32)
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    model.mixture.freeze(0.25, {})
    viewer: Any = Viewer(
        trainer.config.viewer,
        tmp_path / "log" / "viewer",
        tiny_scene,
        pipeline,
        None,
        threading.Lock(),
    )
    try:
        viewer.init_scene(pipeline.datamanager.train_dataset, "completed")
        viewer.update_scene(0)
        address = f"http://127.0.0.1:{viewer.viser_server.get_port()}"
        with open_page(address, tmp_path / "profile") as page:
            page.wait_for(lambda: viewer.viser_server.get_clients() and page.errors == [])
            (client,) = viewer.viser_server.get_clients().values()
            places = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :, 3]

            def distance() -> float:
                place = torch.tensor(client.camera.position) / VISER_NERFSTUDIO_SCALE_RATIO
                return float((places - place).norm(dim=-1).min())

            page.wait_for(lambda: distance() < 0.1)
            # the first picture tells the slider of the threshold that the run has
            page.wait_for(lambda: model.leco_view.keep_from.value == 0.25)
            shown = page.evaluate("document.body.innerText")
            assert "Keep o(x) from" in shown and "Kept, skipped, unseen" in shown
    finally:
        viewer.viser_server.stop()
