"""`leco poses`: from a folder of photographs to a scene with poses, points and metres."""

from __future__ import annotations

import hashlib
import json
import shutil
import time
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from leco_plugin.log import first_of, resumable
from leco_plugin.scenes.input_error import InputError, one_line
from leco_plugin.scenes.poses import ASKED
from leco_plugin.scenes.poses import georeference as world
from leco_plugin.scenes.poses.georeference import MODEL, POINTS, Placement, points_of, poses_of
from leco_plugin.scenes.poses.originals import (
    Photograph,
    copy_photographs,
    find_photographs,
    without_repeats,
)
from leco_plugin.scenes.poses.reconstruction import (
    ENTERED,
    MODELS,
    Lens,
    Reconstructor,
    check_options,
    choose_pairs,
    load_pycolmap,
    require_disk,
)
from leco_plugin.scenes.scene_file import NO_SCENE, load_json
from leco_plugin.scenes.whole_files import alone_in, remove_parts, write_json

REPORT = "poses.json"
"""In the folder of the scene: what came of what was asked for."""
FORMAT, DESCRIPTION = 2, "transforms.json"
GPS, BEFORE = "gps", "transforms.before_gps.json"
"""What of it says the photographs' GPS; and transforms.json as it was, where that was mended."""
GROWTH = 3
"""Bytes of a copy that is written anew over those of its original: of JPEG 1.7 to 2.1 were seen."""
WRONG = 50.0
"""Metres from its pose beyond which a position by GPS is no scatter: its photograph is named."""
ASTRAY = 10.0
"""Distance from its pose, in medians of all and at least as many metres, from which on a position
does not scatter as the others do: its photograph is named too."""
FEW_PLACED = 0.8
"""Share of the photographs up to which a line says what places more."""
NAMED = 5
"""Photographs that are named in a line; the report names all."""


def make_scene(
    folder: Path, out: Path, lens: Lens = "perspective", size: int = 1600, threads: int = 0
) -> dict[str, Any]:
    """Makes a scene of photographs, or goes on with it, unless `out` holds it; returns the report.
    Features are looked for at a longest side of `size` pixels; 0 threads are all. InputError if
    `out` holds something else, or the photographs cannot be used; ImportError without pycolmap."""
    check_options(size, threads)
    pycolmap = load_pycolmap()
    folder, out, began = folder.resolve(), out.resolve(), time.monotonic()
    found = without_repeats(find_photographs(folder, out))
    asked = _asked(found.photographs, lens, size)
    if finished := _finished(out, asked):
        print(f"{out} already holds this scene: nothing is done")
        return finished
    with alone_in(out, "scene"), resumable():
        _begin(out, asked)
        _require_disk(out, found.photographs)
        found = copy_photographs(found, out / "images")
        for line in list(found.refused.values())[:NAMED]:
            print(f"left out: {line}")
        if (out / DESCRIPTION).exists():  # it was finished, and has lost files since
            if not (out / POINTS).is_file():
                points = points_of(pycolmap.Reconstruction(out / MODEL))
                world.write_sparse_points(out / POINTS, *points)
            return _read(out / REPORT) or {}
        photographs = found.photographs
        _require_disk(out, photographs)  # once more, as the size of copies was a guess
        exifs = [each.exif for each in photographs]
        origin, places = world.local_places(pycolmap, [exif.position for exif in exifs])
        chosen = choose_pairs([each.name for each in photographs], exifs, places)
        work = Reconstructor(out, photographs, threads)
        work.extract(lens, size)
        work.match(chosen)
        models = work.map()
        work.refine(models[0], lens)
        gps = {each.name: gps for each, gps in zip(photographs, places)}
        altitudes = any(each.position and np.isfinite(each.position[2]) for each in exifs)
        placement = _put_in_the_world(pycolmap, models[0], gps, altitudes)
        sources = {each.name: str(each.path.relative_to(folder)) for each in photographs}
        refused = {str(path.relative_to(folder)) for path in found.refused}
        repeats = {str(path.relative_to(folder)) for path in found.repeats}
        report = _report(models, sources, placement) | {
            "not_read": sorted(refused - repeats),
            "repeats": sorted(repeats),
            "altitudes": altitudes,
            "pairs": len(chosen.pairs),
            "pairs_by": chosen.reason,
            "seconds": round(time.monotonic() - began, 1),
        }
        write_json(out / REPORT, report, indent=1)
        world.write_scene(out, models[0], world.transforms_of(models[0], placement, origin))
    return report


