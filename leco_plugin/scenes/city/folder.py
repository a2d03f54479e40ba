"""The city as a scene on disk: written once, never seen half done, and taken up again when killed.

How the pictures lie there is the business of `layouts`; beside them
city.json          the configuration, from which the exact geometry is built again
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import leco_plugin
from leco_plugin.scenes.city.cameras import CaptureConfig, View, views_of
from leco_plugin.scenes.city.city import DESCRIPTION, City, CityConfig, read_description
from leco_plugin.scenes.city.layouts import (
    LAYOUTS,
    MAPPINGS,
    PARTS,
    TRANSFORMS,
    Layout,
    LayoutName,
    with_alpha,
)
from leco_plugin.scenes.input_error import one_line
from leco_plugin.scenes.whole_files import remove_parts, write_whole

__all__ = ["CaptureConfig", "count_pictures", "read_transforms", "write_city"]


def write_city(
    config: CityConfig,
    out_dir: Path | str,
    capture: CaptureConfig | None = None,
    progress: bool = True,
    layout: LayoutName = "nerfstudio",
) -> Path:
    """Writes the city as a scene, unless `out_dir` already holds just that.

    The folder appears under its name only when it is complete. Until then the pictures lie in a
    hidden folder beside it; a run that was killed is taken up there, and several may work on it.

    Args:
        config: the city.
        out_dir: the folder to write; its parents are made.
        capture: how it is photographed, by default about 60 small aerial pictures for 3 blocks.
        progress: whether to show a bar.
        layout: in which format.
    Returns:
        `out_dir`.
    Raises:
        FileExistsError: `out_dir` holds something else, and is left alone.
        ValueError: `out_dir` holds a damaged city, and is left alone.
    """
    out_dir, capture = Path(out_dir), capture or CaptureConfig()
    parts = {"city": dataclasses.asdict(config), "capture": dataclasses.asdict(capture)}
    wanted = {"format": 1, **parts, "layout": layout}
    text = json.dumps(wanted, indent=2) + "\n"
    if _holds(out_dir, wanted):
        return out_dir
    city = City(config)
    views = views_of(city, capture)
    files = LAYOUTS[layout](views, capture.lens, config.seed)
    unfinished = _unfinished(out_dir, text)
    unfinished.mkdir(parents=True, exist_ok=True)
    try:
        _photograph(city, views, files, unfinished, capture, progress)
        files.finish(unfinished)
        write_whole(unfinished / DESCRIPTION, lambda file: file.write(text.encode()))
        remove_parts(unfinished)
        unfinished.replace(out_dir)
    except OSError:
        # Somebody else may have finished the same city in the meantime.
        if not _holds(out_dir, wanted):
            raise
        shutil.rmtree(unfinished, ignore_errors=True)
    return out_dir


def _unfinished(out_dir: Path, description: str) -> Path:
    """Where a city of this description waits to be completed, if this version has drawn it."""
    drawn = f"{leco_plugin.__version__} {description}".encode()
    digest = hashlib.blake2b(drawn, digest_size=4).hexdigest()
    return out_dir.parent / f".{out_dir.name}-unfinished-{digest}"


def _photograph(
    city: City,
    views: list[View],
    layout: Layout,
    folder: Path,
    capture: CaptureConfig,
    progress: bool,
) -> None:
    """Takes the pictures that are not there yet, one by one."""
    from rich.progress import track

    from leco_plugin.scenes.city.render import Tracer

    def missing(view: View) -> bool:
        return not all((folder / path).is_file() for path in layout.files(view))

    wanted = [view for view in views if missing(view)]
    if not wanted:
        return
    tracer, there = Tracer(city), len(views) - len(wanted)
    what = "Photographing the city" + (f" ({there} of {len(views)} are there)" if there else "")
    for view in track(wanted, what, transient=True, disable=not progress):
        if missing(view):  # another process may work on the same city
            image, depth = tracer.photograph(view.pose, capture.lens)
            image = image if city.config.sky else with_alpha(image, depth)
            layout.write(folder, view, image, depth)


def _holds(folder: Path, wanted: dict[str, Any]) -> bool:
    """Whether `folder` holds these pictures of this city; False if there is nothing yet."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return False
    if not (folder / DESCRIPTION).is_file():
        raise FileExistsError(f"{folder} exists and is not a city: choose another folder")
    found = read_description(folder)
    there, asked = (
        {**one["city"], **one["capture"], "layout": one["layout"]} for one in (found, wanted)
    )
    for name, value in asked.items():
        if there.get(name) != value:
            raise FileExistsError(
                f"{folder} holds another city ({name} is {there.get(name)} there, not {value}): "
                "choose another folder"
            )
    missing = _first_missing(folder, wanted["layout"])
    if missing is not None:
        raise ValueError(
            f"{folder} is damaged: {missing} is missing; delete the folder to write it anew"
        )
    return True


def _first_missing(folder: Path, layout: LayoutName) -> str | None:
    """A file that a finished city names and does not hold."""
    if layout == "nerfstudio":
        frames = read_transforms(folder)["frames"]
        paths = [str(frame[key]) for frame in frames for key in ("file_path", "depth_file_path")]
        return next((path for path in paths if not (folder / path).is_file()), None)
    if not (folder / MAPPINGS).is_file():
        return MAPPINGS
    there = {f"{path.parent.name}/{path.name}" for path in folder.glob("*/*/*")}
    lines = (folder / MAPPINGS).read_text(errors="replace").splitlines()
    stems = [Path(line.rsplit(",", 1)[-1]).stem for line in lines]
    paths = [f"{part}/{stem}.{ending}" for stem in stems for part, ending in PARTS]
    return next((path for path in paths if path not in there), None)


def count_pictures(folder: Path) -> tuple[int, int]:
    """How many pictures a finished city has, and how many of them are held out."""
    if read_description(folder)["layout"] == "mega-nerf":
        splits = [len(list((folder / split / "rgbs").iterdir())) for split in ("train", "val")]
        return sum(splits), splits[1]
    transforms = read_transforms(folder)
    return len(transforms["frames"]), len(transforms["test_filenames"])


def read_transforms(folder: Path) -> dict[str, Any]:
    """A city's `transforms.json`. ValueError, in one line, if it is incomplete."""
    try:
        transforms = json.loads((folder / TRANSFORMS).read_text())
        needed = {"file_path", "depth_file_path", "transform_matrix"}
        if not all(needed <= set(frame) for frame in transforms["frames"]):
            raise ValueError("a frame is incomplete")
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{folder} is damaged: {TRANSFORMS}: {one_line(error)}"
        raise ValueError(message) from error
    return dict(transforms)
