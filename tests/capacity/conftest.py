"""Small sizes, which all tests of this room share."""

from __future__ import annotations

from pathlib import Path

import pytest

from leco_plugin.capacity import references, search
from leco_plugin.capacity.sources import Source, find_source
from leco_plugin.learning import sharpening
from leco_plugin.occupancy import Occupancy


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps and positions, and no more rays than tiny photographs can give."""
    monkeypatch.setattr(references, "RAYS", 1500)
    monkeypatch.setattr(search, "STEPS", 200)
    monkeypatch.setattr(search, "VOLUME_POINTS", 1 << 14)
    monkeypatch.setattr(search, "TAUGHT_POINTS", 1 << 14)
    monkeypatch.setattr(sharpening, "BATCH", 4096)


@pytest.fixture
def file(known_run: Path) -> Path:
    """What a known run has left."""
    return known_run / "occupancy.safetensors"


@pytest.fixture
def known(file: Path, tiny_scene: Path) -> tuple[Source, Occupancy]:
    """Its photographs with its model, and its occupancy."""
    return find_source(file, tiny_scene), Occupancy.load(file)