def _asked(photographs: list[Photograph], lens: Lens, size: int) -> dict[str, Any]:
    """What is asked for: JSON values, those of photographs and of their GPS as digests."""
    known = _digest([each.content for each in photographs])
    positions = _digest([each.exif.position for each in photographs])
    asked = {"format": FORMAT, "photographs": len(photographs), "digest": known}
    return {**asked, GPS: positions, "lens": lens, "size": size}


def _digest(value: Any) -> str:
    return hashlib.blake2b(json.dumps(value).encode(), digest_size=8).hexdigest()


def _read(file: Path) -> dict[str, Any] | None:
    """What a file of JSON says; None where there is none. InputError for a damaged one."""
    try:
        return json.loads(file.read_text()) if file.is_file() else None
    except ValueError as error:
        fault = f"{file} is damaged ({one_line(error, 80)})"
        raise InputError(f"{fault}: give another folder with --out, or delete this one") from None


def _finished(out: Path, asked: dict[str, Any]) -> dict[str, Any] | None:
    """The report of a finished scene, or None. InputError if the folder holds something else."""
    found = _read(out / ASKED)
    if found is None:
        # a full disk leaves folders without a file, and others' programs hidden files
        if out.is_file() or any(path.is_file() and path.name[0] != "." for path in out.rglob("*")):
            raise InputError(f"--out {out} holds something else: give another folder")
        return None
    other = [name for name in asked if name != GPS and found.get(name) != asked[name]]
    if other and (out / ENTERED).exists():
        what = " and ".join(sorted({"photographs" if n == "digest" else n for n in other}))
        why = "by another version" if "format" in other else f"with other {what}"
        raise InputError(f"--out {out} was begun {why}: give another folder, or delete it")
    if found != asked or not (out / DESCRIPTION).is_file() or not (out / POINTS).is_file():
        return None
    try:
        images = [out / frame["file_path"] for frame in load_json(out / DESCRIPTION)["frames"]]
    except NO_SCENE as error:  # it may have been edited
        fault = f"{out / DESCRIPTION} is no scene ({type(error).__name__}: {one_line(error, 80)})"
        raise InputError(f"{fault}: mend it, or delete it to have it written anew") from None
    return _read(out / REPORT) if all(image.is_file() for image in images) else None


def _begin(out: Path, asked: dict[str, Any]) -> None:
    """Begins a scene or goes on with it. Where GPS was mended since, or nothing but copies were
    made of other photographs, what follows from them is made anew; features and matches stay."""
    found = _read(out / ASKED)
    if found is not None and found != asked:
        if (out / ENTERED).exists():
            print("EXIF has other GPS than before: photographs are placed anew")
        shutil.rmtree(out / "images", ignore_errors=True)
        shutil.rmtree(out / MODELS, ignore_errors=True)
    can_be_restored = (out / REPORT).is_file() and any((out / x).exists() for x in (POINTS, MODEL))
    if (out / DESCRIPTION).exists() and (found != asked or not can_be_restored):
        (out / DESCRIPTION).replace(out / BEFORE)
    write_json(out / ASKED, asked)
    remove_parts(out)


def _require_disk(out: Path, photographs: list[Photograph]) -> None:
    """InputError if the disk is too full for the copies that are not there yet, and features."""
    missing = [each for each in photographs if not (out / "images" / each.name).exists()]
    copies = sum(each.path.stat().st_size * (1 if each.is_copied else GROWTH) for each in missing)
    require_disk(out, len(photographs), copies, "--out")


