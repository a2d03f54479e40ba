"""Which of nerfstudio's readers, or which of its converters, a folder is for."""

from __future__ import annotations

import shlex
import sys
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
PICTURES = "*.[jJpP][pPnN]*[gG]"
CONVERTERS = {
    "keyframes": "polycam",
    "opensfm": "odm",
    "odm_report": "odm",
    "rgb": "record3d",
    "EXR_RGBD": "record3d",
    "*.xml": "metashape --xml FILE.xml",
    "*.csv": "realitycapture --csv FILE.csv",
    PICTURES: "images",
    "images": "images",
}
"""What lies in a folder, and which of ns-process-data's commands is for it."""
METHOD = "leco-occupancy"
"""Named where none was typed."""


def command_with(reader: str, data: Path) -> str | None:
    """The command that was typed, with a reader of this name and its options; None where the
    command takes no reader."""
    program, typed = Path(sys.argv[0]).name, sys.argv[1:]
    given = f"--data {shlex.quote(str(data))} {reader}"
    if program == "leco":
        if typed[:1] != ["swap"]:
            return None
        own = typed[: typed.index("--")] if "--" in typed else typed
        return f"{shlex.join(['leco', *own])} -- {given}"
    if program.startswith("ns-") and program != "ns-train":
        return None
    named = program == "ns-train" and typed and typed[0][:1] != "-"
    return f"ns-train {shlex.quote(typed[0]) if named else METHOD} {given}"


def has_model(folder: Path) -> bool:
    """Whether a folder holds a model of COLMAP."""
    return any((folder / f"cameras.{ending}").is_file() for ending in ("bin", "txt"))


def _readers_for(folder: Path) -> list[str]:
    """Readers that may read a folder, each with its options."""
    found = [reader for sign, reader in READERS.items() if (folder / sign).is_file()]
    for place in COLMAP:
        if has_model(folder / place):
            path = "" if place == COLMAP[0] else f" --colmap-path {place}"
            return [*found, f"colmap{path}{_images_option(folder)}"]
    return found


def _images_option(folder: Path) -> str:
    """Where the pictures of a model of COLMAP are, if not in `images`."""
    if (folder / "images").is_dir():
        return ""
    beside = [folder, *sorted(each for each in folder.iterdir() if each.is_dir())]
    place = next((each for each in beside if any(each.glob(PICTURES))), None)
    return "" if place is None else f" --images-path {shlex.quote(str(place.relative_to(folder)))}"


def _converter_for(data: Path) -> str | None:
    """The command that makes a scene of a folder; None where none is known."""
    if not data.is_dir():
        return None
    for sign, kind in CONVERTERS.items():
        if any(data.glob(sign)):
            source = data / "images" if sign == "images" else data
            command, *options = kind.split()
            place = next((each for each in COLMAP if (data / each / "cameras.bin").is_file()), None)
            if command == "images" and place is None:
                return f"leco poses {shlex.quote(str(source))} --out SCENE"
            given = [command, "--data", shlex.quote(str(source)), *options]
            if command == "images" and place is not None:
                model = shlex.quote(str((data / place).resolve()))
                given += ["--skip-colmap", "--colmap-model-path", model]
            return " ".join(["ns-process-data", *given, "--output-dir", "SCENE"])
    return None


def remedy_for(data: Path) -> str | None:
    """What to do about a folder that lacks the files of the reader it was given to; None where
    nothing is known."""
    known = [(reader, folder) for folder in (data, data.parent) for reader in _readers_for(folder)]
    for reader, folder in known:
        if command := command_with(reader, folder):
            return f"`{command}` reads it"
    if known and "colmap" not in known[0][0]:
        return f"it is for the reader {known[0][0]}, and this command reads a transforms.json only"
    converter = _converter_for(data)
    return None if converter is None else f"`{converter}` makes a scene of it"
