"""Fixtures that more than one test file uses, and the markers that skip what this machine lacks."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import tiny_scene as tiny_scene_writer
import torch


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    without_scenes = pytest.mark.skip(reason="LECO_SCENES does not name a folder of real scenes")
    without_gpu = pytest.mark.skip(reason="there is no CUDA device")
    for item in items:
        if (
            item.get_closest_marker("scenes")
            and not Path(os.environ.get("LECO_SCENES", "/nowhere")).is_dir()
        ):
            item.add_marker(without_scenes)
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(without_gpu)


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a scene of nine 32 x 32 images in nerfstudio's format."""
    return tiny_scene_writer.write(tmp_path_factory.mktemp("tiny_scene") / "ball")


@pytest.fixture(scope="session")
def scenes() -> Path:
    """Folder of real scenes; for tests marked `scenes`."""
    return Path(os.environ["LECO_SCENES"])
