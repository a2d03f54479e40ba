"""A run of `leco-occupancy` that is known, for whatever asks one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from ball_occupancy import THEIR_MARCH, ball_of_the_tiny_scene
from tiny_run import tiny_trainer

from leco_plugin.scenes.frames import frame_of
from leco_plugin.shrink import references


@pytest.fixture(scope="session")
def known_run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of `leco-occupancy`: its frozen gate is the ball, its field is opaque."""
    outputs, gate = tmp_path_factory.mktemp("outputs"), ball_of_the_tiny_scene().gate.config
    torch.manual_seed(0)  # what a shrunk gate loses of an untrained field is anything
    trainer = tiny_trainer(tiny_scene, outputs, gate, candidates=64)
    model, frame = trainer.pipeline.model, frame_of(trainer.pipeline.datamanager)
    assert frame is not None
    known = ball_of_the_tiny_scene(frame)
    model.gate.load_state_dict(known.gate.state_dict())
    model.space.load_state_dict(known.space.state_dict())
    model.threshold.fill_(known.threshold)
    model.frozen.fill_(True)
    with torch.no_grad():
        model.field.density_head.bias.fill_(6.0)
    near, far, step_size, cone_angle = THEIR_MARCH.values()
    model.march_range.copy_(torch.tensor([near, far, step_size, step_size, cone_angle, cone_angle]))
    model.report = THEIR_MARCH | {"lost_surface_mass": 1e-4}
    model.occupancy().save(trainer.base_dir / "occupancy.safetensors")
    trainer.save_checkpoint(0)
    return Path(trainer.base_dir)


@pytest.fixture(autouse=True)
def fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many as tiny photographs can give without being asked for again and again."""
    monkeypatch.setattr(references, "RAYS", 1500)