def _put_in_the_world(pycolmap: Any, model: Any, gps: dict[str, Any], altitudes: bool) -> Placement:
    """Moves a model upright, and to metres where GPS allows it, by its altitudes if it has some."""
    names, poses = poses_of(model)
    up = world.upright(poses, points_of(model)[0])
    known, top = np.array([gps[name] for name in names]), poses[:, :, 1].mean(axis=0)
    edges = {"top": top, "rights": poses[:, :, 0]}
    placed = world.place(pycolmap, poses[:, :, 3], known, up, **edges, altitudes=altitudes)
    model.transform(pycolmap.Sim3d(placed.scale, pycolmap.Rotation3d(placed.turn), placed.shift))
    return placed


def _report(models: list[Any], sources: dict[str, str], placement: Placement) -> dict[str, Any]:
    blocks = [{sources[name] for name in poses_of(model)[0]} for model in models]
    lost = sorted({*sources.values()} - blocks[0])
    residuals = placement.residuals
    gps: dict[str, Any] = {"used": residuals is not None, "reason": placement.reason}
    gps["level"] = placement.level
    if residuals is not None:
        names = [sources[name] for name in poses_of(models[0])[0]]
        gps["contradicted"] = [name for name, off in zip(names, residuals) if off > WRONG]
        known = residuals[residuals <= WRONG]
        median, most = (round(float(part(known)), 3) for part in (np.median, np.max))
        usual = ASTRAY * max(1.0, median)
        gps["astray"] = [name for name, off in zip(names, residuals) if usual < off <= WRONG]
        gps |= {"photographs": len(known), "median_metres": median, "most_metres": most}
    return {
        "format": 1,
        "photographs": len(sources),
        "placed": len(blocks[0]),
        "not_placed": lost,
        "other_blocks": [sorted(block - blocks[0]) for block in blocks[1:] if block - blocks[0]],
        "points": models[0].num_points3D(),
        "reprojection_error": round(models[0].compute_mean_reprojection_error(), 3),
        "gps": gps,
    }


def summary(report: dict[str, Any]) -> list[str]:
    """Lines that say what came of the photographs, and what to do."""
    count, placed = report["photographs"], report["placed"]
    lines = [
        f"{placed} of {count} photographs are placed, with {report['points']} points "
        f"({report['reprojection_error']:.2f} pixels mean error)"
    ]
    if unread := report["not_read"]:
        lines.append(f"left out, as they cannot be read: {_some(unread)}")
    if repeats := report.get("repeats"):
        lines.append(f"left out, as copies of others: {_some(repeats)}")
    if lost := report["not_placed"]:
        lines.append(f"not placed: {_some(lost)}")
    if blocks := report["other_blocks"]:
        named = "; ".join(_some(block) for block in blocks[:NAMED])
        lines.append(
            f"{len({*chain(*blocks)})} of these fit together only in groups of their own, which "
            f"share too little with the rest: {named}; for a scene of such a group, give leco "
            "poses a folder with its photographs alone"
        )
    if placed <= FEW_PLACED * count:
        lines.append("more overlap between neighbours places more photographs")
    gps = report["gps"]
    if gps["used"]:
        off = f"{gps['median_metres']:.2f} m (median) and {gps['most_metres']:.2f} m at most"
        known = f"in metres by the GPS of {gps['photographs']} photographs"
        lines.append(f"{known}: they are off by {off}")
        if not report["altitudes"]:
            lines.append("EXIF gives no altitude: heights count from the cameras, not the sea")
        elif gps.get("level"):
            wrong = "altitudes in EXIF contradict the poses: heights are by their median alone"
            lines.append(f"{wrong}, and up is what cameras and ground say")
        if astray := gps.get("astray"):
            much = f"{len(astray)} of these are off much farther than the rest"
            lines.append(f"{much}, as with another zoom or wrong GPS: {_some(astray)}")
        if wrong := gps["contradicted"]:
            much = f"GPS contradicts the poses by more than {WRONG:.0f} m"
            lines.append(f"{much}, and is not used, of {_some(wrong)}")
    else:
        lines.append(f"no metres: {gps['reason']}")
    return lines


def _some(names: list[str]) -> str:
    return first_of(names, NAMED, f"more ({REPORT} has all)")
