"""Scenes that more than one test file of this room changes."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def scene(tiny_scene: Path, tmp_path: Path) -> Path:
    """The tiny scene, for one test to change."""
    return Path(shutil.copytree(tiny_scene, tmp_path / "scene"))
