"""What `leco swap` refuses before anything is read or trained."""

from __future__ import annotations

from pathlib import Path

import pytest
from ball_occupancy import ball

from leco_plugin.swap import swapped_config


def test_a_scene_that_is_not_there_is_said_before_the_run_has_a_folder(tmp_path: Path) -> None:
    file, scene = tmp_path / "occupancy.safetensors", tmp_path / "nowhere"
    ball().save(file)
    with pytest.raises(ValueError, match=f"there is no scene {scene}"):
        swapped_config("nerfacto", file, ["--data", str(scene)])
    scene.mkdir()
    assert swapped_config("nerfacto", file, ["--data", str(scene)]).data == scene
