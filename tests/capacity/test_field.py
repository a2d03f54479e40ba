"""Claims about the field that teaches all representations, and about its rays."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
import torch

from leco_plugin.capacity import measuring
from leco_plugin.scenes.city.cameras import CaptureConfig
from leco_plugin.scenes.city.city import CityConfig
from leco_plugin.scenes.city.folder import write_city


def test_resuming_has_the_same_rays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also whoever has learned the field, with rays to sparse points, and whatever was drawn
    between."""
    capture = CaptureConfig(24, 18, aerial_per_block=12.0, street_per_block=0.0)
    city = write_city(CityConfig(1), tmp_path / "city", capture, progress=False)
    monkeypatch.setattr(measuring, "RAYS", 128)
    monkeypatch.setattr(measuring, "TAUGHT_RAYS", 256)
    monkeypatch.setattr(measuring, "VOLUME_POINTS", 512)
    first = measuring.prepare(city, tmp_path, learn_steps=4)
    random.random()
    torch.rand(7)
    again = measuring.prepare(city, tmp_path, learn_steps=4)
    for one, other in (
        (first.lesson.mapped, again.lesson.mapped),
        (first.lesson.keep, again.lesson.keep),
        (first.held_out.positions, again.held_out.positions),
        (first.volume, again.volume),
    ):
        assert torch.equal(one, other)
