"""What a scene is called, and what tells it from another of that name."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from leco_plugin.scenes.photographs import check_scene, folder_of


def describe_scene(data: Path) -> dict[str, Any]:
    """Name, number of images, and what tells the scene from another: JSON values.

    Raises:
        InputError: it is no scene that can be read.
    """
    meta = check_scene(data)
    description = data if data.suffix == ".json" else data / "transforms.json"
    digest = hashlib.sha256(description.read_bytes()).hexdigest()
    name = folder_of(data).resolve().name
    return {"name": name, "images": len(meta["frames"]), "digest": digest[:16]}
