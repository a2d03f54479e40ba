"""Which of nerfstudio's readers, or which of its converters, a folder is for."""

from __future__ import annotations

import shlex
from pathlib import Path

COLMAP = ("colmap/sparse/0", "sparse/0", "sparse", "colmap/sparse", "0", ".")
"""Where COLMAP's own files lie, in the order they are looked for."""
READERS = {
    "transforms.json": "leco-photographs",
    "transforms_train.json": "blender-data",
    "coordinates.pt": "mega-nerf",
    "dslr/nerfstudio/transforms.json": "scannetpp-data",
    "intrinsic/intrinsic_color.txt": "scannet-data",
    "meta_data.json": "sdfstudio-data",
    "scene.json": "dycheck-data",
    "train.npz": "minimal-parser",
}
CONVERTERS = {
    "keyframes": "polycam",
    "opensfm": "odm",
    "odm_report": "odm",
    "rgb": "record3d",
    "EXR_RGBD": "record3d",
    "*.xml": "metashape --xml FILE.xml",
    "*.csv": "realitycapture --csv FILE.csv",
    "*.[jJ][pP]*[gG]": "images",
    "images": "images",
}
"""What lies in a folder, and which of ns-process-data's commands makes a scene of it."""


def _commands_for(folder: Path) -> list[tuple[str, str]]:
    """Readers that may read a folder, each with the command that a user types."""
    given = f"--data {shlex.quote(str(folder))}"
    found = [
        (reader, f"ns-train METHOD {given} {reader}")
        for sign, reader in READERS.items()
        if (folder / sign).is_file()
    ]
    for place in COLMAP:
        if any((folder / place / f"cameras.{ending}").is_file() for ending in ("bin", "txt")):
            path = "" if place == COLMAP[0] else f" --colmap-path {place}"
            found.append((f"colmap {place}", f"ns-train METHOD {given} colmap{path}"))
            break
    return found


def converter_for(data: Path) -> str | None:
    """The command of ns-process-data that makes a scene of a folder; None where none is known."""
    if not data.is_dir():
        return None
    for sign, kind in CONVERTERS.items():
        if any(data.glob(sign)):
            source = data / "images" if sign == "images" else data
            command, *options = kind.split()
            given = [command, "--data", shlex.quote(str(source)), *options]
            return " ".join(["ns-process-data", *given, "--output-dir", "SCENE"])
    return None


def remedy_for(data: Path, used: str) -> str | None:
    """What to do about a folder that a reader does not read; None is not known.

    Args:
        used: name of the reader; of `colmap` with its path, as `colmap sparse/0`.
    """
    known = [each for folder in (data, data.parent) for each in _commands_for(folder)]
    others = [command for reader, command in known if reader != used]
    if others:
        doubt = ", or names what is wrong" if READERS["transforms.json"] in others[0] else ""
        return f"`{others[0]}` reads it{doubt}"
    converter = None if known else converter_for(data)
    return None if converter is None else f"`{converter}` makes a scene of it"
