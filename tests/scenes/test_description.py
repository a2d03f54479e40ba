"""Claims about what tells one scene from another."""

from __future__ import annotations

from pathlib import Path

from leco_plugin.scenes.photographs import describe_scene


def test_scenes_are_told_apart_by_what_is_in_them(tiny_scene: Path, tmp_path: Path) -> None:
    seen = describe_scene(tiny_scene)
    assert seen == describe_scene(tiny_scene / "transforms.json")
    assert seen["name"] == tiny_scene.name and seen["images"] == 9
    moved = tmp_path / tiny_scene.name
    moved.mkdir()
    (moved / "images").symlink_to(tiny_scene / "images")
    text = (tiny_scene / "transforms.json").read_text()
    (moved / "transforms.json").write_text(text.replace('"fl_x": 32.0', '"fl_x": 33.0'))
    assert describe_scene(moved)["digest"] != seen["digest"]
