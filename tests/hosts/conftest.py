"""One scene through several readers."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from scene_readers import Data


@pytest.fixture(scope="module")
def tilted(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny scene without a word on its orientation: each reader turns it in its own way."""
    folder = tmp_path_factory.mktemp("tilted") / "ball"
    shutil.copytree(tiny_scene, folder)
    description = folder / "transforms.json"
    scene = json.loads(description.read_text())
    del scene["orientation_override"]
    description.write_text(json.dumps(scene))
    return folder


@pytest.fixture(scope="module")
def readers(tilted: Path) -> dict[str, Data]:
    """Readers of one scene, each with coordinates of its own."""
    options: dict[str, dict[str, Any]] = {
        "as it is": {"orientation_method": "none", "center_method": "none"},
        "turned by pca": {"orientation_method": "pca", "scale_factor": 0.4},
        "turned up": {"orientation_method": "up", "center_method": "focus"},
    }
    return {
        name: Data(NerfstudioDataParserConfig(data=tilted, **values))
        for name, values in options.items()
    }


@pytest.fixture
def data(readers: dict[str, Data]) -> Data:
    """The scene in its own coordinates."""
    return readers["as it is"]
