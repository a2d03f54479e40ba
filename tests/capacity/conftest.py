"""Small sizes, which all tests of this room share."""

from __future__ import annotations

import copy
import hashlib
from pathlib import Path
from typing import Any

import pytest

from leco_plugin.capacity import references, search
from leco_plugin.capacity.sources import Source, find_source
from leco_plugin.learning import sharpening
from leco_plugin.models.gate import Gate, GateConfig
from leco_plugin.occupancy import Occupancy

TAUGHT: dict[str, Gate] = {}
"""Gates that a search has had taught, by all that decides what they learn."""


def teach_once(
    config: GateConfig, lesson: sharpening.Lesson, *settings: Any, on_progress: Any = None
) -> Gate:
    """The gate that `sharpening.teach` returns, which is the same each time for the same lesson:
    taught by the first test that wants it."""
    heard = b"".join(part.detach().cpu().numpy().tobytes() for part in lesson)
    known = (config, settings, sharpening.BATCH, hashlib.sha256(heard).hexdigest())
    if (key := repr(known)) not in TAUGHT:
        TAUGHT[key] = sharpening.teach(config, lesson, *settings, on_progress=on_progress)
    elif on_progress is not None:
        on_progress(1.0)
    return copy.deepcopy(TAUGHT[key])


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few steps and positions, no more rays than tiny photographs can give, and a search has the
    same gate taught once."""
    monkeypatch.setattr(search, "teach", teach_once)
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
