"""nerfstudio's viewer reads a model before its first step; what is trained must be the same. In a
browser it opens on a training view, and shows what an occupancy keeps."""

from __future__ import annotations

import io
import random
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import viser
from browser import Page, needs_chromium, open_page
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.viewer.utils import parse_object
from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO, Viewer
from nerfstudio.viewer.viewer_elements import ViewerElement
from PIL import Image
from tiny_run import tiny_trainer

from leco_plugin.models.encodings import EncodingConfig
from leco_plugin.models.gate import GateConfig
from leco_plugin.studio.viewer import stop_drawing

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


TICK = """(() => {
  const label = [...document.querySelectorAll("label")].find(l => l.innerText.startsWith("Kept"));
  document.getElementById(label.htmlFor).click();
})()"""
"""Ticks "Kept, skipped, unseen"."""
PICTURE = (slice(120, 560), slice(40, 900))
"""Rows and columns of the page in which neither bars nor panels are."""


def shown(page: Page, folder: Path) -> np.ndarray:
    """The part of the page with the picture, [H, W, 3] uint8."""
    png = page.screenshot(folder / "page.png").read_bytes()
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))[PICTURE].astype(int)


def stop(server: viser.ViserServer) -> None:
    """Stops a server with its threads, which outlive it by themselves."""
    stop_drawing()
    loop = server._websock_server._broadcast_buffer.event_loop
    server.stop()
    loop.call_soon_threadsafe(loop.stop)
    deadline = time.monotonic() + 10.0
    while loop.is_running() and time.monotonic() < deadline:
        time.sleep(0.05)
    loop.close()


@needs_chromium
@pytest.mark.long
@pytest.mark.timeout(150)
# as an error in viser's thread it would leave the viewer waiting for its server
@pytest.mark.filterwarnings("ignore:websockets:DeprecationWarning")
def test_a_browser_opens_on_a_training_view_and_shows_what_is_kept(
    tiny_scene: Path, tmp_path: Path
) -> None:
    trainer = tiny_trainer(tiny_scene, tmp_path, GATE, candidates=32)
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    model.mixture.freeze(0.0, {})
    lock = threading.Lock()
    where = (tmp_path / "log" / "viewer", tiny_scene, pipeline)
    viewer: Any = Viewer(trainer.config.viewer, *where, train_lock=lock)
    try:
        viewer.init_scene(pipeline.datamanager.train_dataset, "completed")
        viewer.set_camera_visibility(False)
        viewer.control_panel._max_res.value = 64
        address = f"http://127.0.0.1:{viewer.viser_server.get_port()}"
        with open_page(address, tmp_path / "profile") as page:
            page.wait_for(lambda: viewer.viser_server.get_clients(), 60.0)
            (client,) = viewer.viser_server.get_clients().values()
            places = pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :, 3]

            def distance() -> float:
                place = torch.tensor(client.camera.position) / VISER_NERFSTUDIO_SCALE_RATIO
                return float((places - place).norm(dim=-1).min())

            page.wait_for(lambda: distance() < 0.1, 60.0)
            page.wait_for(lambda: shown(page, tmp_path).std() > 2.0, 60.0)
            plain = shown(page, tmp_path)
            page.evaluate(TICK)
            page.wait_for(lambda: np.abs(shown(page, tmp_path) - plain).mean() > 10.0, 60.0)
            green = shown(page, tmp_path).mean(axis=(0, 1)) - plain.mean(axis=(0, 1))
            assert model.leco_view.overlay.value and green.argmax() == 1 and page.errors == []
    finally:
        stop(viewer.viser_server)
